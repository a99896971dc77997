"""A uniform product grid in an affine frame, quintic B-splines on it, and Gaussian convolution along its axes.

    x = m + B z,    z_k = low_k + step_k i,   i = 0 .. N_k - 1;    u(x) = sum_i c_i prod_k beta5((z_k - low_k) / step_k - i_k)

A function is zero outside of its grid, except along a closed axis (an angle whose whole circle is covered), where it is periodic.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from zakai.numerics.compiled import helper

Array = Any
PAD = 6  # coefficients kept beyond both ends of an axis, so that the six taps of any point inside the support stay in the array
_RESOLVED = 0.5  # variance of a kernel in squares of the spacing, from which its values at the points are summed: error e^-10
_MARGIN = 0.9  # share of the half width of a box that noise adds in units of its deviation: 5 deviations of 5.5


class Grid(NamedTuple):
    """A grid: `centre` m (n,), `basis` B (n, n), `low` (n,), `step` (n,), `sizes` N (n,), and which axes are `closed` (n,)."""

    centre: Array
    basis: Array
    low: Array
    step: Array
    sizes: Array
    closed: Array

    @property
    def n(self) -> int:
        """The number of axes."""
        return len(self.low)

    @property
    def high(self) -> Array:
        """The last points of the axes (n,); of a closed axis the end of the circle."""
        return self.low + self.step * (self.sizes - 1 + self.closed)

    @property
    def volume(self) -> float:
        """The volume of a cell in x."""
        return float(np.prod(self.step) * abs(np.linalg.det(self.basis)))

    def axis(self, k: int) -> Array:
        """Return the points of an axis (N_k,)."""
        return self.low[k] + self.step[k] * np.arange(self.sizes[k])

    def z_of(self, x: Array) -> Array:
        """Return the coordinates z (n, P) of points x (n, P)."""
        return np.asarray(np.linalg.inv(self.basis) @ (x - self.centre[:, None]))

    def x_of(self, z: Array) -> Array:
        """Return the points x (n, P) of coordinates z (n, P)."""
        return self.centre[:, None] + self.basis @ z

    def index_of(self, x: Array) -> Array:
        """Return the nearest indices (P, n) of points x (n, P), inside of the grid."""
        index = np.rint((self.z_of(x) - self.low[:, None]) / self.step[:, None])
        top = self.sizes[:, None]
        index = np.where(self.closed[:, None], index % top, np.clip(index, 0, top - 1))
        return np.ascontiguousarray(index.T.astype(np.int64))


@helper
def taps(t: float, w: Array) -> None:
    """Write the values of the six quintic B-splines that do not vanish at an offset t in [0, 1) past the third of their knots."""
    t2 = t * t
    t3 = t2 * t
    t4 = t3 * t
    t5 = t4 * t
    s = 1.0 / 120.0
    w[0] = s * (1.0 - 5.0 * t + 10.0 * t2 - 10.0 * t3 + 5.0 * t4 - t5)
    w[1] = s * (26.0 - 50.0 * t + 20.0 * t2 + 20.0 * t3 - 20.0 * t4 + 5.0 * t5)
    w[2] = s * (66.0 - 60.0 * t2 + 30.0 * t4 - 10.0 * t5)
    w[3] = s * (26.0 + 50.0 * t + 20.0 * t2 - 20.0 * t3 - 20.0 * t4 + 10.0 * t5)
    w[4] = s * (1.0 + 5.0 * t + 10.0 * t2 + 10.0 * t3 + 5.0 * t4 - 5.0 * t5)
    w[5] = s * t5


@lru_cache(maxsize=512)
def padded_prefilter(size: int, closed: bool) -> Array:
    """Return the matrix (N + 2 PAD, N) from values at the points of an axis to B-spline coefficients."""
    A, i = np.zeros((size, size)), np.arange(size)
    for d, v in zip(range(-2, 3), (1, 26, 66, 26, 1), strict=True):
        j = i + d
        keep = np.ones(size, bool) if closed else (j >= 0) & (j < size)
        np.add.at(A, (i[keep], j[keep] % size), v / 120.0)
    inverse = np.linalg.inv(A)
    if closed:
        return np.ascontiguousarray(inverse[np.arange(-PAD, size + PAD) % size])
    return np.ascontiguousarray(np.pad(inverse, ((PAD, PAD), (0, 0))))


def kernel_matrix(grid: Grid, k: int, variance: float, target: Grid) -> Array:
    """Return the matrix (M, N) that convolves values on axis k of a grid with N(0, variance), to the axis of a target.

    A kernel that the points resolve is summed over them, with an error exp(-2 pi^2 variance / step^2); a narrower one, and one on
    a closed axis, is applied to the Fourier coefficients on the same points.
    """
    step, size, closed = float(grid.step[k]), int(grid.sizes[k]), bool(grid.closed[k])
    if closed or (variance < _RESOLVED * step**2):
        padded = size if closed else 2 * size
        frequencies = 2 * np.pi * np.fft.fftfreq(padded, step)
        row = np.fft.ifft(np.exp(-0.5 * variance * frequencies**2)).real
        i = np.arange(size)
        return row[(i[:, None] - i) % padded]
    apart = target.axis(k)[:, None] - grid.axis(k)
    return step / math.sqrt(2 * np.pi * variance) * np.exp(-0.5 * apart**2 / variance)


def after_noise(grid: Grid, variances: Array) -> Grid:
    """Return the grid, of as many points, that holds a density after a convolution with these variances of the axes (n,)."""
    low, step = grid.low.copy(), grid.step.copy()
    for k, variance in enumerate(variances):
        if not grid.closed[k] and variance >= _RESOLVED * step[k] ** 2:
            high = low[k] + step[k] * (grid.sizes[k] - 1)
            middle, half = 0.5 * (low[k] + high), 0.5 * (high - low[k])
            half = math.sqrt(half**2 + (_MARGIN * half) ** 2 * variance)
            low[k], step[k] = middle - half, 2 * half / (grid.sizes[k] - 1)
    return grid._replace(low=low, step=step)
