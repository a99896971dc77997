"""The operator of a message of one state on a grid, in a gauge in which it is symmetric.

A message b obeys -b_t = G b'' / 2 + f b'.  What is moved is psi = F e^s b with s' = (f - G'/2) / G and an F that falls to zero
towards the ends of the grid: its operator is that of a density, with the drift f + G F'/F of a process that keeps to the grid.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from zakai.methods.line.message import FALL, HALF, PAD
from zakai.methods.line.system import Prepared
from zakai.methods.line.tables import decomposed
from zakai.numerics.line import window as lw
from zakai.numerics.line.operator import Spectral

Array = Any


@lru_cache(maxsize=64)
def _fall(size: int) -> tuple[Array, Array]:
    """Return F'/F and its derivative at the points of a grid on the line (size,) with the spacing one."""
    from scipy.special import erfcx

    i = np.arange(size)
    y = (np.maximum(PAD - i, PAD - i[::-1]) - HALF) / FALL
    with np.errstate(over="ignore"):
        slope = -2.0 / (np.sqrt(np.pi) * erfcx(y)) / FALL  # of log(erfc(y) / 2)
    return slope * np.where(i < size / 2, -1.0, 1.0), -slope * (2.0 * y / FALL + slope)


def gauged(prepared: Prepared, window: lw.Window) -> Spectral | None:
    """Return the decomposition for psi on a grid of a system without time, None where there is none; s are its logarithms."""
    ends = None
    if not window.closed:
        slope, curvature = _fall(window.size)
        ends = slope / window.spacing, curvature / window.spacing**2

    def make() -> tuple[Spectral | None]:
        found = decomposed(prepared, window, lw.LARGE, ends)
        if found is not None:
            found.modes = np.asfortranarray(found.modes)  # the loop reads rows of U'
        return (found,)

    known: tuple[Spectral | None] = prepared.once(("gauged", window), make)
    return known[0]
