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
    `log_factor` a constant of the logarithm of the mass; `pairs` of averages and `substeps` of a splitting.
    """

    error: float
    rounding: float
    clipped: float
    spread: float
    contraction: float
    needed: float
    log_factor: float
    pairs: float
    substeps: float


@helper
def failed(spread: float, needed: float) -> Transition:
    """Return the figures of a transition that failed."""
    return Transition(np.inf, np.inf, 1.0, spread, 1.0, needed, 0.0, 0.0, 0.0)


@helper
def add(to: Array, weight: float, values: Array) -> None:
    """Add values with a weight."""
    for j in range(to.size):
        to[j] += weight * values[j]


@helper
def observation_of(table: Array, outputs: Array, at: int) -> tuple[Array, Array]:
    """Return h (m, N), the sum of terms (R, 4 + m, N) with factors (R,), and its values (m,) at a point."""
    h, centre = np.zeros((table.shape[1] - OBSERVED, table.shape[2])), np.empty(table.shape[1] - OBSERVED)
    for r in range(outputs.size):
        if outputs[r] != 0.0:
            for i in range(centre.size):
                add(h[i], outputs[r], table[r, OBSERVED + i])
    for i in range(centre.size):
        centre[i] = h[i, at]
    return h, centre


@helper
def exponent_added(h: Array, centre: Array, precision: Array, observed: Array, weight: float, share: float, b: Array) -> float:
    """Add h'S^-1 (weight y - share h / 2) less its value where h is `centre` (m,); return that value.

    Large numbers cancel in this way before they are squared.
    """
    constant = 0.0
    for i in range(centre.size):
        weighted, own = 0.0, h[i]
        for l in range(centre.size):
            if precision[i, l] != 0.0:
                weighted += precision[i, l] * (weight * observed[l] - share * centre[l])
                constant += centre[i] * precision[i, l] * (weight * observed[l] - 0.5 * share * centre[l])
                pull, other = 0.5 * share * precision[i, l], h[l]
                for j in range(b.size):
                    b[j] -= pull * (other[j] - centre[l]) * (own[j] - centre[i])
        for j in range(b.size):
            b[j] += weighted * (own[j] - centre[i])
    return constant
