"""The terms of f and h on a grid, from which transitions are computed, and what a transition returns.

A term (4 + m, T) has the rows phi of Gaussian kernels or of a decomposition, the integral of f over the spacing above a point,
f, f' and h.  The functions of an interval are sums of terms with factors that depend on time.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.compiled import helper

Array = NDArray[Any]

PHI, CELL, DRIFT, SLOPE, OBSERVED = 0, 1, 2, 3, 4  # rows of a term


class Transition(NamedTuple):
    """The figures of a transition.

    `error` is that of a splitting, infinite where the transition failed; `rounding` the rounding error and `clipped` the largest
    value that may have become zero, relative to the maximum; `spread` the variance of its noise and `contraction` the factor of
    deviations; `needed` the spacing that filters of positive numbers need, where that of the grid is larger, else zero;
    `exponent` a constant of the logarithm of the mass.
    """

    error: float
    rounding: float
    clipped: float
    spread: float
    contraction: float
    needed: float
    exponent: float


@helper
def failed(spread: float, needed: float) -> Transition:
    """Return the figures of a transition that failed."""
    return Transition(np.inf, np.inf, 1.0, spread, 1.0, needed, 0.0)


@helper
def add(to: Array, weight: float, values: Array) -> None:
    """Add values with a weight."""
    for j in range(to.size):
        to[j] += weight * values[j]


@helper
def observation_of(table: Array, outputs: Array) -> Array:
    """Return h (m, N), the sum of terms (R, 4 + m, N) with factors (R,)."""
    h = np.zeros((table.shape[1] - OBSERVED, table.shape[2]))
    for r in range(outputs.size):
        if outputs[r] != 0.0:
            for i in range(h.shape[0]):
                add(h[i], outputs[r], table[r, OBSERVED + i])
    return h


@helper
def exponent_added(h: Array, precision: Array, observed: Array, weight: float, share: float, at: int, b: Array) -> float:
    """Add h'S^-1 (weight y - share h / 2) less its value at a point, which is returned.

    Large numbers cancel in this way before they are squared.
    """
    constant = 0.0
    for i in range(h.shape[0]):
        weighted, centre = 0.0, h[i, at]
        for l in range(h.shape[0]):
            if precision[i, l] != 0.0:
                weighted += precision[i, l] * (weight * observed[l] - share * h[l, at])
                constant += centre * precision[i, l] * (weight * observed[l] - 0.5 * share * h[l, at])
                pull, other = 0.5 * share * precision[i, l], h[l, at]
                for j in range(b.size):
                    b[j] -= pull * (h[l, j] - other) * (h[i, j] - centre)
        if weighted != 0.0:
            for j in range(b.size):
                b[j] += weighted * (h[i, j] - centre)
    return constant
