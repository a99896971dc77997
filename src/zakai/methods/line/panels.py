"""One interval of one state on Gauss-Lobatto panels (`numerics/line/rational.py`), where a uniform grid does not serve.

That is where the density contracts so much that no uniform grid holds it, as by -x^3 from a broad prior, where coefficients have
kinks or jumps, at which panels end, and near natural ends.  Panels are bisected until they resolve the density before and after,
and added where it reaches their ends.  The error estimate is the difference of two solutions, of different order in space and
with different steps in time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from zakai.methods.line.cache import Derived
from zakai.methods.line.coefficients import coefficients, covariance_at, resolved_parts
from zakai.methods.line.domain import ends_of_leak, reflecting_ends
from zakai.methods.line.model import finite, within
from zakai.methods.line.prepared import Prepared, TimeInterval
from zakai.methods.line.report import Report
from zakai.methods.line.transition import Prediction
from zakai.numerics.arrays import Array, Number
from zakai.numerics.line import window as lw
from zakai.numerics.line.averages import GAUSS_NODES, Panels, interpolation
from zakai.numerics.line.grid_choice import FAR
from zakai.numerics.line.rational import COLLOCATION, CONTRACTION, Factors, collocated, joined, masses, separated, weak_form
from zakai.numerics.line.resolution import RESOLVED, ROUNDING, SUPPORT, TRANSITION_SHARE
from zakai.numerics.lobatto import Element

Function = Callable[[Array], Array]

SIZES = 9, 13  # points of a panel of two solutions
FIRST_PANELS = 8  # of equal length
TAIL = 1.0  # allowed errors that a panel may leave unresolved in the coarser of two solutions
TIGHTER = 0.03  # that where two solutions differ too much, relative to that before
LEVELS = 5  # pairs of solutions that are compared
GROSS = 1e-2  # share of the function that a panel leaves unresolved, which shows in all others, and error of no solution
WORST = 0.03  # of the worst panel: what others leave unresolved that are bisected with it
ROUNDS = 40  # of bisection
MOST_PANELS = 500  # beyond which none is bisected
EDGE = 1e-9  # density at the ends of panels, relative to the maximum, beyond which they are too few
MUCH = 1e-3  # probability of an outermost panel beyond which the panels are too few before they are too long
FASTEST = 100.0  # largest rate at which the drift contracts, times the length of the interval and the tolerance
RATIO = 4.0  # of the lengths of steps in time, at first
FIRST = 0.1  # of the time in which the drift would cross the range of the density, and of the interval: the first step
REACH = 7.0  # standard deviations of the noise beyond the density before, between which the first panels lie
DIFFUSED = 0.5  # of the time in which noise would double the variance: the first step
MOST_STEPS = 1000  # in time, beyond which none is divided
LEAST_STEP = 1e-9  # of the interval


class Problem(NamedTuple):
    """What an interval does to the density before it, or to a `message`, what a state is worth at the end, backward.

    Both are functions of states (J,), smooth between `probes`.  The density before lies between `low` and `high`, noise carries
    it by `reach` beyond, and `after` is the one after the interval.  The coefficients are polynomials of time in each of the
    `parts`; the first step in time is `quick`.
    """

    prepared: Prepared
    interval: TimeInterval
    density: Function
    probes: Array
    low: float
    high: float
    parts: Panels
    quick: float
    reach: float
    message: Function | None = None
    after: Function | None = None

    @classmethod
    def of(
        cls, prepared: Prepared, interval: TimeInterval, points: lw.Points, values: Array, density: Function, ends: Array
    ) -> Problem:
        """Return the problem for the probabilities (N,) of points, between two ends."""
        parts, theta, (low, high) = Panels([(0.0, interval.length)], 0.0), prepared.theta.real, ends.tolist()
        if prepared.system.varying:
            parts = resolved_parts(prepared, values, points, interval)
        drift = np.max(np.abs(finite(prepared.system.drift(ends[:, None], interval.start, theta)[:, 0])))
        top = points.points[[int(np.argmax(values.real))]]
        noise = float(np.max(covariance_at(prepared.system, top, interval.start, theta)))
        rate = max(min(drift / (high - low), FASTEST / (interval.length * prepared.tolerance)), 1.0 / interval.length)
        diffused = DIFFUSED * ((high - low) / (2.0 * SUPPORT)) ** 2 / max(noise, 1e-300)
        reach = REACH * float(np.sqrt(noise * interval.length))
        return cls(prepared, interval, density, points.points, low, high, parts, min(FIRST / rate, float(diffused)), reach)

    @classmethod
    def of_grid(cls, prepared: Prepared, interval: TimeInterval, values: Array, window: lw.Window) -> Problem:
        """Return the problem for the probabilities of a uniform grid."""
        check = lw.grid_check(values, False)
        ends = window.points[[max(check.first - 1, 0), min(check.last + 1, window.size - 1)]]
        return cls.of(prepared, interval, window, values, lambda x: lw.density_at(values, window, x - window.origin), ends)

    @property
    def backward(self) -> bool:
        """Whether a message is taken to the start."""
        return self.message is not None

    def weights(self, element: Element, values: Array, after: bool) -> Array:
        """Return the weights (N,) of errors at the points, relative to the function: after the interval, or before it.

        Those of a density count with 1 + ((x - mean) / deviation)^2, those of a message with the density.
        """
        if self.message is not None:
            density = self.density if after else self.after
            assert density is not None
            weights = element.weights * np.maximum(density(element.points).real, 0.0)
            return np.asarray(weights / (weights @ values.real))
        masses = element.weights * values.real
        return np.asarray(element.weights * _importance(element.points, masses) / np.sum(masses))


def _importance(x: Array, masses: Array) -> Array:
    """Return 1 + ((x - mean) / deviation)^2 for masses at points."""
    p = np.abs(masses) / np.sum(np.abs(masses))
    square = (x - p @ x) ** 2
    return np.asarray(1.0 + square / max(float(p @ square), 1e-300))


class Solution(NamedTuple):
    """A function after an interval: its values at the points of panels, the logarithm of its scale, and the error."""

    element: Element
    values: Array
    log_scale: Number
    error: float = np.inf

    def at(self, points: Array) -> Array:
        """Return the values at states (J,), zero beyond the panels."""
        return self.element.at(self.values * self.element.weights, points)

    def extended(self, points: Array) -> Array:
        """Return the values at states (J,), beyond the panels those at their ends."""
        return self.at(np.clip(points, self.element.lower, self.element.upper))


class Operator:
    """The operator A on panels, and its M and r at the ends of steps."""

    def __init__(self, problem: Problem, element: Element) -> None:
        self.problem, self.element, self.offset = problem, element, 0.0
        prepared, (_, start, length, inside, _) = problem.prepared, problem.interval
        self.before = problem.density(element.points)
        centre, reach = 0.5 * (problem.low + problem.high), 0.5 * (problem.high - problem.low)
        rate = FASTEST / (length * prepared.tolerance)
        self.fastest = rate * np.maximum(np.abs(element.points - centre), reach)
        self.begin = self._at(np.array([start]))
        if inside.any():
            V = self.begin[2][0].real
            self.offset = float(np.max(V[self.before.real > 1e-6 * self.before.real.max()]))

    def _at(self, times: Array) -> tuple[Array, Array, Array]:
        """Return G, f and V (T, N) at times."""
        problem = self.problem
        drift, covariance, potential, constant = coefficients(
            problem.prepared, self.element, times, problem.interval.inside, problem.interval.rates, self.before
        )
        drift = np.where(np.abs(drift) < self.fastest, drift, self.fastest * np.sign(drift.real))
        covariance = covariance if covariance.ndim == 2 else covariance[:, None]
        return np.broadcast_to(covariance, drift.shape), drift, potential + constant[:, None]

    def part(self, low: float, high: float) -> Callable[[Array, float], Array]:
        """Return the function that gives the parts of A, times a step, at times after the start (T, P, n, n).

        The times are in a part of the interval.  Where no coefficient depends on time it gives one.
        """
        varying, start = self.problem.prepared.system.varying, self.problem.interval.start
        times = within(start + low + (high - low) * GAUSS_NODES, start + low, start + high)
        known = self._at(times) if varying else self.begin

        def blocks(times: Array, step: float) -> Array:
            weights = interpolation((times - low) / (high - low)) if varying else np.ones((1, 1))
            G, f, V = (weights @ one for one in known)
            result = step * weak_form(self.element, G, f, V - self.offset, self._scale(G))
            return result.swapaxes(-1, -2) if self.problem.backward else result

        return blocks

    def _scale(self, covariance: Array) -> Array:
        """Return r (..., P) for G (..., P n)."""
        left, right = covariance[..., :: self.element.size], covariance[..., self.element.size - 1 :: self.element.size]
        ratios = np.ones_like(left)
        known = right.real[..., :-1] * left.real[..., 1:] > 0.0
        np.divide(right[..., :-1], left[..., 1:], out=ratios[..., 1:], where=known)
        return np.asarray(np.cumprod(np.where(np.abs(ratios - 1.0) > JUMP, ratios, 1.0), axis=-1))

    def density(self, values: Array, t: float) -> Array:
        """Return the density (..., P n) at a time after the start from the masses of points (..., P (n - 1) + 1)."""
        start = self.problem.interval.start
        varying = self.problem.prepared.system.varying
        G, _, _ = self._at(within(np.array([start + t]), start, start + t)) if varying else self.begin
        scale = self._scale(G[0])
        return np.asarray(separated(self.element, values / masses(self.element, scale)) * np.repeat(scale, self.element.size))


JUMP = 1e-5  # relative difference of G on both sides of a cut from which it is a jump


class Steps(NamedTuple):
    """Steps in time: each longer than the one before by at most a `ratio`, or `number` equal ones by an exponential."""

    ratio: float = 0.0
    number: int = 1

    def finer(self, power: float) -> Steps:
        """Return steps whose ratio is to a power of at most one half, or twice as many."""
        return Steps(self.ratio**power, 2 * self.number)


def _ends_of_steps(problem: Problem, steps: Steps) -> Array:
    """Return the ends (T + 1,) of steps; backward they are short at the end, too."""
    length, ratio = problem.interval.length, steps.ratio
    if not ratio:
        return np.linspace(0.0, length, steps.number + 1)
    count = int(np.ceil(np.log(length / problem.quick) / np.log(ratio)))
    ends = length * (problem.quick / length) ** np.linspace(1.0, 0.0, count + 1)
    bounds = [0.0, *(stop for _, stop in problem.parts.bounds)]
    return np.unique(np.concatenate([bounds, ends[:-1], length - ends[:-1] if problem.backward else []]))


def _solved(problem: Problem, element: Element, chosen: Steps) -> Solution | None:
    """Return the function after the interval on panels, None where there is none."""
    operator, backward, length = Operator(problem, element), problem.backward, problem.interval.length
    v = joined(element, element.weights * (problem.message or problem.density)(element.points))
    v = v / joined(element, element.weights) if backward else v

    def size(v: Array) -> Number:
        result: Number = np.max(v.real) if backward else np.sum(v)
        return result

    gained = np.log(size(v) if backward else size(v) / size(v).real)
    v = v / size(v)
    ends = _ends_of_steps(problem, chosen)
    steps, part, factors = list(zip(ends[:-1], ends[1:], strict=True)), (0.0, 0.0), None
    steps = steps if backward else steps[::-1]
    while steps:
        first, last = steps.pop()
        step = last - first
        if not part[0] <= 0.5 * (first + last) <= part[1]:
            part = next(bounds for bounds in problem.parts.bounds if bounds[0] <= 0.5 * (first + last) <= bounds[1])
            blocks = operator.part(*part)
        if chosen.ratio:
            at = last - step * COLLOCATION.nodes if backward else first + step * COLLOCATION.nodes
            found = collocated(element, blocks(at, step), v)
            if found is None:
                middle = 0.5 * (first + last)
                if len(steps) > MOST_STEPS or step < LEAST_STEP * length:
                    return None
                steps += [(first, middle), (middle, last)] if backward else [(middle, last), (first, middle)]
                continue
            v = found
        else:
            factors = factors or Factors.of(element, blocks(ends[:1], step)[0], CONTRACTION.values)
            v = factors.exponential(v)
        scale = size(v)
        if not scale.real > 0.0:
            return None
        v, gained = v / scale, gained + np.log(scale)
    u = separated(element, v) if backward else operator.density(v, length)
    return Solution(element, u, gained + operator.offset * length)


def _unresolved(problem: Problem, element: Element, values: Array, after: bool) -> Array:
    """Return what each panel (P,) leaves unresolved, relative to the function."""
    return np.asarray(element.tails(values.real) * element.sums(problem.weights(element, values, after)))


def _coarse(unresolved: Array, limit: float) -> Array:
    """Return which panels (P,) are bisected: first the worst where what they leave unresolved shows in all others."""
    worst = float(np.max(unresolved))
    return np.asarray(unresolved > max(limit, WORST * worst if worst > GROSS else 0.0))


def _began(problem: Problem, element: Element, limit: float) -> Element:
    """Return panels that resolve the function before it is taken through the interval."""
    function = problem.message or problem.density
    probes = problem.probes[(problem.probes > element.lower) & (problem.probes < element.upper)]
    known = function(probes).real
    for _ in range(ROUNDS):
        values = function(element.points).real
        rest, worst = np.abs(element.at(values * element.weights, probes) - known), np.zeros(len(element.halves))
        np.maximum.at(worst, element.panel(probes), rest)
        worst = worst * element.sums(problem.weights(element, values, False))
        coarse = _coarse(np.maximum(_unresolved(problem, element, values, False), worst), limit)
        if not coarse.any() or len(coarse) > MOST_PANELS:
            break
        element = element.bisected(coarse)
    return element


def _ended(problem: Problem, element: Element, steps: Steps, limit: float) -> Solution | None:
    """Return the solution on panels that hold and resolve the function after the interval, too; None where there is none."""
    for _ in range(ROUNDS):
        solution = _solved(problem, element, steps)
        if solution is None:
            return None
        sides = (False, False) if problem.backward else _reached(problem, solution)
        masses = element.sums(element.weights * solution.values.real)
        coarse = _coarse(_unresolved(problem, element, solution.values, True), limit)
        if not (coarse.any() or any(sides)) or len(coarse) > MOST_PANELS:
            break
        if coarse.any() and not any(masses[[0, -1]][list(sides)] > MUCH * np.sum(masses)):
            element = element.bisected(coarse)
        else:
            more = 4.0 * element.halves[[0, -1]] * sides
            element = _around(problem, more, (element.lower, *element.cuts, element.upper))
    return solution


def _reached(problem: Problem, solution: Solution) -> tuple[bool, bool]:
    """Return whether a density reaches the ends of its panels, beyond which there may be more of it."""
    density, element = np.abs(solution.values.real), solution.element
    low, high = reflecting_ends(problem.prepared)
    left, right = density[[0, -1]] > EDGE * np.max(density)
    return bool(left and element.lower > low), bool(right and element.upper < high)


def panels_between(prepared: Prepared, low: float, high: float, t: float, cuts: tuple[float, ...] = ()) -> Element:
    """Return panels between two states in the domain, with ends at kinks, at `cuts`, or else of equal length."""
    more = np.array(cuts) if cuts else np.linspace(low, high, FIRST_PANELS + 1)
    low, high = np.clip([low, high], *reflecting_ends(prepared)).tolist()
    ends, apart = np.array([low, *kinks_of(prepared, low, high, t), high]), APART * (high - low)
    more = more[np.min(np.abs(more[:, None] - ends), axis=1) > apart]
    ends = np.sort(np.append(ends[(ends > low + apart) & (ends < high - apart)], more[(more > low) & (more < high)]))
    return Element(low, high, SIZES[0], tuple(ends.tolist()))


def _around(problem: Problem, more: Array, ends: tuple[float, ...]) -> Element:
    """Return panels with some ends, and by so much `more` (2,) on each side as the coefficients have values."""
    middle, start = 0.5 * (ends[0] + ends[-1]), problem.interval.start
    low, high = np.clip([ends[0] - more[0], ends[-1] + more[1]], *reflecting_ends(problem.prepared)).tolist()
    low, high = (_defined(problem.prepared, middle, end, start) for end in (low, high))
    return panels_between(problem.prepared, low, high, start, ends)


def settled(problem: Problem, allowed: float) -> Solution | None:
    """Return the function after the interval on more panels until two solutions differ by less than allowed, or by the least."""
    ends = tuple(np.linspace(problem.low, problem.high, FIRST_PANELS + 1).tolist())
    element, best = _around(problem, np.full(2, problem.reach), ends), None
    for steps in (Steps(), Steps(RATIO))[problem.prepared.system.varying :]:
        limit, before, in_time, turned = TAIL * allowed, np.inf, steps.ratio > 0.0, False
        if problem.backward:
            forward = _ended(problem._replace(message=None), element, steps, limit)
            if forward is None:
                continue
            problem, element = problem._replace(after=forward.at), forward.element
        for _ in range(LEVELS):
            first = _ended(problem, _began(problem, element, limit), steps, limit)
            if first is None:
                break
            second = _solved(problem, first.element._replace(size=SIZES[1]), steps.finer(0.5))
            if second is None:
                break
            parts, element = _differences(problem, first, second), first.element
            error = float(np.sum(parts))
            if not (problem.backward or problem.interval.inside.any()):
                error += abs(float(second.log_scale.real))  # the mass stays, but for rounding
            if best is None or error < best.error:
                best = second._replace(error=error)
            if error < allowed:
                return best
            if error > 0.3 * before:  # what was made finer did not matter
                if turned:
                    break
                in_time, turned = not in_time, True
            before = error
            if in_time:
                steps = steps.finer(float(np.clip((allowed / error) ** 0.2, 0.15, 0.5)))  # the error is of fifth order
                if len(_ends_of_steps(problem, steps)) > MOST_STEPS:
                    break
                continue
            if len(parts) > MOST_PANELS:
                break
            limit *= TIGHTER
            element = element.bisected(parts > 0.5 * allowed / len(parts))
    return best if best is not None and best.error < GROSS else None


def _differences(problem: Problem, first: Solution, second: Solution) -> Array:
    """Return by how much two solutions on the same panels differ, relative to the function, on each panel (P,)."""
    other = first.element.finer(first.values.real, SIZES[1]) * np.exp((first.log_scale - second.log_scale).real)
    weights = problem.weights(second.element, second.values, True)
    return second.element.sums(weights * np.abs(other - second.values.real))


SMOOTH = 1e-7  # error of a backward interval that is allowed


def pulled_back(problem: Problem, logs: Function, probes: Array) -> Solution | None:
    """Return the expectation of a function of the state after an interval, given the state before; None where there is none.

    Args:
        problem: that of the density before the interval.
        logs: the logarithm of the function at states (J,), smooth between `probes`.
    """
    known = logs(probes)
    top = float(np.max(known))
    p = np.exp(known - top) / np.sum(np.exp(known - top))
    noise = np.max(covariance_at(problem.prepared.system, probes, problem.interval.start, problem.prepared.theta.real))
    quick = min(problem.quick, DIFFUSED * float(p @ (probes - p @ probes) ** 2) / max(float(noise), 1e-300))
    problem = problem._replace(message=lambda x: np.exp(logs(x) - top), probes=probes, quick=quick)
    result = settled(problem, SMOOTH)
    return None if result is None else result._replace(log_scale=result.log_scale + top)


APART = 1e-6  # of the range: ends of panels that are nearer to each other are one
PROBES = 65  # points between which a formula ceases to have values


def _defined(prepared: Prepared, inner: float, outer: float, t: float) -> float:
    """Return how far between two states the drift and the noise have values."""
    system, theta = prepared.system, prepared.theta.real
    for _ in range(4):
        x = np.linspace(inner, outer, PROBES)[:, None]
        missing = ~(np.isfinite(system.drift(x, t, theta)[:, 0]) & (system.covariance(x, t, theta)[:, 0, 0] >= 0.0))
        if not missing.any():
            return outer
        first = max(int(np.argmax(missing)), 1)
        inner, outer = float(x[first - 1, 0]), float(x[first, 0])
    return inner


def kinks_of(prepared: Prepared, lower: float, upper: float, t: float) -> Array:
    """Return the kinks between two states, of those that are known between ends out of few."""
    if prepared.system.kinks is None:
        return np.zeros(0)
    unit, t = 2.0 ** np.ceil(np.log2(upper - lower)), t if prepared.system.varying else prepared.model.start
    low, high = float(unit * np.floor(lower / unit)), float(unit * np.ceil(upper / unit))
    between, theta = prepared.system.kinks_between, prepared.theta.real
    known: Array = prepared.once(Derived.KINKS, (low, high, t), lambda: between(low, high, t, theta))
    return known[(known > lower) & (known < upper)]


TURNING_OF_LARGE_GRID = 300.0  # phase by which the drift turns the shortest wave of a large grid, above which that is not tried


def rough(prepared: Prepared, inside: np.ndarray) -> bool:
    """Return whether coefficients have kinks or jumps, which without a decomposition leave waves on a uniform grid."""
    system = prepared.system
    needed = system.varying or bool(inside.any()) or system.slope is None or system.spread is None
    return (needed or (system.kinked_drift and not prepared.weak)) and system.kinks is not None


def contracted(
    prepared: Prepared, values: Array, window: lw.Window, interval: TimeInterval, report: Report, moving: bool
) -> Prediction | None:
    """Return the density after an interval, None where panels do not serve or a uniform grid, which may move, is better."""
    if window.closed:
        return None
    check, (_, start, length, inside, _) = lw.grid_check(values, False, prepared.negligible), interval
    ends = window.points[[max(check.first - 1, 0), min(check.last + 1, window.size - 1)]]
    drift = finite(prepared.system.drift(ends[:, None], start, prepared.theta.real)[:, 0])
    width, speed = float(np.ptp(ends)), 0.5 * float(np.ptp(drift)) if moving else float(np.max(np.abs(drift)))
    fine = window.size > lw.LARGEST and np.pi * speed * length > TURNING_OF_LARGE_GRID * window.spacing
    # The noise of the logarithm of a state grows without limit towards a natural end.
    noise = float(np.max(covariance_at(prepared.system, window.points, start, prepared.theta.real)))
    stiff = ROUNDING * 0.5 * (np.pi / window.spacing) ** 2 * noise * length > TRANSITION_SHARE * prepared.tolerance
    stiff = stiff or ends_of_leak(prepared, window, ends - window.origin, start, length) is not None
    if not (rough(prepared, inside) or fine or stiff or speed * length > FAR * width):
        return None
    # Panels do not bring back what the grid does not resolve.
    allowed = TRANSITION_SHARE * max(prepared.tolerance, check.aliasing)

    problem = Problem.of_grid(prepared, interval, values, window)
    solution = settled(problem, allowed)
    if solution is None or any(_reached(problem, solution)):
        return None
    report.time, report.noise = report.time + solution.error + problem.parts.error, max(report.noise, solution.error)
    prediction = _resampled(prepared, solution, window)
    assert prediction.check is not None
    report.density(prediction.check)
    return prediction


def _resampled(prepared: Prepared, solution: Solution, window: lw.Window) -> Prediction:
    """Return a density on a uniform grid."""
    used = solution.element.points[solution.values.real > lw.CUT * np.max(solution.values.real)][[0, -1]] - window.origin
    spacing = (used[-1] - used[0]) / 64.0
    for _ in range(9):
        new = lw.quantized(window, used[0], used[-1], spacing, most=lw.SIZES[-1])
        values = solution.at(new.points)
        values = np.where(values.real > 0.0, values, 0.0)
        values = values / np.sum(values)
        check = lw.grid_check(values, False, prepared.negligible)
        if check.aliasing <= max(RESOLVED, 1e-2 * solution.error) or new.size >= lw.SIZES[-1]:
            break
        spacing = 1.001 * new.spacing / 2**0.5
    return Prediction(values, new, solution.log_scale, check)
