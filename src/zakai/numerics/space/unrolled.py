"""Densities of angles on the line: any density whose sum over whole turns is the density on the circle.

A Gaussian transition needs no circle: functions of the angle are periodic, and a density on the line obeys the same equation.
What has spread over more than three turns is folded: its sum over whole turns, times a smooth window whose sum over whole turns
is one, is again such a density.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from zakai.numerics.complex_step import is_complex
from zakai.numerics.space.grid import Grid
from zakai.numerics.space.resample import sinc_resampled, triangular_resampled

Array = NDArray[Any]
Interpolant = Callable[[Array, Grid, Grid], Array]
SMOOTH = 0.8  # the window is (erf((a + pi) / SMOOTH) - erf((a - pi) / SMOOTH)) / 2
REACH = np.pi + 5.2 * SMOOTH  # where it has fallen to 1e-13
HIGHEST = 10.6 / SMOOTH  # the frequency at which its spectrum has fallen to 1e-12
MOST = 6 * np.pi  # width of a grid from which on a density is folded


def window(angle: Array) -> Array:
    """Return the smooth window at angles relative to its centre."""
    return np.asarray(0.5 * (erf((angle + np.pi) / SMOOTH) - erf((angle - np.pi) / SMOOTH)))


def widths(grid: Grid) -> Array:
    """Return the widths (n,) of a grid along the coordinates."""
    return np.asarray(np.abs(grid.basis) @ np.array(grid.sizes))


def _sum_of_turns(values: Array, grid: Grid, new: Grid, angle: Array, resampled: Interpolant) -> Array:
    """Return the sum over whole turns of a density on the line at the points of a grid."""
    reach = 0.5 * (widths(grid) + widths(new))
    turns = np.where(angle, np.ceil((reach + np.abs(grid.centre - new.centre)) / (2 * np.pi)), 0).astype(int)
    total = np.zeros(new.sizes, values.dtype)
    for shift in np.ndindex(*(2 * turns + 1)):
        place = new.centre + 2 * np.pi * (np.array(shift) - turns)
        if np.all(np.abs(place - grid.centre) < reach):
            total += resampled(values, grid, new._replace(centre=place, closed=grid.closed))
    return total


def folded(values: Array, grid: Grid, angles: tuple[bool, ...], centre: Array, narrow: bool) -> tuple[Array, Grid]:
    """Return the sum of a density over whole turns, times the window, on a grid with the same directions.

    Args:
        values: the density on the line (*sizes).
        grid: its grid, without closed axes.
        angles: which coordinates are angles (n,).
        centre: the centre (n,) of the window; only its angles are used.
        narrow: whether the density is zero half a turn from the centre, so that it may be cut there.
    """
    angle = np.array(angles)
    reach = np.where(angle, np.pi if narrow else REACH, 0.5 * widths(grid))
    scale = 1.0 + (0.0 if narrow else HIGHEST / np.pi) * np.abs(grid.basis[angle]).sum(axis=0)
    basis = grid.basis / scale
    sizes = tuple(2 * int(np.ceil(half)) for half in np.abs(np.linalg.inv(basis)) @ reach)
    new = Grid(np.where(angle, centre, grid.centre), basis, sizes, grid.closed)
    apart = new.offsets[:, angle]
    weights = (np.abs(apart) <= np.pi) * 1.0 if narrow else window(apart)
    return _sum_of_turns(values, grid, new, angle, triangular_resampled) * weights.prod(axis=1).reshape(sizes), new


def wrapped(values: Array, grid: Grid, angles: tuple[bool, ...]) -> tuple[Array, Grid]:
    """Return a density on the line as one on the circle, on an aligned grid."""
    angle = np.array(angles)
    reach = np.where(angle, np.pi, 0.5 * widths(grid))
    sizes = tuple(int(2 * np.ceil(r * k)) for r, k in zip(reach, np.abs(grid.inverse).sum(axis=0), strict=True))
    new = Grid(grid.centre, np.diag(2 * reach / np.array(sizes)), sizes, angles)
    return _sum_of_turns(values, grid, new, angle, sinc_resampled), new


def weighed(values: Array, grid: Grid, angles: tuple[bool, ...]) -> Array:
    """Return values on an aligned grid times the window about its centre."""
    for d, angle in enumerate(angles):
        if angle:
            line = window(grid.basis[d, d] * (np.arange(grid.sizes[d]) - grid.sizes[d] // 2))
            values = values * line.reshape([-1 if a == d else 1 for a in range(grid.n)])
    return values


def _on_more_points(values: Array, count: int, axis: int) -> Array:
    """Return a periodic function at more points along an axis."""
    if is_complex(values):
        return _on_more_points(values.real, count, axis) + 1j * _on_more_points(values.imag, count, axis)
    size, spectrum = values.shape[axis], np.moveaxis(np.fft.rfft(values, axis=axis), axis, -1)
    if size % 2 == 0:
        spectrum[..., -1] *= 0.5  # half of the highest frequency belongs to its negative
    return np.moveaxis(np.fft.irfft(spectrum, count), -1, axis) * (count / size)


def opened(values: Array, grid: Grid) -> tuple[Array, Grid]:
    """Return a density on an aligned grid with closed axes as one on the line."""
    for d, closed in enumerate(grid.closed):
        if closed:
            size = grid.sizes[d]
            finer = int(2 * np.ceil(0.5 * size + HIGHEST))
            wide = int(2 * np.ceil(REACH / (2 * np.pi) * finer))
            # The first point of the grid keeps its place.
            values = np.roll(_on_more_points(values, finer, d), finer // 2 - round(size // 2 * finer / size), axis=d)
            values = np.take(values, np.arange(finer // 2 - wide // 2, finer // 2 - wide // 2 + wide) % finer, axis=d)
            basis = grid.basis.copy()
            basis[d, d] = 2 * np.pi / finer
            sizes = tuple(wide if a == d else s for a, s in enumerate(grid.sizes))
            grid = Grid(grid.centre, basis, sizes, tuple(c and a != d for a, c in enumerate(grid.closed)))
            values = weighed(values, grid, tuple(a == d for a in range(grid.n)))
    return values, grid
