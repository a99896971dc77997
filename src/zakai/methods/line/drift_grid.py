"""A grid of one state between whose points the drift does what it does at them."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.methods.line.system import Prepared
from zakai.methods.line.tables import finite
from zakai.numerics.line import window as lw

Array = Any

HIDDEN = 0.05  # share of the drift that interpolation between the points may miss: a wave has at least five points
SLIGHT = 1e-4  # of the largest drift: less is rounding
BETWEEN = 0.5 * (np.sqrt(5.0) - 1.0)  # place in a spacing: the golden ratio is far from every fraction of a period
_CUBIC = np.array([np.prod([(BETWEEN - m) / (j - m) for m in range(-1, 3) if m != j]) for j in range(-1, 3)])


def showing_drift(
    prepared: Prepared, values: Array, window: lw.Window, start: float, length: float
) -> tuple[Array, lw.Window]:
    """Return a density at the start of an interval on a grid that shows the drift, and this grid.

    The density alone does not tell its grid: a broad prior is resolved by spacings of a period of f = sin(x), at which f is zero
    everywhere.  Where f has kinks or jumps other bounds hold.
    """
    if prepared.kinked or prepared.system.rough or not length > 0.0:
        return values, window
    deviation = float(np.sqrt(lw.moments(values.real, window)[1]))
    while window.size < lw.SIZES[-1]:
        hidden, whole = _hidden(prepared, window, start)
        share, size = (float(np.abs(values.real) @ one) for one in (hidden, whole))
        if share <= HIDDEN * size or HIDDEN * length * size <= prepared.tolerance * deviation:
            break
        new = lw.refined(window, 2.0)
        values = lw.resampled(values, window, new)
        values, window = values / np.sum(values), new
    return values, window


def hides_drift(prepared: Prepared, window: lw.Window) -> bool:
    """Return whether a density may be on this grid that does not show a drift without time."""
    steady = not (prepared.kinked or prepared.system.rough or prepared.system.varying)
    return steady and bool(_hidden(prepared, window, prepared.model.start)[0].any())


def _hidden(prepared: Prepared, window: lw.Window, start: float) -> tuple[Array, Array]:
    """Return the error of f after each point, by cubic interpolation, where it counts, and the size of f there, (N,) each."""

    def make() -> tuple[Array, Array]:
        around = window.origin + window.centre + window.spacing * (np.arange(-1, window.size + 2) - window.size // 2)
        theta = prepared.theta.real
        known, between = (
            finite(prepared.system.drift(x[:, None], start, theta)[:, 0])
            for x in (around, around[1:-2] + BETWEEN * window.spacing)
        )
        found = np.array(sum(c * known[j : j + window.size] for j, c in enumerate(_CUBIC)))
        error, whole = np.abs(between - found), np.maximum(np.abs(between), np.abs(found))
        return np.where(error > np.maximum(HIDDEN * whole, SLIGHT * np.max(whole)), error, 0.0), whole

    if prepared.system.varying:
        return make()
    pair: tuple[Array, Array] = prepared.once(("hidden", window), make)
    return pair
