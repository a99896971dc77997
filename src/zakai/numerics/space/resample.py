"""Band-limited interpolation of a density on other grids."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.space.grid import (
    Grid,
    rounded_size,
)
from zakai.numerics.space.spline import relative_index

Array = NDArray[Any]
_MOST_SHEARED = 3.0  # times the points of an axis that a shear may need


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
    z = relative_index(new, grid)
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


@lru_cache(maxsize=256)
def _finer(size: int, new: int, closed: bool) -> Array:
    """Return the matrix (new, size) of band-limited interpolation along an axis, at more points over the same width."""
    at = (np.arange(new) - new // 2) * (size / new)
    apart = at[:, None] - (np.arange(size) - size // 2)
    if not closed:
        return np.sinc(apart)
    waves = np.arange(1, (size + 1) // 2)
    matrix = 1.0 + 2.0 * np.cos(2 * np.pi / size * apart[..., None] * waves).sum(axis=-1)
    return np.asarray((matrix + (np.cos(np.pi * apart) if size % 2 == 0 else 0.0)) / size)


def refined(values: Array, grid: Grid, sizes: tuple[int, ...]) -> tuple[Array, Grid]:
    """Return the band-limited interpolant on a grid over the same window with more points."""
    for d, size in enumerate(sizes):
        if size != grid.sizes[d]:
            matrix = _finer(grid.sizes[d], size, grid.closed[d])
            values = np.moveaxis(np.tensordot(matrix, values, axes=([1], [d])), 0, d)
    basis = grid.basis * (np.array(grid.sizes) / np.array(sizes))
    return np.ascontiguousarray(values), Grid(grid.centre, basis, sizes, grid.closed)
