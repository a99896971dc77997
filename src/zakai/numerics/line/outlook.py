"""The grid for a density after an interval, out of few."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.compiled import helper
from zakai.numerics.line.place import PER
from zakai.numerics.line.window import SIZES

Array = NDArray[Any]

PROFILE = 4096  # offsets at which f and G are known without a grid
REACH = 7.6  # standard deviations of the noise by which the support grows
FAR = 3.0  # ranges of a density that it moves in an interval, above which grids move with it
_SPACING = 0.34  # spacing in standard deviations of the noise, at most: the shortest wave decays by exp(-42)
_MARGIN = 7.2  # of them beyond the support: the waves that R' leaves everywhere end there, and spread from the ends
_NARROW = 7.0  # support of a density in standard deviations of the noise
_APART = 32  # the centres of coarse grids are multiples of so many spacings
_SIZES = np.array(SIZES)


class Outlook(NamedTuple):
    """The spacing and the ends of a grid for the density after an interval, and the margin beyond these.

    The spacing is NaN where the density moves so far that the grid should move with it.
    """

    spacing: float
    left: float
    right: float
    margin: float


@helper
def outlook(low: float, high: float, tau: float, unit: float, profile: Array) -> Outlook:
    """Return what grid a density between two offsets needs after an interval, by the linear equation around its middle.

    Args:
        low, high: the ends of the support.
        tau: the length of the interval.
        unit: the scale of spacings.
        profile: f, f' and G (3, L) at offsets that are unit / PER apart, or of one point, of which only G is read: then the
            spacing is infinite where the interval makes the support far wider, else zero.
    """
    if profile.shape[1] == 1:
        return Outlook(np.inf if high - low < _NARROW * np.sqrt(profile[2, 0] * tau) else 0.0, low, high, 0.0)
    middle, per, last = profile.shape[1] // 2, PER / unit, profile.shape[1] - 1.0
    first, stop = int(min(max(np.floor(low * per) + middle, 0.0), last)), int(min(max(np.ceil(high * per) + middle, 0.0), last))
    least, most = profile[2, first], profile[2, first]
    for i in range(first, stop + 1):
        least, most = min(least, profile[2, i]), max(most, profile[2, i])
    wide = np.sqrt(most * tau)
    at = (first + stop) // 2
    here = -tau * profile[1, at]
    shift = tau * profile[0, at] * relative(here)
    there = -tau * profile[1, int(min(max(at + shift * per, 0.0), last))]
    fast, slow = max(here, there, 0.0), max(min(here, there), -1.0)
    spacing = _SPACING * np.sqrt(least * tau * relative(2.0 * fast))
    spacing = unit * 2.0 ** (0.5 * np.floor(2.0 * np.log2(spacing / unit) + 1e-9))
    half, centre = 0.5 * (high - low) * np.exp(-slow) + REACH * wide * np.sqrt(relative(2.0 * slow)), 0.5 * (low + high)
    spacing = np.nan if abs(shift) > 2.0 * FAR * half else spacing
    return Outlook(spacing, centre - half + min(shift, 0.0), centre + half + max(shift, 0.0), _MARGIN * wide)


@helper
def relative(x: float) -> float:
    """Return (1 - exp(-x)) / x."""
    return (1.0 - np.exp(-max(x, -5.0))) / max(x, -5.0) if abs(x) > 1e-8 else 1.0


@helper
def wanted(low: float, high: float, spacing: float, margin: float, answer: Array) -> None:
    """Write the centre, the spacing and the size of a grid from `low` to `high` with a margin on both sides."""
    apart = _APART * spacing
    answer[0], answer[1], answer[2] = apart * np.floor(0.5 * (low + high) / apart + 0.5), spacing, np.inf
    for known in _SIZES[::-1]:
        if known >= (high - low + 2.0 * margin) / spacing + _APART + 2:
            answer[2] = float(known)


@helper
def place_of(index: Array, answer: Array) -> int:
    """Return which of the known grids is wanted, -1 for none."""
    for g in range(index.shape[0]):
        if index[g, 0] == answer[0] and index[g, 1] == answer[1] and index[g, 2] == answer[2]:
            return g
    return -1
