"""Functions on uniform affine grids in one to four dimensions: Gaussian spreading and interpolation by splines and in frequency.

A grid is x = centre + basis (i - size // 2).  A density that the grid resolves is band-limited: its sums are integrals, and
spreading by a Gaussian is exact in frequency.  Values between the points are those of the quintic spline, whose error for a
Gaussian of s spacings is about 5e-4 / s^6.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.compiled import kernel
from zakai.numerics.complex_step import is_complex

Array = NDArray[Any]
_MOST_SHEARED = 3.0  # times the points of an axis that a shear may need
BLOCK = 5  # points of a block along each axis, of which the six taps of a spline reach two at most
PAD = 3  # zeros, or the other end of a circle, around the coefficients of a spline


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
    def inverse(self) -> Array:
        """The inverse of the basis."""
        return np.linalg.inv(self.basis)

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
    inverse = grid.inverse
    return filtered(values, gaussian_response(inverse @ cov @ inverse.T, grid.sizes, spline))


@kernel(
    "void(float64[::1], int64[::1], boolean[::1], float64, float64[:, ::1], float64[::1])",
    "void(complex128[::1], int64[::1], boolean[::1], float64, complex128[:, ::1], complex128[::1])",
)
def _gather(values: Any, sizes: Any, closed: Any, least: Any, z: Any, out: Any) -> None:
    """out_j = sum over the taps of coefficients times quintic B-splines at indices z (n, J).

    Outside it is zero, and where all coefficients are below `least`.
    """
    n, count = z.shape
    padded = sizes + 2 * PAD
    strides = np.ones(n, np.int64)
    for d in range(n - 2, -1, -1):
        strides[d] = strides[d + 1] * padded[d + 1]
    last = sizes[n - 1]
    c = np.zeros(strides[0] * padded[0], z.dtype)
    for line in range(c.size // padded[n - 1]):
        # The source of a padded line: zeros, or the other end of a circle, surround the coefficients.
        rest, source, scale, inside = line, 0, last, True
        for d in range(n - 2, -1, -1):
            i = rest % padded[d] - PAD
            rest //= padded[d]
            if closed[d]:
                i = i % sizes[d]
            inside = inside and 0 <= i < sizes[d]
            source += i * scale
            scale *= sizes[d]
        first = line * padded[n - 1] + PAD
        if inside:
            for i in range(last):
                c[first + i] = values[source + i]
            if closed[n - 1]:
                for i in range(PAD):
                    c[first - 1 - i] = values[source + last - 1 - i]
                    c[first + last + i] = values[source + i]
    # The largest coefficient of each block.
    blocks = (padded + BLOCK - 1) // BLOCK
    steps = np.ones(n, np.int64)
    for d in range(n - 2, -1, -1):
        steps[d] = steps[d + 1] * blocks[d + 1]
    largest = np.zeros(steps[0] * blocks[0])
    for line in range(c.size // padded[n - 1]):
        rest, block = line, 0
        for d in range(n - 2, -1, -1):
            block += rest % padded[d] // BLOCK * steps[d]
            rest //= padded[d]
        first = line * padded[n - 1]
        for i in range(padded[n - 1]):
            at = block + i // BLOCK
            largest[at] = max(largest[at], abs(c[first + i].real))
    scaling = 120.0**-n
    outer = 1
    for _ in range(n - 1):
        outer *= 6
    offsets = np.zeros(outer, np.int64)
    weights = np.zeros(outer, z.dtype)
    w = np.zeros((n, 6), z.dtype)
    blocks_at = np.zeros(2**n, np.int64)
    for j in range(count):
        base = 0
        inside = True
        used = 1
        blocks_at[0] = 0
        for d in range(n):
            floor = math.floor(z[d, j].real) if math.isfinite(z[d, j].real) else -1e9
            if not closed[d] and (floor < -1 or floor >= sizes[d]) or abs(floor) > 1e8:
                inside = False
                break
            cell = int(floor)
            if closed[d]:
                cell = cell % sizes[d]
            first = cell + PAD - 2
            base += first * strides[d]
            low, high = first // BLOCK, (first + 5) // BLOCK
            for i in range(used):
                blocks_at[used + i] = blocks_at[i] + high * steps[d]
                blocks_at[i] += low * steps[d]
            used *= 2
        if inside:
            inside = False
            for i in range(used):
                inside = inside or largest[blocks_at[i]] >= least
        if not inside:
            out[j] = 0.0
            continue
        for d in range(n):
            t = z[d, j] - math.floor(z[d, j].real)
            s = 1.0 - t
            t2 = t * t
            s2 = s * s
            w[d, 0] = s2 * s2 * s
            w[d, 5] = t2 * t2 * t
            w[d, 1] = 26.0 + t * (-50.0 + t * (20.0 + t * (20.0 + t * (-20.0 + 5.0 * t))))
            w[d, 2] = 66.0 + t2 * (-60.0 + t2 * (30.0 - 10.0 * t))
            w[d, 3] = 66.0 + s2 * (-60.0 + s2 * (30.0 - 10.0 * s))
            w[d, 4] = 26.0 + s * (-50.0 + s * (20.0 + s * (20.0 + s * (-20.0 + 5.0 * s))))
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
            row = (
                c[o] * w[n - 1, 0]
                + c[o + 1] * w[n - 1, 1]
                + c[o + 2] * w[n - 1, 2]
                + c[o + 3] * w[n - 1, 3]
                + c[o + 4] * w[n - 1, 4]
                + c[o + 5] * w[n - 1, 5]
            )
            total += weights[i] * row
        out[j] = total * scaling


def gather(coefficients: Array, z: Array, grid: Grid, least: float = 0.0) -> Array:
    """Return the spline with the coefficients (*sizes) at the indices z (J, n), counted from the first point of the grid.

    It is zero where all coefficients nearby are below `least`.
    """
    dtype = complex if is_complex(coefficients, z) else float
    out = np.empty(len(z), dtype)
    c, at = np.ascontiguousarray(coefficients, dtype).reshape(-1), np.ascontiguousarray(z.T, dtype)
    _gather(c, np.array(grid.sizes, np.int64), np.array(grid.closed), least, at, out)
    return out


def relative_index(offsets: Array, start: Array, grid: Grid, periodic: Sequence[bool] | None = None) -> Array:
    """Return the indices, counted from the first point of a grid, of the points start + offsets (J, n); angles are wrapped."""
    x = offsets + (start - grid.centre)
    if periodic is not None and any(periodic):
        x = np.where(np.array(periodic), x - 2 * np.pi * np.round(x.real / (2 * np.pi)), x)
    return np.asarray(transformed(x, grid.inverse) + np.array(grid.sizes) // 2)


def resampled(values: Array, grid: Grid, new: Grid, periodic: Sequence[bool] | None = None) -> Array:
    """Return the spline interpolant of a density at the points of another grid (*sizes)."""
    coefficients = filtered(values, gaussian_response(np.zeros((grid.n, grid.n)), grid.sizes, spline=True))
    return gather(coefficients, relative_index(new.offsets, new.centre, grid, periodic), grid).reshape(new.sizes)


def padded(values: Array, grid: Grid, sizes: tuple[int, ...]) -> tuple[Array, Grid]:
    """Return a density with zeros around it, on a grid of larger sizes."""
    if sizes == grid.sizes:
        return values, grid
    wide = np.zeros(sizes, values.dtype)
    first = [new // 2 - old // 2 for old, new in zip(grid.sizes, sizes, strict=True)]
    wide[tuple(slice(i, i + old) for i, old in zip(first, grid.sizes, strict=True))] = values
    return wide, grid._replace(sizes=sizes)


def triangular_resampled(values: Array, grid: Grid, new: Grid, sheared: bool = False) -> Array:
    """Return the band-limited interpolant of a density on a grid whose axes are the old ones times a lower triangle.

    Lines along an axis are first shifted by what the axes before it say, in frequency, then scaled together by a sinc matrix.
    Outside of the old grid the density is zero.  `sheared` tells that the grid has points enough for the shifts.
    """
    if np.iscomplexobj(values):
        real, imag = (triangular_resampled(np.ascontiguousarray(part), grid, new, sheared) for part in (values.real, values.imag))
        return np.asarray(real + 1j * imag)
    n = grid.n
    inverse = grid.inverse
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
    """Return u(z + shift) along an axis; `shift` has length one along it.  Zeros around it leave space for the shift."""
    size = values.shape[axis]
    padding_size = int(min(np.ceil(np.abs(shift).max()), size)) + 2
    padding = [(padding_size, padding_size) if a == axis else (0, 0) for a in range(values.ndim)]
    wide = np.pad(values, padding)
    k = 2 * np.pi * np.fft.rfftfreq(size + 2 * padding_size)
    view = k.reshape([-1 if a == axis else 1 for a in range(values.ndim)])
    moved = np.fft.irfft(np.fft.rfft(wide, axis=axis) * np.exp(1j * view * shift), size + 2 * padding_size, axis=axis)
    return np.take(moved, np.arange(padding_size, padding_size + size), axis=axis)


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


_SIZES = np.array([8, 12, 16, 20, 24, 28, 32, 36, 40, 44, 48, 52, 56, 60, 64, 70, 72, 80, 84, 90, 96, 100, 108, 112, 120, 128,
                   140, 144, 160, 180, 192, 216, 240, 256, 288, 320, 360, 384, 432, 480, 512, 576, 640, 720, 768, 864, 960, 1024,
                   1152, 1280, 1440, 1536, 1728, 1920, 2048])  # fmt: skip


def rounded_size(points: float, least: int, most: int) -> int:
    """Return the smallest size, fast for the Fourier transform, of at least so many points, between two bounds."""
    wanted = min(max(points, least), most)
    return int(_SIZES[min(int(np.searchsorted(_SIZES, wanted - 1e-9)), len(_SIZES) - 1)])
