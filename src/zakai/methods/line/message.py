"""The message of one state: the logarithm of b(x) = p(later observations | x) on a grid, and the operator that moves it.

A message b obeys -b_t = G b'' / 2 + f b'.  What is moved is psi = F e^s b with s' = (f - G'/2) / G and an F that falls to zero
towards the ends of the grid: its operator is that of a density, with the drift f + G F'/F of a process that keeps to the grid.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from zakai.methods.line.cache import Derived
from zakai.methods.line.coefficients import decomposed
from zakai.methods.line.prepared import Prepared, State
from zakai.numerics.arrays import Array
from zakai.numerics.line import window as lw
from zakai.numerics.line.backward import FEWEST
from zakai.numerics.line.modes import FALL
from zakai.numerics.line.operator import Spectral
from zakai.numerics.line.window import local_polynomial

PAD = 28  # spacings over which F falls from one to zero
SURE_OF_DENSITY = 10.0  # errors of a density from which its small values count
LOWEST = float(np.log(lw.CUT))  # of the largest error of small values, relative to the largest value


class Message(NamedTuple):
    """The logarithm of the function b at the points of a grid (N,), constant beyond them.

    The grid covers where b matters.  `needed` is the spacing that its product with the density needs; `error` is the estimate of
    its relative error.  `mean`, relative to the origin, and `deviation` are those of the product, where it is known; `scaled` is
    the factor by which the drift has made the message wider in the last interval backward, where that is known.
    """

    logs: np.ndarray
    origin: float
    centre: float
    spacing: float
    unit: float
    closed: bool
    needed: float
    error: float
    mean: float = 0.0
    deviation: float = 0.0
    scaled: float = 1.0

    @classmethod
    def of(cls, logs: Array, window: lw.Window, needed: float, error: float) -> Message:
        """Return the message with logarithms at the points of a grid."""
        origin, centre, spacing, _, closed, unit = window
        return cls(logs, origin, centre, spacing, unit, closed, needed, error)

    @property
    def window(self) -> lw.Window:
        """The grid."""
        return lw.Window(self.origin, self.centre, self.spacing, len(self.logs), self.closed, self.unit)

    @property
    def ends(self) -> tuple[float, float]:
        """The first and the last point, as offsets from the origin."""
        half = len(self.logs) // 2
        return self.centre - half * self.spacing, self.centre + (len(self.logs) - 1 - half) * self.spacing

    def at(self, offsets: Array) -> Array:
        """Return log b at offsets from the origin (J,)."""
        return local_polynomial(self.logs, self.window, offsets)

    def falling(self, offsets: Array) -> Array:
        """Return log b at offsets from the origin (J,), beyond the grid with the slope at its ends where b falls outward."""
        result = self.at(offsets)
        (low, high), (left, right) = self.ends, np.maximum(self.logs[[3, -4]] - self.logs[[0, -1]], 0.0) / (3.0 * self.spacing)
        return np.asarray(result - left * np.maximum(low - offsets, 0.0) - right * np.maximum(offsets - high, 0.0))

    def between(self, low: float, high: float) -> Message:
        """Return the message on its points between two offsets, and on those that hold them."""
        if self.closed:
            return self
        size, first = len(self.logs), self.ends[0]
        i = int(np.clip(np.floor((low - first) / self.spacing + 1e-9), 0, size - FEWEST))
        j = int(np.clip(np.ceil((high - first) / self.spacing - 1e-9), i + FEWEST - 1, size - 1))
        return self._replace(logs=self.logs[i : j + 1], centre=first + self.spacing * (i + (j - i + 1) // 2))

    def on(self, window: lw.Window) -> Message:
        """Return the message on another grid."""
        result = Message.of(self.at(window.offsets), window, self.needed, self.error)
        return result._replace(mean=self.mean, deviation=self.deviation)

    @property
    def moments(self) -> tuple[float, float]:
        """The mean of b as a density, relative to the origin, and its variance."""
        values = np.exp(self.logs - np.max(self.logs))
        mean, variance = lw.moments(values / np.sum(values), self.window)
        return float(mean), float(variance)

    @property
    def variance(self) -> float:
        """The variance of b as a density."""
        return self.moments[1]


def taper(offsets: Array, ends: tuple[float, float], spacing: float) -> Array:
    """Return F of a grid that ends `PAD` spacings beyond two offsets."""
    from scipy.special import erfc

    beyond = np.maximum(ends[0] - offsets, offsets - ends[1]) / spacing
    return np.asarray(0.5 * erfc(FALL * (2.0 * beyond / PAD - 1.0)))


def points_of(window: lw.Window, low: float, high: float, spacing: float) -> lw.Window:
    """Return the grid of at most this spacing between two offsets, without the fall of F."""
    if window.closed:
        size = lw.size_for(2 * np.pi / spacing * 0.999)
        return window._replace(size=size, spacing=2 * np.pi / size)
    spacing = lw.quantized(window, low, high, spacing).spacing
    first, last = np.floor(low / spacing + 1e-9), np.ceil(high / spacing - 1e-9)
    size = max(int(last - first) + 1, FEWEST)
    step = 2 * lw.ALIGNMENT  # large grids have few different sizes
    size = size if size < 4 * step else step * -(-size // step)
    return window._replace(centre=float((first + size // 2) * spacing), spacing=spacing, size=size)


def reliable(state: State, window: lw.Window) -> Array:
    """Return the density on another grid, zero where its error is as large."""
    values = np.asarray(state.values).real
    floor = SURE_OF_DENSITY * float(np.exp(min(state.log_floor, LOWEST))) * float(np.max(values))
    return lw.resampled(np.where(values > floor, values, 0.0), state.window, window)


@lru_cache(maxsize=64)
def _fall(size: int) -> tuple[Array, Array]:
    """Return F'/F and its derivative at the points of a grid on the line (size,) with the spacing one."""
    from scipy.special import erfcx

    i = np.arange(size)
    rate = 2.0 * FALL / PAD
    y = rate * np.maximum(PAD - i, PAD - i[::-1]) - FALL
    with np.errstate(over="ignore"):
        slope = -2.0 / (np.sqrt(np.pi) * erfcx(y)) * rate  # of log(erfc(y) / 2)
    return slope * np.where(i < size / 2, -1.0, 1.0), -slope * (2.0 * y * rate + slope)


def gauged(prepared: Prepared, window: lw.Window) -> Spectral | None:
    """Return the decomposition for psi on a grid of a system without time, None where there is none; s are its logarithms."""
    ends = None
    if not window.closed:
        slope, curvature = _fall(window.size)
        ends = slope / window.spacing, curvature / window.spacing**2

    def make() -> tuple[Spectral | None]:
        result = decomposed(prepared, window, lw.LARGE, ends)
        if result is not None:
            result.modes = np.asfortranarray(result.modes)  # the loop reads rows of U'
        return (result,)

    known: tuple[Spectral | None] = prepared.once(Derived.MESSAGE_MODES, window, make)
    return known[0]
