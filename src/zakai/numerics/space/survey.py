"""One pass over a density on a grid: its moments, and how well the grid covers and resolves it."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

from zakai.numerics.compiled import kernel
from zakai.numerics.small_matrices import congruence, dot
from zakai.numerics.space.fit import conditional_deviations
from zakai.numerics.space.grid import Grid

Array = NDArray[Any]
# Squared deviations from the mean beyond which an edge counts for more than its mass, if the bound on edges is above ROUNDING:
# below it what is at an edge is noise of interpolation, as likely far out as near.
FAR, ROUNDING = 36.0, 1e-11


class Survey(NamedTuple):
    """Moments, edges and spectrum of a density on a grid.

    The `total` of the values, the mean (n,) and covariance (n, n) of the offsets from the centre in x; for each axis (n,) the
    largest `edges` relative to the maximum of the marginal (times the squared distance where they are far from the mean), the
    `tails` of the spectrum at its two highest frequencies relative to the mass, the first and last index `used` (n, 2) above the
    bound on edges, and the `conditional` standard deviation of a Gaussian in spacings; and the negative mass as a share of the
    total.
    """

    total: float
    mean: Array
    cov: Array
    edges: Array
    tails: Array
    used: Array
    conditional: Array
    negative: float


@kernel(
    "void(float64[::1], int64[::1], boolean[::1], float64[:, ::1], float64, float64[::1], float64[:, ::1], float64[:, ::1])",
    reordered=True,
)
def _survey(u: Any, sizes: Any, closed: Any, basis: Any, edge: float, mean: Any, cov: Any, axes: Any) -> None:
    """Write the mean and covariance; of each axis the edge, tail, first and last index and deviation; and the totals."""
    n, count = sizes.size, u.size
    last = sizes[n - 1]
    most = last
    for d in range(n - 1):
        most = max(most, sizes[d])
    marginals, spectra, cosines, sines = np.zeros((n, most)), np.zeros((n, 2)), np.empty((n, 2, most)), np.empty((n, 2, most))
    for d in range(n):
        for k in range(2):
            for i in range(sizes[d]):
                angle = 2.0 * math.pi * (((sizes[d] // 2 - k) * i) % sizes[d]) / sizes[d]
                cosines[d, k, i], sines[d, k, i] = math.cos(angle), math.sin(angle)
    index, z = np.zeros(n), np.empty(last)
    for i in range(last):
        z[i] = i - last // 2
    marginal, negative = marginals[n - 1], 0.0
    for line in range(count // last):
        rest = line
        for d in range(n - 2, -1, -1):
            index[d] = rest % sizes[d] - sizes[d] // 2
            rest //= sizes[d]
        values, total, first = u[line * last : (line + 1) * last], 0.0, 0.0
        for i in range(last):
            total += values[i]
            first += values[i] * z[i]
            negative -= min(values[i], 0.0)
            marginal[i] += values[i]
        for k in range(2):
            cosine, sine, real, imag = cosines[n - 1, k], sines[n - 1, k], 0.0, 0.0
            for i in range(last):
                real += cosine[i] * values[i]
                imag += sine[i] * values[i]
            spectra[n - 1, k] += math.sqrt(real * real + imag * imag)
        for d in range(n - 1):
            marginals[d, int(index[d]) + sizes[d] // 2] += total
            cov[n - 1, d] += first * index[d]
            for e in range(d):
                cov[d, e] += total * index[d] * index[e]
    inner = last
    for d in range(n - 2, -1, -1):
        for outer in range(count // (sizes[d] * inner)):
            for k in range(2):
                real_, imag_ = np.zeros(inner), np.zeros(inner)
                for i in range(sizes[d]):
                    start, cosine_, sine_ = (outer * sizes[d] + i) * inner, cosines[d, k, i], sines[d, k, i]
                    values = u[start : start + inner]
                    for q in range(inner):
                        real_[q] += cosine_ * values[q]
                        imag_[q] += sine_ * values[q]
                for q in range(inner):
                    spectra[d, k] += math.sqrt(real_[q] ** 2 + imag_[q] ** 2)
        inner *= sizes[d]
    total = 0.0
    for i in range(last):
        total += marginal[i]
    axes[n, 0], axes[n, 1] = total, negative
    for d in range(n):
        for i in range(sizes[d]):
            mean[d] += marginals[d, i] * (i - sizes[d] // 2)
            cov[d, d] += marginals[d, i] * float(i - sizes[d] // 2) ** 2
        mean[d] /= total
        for e in range(d + 1):
            cov[d, e] = cov[e, d] = cov[d, e] / total - mean[d] * mean[e]
    for d in range(n):
        size, marginal, top = sizes[d], marginals[d], -np.inf
        for i in range(size):
            top = max(top, marginal[i])
        if not closed[d]:
            lower, upper = max(abs(marginal[0]), abs(marginal[1])), max(abs(marginal[size - 2]), abs(marginal[size - 1]))
            if edge > ROUNDING:
                lower *= max(1.0, (size // 2 + mean[d]) ** 2 / (FAR * cov[d, d]))
                upper *= max(1.0, (size - 1 - size // 2 - mean[d]) ** 2 / (FAR * cov[d, d]))
            axes[d, 0] = max(lower, upper) / top
        axes[d, 1] = max(spectra[d, 0], spectra[d, 1]) / total
        low = size
        high = -1
        for i in range(size):
            if marginal[i] > edge * top:
                low = min(low, i)
                high = i
        axes[d, 2] = low if high >= 0 else 0
        axes[d, 3] = high if high >= 0 else size - 1
        if not (math.isfinite(total) and total > 0.0):
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
        axes[d, 4] = deviations[d]


def survey(values: Array, grid: Grid, edge: float = 0.0) -> Survey:
    """Return the survey of a real density.

    Args:
        values: the density (*sizes).
        grid: its grid.
        edge: share of the maximum that counts as zero.
    """
    n = grid.n
    mean, cov, axes = np.zeros(n), np.zeros((n, n)), np.zeros((n + 1, 5))
    flat = np.ascontiguousarray(values.real).reshape(-1)
    basis = np.ascontiguousarray(grid.basis)
    _survey(flat, grid.shape, grid.circles, basis, edge, mean, cov, axes)
    total, negative = axes[n, :2].tolist()
    return Survey(
        total, mean, cov, axes[:n, 0], axes[:n, 1], axes[:n, 2:4].astype(int), axes[:n, 4], negative / max(total, 1e-300)
    )


def narrowest(found: Survey, values: Array, tail: float, least: float = 0.0) -> tuple[Array, Array]:
    """Return the smallest standard deviation along each axis, in conditional deviations (n,), at most 1, and in spacings (n,).

    It follows from the highest frequency at which the spectrum of the values is above `tail` of the mass; where that is so at all
    frequencies, as at a kink, it is not less than `least` spacings.
    """
    highest, real = np.ones(values.ndim), np.ascontiguousarray(values.real)
    for d, size in enumerate(values.shape):
        others = tuple(e for e in range(values.ndim) if e != d)
        above = np.flatnonzero(~(np.abs(rfft(real, axis=d)).sum(axis=others)[1:] <= tail * found.total))
        highest[d] = min(((above[-1] if above.size else 0) + 2.0) / (size // 2), 1.0)
    width = math.sqrt(-2 * math.log(tail)) / (math.pi * highest)
    width = np.where(highest >= 1.0, np.maximum(deviations_in_spacings(found.tails), least), width)
    return np.minimum(width / found.conditional, 1.0), np.minimum(width, found.conditional)


def smoothed(narrow: Array, conditional: Array, noise: Array) -> Array:
    """Return the smallest standard deviations of `narrowest` (n,), in conditional ones, after noise (n, n) in squared spacings.

    Along an axis the spectrum decreases at least by the variance of the noise given its other coordinates.
    """
    variances, own = np.diagonal(noise), conditional**2
    scale = np.sqrt(np.maximum(variances, 1e-12 * own))
    inverse = np.linalg.inv(noise / (scale[:, None] * scale) + 1e-6 * np.eye(len(noise)))
    given = np.minimum(np.maximum(scale**2 / np.diagonal(inverse) - 2e-6 * scale**2, 0.0), variances)
    return np.asarray(np.sqrt((narrow**2 * own + given) / (own + given)))


def deviations_in_spacings(tails: Array) -> Array:
    """Return the standard deviation in spacings of a Gaussian with such a spectrum at the highest frequency."""
    return np.asarray(np.sqrt(-2 * np.log(np.clip(tails, 1e-15, 0.9))) / np.pi)
