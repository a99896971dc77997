"""How an interval moves a density of one state, and the finite volumes that hold it all the way (`line/volumes.py`)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.methods.line.coefficients import resolved_parts
from zakai.methods.line.system import Prepared
from zakai.methods.line.tables import covariance_at, finite
from zakai.numerics.line import window as lw
from zakai.numerics.line.panels import Panels
from zakai.numerics.line.volumes import Volumes, ends_of_steps, volumes

Array = Any

FAST = 5.0  # ranges of a density that the drift crosses in an interval, below which it is not followed
LEVELS = ((256, 24), (512, 34), (1024, 48), (2048, 68), (4096, 96), (8192, 136), (16384, 192))  # cells and steps
FIRST = 0.1  # of the time in which the drift would cross the range of the density: the first step
FASTEST = 100.0  # ranges of the density in the interval, divided by the tolerance: a faster drift counts as this
REACH = 8.0  # standard deviations to the end of a density
KINK_PROBES = 1025  # points between which kinks are sought
MOST_KINKS = 16
PROBES = 65  # points between which a formula ceases to have values
DIFFUSED = 0.5  # of the time in which noise would double the variance: the first step
GENTLE = 0.25  # of the steps where the density does not contract much
_FLOW_POINTS = 17
_FLOW_STEPS = 32


class Course(NamedTuple):
    """How an interval moves a density, the cells that hold it all the way, the first step, and the fastest drift that counts.

    `last` is the step with which a message that is sharp at the end begins.  Between two `bounds` (B + 1,) the coefficients are
    polynomials of time, up to the relative error `unresolved`; `share` is that of the steps of `LEVELS` that are taken.
    """

    way: _Way
    cells: Volumes
    finest: float
    quick: float
    fastest: float
    bounds: Array
    unresolved: float
    share: float
    last: float = np.inf

    def steps(self, count: int) -> Array:
        """Return the ends of about `count` steps, none of which crosses a bound, graded towards the start and what is sharp."""
        length, number = float(self.bounds[-1]), int(np.ceil(self.share * count))
        ends = np.union1d(self.bounds, ends_of_steps(length, self.quick, number)[:-1])
        if self.last < FIRST * length:
            ends = np.union1d(ends, length - ends_of_steps(length, self.last, number)[:-1])
        return ends


def course_of(
    prepared: Prepared, values: Array, window: lw.Window, ends: Array, start: float, length: float, inside: np.ndarray,
    aim: tuple[float, float] = (0.0, np.inf), widening: float = np.inf,
) -> Course | None:  # fmt: skip
    """Return the course of a density between two offsets, None where the drift leads beyond all numbers.

    Args:
        prepared: the system.
        values, window: the density before the interval, and its grid.
        ends: its ends as offsets from the origin.
        start, length: the interval.
        inside: which increments act within it.
        aim: the mean and the standard deviation of a function of the state at the end that is taken back to the start.
        widening: the most by which the range of the density grows on each side.
    """
    width, speed = float(ends[1] - ends[0]), float(np.max(np.abs(drift_along(prepared, window, ends, start))))
    fastest = FASTEST * width / (length * prepared.tolerance)
    points = window.origin + np.linspace(ends[0], ends[1], 5)
    noise = float(np.max(covariance_at(prepared.system, points, start, prepared.theta.real)))
    diffused, last = DIFFUSED * np.array([width / (2.0 * REACH), aim[1]]) ** 2 / max(noise, 1e-300)
    quick = min(FIRST * width / max(min(speed, fastest), 1e-300), FIRST * length, float(diffused))
    parts = Panels([(0.0, length)], 0.0)
    if prepared.system.varying:
        parts = resolved_parts(prepared, values, window, start, length, inside)
    bounds = np.array([0.0, *(stop for _, stop in parts.bounds)])
    ratio = float(np.log2(length / min(quick, float(last)))) / LEVELS[0][1]  # steps grow at most by a factor of two
    share = 1.0 if speed * length > FAST * width else max(GENTLE, min(ratio, 1.0))
    way = _way(prepared, window, ends, start, np.union1d(bounds, ends_of_steps(length, quick, int(share * _FLOW_STEPS))))
    way = way._replace(low=max(way.low, float(ends[0]) - widening), high=min(way.high, float(ends[1]) + widening))
    if not np.isfinite([way.low, way.high]).all() or not way.high > way.low:
        return None
    centre, scale, walls = 0.5 * (way.low + way.high), 0.5 * (way.high - way.low), walls_of(prepared, window.origin)
    low, high = np.clip([min(ends[0], centre - scale), max(ends[1], centre + scale)], *walls)
    low, high = (_defined(prepared, window.origin, centre, float(end), start) for end in (low, high))
    if REACH * aim[1] < scale:
        centre, scale = aim[0], REACH * aim[1]
    cells = volumes(window.origin, centre, scale, float(low), float(high), LEVELS[0][0])
    finest = (cells.last - cells.first) / LEVELS[-1][0] * np.hypot(scale, max(abs(ends[0] - centre), abs(ends[1] - centre)))
    cells = cells._replace(cuts=_cuts(prepared, cells, start))
    return Course(way, cells, float(finest), quick, fastest, bounds, parts.error, share, float(last))


def _defined(prepared: Prepared, origin: float, inner: float, outer: float, t: float) -> float:
    """Return how far between two offsets from the origin the drift and the noise have values."""
    system, theta = prepared.system, prepared.theta.real

    def has_values(offsets: Array) -> Array:
        x = origin + offsets[:, None]
        return np.isfinite(system.drift(x, t, theta)[:, 0]) & (system.covariance(x, t, theta)[:, 0, 0] >= 0.0)

    for _ in range(4):
        offsets = np.linspace(inner, outer, PROBES)
        missing = ~has_values(offsets)
        if not missing.any():
            return outer
        first = max(int(np.argmax(missing)), 1)
        inner, outer = float(offsets[first - 1]), float(offsets[first])
    return inner


def walls_of(prepared: Prepared, origin: float) -> tuple[float, float]:
    """Return the reflecting ends of the domain as offsets from the origin."""
    if not prepared.system.reflecting:
        return -np.inf, np.inf
    domain = prepared.model.domain[prepared.model.state[0]]
    return domain.lower - origin, domain.upper - origin


def ends_of(values: Array, window: lw.Window) -> Array:
    """Return the ends of the support of a density as offsets from the origin (2,)."""
    look = lw.figures(values, False)
    return window.offsets[[max(look.first - 1, 0), min(look.last + 1, window.size - 1)]]


def drift_along(prepared: Prepared, window: lw.Window, offsets: Array, t: float) -> Array:
    """Return f at offsets from the origin (J,)."""
    return finite(prepared.system.drift(window.origin + offsets[:, None], t, prepared.theta.real)[:, 0])


def _cuts(prepared: Prepared, cells: Volumes, start: float) -> tuple[float, ...]:
    """Return where in the range of cells coefficients have kinks or jumps, in s; nothing where these are many."""
    lower, upper = cells.origin + cells.centre + cells.scale * np.sinh([cells.first, cells.last])
    found, apart = [cells.first], 1e-6 * (cells.last - cells.first)
    for s in np.arcsinh((kinks_between(prepared, lower, upper, start) - cells.origin - cells.centre) / cells.scale):
        if s - found[-1] > apart and cells.last - s > apart:
            found.append(float(s))
    return tuple(found[1:])


def kinks_between(prepared: Prepared, lower: float, upper: float, t: float) -> Array:
    """Return the states between two, in increasing order, where coefficients have kinks or jumps; none where these are many."""
    kinks, theta = prepared.system.kinks, prepared.theta.real
    if kinks is None:
        return np.zeros(0)
    x = np.linspace(lower, upper, KINK_PROBES)
    negative = kinks(x[:, None], t, theta) < 0
    at, which = np.nonzero(negative[1:] != negative[:-1])
    if len(at) > MOST_KINKS:
        return np.zeros(0)
    low, high, left = x[at], x[at + 1], negative[at, which]
    for _ in range(60):
        middle = 0.5 * (low + high)
        same = (kinks(middle[:, None], t, theta)[np.arange(len(at)), which] < 0) == left
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return np.sort(0.5 * (low + high))


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
    own, noise, walls = np.full(count, (width / (2.0 * REACH)) ** 2), np.zeros(count), walls_of(prepared, window.origin)
    for step in np.diff(steps):
        near = 1e-6 * np.maximum(np.abs(window.origin + x), 1e-3 * width)
        f = drift_along(prepared, window, np.concatenate([x, x + near, x - near]), t)
        slope = 0.5 * step * (f[count : 2 * count] - f[2 * count :]) / near
        G = covariance_at(prepared.system, window.origin + x, t, prepared.theta.real)
        by = step * f[:count] * _relative(np.minimum(slope, 3.0))
        x, t = np.clip(x + by, *walls), t + step
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
