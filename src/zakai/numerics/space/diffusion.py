"""Spreading of a density by noise that depends on the state, on a grid that resolves it.

    exp(1/2 sum_ij d_i d_j C_ij(x)) u

The derivatives are exact in frequency, so that mass is kept; the exponential of the operator is a series of Chebyshev
polynomials, for noise of any size.  Noise that is much wider than the density acts in parts, on a grid that becomes wider and
coarser, so that the number of terms grows as the logarithm of the noise.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft
from scipy.special import ive

from zakai.numerics.space.grid import Grid
from zakai.numerics.space.resample import padded
from zakai.numerics.space.window import LEAST, Bounds, padded_sizes

Array = NDArray[Any]
_REST = 1e-12  # terms of the series that are left out, relative to the density
NEGLIGIBLE = 1e-8  # of the maximum, below which the noise need not be exact
SPARE = 2.0  # times the largest noise elsewhere
MOST_TERMS = 4000
_RADIUS = 80.0  # of the spectrum of a part, which about halves the number of points that a density needs
_LONGER = 4.0  # ratio of the next radius where it did not


@lru_cache(maxsize=128)
def _derivatives(size: int) -> tuple[Array, Array]:
    """Return the matrices (size, size) of the first and second derivative in index units."""
    k = 2 * np.pi * np.fft.fftfreq(size)
    # The sign of the highest frequency is unknown: a first derivative has none of it.
    first = np.where(np.abs(k) > np.pi - 1e-9, 0.0, 1j * k)
    apart = np.subtract.outer(np.arange(size), np.arange(size)) % size
    return np.fft.ifft(first).real[apart], np.fft.ifft(-(k**2)).real[apart]


def _along(matrix: Array, values: Array, axis: int) -> Array:
    """Return a matrix times the values along an axis."""
    if axis == values.ndim - 1:
        return values @ matrix.T
    shape = values.shape
    return np.asarray(matrix @ values.reshape(*shape[: axis + 1], -1)).reshape(shape)


class _Operator:
    """The operator 1/2 sum_ij d_i d_j C_ij on a grid, or its adjoint.

    Its eigenvalues are in [-radius, 0]: k'Ck / 2 for waves of at most pi a spacing along each axis.
    """

    def __init__(self, values: Array, grid: Grid, noise: Array, adjoint: bool = False):
        inverse = grid.inverse
        noise = inverse @ noise @ inverse.T
        # Where the density is negligible the noise may be so too, which bounds the spectrum of the operator.
        size, real = np.abs(noise.real).sum(axis=(1, 2)), values.real.reshape(-1)
        largest = SPARE * float(np.max(size, where=real > NEGLIGIBLE * real.max(), initial=0.0))
        noise = noise * np.minimum(1.0, largest / np.maximum(size, 1e-300))[:, None, None]
        self.entries, self.adjoint = {}, adjoint
        for i in range(grid.n):
            for j in range(i + 1):
                entry = (0.5 if i == j else 1.0) * noise[:, i, j].reshape(grid.sizes)
                if np.any(entry):
                    self.entries[i, j] = entry
        self.radius = 0.5 * np.pi**2 * min(largest, float(size.max()))

    def __call__(self, u: Array) -> Array:
        """Return the operator times the values."""
        total: Array = np.zeros((), float)
        for (i, j), entry in self.entries.items():
            part = u if self.adjoint else entry * u
            if i == j:
                part = _along(_derivatives(u.shape[i])[1], part, i)
            else:
                part = _along(_derivatives(u.shape[i])[0], _along(_derivatives(u.shape[j])[0], part, j), i)
            total = total + (entry * part if self.adjoint else part)
        return total

    def exponential(self, values: Array, share: float = 1.0) -> Array:
        """Return the exponential of a share of the operator times the values."""
        radius = share * self.radius
        weights = ive(np.arange(min(MOST_TERMS, int(20 + 2 * radius))), 0.5 * radius)
        weights = weights[: 1 + int(np.flatnonzero(weights > _REST * weights[0])[-1])]
        scale = 2.0 / self.radius
        before, last = values, values + scale * self(values)
        result = weights[0] * values + (2.0 * weights[1] if len(weights) > 1 else 0.0) * last
        for weight in weights[2:]:
            before, last = last, 2.0 * (last + scale * self(last)) - before
            result += 2.0 * weight * last
        return np.asarray(result)


def diffused(values: Array, grid: Grid, noise: Array, adjoint: bool = False) -> Array:
    """Return a density after spreading by noise that depends on the state.

    With `adjoint` the values are a function of the state after it, whose mean given the state before it is returned.

    Args:
        values: the density (*sizes); an imaginary part is a derivative.
        grid: its grid.
        noise: C at the points of the grid (J, n, n).
    """
    operator = _Operator(values, grid, noise, adjoint)
    return operator.exponential(values) if operator.radius > 0.0 else values


def spread_out(
    values: Array, grid: Grid, noise_at: Callable[[Array], Array], bounds: Bounds
) -> tuple[Array, Grid]:
    """Return a density after spreading by noise, on a grid that is wide enough, and coarser where the density needs no more.

    Args:
        values: the density (*sizes); an imaginary part is a derivative.
        grid: its grid.
        noise_at: C (J, n, n) at points (J, n).
        bounds: the requirements for a grid.
    """
    left, largest = 1.0, _RADIUS
    while True:
        noise = left * noise_at(grid.points)
        operator = _Operator(values, grid, noise)
        if not operator.entries:
            return values, grid
        share = min(largest / operator.radius, 1.0)
        share = 1.0 if share > 0.5 else share
        sizes = padded_sizes(values, grid, share * _largest(values, grid, noise), bounds)
        if sizes != grid.sizes:
            values, grid = padded(values, grid, sizes)
            operator = _Operator(values, grid, left * noise_at(grid.points))
        values = operator.exponential(values, share)
        if share == 1.0:
            return values, grid
        left *= 1.0 - share
        before = grid
        values, grid = _coarser(values, grid, bounds)
        if grid is before:
            largest *= _LONGER


def _largest(values: Array, grid: Grid, noise: Array) -> Array:
    """Return a covariance (n, n) with the largest variances along the axes where a density is not negligible."""
    real, inverse = values.real.reshape(-1), grid.inverse
    variances = np.einsum("di,jie,de->jd", inverse, noise.real[real > NEGLIGIBLE * real.max()], inverse)
    return (grid.basis * variances.max(axis=0, initial=0.0)) @ grid.basis.T


def _coarser(values: Array, grid: Grid, bounds: Bounds) -> tuple[Array, Grid]:
    """Return every second value along the axes on which these resolve a density."""
    real, total = np.ascontiguousarray(values.real), float(values.real.sum())
    for d, size in enumerate(grid.sizes):
        if grid.closed[d] or size < 2 * LEAST[grid.n]:
            continue
        others = tuple(e for e in range(grid.n) if e != d)
        spectrum = np.abs(rfft(real, axis=d)).sum(axis=others)
        if spectrum[int(size / (4 * bounds.finer)) :].max() <= bounds.tail * total:
            kept = [slice(size // 2 % 2, None, 2) if e == d else slice(None) for e in range(grid.n)]
            values, real = values[tuple(kept)], np.ascontiguousarray(real[tuple(kept)])
            total = float(real.sum())
            basis = grid.basis.copy()
            basis[:, d] *= 2
            grid = Grid(grid.centre, basis, values.shape, grid.closed)
    return np.ascontiguousarray(values), grid
