"""A prior by its density on a grid or between the ends of a domain, as a function that formulas can hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray

from zakai.densities import Density, GridDensity, IntervalDensity
from zakai.densities.as_prior import MOST_NUMBERS, mapped
from zakai.errors import InputError
from zakai.models._entries import array, items, kind_of, number
from zakai.models._errors import named
from zakai.models.functions import table_function

_OUTSIDE = -600.0  # the logarithm of the density outside of the grid, which falls from there on, so that a search finds it


class GridFunction:
    """The logarithm of a density, as a function of the n states; outside of its grid or its ends it is negligible."""

    name = "prior_density"
    degree = 1

    def __init__(self, density: Density):
        self.density = density
        self.axes = (None,) * len(density.names)  # of these a function class takes only the number
        self.functions: dict[tuple[int, ...], Any] = {}
        self._mean, self._whiten = density.mean(), np.linalg.inv(np.linalg.cholesky(density.cov()))

    def __call__(self, *arguments: Any, orders: tuple[int, ...] | None = None) -> NDArray[Any]:
        """Return the logarithm (...) at states that are given by coordinate."""
        if orders is not None and any(orders):
            raise InputError("prior: a density on a grid has no derivatives, which this method needs; give a formula")
        points = np.real(np.stack(np.broadcast_arrays(*arguments), axis=-1)).astype(float)
        flat = points.reshape(-1, points.shape[-1])
        bad = ~np.isfinite(flat).all(axis=1)
        flat = np.where(bad[:, None], self._mean, flat)
        apart = flat - self._mean
        apart = np.where(self.density.periodic, apart - 2 * np.pi * np.round(apart / (2 * np.pi)), apart)
        apart = np.clip(apart @ self._whiten.T, -1e150, 1e150)
        values = np.maximum(self.density.log_density(flat), _OUTSIDE - np.log1p(np.sum(apart**2, axis=1)))
        return np.where(bad, np.nan, values).reshape(points.shape[:-1])


def read_grid(
    keys: Mapping[str, Any], states: Sequence[sympy.Symbol], periodic: tuple[bool, ...]
) -> tuple[sympy.Expr, dict[str, Any]]:
    """Return the logarithm of the density of a prior on a grid as an expression, and the keys in plain numbers.

    Raises:
        InputError: a key has the wrong shape, or there is no density.
    """
    n = len(states)
    with named("centre"):
        centre = array(keys["centre"], (n,), f"a list of {n} numbers (one a state)")
    with named("basis"):
        basis = array(keys["basis"], (n, n), f"a {n} x {n} list of rows: the steps of the grid")
        if np.linalg.matrix_rank(basis) < n:
            raise InputError("its columns must be linearly independent steps")
    with named("log_values"):
        try:
            values = np.array(keys["log_values"], dtype=float)
        except (TypeError, ValueError):
            raise InputError(f"expected numbers on a full grid of {n} axes, got {kind_of(keys['log_values'])}") from None
        if values.ndim != n or values.size > MOST_NUMBERS or min(values.shape, default=0) < 2:
            raise InputError(f"expected at most {MOST_NUMBERS:,} numbers on a full grid of {n} axes; its shape is {values.shape}")
        if np.isnan(values).any() or not np.isfinite(values.max()):
            raise InputError("expected logarithms of a density: finite, or -inf where it is zero")
    grid = GridDensity(values, centre, basis, tuple(map(str, states)), periodic)
    table = {"kind": "grid", "centre": centre.tolist(), "basis": basis.tolist(), "log_values": values.tolist()}
    more: dict[str, Any] = {key: _number_of(keys, key) for key in ("lower", "upper") if keys.get(key) is not None}
    if more and (n > 1 or not more.get("lower", -np.inf) < more.get("upper", np.inf)):
        raise InputError("lower, upper: expected the natural ends of the domain of the only state, lower < upper")
    if keys.get("logarithms") is not None:
        chosen = list(keys["logarithms"]) if isinstance(keys["logarithms"], list | tuple) else []
        circle = any(angle and bool(one) for angle, one in zip(periodic, chosen, strict=False))
        if more or len(chosen) != n or not all(isinstance(one, bool) for one in chosen) or not any(chosen) or circle:
            raise InputError(f"logarithms: expected {n} booleans: of which states, no angles, the grid has the logarithm")
        more = {"logarithms": chosen}
    return table_function(GridFunction(mapped(grid, more)))(*states), {**table, **more}  # type: ignore[arg-type]


def _number_of(keys: Mapping[str, Any], key: str) -> float:
    with named(key):
        return float(number(keys[key]))


def read_interval(keys: Mapping[str, Any], states: Sequence[sympy.Symbol]) -> tuple[sympy.Expr, dict[str, Any]]:
    """Return the logarithm of the density of a prior between reflecting ends as an expression, and the keys in plain numbers.

    Raises:
        InputError: a key has the wrong shape, or there is no density.
    """
    if len(states) > 1:
        raise InputError(f"kind: an interval prior is for one state, and there are {len(states)}")
    with named("nodes"):
        count = len(items(keys["nodes"], None, "a list of numbers"))
    parts = {}
    for key in ("values", "nodes", "rule"):
        with named(key):
            parts[key] = array(keys[key], (count,), f"a list of {count} numbers")
    values, nodes, rule = parts.values()
    if not 2 <= len(nodes) <= MOST_NUMBERS or not (np.diff(nodes) > 0).all() or not (rule > 0).all():
        raise InputError("nodes, rule: expected increasing nodes and their positive weights, as model.with_prior writes them")
    if not np.sum(values * rule) > 0:
        raise InputError("values: expected a density with a positive integral")
    density = IntervalDensity(values, nodes, rule, (str(states[0]),))
    table = {"kind": "interval", **{key: part.tolist() for key, part in parts.items()}}
    return table_function(GridFunction(density))(*states), table  # type: ignore[arg-type]
