"""The grid that covers and resolves weighted points, in one kernel."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import boolean, float64, int64, types, void
from numpy.typing import NDArray

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.small_matrices import congruence, solve
from zakai.numerics.space.grid import SIZES

Array = NDArray[Any]

_CORRELATED = 0.6  # correlation above which the axes follow the covariance
_OPEN, _CLOSED = 0.6, 0.85  # shares of a circle below which an axis is cut open, and above which it is closed


@helper
def invert(out: Any, matrix: Any) -> None:
    """Set `out` (n, n) to the inverse of a matrix."""
    n = len(matrix)
    work = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            work[i, j], out[i, j] = matrix[i, j], (1.0 if i == j else 0.0)
    solve(work, out)


@helper
def rounded(points: float, least: int, most: int) -> int:
    """Return the smallest size, fast for the Fourier transform, of at least so many points, between two bounds."""
    wanted = min(points, float(most)) if points > least else float(least)
    for size in SIZES:
        if size >= wanted - 1e-9:
            return int(size)
    return int(SIZES[-1])


@helper
def conditional_deviations(out: Any, cov: Any, ridge: float) -> None:
    """Set `out` (n,) to the standard deviations of a Gaussian along the axes, all other coordinates given."""
    n = len(cov)
    scaled, inverse = np.empty((n, n)), np.empty((n, n))
    for i in range(n):
        for j in range(n):
            scaled[i, j] = cov[i, j] / math.sqrt(cov[i, i] * cov[j, j])
        scaled[i, i] += ridge
    invert(inverse, scaled)
    for i in range(n):
        out[i] = math.sqrt(cov[i, i] / inverse[i, i])


@helper
def _axes(shape: Any, cov: Any, previous: Any, aligned: bool) -> None:
    """Set `shape` to axes (columns) of unit size in their own coordinate: those of the states, previous ones, or Cholesky's."""
    n = len(cov)
    inverse, product, spread = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    for attempt in range(2):
        for i in range(n):
            for j in range(n):
                shape[i, j] = previous[i, j] / previous[j, j] if attempt == 0 else (1.0 if i == j else 0.0)
        if aligned:
            continue
        invert(inverse, shape)
        congruence(spread, inverse, cov, product)
        worst = 0.0
        for i in range(n):
            for j in range(i):
                worst = max(worst, abs(spread[i, j]) / math.sqrt(spread[i, i] * spread[j, j]))
        if worst < _CORRELATED:
            return
    if aligned:
        return
    factor = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = cov[i, j] / math.sqrt(cov[i, i] * cov[j, j]) + (1e-8 if i == j else 0.0)
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            factor[i, j] = math.sqrt(max(total, 1e-16)) if i == j else total / factor[j, j]
    for i in range(n):
        for j in range(n):
            shape[i, j] = math.sqrt(cov[i, i] / cov[j, j]) * factor[i, j] / factor[j, j]


@helper
def _moments(x: Any, logs: Any, least: float, closed: Any, mean: Any, cov: Any) -> None:
    """Write the mean (n,) of points with logarithms of at least `least`, add their covariance, and move angles near the mean."""
    n, count = x.shape
    total = 0.0
    for j in range(count):
        total += math.exp(logs[j]) if logs[j] >= least else 0.0
    for d in range(n):
        if closed[d]:
            sine, cosine = 0.0, 0.0
            for j in range(count):
                if logs[j] >= least:
                    sine += math.exp(logs[j]) * math.sin(x[d, j])
                    cosine += math.exp(logs[j]) * math.cos(x[d, j])
            middle = math.atan2(sine, cosine)
            for j in range(count):
                x[d, j] -= 2 * math.pi * math.floor((x[d, j] - middle) / (2 * math.pi) + 0.5)
    for j in range(count):
        if logs[j] >= least:
            weight = math.exp(logs[j]) / total
            for d in range(n):
                mean[d] += weight * x[d, j]
    for j in range(count):
        if logs[j] >= least:
            weight = math.exp(logs[j]) / total
            for d in range(n):
                for e in range(d + 1):
                    cov[d, e] += weight * (x[d, j] - mean[d]) * (x[e, j] - mean[e])
    for d in range(n):
        for e in range(d):
            cov[e, d] = cov[d, e]


class Weighted(NamedTuple):
    """The points x (n, J) relative to `start` (n,), with logarithms of densities (J,); those below `least` do not count."""

    x: Array
    logs: Array
    start: Array
    least: float


class Previous(NamedTuple):
    """The basis (n, n) of the grid of the points, which of its axes are closed, and which coordinates are periodic (n,)."""

    basis: Array
    closed: Array
    periodic: Array


class Rule(NamedTuple):
    """What a grid must keep.

    `reach` are the deviations to the end of a density, `spacings` those in a deviation, `extra` the share of its width by which
    it is wider at each end; along an axis there are from `smallest` to `most` points, and about `points` in all.
    """

    reach: float
    spacings: float
    extra: float
    smallest: int
    most: int
    points: float


class Fitted(NamedTuple):
    """What receives the centre (n,), the basis (n, n), the sizes (n,) and which axes are closed (n,)."""

    centre: Array
    basis: Array
    sizes: Array
    closed: Array


_V, _M, _B = float64[::1], float64[:, ::1], boolean[::1]


@kernel(
    void(
        types.NamedTuple([_M, _V, _V, float64], Weighted), _M, _V, types.NamedTuple([_M, _B, _B], Previous),
        types.NamedTuple([float64, float64, float64, int64, int64, float64], Rule),
        types.NamedTuple([_V, _M, int64[::1], _B], Fitted),
    )
)  # fmt: skip
def fit(weighted: Weighted, noise: Array, narrowness: Array, before: Previous, rule: Rule, fitted: Fitted) -> None:
    """Write the centre, basis, sizes and closed axes of a grid for weighted points with a Gaussian N(0, noise) added.

    The points are overwritten; for `narrowness` see `window.fitted_grid`.
    """
    x, logs, start, least = weighted
    previous, was_closed, periodic = before
    reach, spacings, extra, smallest, most, points = rule
    centre, basis, sizes, closed = fitted
    n, count = x.shape
    mean, cov = np.zeros(n), np.empty((n, n))
    for d in range(n):
        for e in range(n):
            cov[d, e] = noise[d, e]
    _moments(x, logs, least, was_closed, mean, cov)
    shape, inverse, product = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    aligned = n == 1
    for d in range(n):
        aligned = aligned or periodic[d]
    _axes(shape, cov, previous, aligned)
    invert(inverse, shape)
    spread, added = np.empty((n, n)), np.empty((n, n))
    congruence(spread, inverse, cov, product)
    congruence(added, inverse, noise, product)
    low, high = np.empty(n), np.empty(n)
    for d in range(n):
        low[d], high[d] = np.inf, -np.inf
    for j in range(count):
        if logs[j] >= least:
            beyond = math.sqrt(max(reach**2 + 2 * min(logs[j], 0.0), 0.0))
            for d in range(n):
                z = 0.0
                for e in range(n):
                    z += inverse[d, e] * (x[e, j] - mean[e])
                width = beyond * math.sqrt(added[d, d])
                low[d], high[d] = min(low[d], z - width), max(high[d], z + width)
    spacing = np.empty(n)
    conditional_deviations(spacing, spread, 1e-10)
    total = 1.0
    for d in range(n):
        wider = extra * (high[d] - low[d])
        low[d], high[d] = low[d] - wider, high[d] + wider
        spacing[d] *= min(max(narrowness[d], 1e-3), 1.0) / spacings
        total *= min((high[d] - low[d]) / spacing[d] + 4, most)
    coarser = max(total / points, 1.0) ** (1 / n)
    for d in range(n):
        spacing[d] *= coarser
        width = high[d] - low[d] + 4 * spacing[d]
        middle = 0.5 * (low[d] + high[d])
        closed[d] = periodic[d] and width > 2 * math.pi * (_OPEN if was_closed[d] else _CLOSED)
        if closed[d]:
            width, middle = 2 * math.pi, 0.0
        sizes[d] = rounded(width / spacing[d], smallest, most)
        # Points to spare go to the width and to the spacing alike.
        step = width / sizes[d]
        if not closed[d]:
            step = max(step, math.sqrt(step * min(spacing[d], 1.3 * step)))
        for e in range(n):
            centre[e] += shape[e, d] * middle
            basis[e, d] = shape[e, d] * step
    for d in range(n):
        centre[d] += mean[d] + start[d]
