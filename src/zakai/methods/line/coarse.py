"""The transition of a density that is much sharper than it is after the interval.

After an interval tau no wave shorter than the standard deviation of the noise is left, (tau G)^(1/2) where the drift does not
contract it.  The modes of the operator on a coarse grid that resolves this deviation carry the density,

    u(tau) = s U exp(-tau lambda) U' R' (u / s),

with the values of u / s on its own fine grid and R the interpolation from the coarse grid to the fine one (its transpose gives
the integrals of modes times density).  The fine grid needs no decomposition, and one coarse grid serves many fine ones.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.methods.line.coefficients import covariance_at, gauge_at, spectral
from zakai.methods.line.prepared import Prepared
from zakai.methods.line.update import grid_check
from zakai.numerics.line import window as lw
from zakai.numerics.line.grid_choice import SPACING
from zakai.numerics.line.window import EDGE

Array = Any

SHARP = 2.0  # how much finer a grid is at least
MARGIN = 7.2  # standard deviations of the noise by which the support grows, and beyond which waves that R' leaves end
TRIALS = 6


class Coarsened(NamedTuple):
    """A density (N,) on a coarse grid, its error, and the numbers of points at the two ends at which there is no density."""

    values: Array
    window: lw.Window
    error: float
    margins: tuple[int, int]


def coarsened(prepared: Prepared, values: Array, window: lw.Window, length: float) -> Coarsened | None:
    """Return the density after an interval without observations inside; None where no coarse grid serves.

    Args:
        prepared: a system without coefficients in time.
        values: probabilities (N,) of the points of `window`.
        window: the fine grid on the line.
        length: tau.
    """
    check = grid_check(prepared, values, window) if prepared.kinked else lw.grid_check(values, window.closed, prepared.negligible)
    inner = slice(check.first, check.last + 1)
    points, retained = window.points[inner], values[inner]
    covariance = covariance_at(prepared.system, points, prepared.model.start, prepared.theta)
    deviation = float(np.sqrt(max(np.min(covariance.real), 0.0) * _remembered(prepared, points, length)))
    if window.closed or SPACING * deviation < SHARP * window.spacing:
        return None
    spacing = window.unit * 2.0 ** np.floor(np.log2(SPACING * deviation / window.unit) + 1e-9)
    wide = float(np.sqrt(np.max(covariance.real) * length))
    low, high = window.offsets[check.first] - MARGIN * wide, window.offsets[check.last] + MARGIN * wide
    allowed = 1e-5 * prepared.tolerance
    for _ in range(TRIALS):
        coarse = _grid(window, float(low - MARGIN * wide), float(high + MARGIN * wide), float(spacing))
        decomposed = spectral(prepared, coarse) if coarse.size <= lw.LARGEST else None
        if decomposed is None or spacing < SHARP * window.spacing:
            return None
        with np.errstate(all="ignore"):
            scale = np.exp(_gauge(prepared, coarse, points) - decomposed.top)
            if np.ndim(covariance):
                scale = scale / np.sqrt(covariance)
            result, error = decomposed.carried(lw.gathered(retained / scale, window.offsets[inner], coarse), length)
        trusted = (coarse.offsets >= low) & (coarse.offsets <= high)
        ends = np.flatnonzero(trusted)[[0, 1, -2, -1]]
        result = np.where(trusted, result, 0.0)
        after = lw.grid_check(result, False, prepared.negligible)
        bound = max(EDGE, 4.0 * after.aliasing)
        left, right = np.max(np.abs(result[ends]).reshape(2, 2), axis=1) > bound * np.max(result.real)
        if left or right:
            third = (high - low) / 3.0
            low, high = low - third * left, high + third * right
        elif after.aliasing > max(30.0 * prepared.negligible, allowed):
            spacing *= 0.5
        elif error > max(1e-11, allowed):
            return None
        else:
            return Coarsened(result, coarse, error, (int(ends[0]), coarse.size - 1 - int(ends[-1])))
    return None


def _remembered(prepared: Prepared, points: Array, length: float) -> float:
    """Return the time for which noise at the end of an interval has not been contracted by the drift at points (J,)."""
    slope = prepared.system.slope
    if slope is None:
        return length
    rate = -2.0 * float(np.min(slope(points[:, None], prepared.model.start, prepared.theta).real))
    return float(-np.expm1(-rate * length) / rate) if rate > 0.0 else length


def _grid(window: lw.Window, low: float, high: float, spacing: float) -> lw.Window:
    """Return a grid out of few that covers offsets from `low` to `high`: its centre is a multiple of 16 spacings."""
    apart = 16.0 * spacing
    centre = apart * round(0.5 * (low + high) / apart)
    size = lw.size_for((high - low) / spacing + 18.0)
    return window._replace(centre=centre, spacing=spacing, size=size)


def _gauge(prepared: Prepared, coarse: lw.Window, points: Array) -> Array:
    """Return int f / G from the first point of the coarse grid to points in it (J,)."""
    ends = np.sort(np.concatenate([coarse.points, points]))
    total = gauge_at(prepared, ends)
    return np.asarray(total[np.searchsorted(ends, points)] - total[np.searchsorted(ends, coarse.points[0])])
