"""Grids that move with a density that the drift carries far within an interval, as of growth and of motion with little noise.

In x = z + v (t - t0) the equation of the density is the same with the drift f(z + v (t - t0), t) - v, which is small near the
density where v is its speed.  The speed is a whole number of spacings in a substep, so that a density ends on the points of a
grid; coefficients depend on time then, whether those of the system do or not.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.methods.line.system import Prepared
from zakai.methods.line.tables import covariance_at, finite
from zakai.numerics.line import window as lw
from zakai.numerics.line.outlook import REACH

Array = Any

CONTRACTED = -2.0  # f' times the length of an interval, below which other grids hold a density that becomes much sharper
SOME = 0.3  # ranges of a density that it moves in an interval without modes, above which grids move with it


def travel(prepared: Prepared, values: Array, window: lw.Window, start: float, length: float) -> float:
    """Return by how many of its ranges the drift moves a density in an interval, zero where grids do not move with it.

    They do not where noise moves the state as far, or the density becomes much sharper.
    """
    system = prepared.system
    if window.closed or prepared.kinked or system.kinks is not None or system.cross is not None or system.reflecting:
        return 0.0
    look, (carried, growth) = lw.figures(values, False), displaced(prepared, values, window, start, length)
    G = covariance_at(system, window.points[[look.first, look.last]], start, prepared.theta.real)
    noise = float(np.sqrt(np.max(G.real) * length))
    if growth < CONTRACTED or abs(carried) < noise:
        return 0.0
    return abs(carried) / (window.spacing * (look.last - look.first + 1) + 2.0 * REACH * noise)


def speed_of(prepared: Prepared, values: Array, window: lw.Window, start: float, length: float) -> float:
    """Return the speed with which a grid follows a density in a substep: a whole number of its spacings in that time."""
    carried, _ = displaced(prepared, values, window, start, length)
    return window.spacing * float(np.round(carried / window.spacing)) / length


def displaced(prepared: Prepared, values: Array, window: lw.Window, start: float, length: float) -> tuple[float, float]:
    """Return about how far the drift carries the mean of a density, by its linearisation there, and f' times the length."""
    mean, variance = lw.moments(values, window)
    x = window.origin + float(mean.real) + float(np.sqrt(variance.real)) * np.array([0.0, -0.1, 0.1])
    here, below, above = finite(prepared.system.drift(x[:, None], start, prepared.theta.real)[:, 0]).tolist()
    growth = length * (above - below) / (x[2] - x[1])
    found = length * here * (np.expm1(min(growth, 3.0)) / growth if abs(growth) > 1e-8 else 1.0)
    return (float(found), float(growth)) if np.isfinite(found) else (0.0, 0.0)
