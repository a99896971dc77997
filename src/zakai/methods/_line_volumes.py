"""One interval in which the density of one state contracts so much that no uniform grid holds it, as by -x^3 from a broad prior.

It is solved on finite volumes (`numerics/line_volumes.py`) that are small where the drift leads and grow with the distance, with
more and more cells and steps until the result settles.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np

from zakai.methods._line_coefficients import coefficients
from zakai.methods._line_model import within
from zakai.methods._line_moves import Moved, Report
from zakai.methods._line_system import Prepared, covariance_at, finite
from zakai.numerics import line_window as lw
from zakai.numerics.line_polynomial import local_polynomial
from zakai.numerics.line_volumes import Bands, Volumes, advanced, ends_of_steps, volumes

Array = Any

FAST = 5.0  # ranges of a density that the drift crosses in an interval, below which it is not followed
STIFF = 100.0  # the same, above which no uniform grid is tried
MOST_TRAVEL = 20.0  # ranges of a density, as it is at the time, that it moves on uniform grids
MOST_DEVIATIONS = 100.0  # range of a density on a uniform grid, in the smallest deviations of its parts
LEVELS = ((256, 24), (512, 34), (1024, 48), (2048, 68), (4096, 96), (8192, 136), (16384, 192))  # cells and steps
SETTLED = 1e-2  # error above which volumes do not serve
NARROWEST = 40.0  # range of a density in cells
SHARE = 0.1  # of the tolerance that volumes may leave
SMOOTH = 1e-7  # error of a backward interval at which more cells are not taken
FIRST = 0.1  # of the time in which the drift would cross the range of the density: the first step
FASTEST = 100.0  # ranges of the density in the interval, divided by the tolerance: a faster drift counts as this
REACH = 8.0  # standard deviations to the end of a density
_FLOW_POINTS = 17
_FLOW_STEPS = 32


def contracted(
    prepared: Prepared,
    values: Array,
    window: lw.Window,
    start: float,
    length: float,
    inside: np.ndarray,
    rates: np.ndarray,
    report: Report,
) -> Moved | None:
    """Return the density after an interval, None where it does not contract much or volumes do not serve."""
    if window.closed:
        return None
    ends = _ends(values, window)
    width, speed = float(ends[1] - ends[0]), float(np.max(np.abs(_drift(prepared, window, ends, start))))
    if not speed * length > FAST * width:
        return None
    course = _course(prepared, window, ends, start, length)
    if course is None:
        return None
    stiff = speed * length > STIFF * width
    if not (stiff or course.way.travel > MOST_TRAVEL or course.way.deviations > MOST_DEVIATIONS):
        return None
    if width < NARROWEST * course.finest:  # sharper than the cells where it begins
        return None

    def at_level(cells: Volumes, steps: Array) -> tuple[Array, Any]:
        masses = lw.density_at(values, window, cells.offsets) * cells.widths
        interval = prepared, values, window, cells, start, inside, rates, steps, course.fastest
        return _advanced(masses / np.sum(masses), *interval)

    def summed(masses: Array) -> Array:
        return masses.reshape(-1, 2).sum(axis=1)

    found = _settled(SHARE * prepared.tolerance, course, length, at_level, summed)
    if found is None:
        return None
    masses, cells, gained, error = found
    report.time, report.noise = report.time + error, max(report.noise, min(error, 1.0))
    resampled = _resampled(prepared, cells, masses, window, error)
    assert resampled.look is not None
    report.density(resampled.look)
    return resampled._replace(gained=gained)


class Worth(NamedTuple):
    """A function of the state at the start of an interval: values (N,) at the middles of cells, the logarithm of their scale."""

    cells: Volumes
    values: Array
    log_scale: float
    error: float

    def at(self, offsets: Array) -> Array:
        """Return the values at offsets from the origin (J,)."""
        s = np.arcsinh((offsets - self.cells.centre) / self.cells.scale)
        return local_polynomial(self.values, self.cells.logarithmic, s)


def pulled_back(
    prepared: Prepared,
    log_worth: Callable[[Array], Array],
    values: Array,
    window: lw.Window,
    start: float,
    length: float,
    inside: np.ndarray,
    rates: np.ndarray,
) -> Worth | None:
    """Return the expectation of a function of the state after an interval, given the state before; None where it does not settle.

    Args:
        log_worth: the logarithm of the function at offsets from the origin of the window (J,).
        values: the density before the interval.
    """
    ends = _ends(values, window)
    course = _course(prepared, window, ends, start, length)
    if course is None:
        return None

    def at_level(cells: Volumes, steps: Array) -> tuple[Array, Any]:
        logs = log_worth(cells.offsets)
        top = float(np.max(logs))
        interval = prepared, values, window, cells, start, inside, rates, steps, course.fastest
        found, gained = _advanced(np.exp(logs - top), *interval, backward=True)
        return found, gained + top

    def between(found: Array) -> Array:
        padded = np.concatenate([found[:1], found, found[-1:]])
        return (9.0 * (found[::2] + found[1::2]) - padded[:-2:2] - padded[3::2]) / 16.0

    found = _settled(SMOOTH, course, length, at_level, between)
    return None if found is None else Worth(found[1], found[0], float(found[2]), found[3])


class _Course(NamedTuple):
    """How an interval moves a density, the cells that hold it all the way, the first step, and the fastest drift that counts."""

    way: _Way
    cells: Volumes
    finest: float
    quick: float
    fastest: float


def _course(prepared: Prepared, window: lw.Window, ends: Array, start: float, length: float) -> _Course | None:
    """Return the course of a density between two offsets, None where the drift leads beyond all numbers."""
    width, speed = float(ends[1] - ends[0]), float(np.max(np.abs(_drift(prepared, window, ends, start))))
    fastest = FASTEST * width / (length * prepared.tolerance)
    quick = min(FIRST * width / max(min(speed, fastest), 1e-300), 0.1 * length)
    way = _way(prepared, window, ends, start, ends_of_steps(length, quick, _FLOW_STEPS))
    if not np.isfinite([way.low, way.high]).all() or not way.high > way.low:
        return None
    centre, scale = 0.5 * (way.low + way.high), 0.5 * (way.high - way.low)
    cells = volumes(window.origin, centre, scale, min(ends[0], centre - scale), max(ends[1], centre + scale), LEVELS[0][0])
    finest = (cells.last - cells.first) / LEVELS[-1][0] * np.hypot(scale, max(abs(ends[0] - centre), abs(ends[1] - centre)))
    return _Course(way, cells, float(finest), quick, fastest)


def _settled(
    allowed: float,
    course: _Course,
    length: float,
    at_level: Callable[[Volumes, Array], tuple[Array, Any]],
    paired: Callable[[Array], Array],
) -> tuple[Array, Volumes, Any, float] | None:
    """Return the values of cells, the cells, the logarithm of the scale and the error, with more cells until they settle.

    Args:
        allowed: the error at which more cells are not taken.
        at_level: values of the sum one on cells and the logarithm of their scale, for the ends of steps.
        paired: values on half as many cells.
    """
    before = best = None
    error = np.inf
    for size, count in LEVELS:
        cells = course.cells._replace(size=size)
        values, gained = at_level(cells, ends_of_steps(length, course.quick, count))
        if before is not None:
            coarse = paired(values)
            # The error of second order falls to a quarter where the size of the cells is halved.
            finer = coarse + (coarse - before[0] * np.exp(before[1] - gained)) / 3.0
            total = np.sum(finer)
            finer, scale = finer / total, gained + np.log(total)
            if best is not None:
                # The rest falls by more than a factor of four from one level to the next.
                half = paired(finer)
                change = half * np.exp(scale - best[1]) - best[0]
                error = 0.25 * float(np.sum(np.abs(change.real)))
            best = finer, scale, cells._replace(size=len(finer))
            if error < allowed:
                break
        before = values, gained
    if best is None or not error < SETTLED:
        return None
    return best[0], best[2], best[1], error


def _ends(values: Array, window: lw.Window) -> Array:
    """Return the ends of the support of a density as offsets from the origin (2,)."""
    look = lw.figures(values, False)
    return window.offsets[[max(look.first - 1, 0), min(look.last + 1, window.size - 1)]]


def _drift(prepared: Prepared, window: lw.Window, offsets: Array, t: float) -> Array:
    return finite(prepared.system.drift(window.origin + offsets[:, None], t, prepared.theta.real)[:, 0])


class _Way(NamedTuple):
    """How the drift moves a density: by how many of its ranges, their most in the smallest deviations of parts, and to where."""

    travel: float
    deviations: float
    low: float
    high: float


def _way(prepared: Prepared, window: lw.Window, ends: Array, start: float, steps: Array) -> _Way:
    """Follow Gaussian parts of a density between two offsets by exponential Euler steps."""
    count, width = _FLOW_POINTS, float(ends[1] - ends[0])
    x, t, travel, most = np.linspace(float(ends[0]), float(ends[1]), count), start, 0.0, 0.0
    own, noise = np.full(count, (width / (2.0 * REACH)) ** 2), np.zeros(count)
    for step in np.diff(steps):
        near = 1e-6 * np.maximum(np.abs(window.origin + x), 1e-3 * width)
        f = _drift(prepared, window, np.concatenate([x, x + near, x - near]), t)
        slope = 0.5 * step * (f[count : 2 * count] - f[2 * count :]) / near
        G = covariance_at(prepared.system, window.origin + x, t, prepared.theta.real)
        by = step * f[:count] * _relative(np.minimum(slope, 3.0))
        x, t = x + by, t + step
        slope = np.minimum(2.0 * slope, 0.0)  # what drifts apart, the points show
        own, noise = own * np.exp(slope), noise * np.exp(slope) + step * G * _relative(slope)
        reach = REACH * np.sqrt(noise)
        low, high = float(np.min(x - reach)), float(np.max(x + reach))
        wide = float(np.max(x) - np.min(x)) + 2.0 * float(np.min(reach))
        most = max(most, wide / float(np.sqrt(np.min(own + noise))))
        travel += float(np.max(np.abs(by))) / wide
    return _Way(travel, most, low, high)


def _relative(x: Array) -> Array:
    """Return (exp(x) - 1) / x."""
    small = np.abs(x) < 1e-8
    return np.where(small, 1.0, np.expm1(x) / np.where(small, 1.0, x))


def _advanced(
    masses: Array,
    prepared: Prepared,
    values: Array,
    window: lw.Window,
    cells: Volumes,
    start: float,
    inside: np.ndarray,
    rates: np.ndarray,
    ends: Array,
    fastest: float,
    backward: bool = False,
) -> tuple[Array, Any]:
    """Return the masses of cells after steps, and the logarithm of their sum."""
    density, at = lw.density_at(values, window, cells.offsets), cast(lw.Window, cells)  # by its points
    known: list[Bands] = []

    def bands(times: Array) -> list[Bands]:
        if not known or prepared.system.varying:
            t = within(start + (times if prepared.system.varying else times[:1]), start, start + float(ends[-1]))
            drift, covariance, potential, constant = coefficients(prepared, at, t, inside, rates, density)
            potential = potential + constant[:, None] - offset
            drift = np.where(np.abs(drift) < fastest, drift, fastest * np.sign(drift.real))
            known[:] = [cells.bands(*part) for part in zip(covariance, drift, potential, strict=True)]
        return known if prepared.system.varying else known * len(times)

    offset = 0.0
    if inside.any():
        *_, potential, constant = coefficients(prepared, at, np.array([start]), inside, rates, density)
        counts = density.real > 1e-6 * density.real.max()
        offset = float(np.max(potential[0, : cells.size][counts].real) + constant[0].real)
    masses, gained = advanced(bands, masses, ends, backward)
    return masses, gained + offset * ends[-1]


def _resampled(prepared: Prepared, cells: Volumes, masses: Array, window: lw.Window, error: float) -> Moved:
    """Return the masses of cells as a density on a uniform grid."""
    density, real = cells.density(masses), (masses / cells.widths).real
    used = cells.offsets[np.flatnonzero(real > lw.CUT * real.max())]
    spacing = (used[-1] - used[0]) / 64.0
    for _ in range(9):
        new = lw.quantized(window, used[0], used[-1], spacing, most=lw.LARGEST_POSTERIOR)
        values = density(new.offsets)
        values = values / np.sum(values)
        look = lw.figures(values, False, prepared.negligible)
        if look.aliasing <= max(1e-11, 1e-2 * error) or new.size >= lw.LARGEST_POSTERIOR:
            break
        spacing = 1.001 * new.spacing / 2**0.5
    return Moved(values, new, 0.0, look)
