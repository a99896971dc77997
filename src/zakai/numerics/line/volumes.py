"""Finite volumes of graded size on the line, for a density that contracts by a large factor within one interval.

    u_t = (G u)'' / 2 - (f u)' + V u

The cells are uniform in s, x = centre + scale sinh(s): of one size around the centre, proportional to the distance far from it.
Space is of second order, extrapolated in the size of the cells by `methods/line/volumes.py`.  Time is implicit Euler, which is
stable for every drift, extrapolated to fifth order in steps of controlled error (Hairer and Wanner, Solving Ordinary Differential
Equations II, section IV.9).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import complex128, float64, int64

from zakai.numerics.arrays import Array, Number
from zakai.numerics.compiled import helper, kernel
from zakai.numerics.line import window as lw
from zakai.numerics.line.window import interpolated_logs

Bands = tuple[Array, Array, Array]

_COUNTS = (1, 2, 3, 4, 6)  # steps of implicit Euler that are extrapolated
_TIMES = np.unique([j / count for count in _COUNTS for j in range(1, count + 1)])  # of a step, at which they need the operator
# The rows of the operators at those times (6, C) for the steps of each count, -1 where there are no more.
_PLACES = np.array([[np.searchsorted(_TIMES, j / c) if j <= c else -1 for c in _COUNTS] for j in range(1, _COUNTS[-1] + 1)])
_BACKWARD = np.ascontiguousarray(_PLACES[::-1])


BASE = 256  # cells of which there is a multiple by a power of two
_FEWEST = 8  # cells between two cuts
_BESIDE = 1e-10  # of the range in s: how far beside a cut coefficients are those of its side


class Volumes(NamedTuple):
    """Cells between the faces origin + centre + scale sinh(s), s from `first` to `last`, uniform between two `cuts`.

    The cuts are faces, at which coefficients may have a kink or a jump.
    """

    origin: float
    centre: float
    scale: float
    first: float
    last: float
    size: int
    cuts: tuple[float, ...] = ()

    @property
    def closed(self) -> bool:
        """Whether they go around a circle: no."""
        return False

    @property
    def ends(self) -> tuple[Array, Array]:
        """Between which s (P + 1,) the cells are uniform, and how many lie before each (P + 1,)."""
        return _geometry(self)[:2]

    def reaching(self, low: float, high: float) -> Volumes:
        """Return as many cells that also cover two offsets from the origin."""
        first, last = np.arcsinh((np.array([low, high]) - self.centre) / self.scale)
        return self._replace(first=min(self.first, float(first)), last=max(self.last, float(last)))

    def place(self, offsets: Array) -> Array:
        """Return how many cells lie before offsets (J,) from the origin, NaN beyond the cells."""
        s, before = self.ends
        return np.interp(np.arcsinh((offsets - self.centre) / self.scale), s, before, np.nan, np.nan)

    @property
    def offsets(self) -> Array:
        """The middles of the cells in s (N,) as offsets from the origin."""
        return _geometry(self)[2]

    @property
    def faces(self) -> Array:
        """The faces (N + 1,) as offsets from the origin."""
        return _geometry(self)[3]

    @property
    def widths(self) -> Array:
        """The lengths of the cells (N,)."""
        return _geometry(self)[4]

    @property
    def points(self) -> Array:
        """The middles of the cells, the faces between two cells, and points on both sides of each cut (2 N - 1 + 2 C,)."""
        s = np.repeat(self.cuts, 2) + np.tile([-_BESIDE, _BESIDE], len(self.cuts)) * (self.last - self.first)
        beside = self.centre + self.scale * np.sinh(s)
        return self.origin + np.concatenate([self.offsets, self.faces[1:-1], beside])

    def bands(self, covariance: Array, drift: Array, potential: Array) -> Bands:
        """Return the operators on the masses of the cells at times (T,): below, on and above the diagonal.

        Args:
            covariance: G (T, 1), or its values at `points` (T, P).
            drift: f at `points` (T, P).
            potential: V at `points` (T, P).
        """
        size, offsets, faces, widths = self.size, self.offsets, self.faces, self.widths
        apart, f = np.diff(offsets), drift[:, size : 2 * size - 1].copy()
        sides = drift[:, 2 * size - 1 :]
        f[:, self.ends[1][1:-1] - 1] = 0.5 * (sides[:, ::2] + sides[:, 1::2])  # at a jump
        share, G = (offsets[1:] - faces[1:-1]) / apart, np.broadcast_to(covariance, drift.shape)[:, :size]
        out = (f * share + 0.5 * G[:, :-1] / apart) / widths[:-1]  # of the flux from a cell to the next
        back = (0.5 * G[:, 1:] / apart - f * (1.0 - share)) / widths[1:]
        diagonal = potential[:, :size] + 0.0 * (covariance[:, :1] + drift[:, :1])  # of the type of all three
        diagonal[:, :-1] -= out
        diagonal[:, 1:] -= back
        return out, diagonal, back

    def density(self, masses: Array) -> Callable[[Array], Array]:
        """Return the function that interpolates the density at offsets (J,), zero where masses are rounding."""
        s, before = self.ends
        parts = []
        for first, last in zip(before[:-1], before[1:], strict=True):
            own, size = masses[first:last], last - first
            curvature = np.diff(own, 2)[np.clip(np.arange(size) - 1, 0, size - 3)]
            smooth = own - curvature / 24.0  # from the mean over a cell to the value in its middle
            parts.append((np.where(smooth.real > 0, smooth, 0.0), lw.Window(0.0, first + size // 2 + 0.5, 1.0, size, False, 1.0)))
        steps = np.diff(s) / np.diff(before)

        def at(offsets: Array) -> Array:
            index, result = self.place(offsets), np.zeros(offsets.shape, masses.dtype)
            part = np.searchsorted(before[1:-1], index, side="right")
            for j, (smooth, window) in enumerate(parts):
                here = (part == j) & np.isfinite(index)
                inner = np.clip(index[here], before[j] + 1e-6, before[j + 1] - 1e-6)  # a face itself lies beyond a window
                result[here] = interpolated_logs(smooth, window, inner)
            return result / (steps[part] * np.sqrt(self.scale**2 + (offsets - self.centre) ** 2))

        return at


@lru_cache(maxsize=16)
def _geometry(cells: Volumes) -> tuple[Array, Array, Array, Array, Array]:
    """Return the ends of the uniform parts in s, the cells before these, the middles, the faces and the widths."""
    s = np.array([cells.first, *cells.cuts, cells.last])
    counts = np.maximum(np.round(BASE * np.diff(s) / (s[-1] - s[0])).astype(int), _FEWEST)
    counts[np.argmax(counts)] += BASE - counts.sum()
    before = np.concatenate([[0], np.cumsum(counts)]) * (cells.size // BASE)
    middles, faces = (
        cells.centre + cells.scale * np.sinh(np.interp(index, before, s))
        for index in (np.arange(cells.size) + 0.5, np.arange(cells.size + 1.0))
    )
    result = s, before, middles, faces, np.diff(faces)
    for array in result:
        array.setflags(write=False)
    return result


def volumes(origin: float, centre: float, scale: float, low: float, high: float, size: int) -> Volumes:
    """Return `size` cells between two offsets from the origin."""
    first, last = np.arcsinh((np.array([low, high]) - centre) / scale)
    return Volumes(origin, centre, scale, float(first), float(last), size)


def ends_of_steps(length: float, first: float, count: int) -> Array:
    """Return the ends (T + 1,) of `count` steps of a time, a first one and then longer by equal factors, with a zero before."""
    return np.concatenate([[0.0], first * (length / first) ** np.linspace(0.0, 1.0, count)])


def advanced(bands: Callable[[Array], Bands], values: Array, ends: Array, backward: bool = False) -> tuple[Array, Number]:
    """Return the masses after steps, with the sum one, and the logarithm of their sum before.

    Args:
        bands: the operators at times after the start (T,), or one that holds at all times.
        values: the masses (N,); `backward` what a mass in each cell is worth at the end, which the adjoint operator takes to
            the start.
        ends: the ends of the steps (T + 1,), with the start.
        backward: whether to take the adjoint.
    """
    gained: Number = 0.0
    steps = list(zip(ends[:-1], ends[1:], strict=True))
    for start, stop in steps[::-1] if backward else steps:
        below, diagonal, above = bands(start + (stop - start) * _TIMES)
        if backward:
            below, above = above, below
        arrays = [np.ascontiguousarray(part) for part in (below, diagonal, above, values)]
        if any(np.iscomplexobj(part) for part in arrays):
            arrays = [part.astype(complex) for part in arrays]
        values = _extrapolated(*arrays, stop - start, _BACKWARD if backward else _PLACES)
        total = np.sum(values)
        values, gained = values / total, gained + np.log(total)
    return values, gained


@kernel(
    float64[::1](float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[::1], float64, int64[:, ::1]),
    complex128[::1](complex128[:, ::1], complex128[:, ::1], complex128[:, ::1], complex128[::1], float64, int64[:, ::1]),
)
def _extrapolated(below: Array, diagonal: Array, above: Array, values: Array, step: float, places: Array) -> Array:
    """Return the masses after a step, from the operators at parts `_TIMES` of it.

    `places` (6, C) are the rows of the operators of each series of Euler steps, -1 where it has no more steps.
    """
    count, size = len(_COUNTS), values.shape[0]
    row, upper = np.empty((size, count), values.dtype), np.empty((size, 3, count), values.dtype)
    for i in range(size):
        for j in range(count):
            row[i, j] = values[i]
    for i in range(places.shape[0]):
        _solve(below, diagonal, above, places[i], row, step, upper)
    for k in range(1, count):
        for j in range(count - 1, k - 1, -1):
            share = 1.0 / (_COUNTS[j] / _COUNTS[j - k] - 1.0)
            for i in range(size):
                row[i, j] += share * (row[i, j] - row[i, j - 1])
    return row[:, count - 1].copy()


@helper
def _solve(below: Array, diagonal: Array, above: Array, places: Array, x: Array, step: float, upper: Array) -> None:
    """Replace x[:, j] by the solutions of (1 - h_j L) y = x[:, j], h_j = step / count, by elimination with row exchanges.

    L has the bands of row `places[j]`, no solution is wanted where that is negative.  `upper` (N, 3, C) holds the triangular
    matrices.  The series are solved side by side, since each waits for its divisions.
    """
    size, first, most = x.shape[0], 0, diagonal.shape[0] - 1
    while places[first] < 0:
        first += 1
    now, right = np.empty(len(_COUNTS), x.dtype), np.empty(len(_COUNTS), x.dtype)
    for j in range(first, len(_COUNTS)):
        k, h = min(places[j], most), step / _COUNTS[j]
        now[j], right[j] = 1.0 - h * diagonal[k, 0], -h * above[k, 0]
    for i in range(size - 1):
        for j in range(first, len(_COUNTS)):
            k, h = min(places[j], most), step / _COUNTS[j]
            low, mid, high = -h * below[k, i], 1.0 - h * diagonal[k, i + 1], 0.0 * now[j]
            if i + 2 < size:
                high = -h * above[k, i + 1]
            if abs(low.real) > abs(now[j].real):
                inverse = 1.0 / low
                factor = now[j] * inverse
                upper[i, 0, j], upper[i, 1, j], upper[i, 2, j] = inverse, mid, high
                now[j], right[j] = right[j] - factor * mid, -factor * high
                x[i, j], x[i + 1, j] = x[i + 1, j], x[i, j] - factor * x[i + 1, j]
            else:
                inverse = 1.0 / now[j]
                factor = low * inverse
                upper[i, 0, j], upper[i, 1, j], upper[i, 2, j] = inverse, right[j], 0.0 * inverse
                now[j], right[j] = mid - factor * right[j], high
                x[i + 1, j] -= factor * x[i, j]
    for j in range(first, len(_COUNTS)):
        x[size - 1, j] /= now[j]
        x[size - 2, j] = (x[size - 2, j] - upper[size - 2, 1, j] * x[size - 1, j]) * upper[size - 2, 0, j]
    for i in range(size - 3, -1, -1):
        for j in range(first, len(_COUNTS)):
            x[i, j] = (x[i, j] - upper[i, 1, j] * x[i + 1, j] - upper[i, 2, j] * x[i + 2, j]) * upper[i, 0, j]
