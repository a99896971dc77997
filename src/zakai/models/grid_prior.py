"""A prior by the logarithm of its density on a grid, as a function that formulas can hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray

from zakai.densities import GridDensity
from zakai.densities.as_prior import MOST_NUMBERS
from zakai.errors import InputError
from zakai.models._entries import array, kind_of
from zakai.models._errors import named
from zakai.models.functions import table_function

_OUTSIDE = -600.0  # the logarithm of the density outside of the grid, which falls from there on, so that a search finds it


class GridFunction:
    """The logarithm of a density on a grid, as a function of the n states; outside of the grid it is negligible."""

    name = "prior_density"
    degree = 1

    def __init__(self, density: GridDensity):
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
    density = GridDensity(values, centre, basis, tuple(map(str, states)), periodic)
    table = {"kind": "grid", "centre": centre.tolist(), "basis": basis.tolist(), "log_values": values.tolist()}
    return table_function(GridFunction(density))(*states), table  # type: ignore[arg-type]
