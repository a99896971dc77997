"""Functions on uniform affine grids in one to four dimensions: Gaussian spreading and interpolation by splines and in frequency.

A grid is x = centre + basis (i - size // 2).  A density that the grid resolves is band-limited: its sums are integrals, and
spreading by a Gaussian is exact in frequency.  Values between the points are those of the quintic spline, whose error for a
Gaussian of s spacings is about 5e-4 / s^6.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.compiled import kernel
from zakai.numerics.complex_step import is_complex

Array = NDArray[Any]
_MOST_SHEARED = 3.0  # times the points of an axis that a shear may need
PAD = 3  # zeros, or the other end of a circle, around the coefficients of a spline


class Grid(NamedTuple):
    """x = `centre` (n,) + `basis` (n, n) (i - size // 2); `closed` tells which axes go once around a circle."""

    centre: Array
    basis: Array
    sizes: tuple[int, ...]
    closed: tuple[bool, ...]

    @property
    def n(self) -> int:
        """The number of coordinates."""
        return len(self.sizes)

    @property
    def offsets(self) -> Array:
        """The points relative to the centre (J, n)."""
        return transformed(indices(self.sizes), self.basis)

    @property
    def points(self) -> Array:
        """The points (J, n)."""
        return self.centre + self.offsets

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
def _frequencies(sizes: tuple[int, ...]) -> tuple[list[Array], Array]:
    """Return the frequencies along each axis, shaped for broadcasting, and the spline's response (real transform)."""
    n = len(sizes)
    out, response = [], np.ones(())
    for d, size in enumerate(sizes):
        k = 2 * np.pi * (np.fft.rfftfreq(size) if d == n - 1 else np.fft.fftfreq(size))
        view = k.reshape([-1 if a == d else 1 for a in range(n)])
        out.append(view)
        response = response * (66 + 52 * np.cos(view) + 2 * np.cos(2 * view)) / 120
    return out, response


def gaussian_response(cov: Array, sizes: tuple[int, ...], spline: bool = False) -> Array:
    """Return the Fourier multiplier of spreading by N(0, cov), cov (n, n) in index units, divided by the spline's response."""
    k, response = _frequencies(sizes)
    n = len(sizes)
    exponent = np.zeros((), cov.dtype)
    for i in range(n):
        if cov[i, i] != 0:
            exponent = exponent - (0.5 * cov[i, i]) * k[i] ** 2
        for j in range(i):
            if cov[i, j] != 0:
                exponent = exponent - cov[i, j] * (k[i] * k[j])
    result = np.exp(np.minimum(exponent.real, 0.0) + (1j * exponent.imag if np.iscomplexobj(exponent) else 0.0))
    return np.asarray(result / response if spline else np.broadcast_to(result, response.shape))


def filtered(values: Array, response: Array) -> Array:
    """Return real values (*sizes) with their spectrum multiplied; complex ones carry a derivative in the imaginary part."""
    sizes, axes = values.shape, tuple(range(values.ndim))
    if not (np.iscomplexobj(values) or np.iscomplexobj(response)):
        return np.asarray(np.fft.irfftn(np.fft.rfftn(values) * response, sizes, axes))
    spectrum = np.fft.rfftn(values.real)
    change = np.fft.rfftn(np.ascontiguousarray(values.imag)) * response.real + spectrum * response.imag
    real = np.fft.irfftn(spectrum * response.real, sizes, axes)
    return np.asarray(real + 1j * np.fft.irfftn(change, sizes, axes))


def spread(values: Array, grid: Grid, cov: Array, spline: bool = False) -> Array:
    """Return the values after spreading by N(0, cov) in x; with `spline`, the coefficients of their spline."""
    if not spline and not np.any(cov):
        return values
    inverse = np.linalg.inv(grid.basis)
    return filtered(values, gaussian_response(inverse @ cov @ inverse.T, grid.sizes, spline))


def _gather(c: Any, strides: Any, sizes: Any, closed: Any, z: Any, out: Any) -> None:
    """out_j = sum over the taps of padded coefficients times quintic B-splines at indices z (J, n); outside it is zero."""
    count, n = z.shape
    outer = 1
    for _ in range(n - 1):
        outer *= 6
    offsets = np.zeros(outer, np.int64)
    weights = np.zeros(outer, z.dtype)
    w = np.zeros((n, 6), z.dtype)
    for j in range(count):
        base = 0
        inside = True
        for d in range(n):
            floor = math.floor(z[j, d].real) if math.isfinite(z[j, d].real) else -1e9
            if not closed[d] and (floor < -1 or floor >= sizes[d]) or abs(floor) > 1e8:
                inside = False
                break
            t = z[j, d] - floor
            cell = int(floor)
            if closed[d]:
                cell = cell % sizes[d]
            base += (cell + PAD - 2) * strides[d]
            s = 1.0 - t
            t2 = t * t
            s2 = s * s
            w[d, 0] = s2 * s2 * s / 120.0
            w[d, 5] = t2 * t2 * t / 120.0
            w[d, 1] = (26.0 + t * (-50.0 + t * (20.0 + t * (20.0 + t * (-20.0 + 5.0 * t))))) / 120.0
            w[d, 2] = (66.0 + t2 * (-60.0 + t2 * (30.0 - 10.0 * t))) / 120.0
            w[d, 3] = (66.0 + s2 * (-60.0 + s2 * (30.0 - 10.0 * s))) / 120.0
            w[d, 4] = (26.0 + s * (-50.0 + s * (20.0 + s * (20.0 + s * (-20.0 + 5.0 * s))))) / 120.0
        if not inside:
            out[j] = 0.0
            continue
        size = 1
        offsets[0] = base
        weights[0] = 1.0
        for d in range(n - 1):
            for tap in range(5, -1, -1):
                for i in range(size):
                    offsets[tap * size + i] = offsets[i] + tap * strides[d]
                    weights[tap * size + i] = weights[i] * w[d, tap]
            size *= 6
        total = 0.0 * w[0, 0]
        for i in range(size):
            o = offsets[i]
            line = (
                c[o] * w[n - 1, 0]
                + c[o + 1] * w[n - 1, 1]
                + c[o + 2] * w[n - 1, 2]
                + c[o + 3] * w[n - 1, 3]
                + c[o + 4] * w[n - 1, 4]
                + c[o + 5] * w[n - 1, 5]
            )
            total += weights[i] * line
        out[j] = total


_gather_real = kernel("void(float64[::1], int64[::1], int64[::1], boolean[::1], float64[:, ::1], float64[::1])")(_gather)


@lru_cache(maxsize=1)
def _gather_complex() -> Any:
    """Return the kernel for derivatives, compiled when it is needed first."""
    return kernel("void(complex128[::1], int64[::1], int64[::1], boolean[::1], complex128[:, ::1], complex128[::1])")(_gather)


def gather(coefficients: Array, z: Array, grid: Grid) -> Array:
    """Return the spline with the coefficients (*sizes) at the indices z (J, n), counted from the first point of the grid."""
    c = np.zeros([size + 2 * PAD for size in grid.sizes], coefficients.dtype)
    c[tuple(slice(PAD, -PAD) for _ in grid.sizes)] = coefficients
    for d, closed in enumerate(grid.closed):
        if closed:
            line = np.moveaxis(c, d, 0)
            line[:PAD], line[-PAD:] = line[-2 * PAD : -PAD].copy(), line[PAD : 2 * PAD].copy()
    strides = np.array(c.strides, np.int64) // c.itemsize
    shape = np.array(grid.sizes, np.int64), np.array(grid.closed)
    if is_complex(c, z):
        out = np.empty(len(z), complex)
        _gather_complex()(c.astype(complex).ravel(), strides, *shape, np.ascontiguousarray(z, complex), out)
    else:
        out = np.empty(len(z))
        _gather_real(c.ravel(), strides, *shape, np.ascontiguousarray(z), out)
    return out


def relative_index(offsets: Array, start: Array, grid: Grid, periodic: Sequence[bool] | None = None) -> Array:
    """Return the indices, counted from the first point of a grid, of the points start + offsets (J, n); angles are wrapped."""
    x = offsets + (start - grid.centre)
    if periodic is not None and any(periodic):
        x = np.where(np.array(periodic), x - 2 * np.pi * np.round(x.real / (2 * np.pi)), x)
    return np.asarray(transformed(x, np.linalg.inv(grid.basis)) + np.array(grid.sizes) // 2)


def resampled(values: Array, grid: Grid, new: Grid, periodic: Sequence[bool] | None = None) -> Array:
    """Return the spline interpolant of a density at the points of another grid (*sizes)."""
    coefficients = filtered(values, gaussian_response(np.zeros((grid.n, grid.n)), grid.sizes, spline=True))
    return gather(coefficients, relative_index(new.offsets, new.centre, grid, periodic), grid).reshape(new.sizes)


def padded(values: Array, grid: Grid, sizes: tuple[int, ...]) -> tuple[Array, Grid]:
    """Return a density with zeros around it, on a grid of larger sizes."""
    if sizes == grid.sizes:
        return values, grid
    widths = [(new // 2 - old // 2, (new - new // 2) - (old - old // 2)) for old, new in zip(grid.sizes, sizes, strict=True)]
    return np.pad(values, widths), grid._replace(sizes=sizes)


def triangular_resampled(values: Array, grid: Grid, new: Grid, sheared: bool = False) -> Array:
    """Return the band-limited interpolant of a density on a grid whose axes are the old ones times a lower triangle.

    Lines along an axis are first shifted by what the axes before it say, in frequency, then scaled together by a sinc matrix.
    Outside of the old grid the density is zero.  `sheared` tells that the grid has points enough for the shifts.
    """
    if np.iscomplexobj(values):
        real, imag = (triangular_resampled(np.ascontiguousarray(part), grid, new, sheared) for part in (values.real, values.imag))
        return np.asarray(real + 1j * imag)
    n = grid.n
    inverse = np.linalg.inv(grid.basis)
    matrix = inverse @ new.basis
    middle = inverse @ (new.centre - grid.centre)
    # A sheared density has higher frequencies along the axes before, for which these need more points.
    needed = np.ones(n)
    for d in range(1, n):
        needed[:d] += np.abs(np.linalg.solve(matrix[:d, :d].T, matrix[d, :d]))
    if needed.max() > _MOST_SHEARED:
        return sinc_resampled(values, grid, new)
    if needed.max() > 1.05 and not sheared:
        sizes = tuple(rounded_size(size * needed[d], size, 4 * size) for d, size in enumerate(grid.sizes))
        finer = Grid(grid.centre, grid.basis * (np.array(grid.sizes) / np.array(sizes)), sizes, grid.closed)
        values, grid = triangular_resampled(values, grid, finer), finer
        return triangular_resampled(values, grid, new, sheared=True)
    axes = [np.arange(size, dtype=float) - size // 2 for size in grid.sizes]
    for d in reversed(range(n)):
        if d:
            before = np.linalg.solve(matrix[:d, :d].T, matrix[d, :d])
            shift = np.zeros([1] * n)
            for e in range(d):
                shift = shift + before[e] * (axes[e] - middle[e]).reshape([-1 if a == e else 1 for a in range(n)])
            if np.abs(before).max() > 1e-15:
                values = _shifted(values, d, shift)
        target = np.arange(new.sizes[d], dtype=float) - new.sizes[d] // 2
        at = middle[d] + matrix[d, d] * target
        kernel_matrix = np.sinc(at[:, None] - axes[d])
        inside = np.abs(at + 0.5 * (grid.sizes[d] % 2 == 0)) <= 0.5 * grid.sizes[d]
        values = np.moveaxis(np.tensordot(kernel_matrix * inside[:, None], values, axes=([1], [d])), 0, d)
    return np.asarray(values)


def sinc_resampled(values: Array, grid: Grid, new: Grid) -> Array:
    """Return the band-limited interpolant of a density at the points of any grid; zero outside of the old one."""
    n = grid.n
    z = relative_index(new.offsets, new.centre, grid)
    out = np.zeros(len(z), values.dtype)
    rest = int(np.prod(grid.sizes[1:]))
    block = max(1, 8_000_000 // rest)
    for first in range(0, len(z), block):
        part = z[first : first + block]
        kernels = [np.sinc(part[:, d : d + 1] - np.arange(grid.sizes[d])) for d in range(n)]
        sums = (kernels[0] @ values.reshape(grid.sizes[0], -1)).reshape(len(part), *grid.sizes[1:])
        for d in range(1, n):
            sums = np.einsum("ji...,ji->j...", sums, kernels[d])
        inside = np.all((part > -0.5) & (part < np.array(grid.sizes) - 0.5), axis=1)
        out[first : first + block] = np.where(inside, sums, 0.0)
    return out.reshape(new.sizes)


def _shifted(values: Array, axis: int, shift: Array) -> Array:
    """Return u(z + shift) along an axis; `shift` has length one along it.  Zeros around make room for the shift."""
    size = values.shape[axis]
    room = int(min(np.ceil(np.abs(shift).max()), size)) + 2
    padding = [(room, room) if a == axis else (0, 0) for a in range(values.ndim)]
    wide = np.pad(values, padding)
    k = 2 * np.pi * np.fft.rfftfreq(size + 2 * room)
    view = k.reshape([-1 if a == axis else 1 for a in range(values.ndim)])
    moved = np.fft.irfft(np.fft.rfft(wide, axis=axis) * np.exp(1j * view * shift), size + 2 * room, axis=axis)
    return np.take(moved, np.arange(room, room + size), axis=axis)


def refined(values: Array, grid: Grid, sizes: tuple[int, ...]) -> tuple[Array, Grid]:
    """Return the band-limited interpolant on a grid over the same window with more points."""
    basis = grid.basis * (np.array(grid.sizes) / np.array(sizes))
    new = Grid(grid.centre, basis, sizes, grid.closed)
    return triangular_resampled(values, grid, new), new


def gradient(values: Array, grid: Grid) -> Array:
    """Return the derivatives of real values along the axes, in index units (n, *sizes)."""
    spectrum = np.fft.rfftn(values)
    k, _ = _frequencies(values.shape)
    axes = tuple(range(values.ndim))
    return np.stack([np.fft.irfftn(1j * k[d] * spectrum, values.shape, axes) for d in axes])


_SIZES = np.array([8, 12, 16, 20, 24, 28, 32, 36, 40, 48, 54, 60, 64, 72, 80, 90, 96, 108, 120, 128, 144, 160, 180, 192, 216, 240,
                   256, 288, 320, 360, 384, 432, 480, 512, 576, 640, 720, 768, 864, 960, 1024,
                   1152, 1280, 1440, 1536, 1728, 1920, 2048])  # fmt: skip


def rounded_size(points: float, least: int, most: int) -> int:
    """Return the smallest size, fast for the Fourier transform, of at least so many points, between two bounds."""
    wanted = min(max(points, least), most)
    return int(_SIZES[min(int(np.searchsorted(_SIZES, wanted - 1e-9)), len(_SIZES) - 1)])
