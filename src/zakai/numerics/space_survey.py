"""One pass over a density on a grid: its moments, and how well the grid covers and resolves it."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.small_matrices import congruence, dot
from zakai.numerics.space_fit import conditional_deviations
from zakai.numerics.space_grid import Grid

Array = NDArray[Any]
# Squared deviations from the mean beyond which an edge counts for more than its mass, if the bound on edges is above ROUNDING:
# below it what is at an edge is noise of interpolation, as likely far out as near.
FAR, ROUNDING = 36.0, 1e-11


class Survey(NamedTuple):
    """Moments, edges and spectrum of a density on a grid.

    The `total` of the values, the mean (n,) and covariance (n, n) of the offsets from the centre in x; for each axis (n,) the
    largest `edges` relative to the maximum of the marginal (times the squared distance where they are far from the mean), the
    `tails` of the spectrum at its two highest frequencies relative to the mass, the first and last index `used` (n, 2) above the
    bound on edges, the `highest` frequency above the bound on tails, as a share of the highest of the grid, and the `conditional`
    standard deviation of a Gaussian in spacings; and the negative mass as a share of the total.
    """

    total: float
    mean: Array
    cov: Array
    edges: Array
    tails: Array
    used: Array
    highest: Array
    conditional: Array
    negative: float


@helper
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


@kernel(
    "void(float64[::1], int64[::1], boolean[::1], float64[:, ::1], float64, float64, float64[::1], float64[:, ::1],"
    " float64[:, ::1])"
)
def _survey(u: Any, sizes: Any, closed: Any, basis: Any, edge: float, tail: float, mean: Any, cov: Any, axes: Any) -> None:
    """Write the mean and covariance; of each axis edge, tail, first, last, highest frequency, deviation; and the totals."""
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
            axes[n, 1] -= min(x, 0.0)
            first += x * z
            squares += x * z * z
        axes[n, 0] += total
        for d in range(n - 1):
            mean[d] += total * index[d]
            cov[n - 1, d] += first * index[d]
            for e in range(d + 1):
                cov[d, e] += total * index[d] * index[e]
        mean[n - 1] += first
        cov[n - 1, n - 1] += squares
    total = axes[n, 0]
    for d in range(n):
        mean[d] /= total
        for e in range(d + 1):
            cov[d, e] = cov[d, e] / total - mean[d] * mean[e]
            cov[e, d] = cov[d, e]
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
        top = -np.inf
        for i in range(size):
            top = max(top, marginal[i])
        if not closed[d]:
            lower, upper = max(abs(marginal[0]), abs(marginal[1])), max(abs(marginal[size - 2]), abs(marginal[size - 1]))
            if edge > ROUNDING:
                lower *= max(1.0, (size // 2 + mean[d]) ** 2 / (FAR * cov[d, d]))
                upper *= max(1.0, (size - 1 - size // 2 - mean[d]) ** 2 / (FAR * cov[d, d]))
            axes[d, 0] = max(lower, upper) / top
        low = size
        high = -1
        for i in range(size):
            if marginal[i] > edge * top:
                low = min(low, i)
                high = i
        axes[d, 2] = low if high >= 0 else 0
        axes[d, 3] = high if high >= 0 else size - 1
        work = np.zeros((2, inner))
        half, highest, k = size // 2, 0, size // 2
        while k > 0 and (highest == 0 or k >= half - 1):
            wave = _wave(u, outer, size, inner, k, work) / total
            if k >= half - 1:
                axes[d, 1] = max(axes[d, 1], wave)
            if highest == 0 and (not wave <= tail or tail >= 1.0 or k == 1):
                highest = k
            k -= 1
        axes[d, 4] = min((highest + 1.0) / half, 1.0)
        inner *= size
    if not (math.isfinite(total) and total > 0.0):
        for d in range(n):
            axes[d, 0] = axes[d, 1] = 1.0
    product, moved, deviations = np.empty((n, n)), np.empty(n), np.empty(n)
    for d in range(n):
        moved[d] = mean[d]
        for e in range(n):
            product[d, e] = max(cov[d, d], 1e-12) if d == e else cov[d, e]
    conditional_deviations(deviations, product, 1e-9)
    congruence(cov, basis, cov, product)
    for d in range(n):
        mean[d] = dot(basis[d], moved)
        axes[d, 5] = deviations[d]


def survey(values: Array, grid: Grid, edge: float = 0.0, tail: float = 1.0) -> Survey:
    """Return the survey of a real density.

    Args:
        values: the density (*sizes).
        grid: its grid.
        edge: share of the maximum that counts as zero.
        tail: share of the mass that counts as zero in the spectrum; 1 leaves `highest` unknown.
    """
    n = grid.n
    mean, cov, axes = np.zeros(n), np.zeros((n, n)), np.zeros((n + 1, 6))
    flat = np.ascontiguousarray(values.real).reshape(-1)
    basis = np.ascontiguousarray(grid.basis)
    _survey(flat, grid.shape, grid.circles, basis, edge, tail, mean, cov, axes)
    total, negative = axes[n, :2].tolist()
    return Survey(
        total, mean, cov, axes[:n, 0], axes[:n, 1], axes[:n, 2:4].astype(int), axes[:n, 4], axes[:n, 5],
        negative / max(total, 1e-300),
    )  # fmt: skip


def narrowest(found: Survey, tail: float, least: float = 0.0) -> tuple[Array, Array]:
    """Return the smallest standard deviation along each axis, in conditional deviations (n,), at most 1, and in spacings (n,).

    It follows from the highest frequency at which the spectrum is above `tail` of the mass; where that is so at all frequencies,
    as at a kink, it is not less than `least` spacings.
    """
    width = math.sqrt(-2 * math.log(tail)) / (math.pi * found.highest)
    width = np.where(found.highest >= 1.0, np.maximum(deviations_in_spacings(found.tails), least), width)
    return np.minimum(width / found.conditional, 1.0), np.minimum(width, found.conditional)


def deviations_in_spacings(tails: Array) -> Array:
    """Return the standard deviation in spacings of a Gaussian with such a spectrum at the highest frequency."""
    return np.asarray(np.sqrt(-2 * np.log(np.clip(tails, 1e-15, 0.9))) / np.pi)
