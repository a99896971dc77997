"""One pass over a density on a grid: its moments, and how well the grid covers and resolves it."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.compiled import kernel
from zakai.numerics.space_grid import Grid

Array = NDArray[Any]


class Survey(NamedTuple):
    """The `total` of the values, the mean (n,) and covariance (n, n) of the offsets from the centre in x; for each axis (n,) the
    largest `edges` relative to the maximum of the marginal, the `tails` of the spectrum at its two highest frequencies relative
    to the mass, the first and last index `used` (n, 2) above the bound on edges, and the `highest` frequency above the bound on
    tails, as a share of the highest of the grid.
    """

    total: float
    mean: Array
    cov: Array
    edges: Array
    tails: Array
    used: Array
    highest: Array


@kernel("float64(float64[::1], int64, int64, int64, int64, float64[:, ::1])")
def _wave(u: Any, outer: int, size: int, inner: int, k: int, work: Any) -> float:
    """Return the sum over lines of the absolute value of the Fourier transform at a frequency."""
    total = 0.0
    cosine = np.empty(size)
    sine = np.empty(size)
    for i in range(size):
        cosine[i] = math.cos(2.0 * math.pi * ((k * i) % size) / size)
        sine[i] = math.sin(2.0 * math.pi * ((k * i) % size) / size)
    for o in range(outer):
        for q in range(inner):
            work[0, q] = 0.0
            work[1, q] = 0.0
        for i in range(size):
            first = (o * size + i) * inner
            for q in range(inner):
                work[0, q] += cosine[i] * u[first + q]
                work[1, q] += sine[i] * u[first + q]
        for q in range(inner):
            total += math.sqrt(work[0, q] ** 2 + work[1, q] ** 2)
    return total


@kernel("void(float64[::1], int64[::1], boolean[::1], float64, float64, float64[::1], float64[:, ::1], float64[:, ::1])")
def _survey(u: Any, sizes: Any, closed: Any, edge: float, tail: float, mean: Any, second: Any, axes: Any) -> None:
    """Write the sums of indices and of their products, and for each axis: edge, tail, first, last, highest frequency; total."""
    n, count = sizes.size, u.size
    last = sizes[n - 1]
    index = np.zeros(n)
    for line in range(count // last):
        rest = line
        for d in range(n - 2, -1, -1):
            index[d] = rest % sizes[d] - sizes[d] // 2
            rest //= sizes[d]
        total = 0.0
        first = 0.0
        squares = 0.0
        for i in range(last):
            x = u[line * last + i]
            z = i - last // 2
            total += x
            first += x * z
            squares += x * z * z
        axes[n, 0] += total
        for d in range(n - 1):
            mean[d] += total * index[d]
            second[n - 1, d] += first * index[d]
            for e in range(d + 1):
                second[d, e] += total * index[d] * index[e]
        mean[n - 1] += first
        second[n - 1, n - 1] += squares
    total = axes[n, 0]
    inner = 1
    for d in range(n - 1, -1, -1):
        size = sizes[d]
        outer = count // (size * inner)
        marginal = np.zeros(size)
        for o in range(outer):
            for i in range(size):
                start = (o * size + i) * inner
                for q in range(inner):
                    marginal[i] += u[start + q]
        top = marginal.max()
        if not closed[d]:
            sides = max(max(abs(marginal[0]), abs(marginal[1])), max(abs(marginal[size - 2]), abs(marginal[size - 1])))
            axes[d, 0] = sides / top
        low = size
        high = -1
        for i in range(size):
            if marginal[i] > edge * top:
                low = min(low, i)
                high = i
        axes[d, 2] = low if high >= 0 else 0
        axes[d, 3] = high if high >= 0 else size - 1
        work = np.zeros((2, inner))
        k = size // 2
        wave = _wave(u, outer, size, inner, k, work) / total
        below = _wave(u, outer, size, inner, k - 1, work) / total
        axes[d, 1] = max(wave, below)
        while k > 1 and wave <= tail and tail < 1.0:
            k -= 1
            wave = below
            if k > 1:
                below = _wave(u, outer, size, inner, k - 1, work) / total
        axes[d, 4] = min((k + 1.0) / (size // 2), 1.0)
        inner *= size


def survey(values: Array, grid: Grid, edge: float = 0.0, tail: float = 1.0) -> Survey:
    """Return the survey of a real density.

    Args:
        values: the density (*sizes).
        grid: its grid.
        edge: share of the maximum that counts as zero.
        tail: share of the mass that counts as zero in the spectrum; 1 leaves `highest` unknown.
    """
    n = grid.n
    mean, second, axes = np.zeros(n), np.zeros((n, n)), np.zeros((n + 1, 5))
    flat = np.ascontiguousarray(values.real).reshape(-1)
    _survey(flat, np.array(grid.sizes, np.int64), np.array(grid.closed), edge, tail, mean, second, axes)
    total = float(axes[n, 0])
    if not (math.isfinite(total) and total > 0):
        axes[:, :2] = 1.0
    mean = mean / total
    second = np.tril(second) + np.tril(second, -1).T
    cov = second / total - mean[:, None] * mean
    edges, tails, used, highest = axes[:n, 0], axes[:n, 1], axes[:n, 2:4].astype(int), axes[:n, 4]
    return Survey(total, grid.basis @ mean, grid.basis @ cov @ grid.basis.T, edges, tails, used, highest)


def narrowest(found: Survey, grid: Grid, tail: float) -> tuple[Array, Array]:
    """Return the width of the narrowest feature along each axis, in conditional deviations of a Gaussian (n,), at most 1, and
    in spacings (n,): it follows from the highest frequency at which the spectrum is above `tail` of the mass."""
    inverse = np.linalg.inv(grid.basis)
    spread = inverse @ found.cov @ inverse.T
    scale = np.sqrt(np.maximum(np.diagonal(spread), 1e-12))
    scaled = spread / np.outer(scale, scale) + 1e-9 * np.eye(grid.n)
    conditional = scale / np.sqrt(np.diagonal(np.linalg.inv(scaled)))
    width = np.sqrt(-2 * np.log(tail)) / (np.pi * found.highest)
    width = np.where(found.highest >= 1.0, deviations_in_spacings(found.tails), width)
    return np.minimum(width / conditional, 1.0), np.minimum(width, conditional)


def deviations_in_spacings(tails: Array) -> Array:
    """Return the standard deviation in spacings of a Gaussian with such a spectrum at the highest frequency."""
    return np.asarray(np.sqrt(-2 * np.log(np.clip(tails, 1e-15, 0.9))) / np.pi)
