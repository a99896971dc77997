"""Uniform affine grids in one to four dimensions, and Gaussian spreading of densities on them.

A grid is x = centre + basis (i - size // 2).  A density that the grid resolves is band-limited: its sums are integrals, and
spreading by a Gaussian is exact in frequency.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfftn, rfftn

from zakai.numerics.compiled import kernel
from zakai.numerics.small_matrices import solve

Array = NDArray[Any]


@kernel("void(float64[:, ::1], float64[:, ::1])", "void(complex128[:, ::1], complex128[:, ::1])")
def _invert(matrix: Any, out: Any) -> None:
    """Turn `out`, the unit matrix, into the inverse of a matrix, which is overwritten."""
    solve(matrix, out)


def inverted(matrix: Array) -> Array:
    """Return the inverse of a small matrix (n, n); one of a singular matrix is not finite."""
    matrix = np.array(matrix, order="C")
    out = np.eye(len(matrix), dtype=matrix.dtype)
    _invert(matrix, out)
    return out


class _Fields(NamedTuple):
    centre: Array
    basis: Array
    sizes: tuple[int, ...]
    closed: tuple[bool, ...]


class Grid(_Fields):
    """x = `centre` (n,) + `basis` (n, n) (i - size // 2); `closed` tells which axes go once around a circle."""

    @property
    def n(self) -> int:
        """The number of coordinates."""
        return len(self.sizes)

    @cached_property
    def shape(self) -> Array:
        """The sizes as an array (n,)."""
        return np.array(self.sizes, np.int64)

    @cached_property
    def circles(self) -> Array:
        """Which axes are closed, as an array (n,)."""
        return np.array(self.closed)

    @cached_property
    def inverse(self) -> Array:
        """The inverse of the basis."""
        return inverted(self.basis)

    @cached_property
    def cell(self) -> float:
        """The volume of one cell."""
        return abs(float(np.linalg.det(self.basis)))

    @cached_property
    def offsets(self) -> Array:
        """The points relative to the centre (J, n)."""
        return transformed(indices(self.sizes), self.basis)

    @cached_property
    def points(self) -> Array:
        """The points (J, n)."""
        return self.centre + self.offsets

    def refines(self, other: Grid) -> bool:
        """Return whether this grid has the same window as another one, and no fewer points."""
        widths = self.basis * np.array(self.sizes) - other.basis * np.array(other.sizes)
        return (
            np.array_equal(self.centre, other.centre)
            and self.closed == other.closed
            and all(a >= b for a, b in zip(self.sizes, other.sizes, strict=True))
            and bool(np.abs(widths).max() <= 1e-12 * np.abs(other.basis).max())
        )

    def same(self, other: Grid) -> bool:
        """Return whether both grids are the same to the last bit."""
        return (
            self.sizes == other.sizes
            and self.closed == other.closed
            and np.array_equal(self.centre, other.centre)
            and np.array_equal(self.basis, other.basis)
        )


@lru_cache(maxsize=64)
def indices(sizes: tuple[int, ...]) -> Array:
    """Return the indices (J, n) of all points, counted from the centre."""
    axes = [np.arange(size, dtype=float) - size // 2 for size in sizes]
    found = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")]).T
    found.setflags(write=False)
    return found


def transformed(points: Array, matrix: Array) -> Array:
    """Return the points (J, n) times a matrix (n, n), with the values of each coordinate contiguous."""
    n = points.shape[1]
    out = np.empty((n, len(points)), np.result_type(points, matrix))
    for i in range(n):
        used = [j for j in range(n) if matrix[i, j] != 0]
        out[i] = matrix[i, used[0]] * points[:, used[0]] if used else 0.0
        for j in used[1:]:
            out[i] += matrix[i, j] * points[:, j]
    return out.T


def weighted_products(weights: Array, points: Array) -> Array:
    """Return the sums (n, n) of weights (J,) times products of coordinates of the points (J, n)."""
    n = points.shape[1]
    out = np.empty((n, n), np.result_type(weights, points))
    for i in range(n):
        line = weights * points[:, i]
        for j in range(i + 1):
            out[i, j] = out[j, i] = line @ points[:, j]
    return out


@lru_cache(maxsize=256)
def _frequencies(sizes: tuple[int, ...]) -> list[Array]:
    """Return the frequencies of a real transform along each axis, shaped for broadcasting."""
    n = len(sizes)
    out = []
    for d, size in enumerate(sizes):
        k = 2 * np.pi * (np.fft.rfftfreq(size) if d == n - 1 else np.fft.fftfreq(size))
        out.append(k.reshape([-1 if a == d else 1 for a in range(n)]))
    return out


@kernel("void(complex128[::1], int64[::1], float64[:, ::1], boolean)")
def _respond(spectrum: Any, sizes: Any, cov: Any, spline: bool) -> None:
    """Multiply a real transform by that of N(0, cov), cov in index units; with `spline`, divide it by the spline's response."""
    n = sizes.size
    most = 0
    for d in range(n):
        most = max(most, sizes[d])
    waves, factors = np.zeros((n, most)), np.zeros((n, most))
    for d in range(n):
        for i in range(sizes[d]):
            waves[d, i] = 2 * math.pi / sizes[d] * (i if 2 * i < sizes[d] or d == n - 1 else i - sizes[d])
            factors[d, i] = 1.0
            if spline:
                factors[d, i] = 120 / (66 + 52 * math.cos(waves[d, i]) + 2 * math.cos(2 * waves[d, i]))
    half = sizes[n - 1] // 2 + 1
    index, slope = np.zeros(n, np.int64), 0.0
    for line in range(spectrum.size // half):
        rest, factor, exponent, slope = line, 1.0, 0.0, 0.0
        for d in range(n - 2, -1, -1):
            index[d] = rest % sizes[d]
            rest //= sizes[d]
            factor *= factors[d, index[d]]
        for d in range(n - 1):
            slope -= cov[n - 1, d] * waves[d, index[d]]
            for e in range(n - 1):
                exponent -= 0.5 * cov[d, e] * waves[d, index[d]] * waves[e, index[e]]
        for i in range(half):
            k = waves[n - 1, i]
            power = min(exponent + k * (slope - 0.5 * cov[n - 1, n - 1] * k), 0.0)
            spectrum[line * half + i] *= factor * factors[n - 1, i] * math.exp(power)


def gaussian_response(cov: Array, sizes: tuple[int, ...], spline: bool = False) -> Array:
    """Return the Fourier multiplier of spreading by N(0, cov), cov (n, n) in index units, divided by the spline's response."""
    response = np.ones((*sizes[:-1], sizes[-1] // 2 + 1), complex)
    _respond(response.reshape(-1), np.array(sizes), np.ascontiguousarray(cov.real), spline)
    if not np.iscomplexobj(cov):
        return np.asarray(response.real)
    k = _frequencies(sizes)
    exponent = sum(0.5 * cov[i, j].imag * (k[i] * k[j]) for i in range(len(sizes)) for j in range(len(sizes)))
    return np.asarray(response.real * (1.0 - 1j * exponent))


def filtered(values: Array, cov: Array, spline: bool = False, shift: Array | None = None) -> Array:
    """Return values (*sizes) after spreading by N(0, cov), cov (n, n) in index units; with `spline`, their spline's coefficients.

    Complex ones carry a derivative in the imaginary part; real ones may be those at other indices, by a `shift` (n,).
    """
    sizes = values.shape
    if not (np.iscomplexobj(values) or np.iscomplexobj(cov)):
        spectrum = rfftn(values)
        _respond(spectrum.reshape(-1), np.array(sizes), np.ascontiguousarray(cov), spline)
        if shift is not None and np.any(shift):
            for waves, distance in zip(_frequencies(sizes), shift, strict=True):
                spectrum *= np.exp(1j * distance * waves)
        return np.asarray(irfftn(spectrum, sizes, overwrite_x=True))
    response, spectrum = gaussian_response(cov, sizes, spline), rfftn(values.real)
    change = rfftn(np.ascontiguousarray(values.imag)) * response.real + spectrum * response.imag
    return np.asarray(irfftn(spectrum * response.real, sizes) + 1j * irfftn(change, sizes))


def spread(values: Array, grid: Grid, cov: Array) -> Array:
    """Return the values after spreading by N(0, cov) in x."""
    if not np.any(cov):
        return values
    inverse = grid.inverse
    return filtered(values, inverse @ cov @ inverse.T)


def gradient(values: Array, grid: Grid) -> Array:
    """Return the derivatives of real values along the axes, in index units (n, *sizes)."""
    spectrum = np.fft.rfftn(values)
    k = _frequencies(values.shape)
    axes = tuple(range(values.ndim))
    return np.stack([np.fft.irfftn(1j * k[d] * spectrum, values.shape, axes) for d in axes])
SIZES = np.array([8, 12, 16, 20, 24, 28, 32, 36, 40, 44, 48, 52, 56, 60, 64, 70, 72, 80, 84, 90, 96, 100, 108, 112, 120, 128,
                   140, 144, 160, 180, 192, 216, 240, 256, 288, 320, 360, 384, 432, 480, 512, 576, 640, 720, 768, 864, 960, 1024,
                   1152, 1280, 1440, 1536, 1728, 1920, 2048])  # fmt: skip
_SIZES = SIZES.tolist()


def rounded_size(points: float, least: int, most: int) -> int:
    """Return the smallest size, fast for the Fourier transform, of at least so many points, between two bounds."""
    wanted = min(max(points, least), most)
    return _SIZES[min(bisect_left(_SIZES, wanted - 1e-9), len(_SIZES) - 1)]
