"""Finite volumes of graded size on the line, for a density that contracts by a large factor within one interval.

    u_t = (G u)'' / 2 - (f u)' + V u

The cells are uniform in s, x = centre + scale sinh(s): of one size around the centre, proportional to the distance far from it.
Space is of second order, extrapolated in the size of the cells by `_line_volumes`.  Time is implicit Euler, which is stable for
every drift, extrapolated to fifth order in steps of controlled error (Hairer and Wanner, Solving Ordinary Differential
Equations II, section IV.9).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs

from zakai.numerics import line_window as lw
from zakai.numerics.line_polynomial import interpolated_logs

Array = NDArray[Any]
Bands = tuple[Array, Array, Array]

_COUNTS = (1, 2, 3, 4, 6)  # steps of implicit Euler that are extrapolated
_TIMES = np.unique([j / count for count in _COUNTS for j in range(1, count + 1)])  # of a step, at which they need the operator
_PLACES = {count: np.searchsorted(_TIMES, [j / count for j in range(1, count + 1)]).tolist() for count in _COUNTS}


class Volumes(NamedTuple):
    """Cells between the faces origin + centre + scale sinh(s), s uniform from `first` to `last`."""

    origin: float
    centre: float
    scale: float
    first: float
    last: float
    size: int

    @property
    def closed(self) -> bool:
        """Whether they go around a circle: no."""
        return False

    @property
    def logarithmic(self) -> lw.Window:
        """The grid of s at the middles of the cells."""
        spacing = (self.last - self.first) / self.size
        return lw.Window(0.0, self.first + spacing * (self.size // 2 + 0.5), spacing, self.size, False, spacing)

    @property
    def offsets(self) -> Array:
        """The middles of the cells in s (N,) as offsets from the origin."""
        return self.centre + self.scale * np.sinh(self.logarithmic.offsets)

    @property
    def faces(self) -> Array:
        """The faces (N + 1,) as offsets from the origin."""
        return self.centre + self.scale * np.sinh(np.linspace(self.first, self.last, self.size + 1))

    @property
    def widths(self) -> Array:
        """The lengths of the cells (N,)."""
        return np.diff(self.faces)

    @property
    def points(self) -> Array:
        """The middles of the cells, then the faces between two cells (2 N - 1,)."""
        return self.origin + np.concatenate([self.offsets, self.faces[1:-1]])

    def bands(self, covariance: Array, drift: Array, potential: Array) -> Bands:
        """Return the operator on the masses of the cells: below, on and above the diagonal.

        Args:
            covariance: G, one number, or its values at `points` (2 N - 1,).
            drift: f at `points`.
            potential: V at `points`.
        """
        size, offsets, faces, widths = self.size, self.offsets, self.faces, self.widths
        apart = np.diff(offsets)
        share, f, G = (offsets[1:] - faces[1:-1]) / apart, drift[size:], 0.5 * (covariance * np.ones(2 * size - 1))[:size]
        out = (f * share + G[:-1] / apart) / widths[:-1]  # of the flux from a cell to the next
        back = (G[1:] / apart - f * (1.0 - share)) / widths[1:]
        diagonal = np.array(potential[:size])
        diagonal[:-1] -= out
        diagonal[1:] -= back
        return out, diagonal, back

    def density(self, masses: Array) -> Callable[[Array], Array]:
        """Return the function that interpolates the density at offsets (J,), zero where masses are rounding."""
        window = self.logarithmic
        smooth = np.array(masses)
        smooth[1:-1] -= np.diff(masses, 2) / 24.0  # from the mean over a cell to the value in its middle
        smooth = np.where(smooth.real > 0, smooth, 0.0)

        def at(offsets: Array) -> Array:
            s = np.arcsinh((offsets - self.centre) / self.scale)
            return interpolated_logs(smooth, window, s) / (window.spacing * self.scale * np.cosh(s))

        return at


def volumes(origin: float, centre: float, scale: float, low: float, high: float, size: int) -> Volumes:
    """Return `size` cells between two offsets from the origin."""
    first, last = np.arcsinh((np.array([low, high]) - centre) / scale)
    return Volumes(origin, centre, scale, float(first), float(last), size)


def ends_of_steps(length: float, first: float, count: int) -> Array:
    """Return the ends (T + 1,) of `count` steps of a time, a first one and then longer by equal factors, with a zero before."""
    return np.concatenate([[0.0], first * (length / first) ** np.linspace(0.0, 1.0, count)])


def advanced(bands: Callable[[Array], list[Bands]], values: Array, ends: Array, backward: bool = False) -> tuple[Array, Any]:
    """Return the masses after steps, with the sum one, and the logarithm of their sum before.

    Args:
        bands: the operators at times after the start (T,).
        values: the masses (N,); `backward` what a mass in each cell is worth at the end, which the adjoint operator takes to
            the start.
        ends: the ends of the steps (T + 1,), with the start.
        backward: whether to take the adjoint.
    """
    gained: Any = 0.0
    steps = list(zip(ends[:-1], ends[1:], strict=True))
    for start, stop in steps[::-1] if backward else steps:
        values = _extrapolated(bands(start + (stop - start) * _TIMES), values, stop - start, backward)
        total = np.sum(values)
        values, gained = values / total, gained + np.log(total)
    return values, gained


def _extrapolated(bands: list[Bands], values: Array, step: float, backward: bool) -> Array:
    """Return the masses after a step, from the operators at parts `_TIMES` of it."""
    row = []
    for count in _COUNTS:
        h, now = step / count, values
        for part in _PLACES[count][::-1] if backward else _PLACES[count]:
            below, diagonal, above = bands[part]
            if backward:
                below, above = above, below
            (solve,) = get_lapack_funcs(("gtsv",), (diagonal, now))
            now = solve(-h * below, 1.0 - h * diagonal, -h * above, now)[3]
        row.append(now)
    for k in range(1, len(row)):
        for j in range(len(row) - 1, k - 1, -1):
            row[j] = row[j] + (row[j] - row[j - 1]) / (_COUNTS[j] / _COUNTS[j - k] - 1.0)
    return row[-1]
