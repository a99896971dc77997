"""One interval of one state on finite volumes (`numerics/line/volumes.py`), where a uniform grid does not serve.

That is where the density contracts so much that no uniform grid holds it, as by -x^3 from a broad prior, and where coefficients
have kinks or jumps.  The cells are small where the drift leads and grow with the distance; kinks and jumps are faces.  Cells and
steps are refined until the result settles.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from zakai.methods.line.coefficients import coefficients, covariance_at, resolved_parts
from zakai.methods.line.domain import ends_of_leak
from zakai.methods.line.model import MOST_KINKS, finite, within
from zakai.methods.line.prepared import Prepared, TimeInterval
from zakai.methods.line.report import Report
from zakai.methods.line.transition import Prediction
from zakai.numerics.arrays import Array, Number
from zakai.numerics.line import window as lw
from zakai.numerics.line.averages import GAUSS_NODES, Panels, interpolation
from zakai.numerics.line.resolution import RESOLVED, ROUNDING, SUPPORT, TRANSITION_SHARE
from zakai.numerics.line.volumes import Bands, Volumes, advanced, ends_of_steps, volumes
from zakai.numerics.line.window import local_polynomial

FAST = 5.0  # ranges of a density that the drift crosses in an interval, below which it is not followed
LEVELS = ((256, 24), (512, 34), (1024, 48), (2048, 68), (4096, 96), (8192, 136), (16384, 192))  # cells and steps
FIRST = 0.1  # of the time in which the drift would cross the range of the density: the first step
FASTEST = 100.0  # ranges of the density in the interval, divided by the tolerance: a faster drift counts as this
KINK_PROBES = 1025  # points between which kinks are sought
MOST_CUTS = 16  # kinks that are faces
ONE_KINK = 1e-10  # distance, of the interval, of the kinks of two coefficients that are one
PROBES = 65  # points between which a formula ceases to have values
DIFFUSED = 0.5  # of the time in which noise would double the variance: the first step
GENTLE = 0.25  # of the steps where the density does not contract much
_FLOW_POINTS = 17
_FLOW_STEPS = 32


class CellPlan(NamedTuple):
    """How an interval moves a density, the cells that hold it throughout, the first step, and the fastest drift that counts.

    `last` is the step with which a message that is sharp at the end begins.  Between two `bounds` (B + 1,) the coefficients are
    polynomials of time, up to the relative error `unresolved`; `share` is that of the steps of `LEVELS` that are used.
    """

    flow: FlowSummary
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


def cell_plan_of(
    prepared: Prepared, values: Array, window: lw.Points, ends: Array, interval: TimeInterval,
    aim: tuple[float, float] = (0.0, np.inf), widening: float = np.inf,
) -> CellPlan | None:  # fmt: skip
    """Return the plan of cells for a density between two offsets, None where the drift leads beyond all numbers.

    Args:
        values, window: the density before the interval, and its grid.
        ends: its ends as offsets from the origin.
        aim: the mean and the standard deviation of a function of the state at the end that is taken back to the start.
        widening: the most by which the range of the density grows on each side.
    """
    start, length = interval.start, interval.length
    width, speed = float(ends[1] - ends[0]), float(np.max(np.abs(drift_along(prepared, window, ends, start))))
    fastest = FASTEST * width / (length * prepared.tolerance)
    points = window.origin + np.linspace(ends[0], ends[1], 5)
    noise = float(np.max(covariance_at(prepared.system, points, start, prepared.theta.real)))
    diffused, last = DIFFUSED * np.array([width / (2.0 * SUPPORT), aim[1]]) ** 2 / max(noise, 1e-300)
    quick = min(FIRST * width / max(min(speed, fastest), 1e-300), FIRST * length, float(diffused))
    parts = Panels([(0.0, length)], 0.0)
    if prepared.system.varying:
        parts = resolved_parts(prepared, values, window, interval)
    bounds = np.array([0.0, *(stop for _, stop in parts.bounds)])
    ratio = float(np.log2(length / min(quick, float(last)))) / LEVELS[0][1]  # steps grow at most by a factor of two
    share = 1.0 if speed * length > FAST * width else max(GENTLE, min(ratio, 1.0))
    steps = np.union1d(bounds, ends_of_steps(length, quick, int(share * _FLOW_STEPS)))
    flow = _flow_summary(prepared, window, ends, start, steps)
    flow = flow._replace(low=max(flow.low, float(ends[0]) - widening), high=min(flow.high, float(ends[1]) + widening))
    if not np.isfinite([flow.low, flow.high]).all() or not flow.high > flow.low:
        return None
    centre, scale, walls = 0.5 * (flow.low + flow.high), 0.5 * (flow.high - flow.low), walls_of(prepared, window.origin)
    low, high = np.clip([min(ends[0], centre - scale), max(ends[1], centre + scale)], *walls)
    low, high = (_defined(prepared, window.origin, centre, float(end), start) for end in (low, high))
    if SUPPORT * aim[1] < scale:
        centre, scale = aim[0], SUPPORT * aim[1]
    cells = volumes(window.origin, centre, scale, float(low), float(high), LEVELS[0][0])
    finest = (cells.last - cells.first) / LEVELS[-1][0] * np.hypot(scale, max(abs(ends[0] - centre), abs(ends[1] - centre)))
    cells = cells._replace(cuts=_cuts(prepared, cells, start))
    return CellPlan(flow, cells, float(finest), quick, fastest, bounds, parts.error, share, float(last))


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
    check = lw.grid_check(values, False)
    return window.offsets[[max(check.first - 1, 0), min(check.last + 1, window.size - 1)]]


def drift_along(prepared: Prepared, window: lw.Points, offsets: Array, t: float) -> Array:
    """Return f at offsets from the origin (J,)."""
    return finite(prepared.system.drift(window.origin + offsets[:, None], t, prepared.theta.real)[:, 0])


def _cuts(prepared: Prepared, cells: Volumes, start: float) -> tuple[float, ...]:
    """Return where in the range of cells coefficients have kinks or jumps, in s; nothing where these are many."""
    lower, upper = cells.origin + cells.centre + cells.scale * np.sinh([cells.first, cells.last])
    result, apart, kinks = [cells.first], 1e-6 * (cells.last - cells.first), kinks_between(prepared, lower, upper, start)
    if len(kinks) > MOST_CUTS:
        return ()
    for s in np.arcsinh((kinks - cells.origin - cells.centre) / cells.scale):
        if s - result[-1] > apart and cells.last - s > apart:
            result.append(float(s))
    return tuple(result[1:])


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
    found = np.sort(0.5 * (low + high))
    return found[np.diff(found, prepend=-np.inf) > ONE_KINK * (upper - lower)]


class FlowSummary(NamedTuple):
    """How the drift moves a density: by how many of its ranges, their most in the smallest deviations of parts, and to where."""

    travel: float
    deviations: float
    low: float
    high: float


def _flow_summary(prepared: Prepared, window: lw.Points, ends: Array, start: float, steps: Array) -> FlowSummary:
    """Follow Gaussian parts of a density between two offsets by exponential Euler steps."""
    count, width = _FLOW_POINTS, float(ends[1] - ends[0])
    x, t, travel, most = np.linspace(float(ends[0]), float(ends[1]), count), start, 0.0, 0.0
    own, noise, walls = np.full(count, (width / (2.0 * SUPPORT)) ** 2), np.zeros(count), walls_of(prepared, window.origin)
    for step in np.diff(steps):
        near = 1e-6 * np.maximum(np.abs(window.origin + x), 1e-3 * width)
        f = drift_along(prepared, window, np.concatenate([x, x + near, x - near]), t)
        slope = 0.5 * step * (f[count : 2 * count] - f[2 * count :]) / near
        G = covariance_at(prepared.system, window.origin + x, t, prepared.theta.real)
        by = step * f[:count] * _relative(np.minimum(slope, 3.0))
        x, t = np.clip(x + by, *walls), t + step
        slope = np.minimum(2.0 * slope, 0.0)  # what drifts apart, the points show
        own, noise = own * np.exp(slope), noise * np.exp(slope) + step * G * _relative(slope)
        reach = SUPPORT * np.sqrt(noise)
        low, high = float(np.min(x - reach)), float(np.max(x + reach))
        wide = float(np.max(x) - np.min(x)) + 2.0 * float(np.min(reach))
        most = max(most, wide / float(np.sqrt(np.min(own + noise))))
        travel += float(np.max(np.abs(by))) / wide
    return FlowSummary(travel, most, low, high)


def _relative(x: Array) -> Array:
    """Return (exp(x) - 1) / x."""
    small = np.abs(x) < 1e-8
    return np.where(small, 1.0, np.expm1(x) / np.where(small, 1.0, x))


TURNING_OF_LARGE_GRID = 300.0  # phase by which the drift turns the shortest wave of a large grid, above which that is not tried
TURNING = 100.0  # the same, above which no uniform grid is tried
MOST_TRAVEL = 20.0  # ranges of a density, as it is at the time, that it moves on uniform grids
MOST_DEVIATIONS = 100.0  # range of a density on a uniform grid, in the smallest deviations of its parts
EDGE_OF_CELLS = 1e-9  # density in the outermost cells, relative to the maximum, beyond which they are too few
SETTLED = 1e-2  # error above which volumes do not serve
NARROWEST_IN_CELLS = 40.0  # range of a density in cells
WIDENINGS = 0.5, 2.0  # ranges of a density by which it grows on each side, where that error is too large
SMOOTH = 1e-7  # error of a backward interval at which more cells are not tried


def rough(prepared: Prepared, inside: np.ndarray) -> bool:
    """Return whether coefficients have kinks or jumps, which without a decomposition leave waves on a uniform grid."""
    system = prepared.system
    needed = system.varying or bool(inside.any()) or system.slope is None or system.spread is None
    return (needed or (system.kinked_drift and not prepared.weak)) and system.kinks is not None


def contracted(
    prepared: Prepared, values: Array, window: lw.Window, interval: TimeInterval, report: Report, moving: bool
) -> Prediction | None:
    """Return the density after an interval, None where volumes do not serve or a uniform grid, which may move, is better."""
    if window.closed:
        return None
    ends, start, length = ends_of(values, window), interval.start, interval.length
    drift = drift_along(prepared, window, ends, start)
    width, speed = float(ends[1] - ends[0]), 0.5 * float(np.ptp(drift)) if moving else float(np.max(np.abs(drift)))
    fine = window.size > lw.LARGEST and np.pi * speed * length > TURNING_OF_LARGE_GRID * window.spacing
    # The noise of the logarithm of a state grows without limit towards a natural end.
    noise = float(np.max(covariance_at(prepared.system, window.points, start, prepared.theta.real)))
    rounding = ROUNDING * 0.5 * (np.pi / window.spacing) ** 2 * noise * length
    general = rough(prepared, interval.inside) or fine
    leak = ends_of_leak(prepared, window, ends, start, length)
    stiff_noise = leak is not None or (not general and rounding > TRANSITION_SHARE * prepared.tolerance)
    if not (general or stiff_noise or speed * length > FAST * width):
        return None
    # Cells do not bring back what the grid does not resolve.
    unresolved = lw.grid_check(values, False, prepared.negligible).aliasing  # where the density is smaller, it may not end
    allowed = TRANSITION_SHARE * max(prepared.tolerance, unresolved)

    def density(offsets: Array) -> Array:
        return lw.density_at(values, window, offsets)

    # Where noise falls that fast, a Gaussian widens less than its own noise says.
    for widening in WIDENINGS if stiff_noise else (np.inf,):
        plan = cell_plan_of(prepared, values, window, ends, interval, widening=widening * width)
        if plan is None:
            return None
        if leak is not None:
            plan = plan._replace(cells=plan.cells.reaching(*leak))
        stiff = stiff_noise or speed * length > TURNING * width
        far = (plan.flow.travel > MOST_TRAVEL and not moving) or plan.flow.deviations > MOST_DEVIATIONS
        if not (general or stiff or far) or width < NARROWEST_IN_CELLS * plan.finest:  # sharper than the cells where it begins
            return None
        result = advanced_by(prepared, density, plan, interval, allowed)
        if result is None:
            return None
        masses, cells, gained, error = result
        after = np.abs((masses / cells.widths).real)
        if max(after[0], after[-1]) <= max(EDGE_OF_CELLS, unresolved) * np.max(after):
            break
    else:  # the cells do not hold it
        return None
    report.time, report.noise = report.time + error + plan.unresolved, max(report.noise, min(error, 1.0))
    resampled = _resampled(prepared, cells, masses, window, error)
    assert resampled.check is not None
    report.density(resampled.check)
    return resampled._replace(gained=gained)


class Settled(NamedTuple):
    """Values of cells (N,) of sum one, the cells, the logarithm of the scale, and the error."""

    values: Array
    cells: Volumes
    log_scale: Number
    error: float


def advanced_by(
    prepared: Prepared, density: Callable[[Array], Array], plan: CellPlan, interval: TimeInterval, allowed: float
) -> Settled | None:
    """Return the masses of cells after an interval, None where they do not settle.

    Args:
        density: the density before, as a function of offsets (J,).
        plan: the plan of the cells.
        allowed: the error at which more cells are not tried.
    """

    def at_level(cells: Volumes, steps: Array) -> tuple[Array, Number]:
        before = density(cells.offsets)
        masses = before * cells.widths
        return _advanced(masses / np.sum(masses), prepared, before, cells, interval, steps, plan)

    def summed(masses: Array) -> Array:
        return np.asarray(masses.reshape(-1, 2).sum(axis=1))

    return _settled(allowed, plan, at_level, summed, lambda cells: np.ones(cells.size))


class BackwardExpectation(NamedTuple):
    """A function of the state at the start of an interval: values (N,) at the middles of cells, the logarithm of their scale."""

    cells: Volumes
    values: Array
    log_scale: float
    error: float

    def at(self, offsets: Array) -> Array:
        """Return the values at offsets from the origin (J,), beyond the outermost middles those there."""
        size = self.cells.size
        index = self.cells.place(np.clip(offsets, *self.cells.offsets[[0, -1]]))
        return local_polynomial(self.values, lw.Window(0.0, size // 2 + 0.5, 1.0, size, False, 1.0), index)


def pulled_back(
    prepared: Prepared,
    log_values: Callable[[Array], Array],
    density: Callable[[Array], Array],
    plan: CellPlan | None,
    interval: TimeInterval,
) -> BackwardExpectation | None:
    """Return the expectation of a function of the state after an interval, given the state before; None where it does not settle.

    Args:
        log_values: the logarithm of the function at offsets (J,).
        density: the density before the interval, as a function of offsets (J,).
        plan: the plan of the cells, None where there is none.
    """
    if plan is None:
        return None

    def at_level(cells: Volumes, steps: Array) -> tuple[Array, Number]:
        logs = log_values(cells.offsets)
        top = float(np.max(logs))
        before = density(cells.offsets)
        result, gained = _advanced(np.exp(logs - top), prepared, before, cells, interval, steps, plan, backward=True)
        return result, gained + top

    def between(result: Array) -> Array:
        padded = np.concatenate([result[:1], result, result[-1:]])
        return np.asarray((9.0 * (result[::2] + result[1::2]) - padded[:-2:2] - padded[3::2]) / 16.0)

    result = _settled(SMOOTH, plan, at_level, between, lambda cells: density(cells.offsets) * cells.widths)
    if result is None:
        return None
    return BackwardExpectation(result.cells, result.values, float(result.log_scale.real), result.error)


def _settled(
    allowed: float,
    plan: CellPlan,
    at_level: Callable[[Volumes, Array], tuple[Array, Number]],
    paired: Callable[[Array], Array],
    weights: Callable[[Volumes], Array],
) -> Settled | None:
    """Return the values of cells, with more cells until they settle.

    Args:
        allowed: the error at which more cells are not tried.
        at_level: values of the sum one on cells and the logarithm of their scale, for the ends of steps.
        paired: values on half as many cells.
        weights: those of the errors of cells.
    """
    before = best = None
    error = np.inf
    for size, count in LEVELS:
        cells = plan.cells._replace(size=size)
        values, gained = at_level(cells, plan.steps(count))
        if before is not None:
            coarse = paired(values)
            # The error of second order falls to a quarter where the size of the cells is halved.
            finer = coarse + (coarse - before[0] * np.exp(before[1] - gained)) / 3.0
            total = np.sum(finer)
            finer, scale = finer / total, gained + np.log(total)
            if best is not None:
                # The rest falls by more than a factor of four from one level to the next.
                change, weight = paired(finer) * np.exp(scale - best[1]) - best[0], weights(best[2])
                error = 0.25 * float(weight @ np.abs(change.real) / (weight @ best[0].real))
            best = finer, scale, cells._replace(size=len(finer))
            if error < allowed:
                break
        before = values, gained
    if best is None or not error < SETTLED:
        return None
    return Settled(best[0], best[2], best[1], error)


def _advanced(
    masses: Array,
    prepared: Prepared,
    density: Array,
    cells: Volumes,
    interval: TimeInterval,
    ends: Array,
    plan: CellPlan,
    backward: bool = False,
) -> tuple[Array, Number]:
    """Return the masses of cells after steps, and the logarithm of their sum; `density` is the one before the interval."""
    bounds, (_, start, _, inside, rates) = plan.bounds, interval
    known: dict[int, Bands] = {}

    def operators(times: Array) -> Bands:
        drift, covariance, potential, constant = coefficients(prepared, cells, times, inside, rates, density)
        drift = np.where(np.abs(drift) < plan.fastest, drift, plan.fastest * np.sign(drift.real))
        covariance = covariance if covariance.ndim == 2 else covariance[:, None]
        return cells.bands(covariance, drift, potential + constant[:, None] - offset)

    def bands(times: Array) -> Bands:
        part = int(np.searchsorted(bounds, 0.5 * (times[0] + times[-1]))) - 1 if prepared.system.varying else 0
        first, last = bounds[part : part + 2]
        if part not in known:
            nodes = first + (last - first) * GAUSS_NODES if prepared.system.varying else np.zeros(1)
            known[part] = operators(within(start + nodes, start + first, start + last))
        if not prepared.system.varying:
            return known[part]
        matrix = interpolation((times - first) / (last - first))
        below, diagonal, above = (matrix @ one for one in known[part])
        return below, diagonal, above

    offset = 0.0
    if inside.any():
        *_, potential, constant = coefficients(prepared, cells, np.array([start]), inside, rates, density)
        counts = density.real > 1e-6 * density.real.max()
        offset = float(np.max(potential[0, : cells.size][counts].real) + constant[0].real)
    masses, gained = advanced(bands, masses, ends, backward)
    return masses, gained + offset * ends[-1]


def _resampled(prepared: Prepared, cells: Volumes, masses: Array, window: lw.Window, error: float) -> Prediction:
    """Return the masses of cells as a density on a uniform grid."""
    density, real = cells.density(masses), (masses / cells.widths).real
    used = cells.offsets[np.flatnonzero(real > lw.CUT * real.max())]
    spacing = (used[-1] - used[0]) / 64.0
    for _ in range(9):
        new = lw.quantized(window, used[0], used[-1], spacing, most=lw.SIZES[-1])
        values = density(new.offsets)
        values = values / np.sum(values)
        check = lw.grid_check(values, False, prepared.negligible)
        if check.aliasing <= max(RESOLVED, 1e-2 * error) or new.size >= lw.SIZES[-1]:
            break
        spacing = 1.001 * new.spacing / 2**0.5
    return Prediction(values, new, 0.0, check)
