"""Averages over one interval of functions of time, by Gauss' rule in panels that are doubled until two rules agree."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
_ORDER = 4  # Gauss nodes in a panel
_FIRST, _LAST = 16, 4096  # panels from which on two rules are compared, and at most


class Average(NamedTuple):
    """The averages of f and of (1 - s) f, s = (t - start) / length.

    `panels` is the smallest number for which a rule agrees with the last; `error` is the relative difference of the last two.
    """

    whole: Array
    falling: Array
    panels: int
    error: float


@lru_cache(maxsize=16)
def panel_rule(panels: int) -> tuple[Array, Array]:
    """Return the places in [0, 1] and the weights, of sum one, of Gauss' rule in equal panels."""
    node, weight = np.polynomial.legendre.leggauss(_ORDER)
    places = (np.arange(panels)[:, None] + 0.5 * (node + 1.0)) / panels
    return places.ravel(), np.tile(0.5 * weight / panels, panels)


def average(function: Callable[[Array], Array], start: float, length: float, tolerance: float = 1e-10) -> Average:
    """Return the averages of a function of times (R,) with values (R, ...) over [start, start + length]."""
    rules: list[tuple[int, Array, Array]] = []
    panels = 1
    while True:
        places, weights = panel_rule(panels)
        values = function(start + length * places)
        whole = np.tensordot(weights, values, axes=(0, 0))
        falling = np.tensordot(weights * (1.0 - places), values, axes=(0, 0))
        rules.append((panels, whole, falling))
        if panels >= _FIRST:
            size = max(float(np.abs(whole.real).max(initial=0.0)), 1e-300)
            differences = [
                float(max(np.abs((whole - a).real).max(initial=0.0), np.abs((falling - b).real).max(initial=0.0))) / size
                for _, a, b in rules
            ]
            if differences[-2] <= tolerance or panels >= _LAST or not np.isfinite(size):
                good = [p for (p, _, _), difference in zip(rules, differences, strict=True) if difference <= tolerance]
                return Average(whole, falling, good[0], differences[-2])
        panels *= 2
