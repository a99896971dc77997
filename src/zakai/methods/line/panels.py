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

from zakai.methods.line.coefficients import coefficients, covariance_at, resolved_parts
from zakai.methods.line.domain import ends_of_leak
from zakai.methods.line.model import MOST_KINKS, finite, within
from zakai.methods.line.prepared import Prepared, TimeInterval
from zakai.methods.line.report import Report
from zakai.methods.line.transition import Prediction
from zakai.numerics.arrays import Array, Number
from zakai.numerics.line import window as lw
from zakai.numerics.line.averages import GAUSS_NODES, GAUSS_WEIGHTS, Panels, interpolation
from zakai.numerics.line.rational import FINE, STABLE, Poles, exponential, joined, separated, weak_form
from zakai.numerics.line.resolution import RESOLVED, ROUNDING, TRANSITION_SHARE
from zakai.numerics.lobatto import Element

Function = Callable[[Array], Array]

SIZES = 9, 13  # points of a panel of two solutions
FIRST_PANELS = 8  # of equal length
TAIL = 10.0  # allowed errors that a panel may leave unresolved: the error that remains after an interval is far smaller
TIGHTER = 0.03  # that where two solutions differ too much, relative to that before
LEVELS = 3  # pairs of solutions that are compared
WORST = 0.03  # of the worst panel: what others leave unresolved that are bisected with it
ROUNDS = 40  # of bisection
MOST_PANELS = 1000
EDGE = 1e-9  # density at the ends of panels, relative to the maximum, beyond which they are too few
MUCH = 1e-3  # probability of an outermost panel beyond which the panels are too few before they are too long
FASTEST = 100.0  # rate at which the drift contracts, times the length of the interval and the tolerance, that no faster one exceeds
MOST_STEPS = 60, 1000  # in time, with the poles for contraction and for motion
LEAST_STEP = 1e-12  # of the interval
LEAST_SHARE = 0.01  # of the allowed error that a step may make however short it is
COARSE_STEP = 30.0  # allowed errors by which a step may differ from two halves, whose error is far smaller
SETTLED = 1e-2  # error above which panels do not serve


class Problem(NamedTuple):
    """What an interval does to the density before it, or to a `message`, what a state is worth at the end, backward.

    Both are functions of states (J,), smooth between `probes`.  The density before lies between `low` and `high`, and `after` is the
    one after the interval.  The coefficients are polynomials of time in each of the `parts`.
    """

    prepared: Prepared
    interval: TimeInterval
    density: Function
    probes: Array
    low: float
    high: float
    parts: Panels
    message: Function | None = None
    after: Function | None = None

    @classmethod
    def of(
        cls, prepared: Prepared, interval: TimeInterval, points: lw.Points, values: Array, density: Function, ends: Array
    ) -> Problem:
        """Return the problem for the probabilities (N,) of points, between two ends."""
        parts = Panels([(0.0, interval.length)], 0.0)
        if prepared.system.varying:
            parts = resolved_parts(prepared, values, points, interval)
        return cls(prepared, interval, density, points.points, float(ends[0]), float(ends[1]), parts)

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


class _Operator:
    """The operator on panels: M, r, and B of steps."""

    def __init__(self, problem: Problem, element: Element) -> None:
        self.problem, self.element, self.offset = problem, element, 0.0
        prepared, (_, start, length, inside, _) = problem.prepared, problem.interval
        self.before = problem.density(element.points)
        centre, reach = 0.5 * (problem.low + problem.high), 0.5 * (problem.high - problem.low)
        rate = FASTEST / (length * prepared.tolerance)
        self.fastest = rate * np.maximum(np.abs(element.points - centre), reach)
        G, _, V = self.at(np.array([start]))
        if inside.any():
            self.offset = float(np.max(V[0].real[self.before.real > 1e-6 * self.before.real.max()]))
        ends = G[0].reshape(-1, element.size)
        left, right = ends[:-1, -1], ends[1:, 0]
        ratios = np.where(right.real > 0.0, left, 1.0) / np.where(right.real > 0.0, right, 1.0)
        self.scale = np.append(1.0, np.cumprod(np.where(np.abs(ratios - 1.0) > JUMP, ratios, 1.0)))
        self.masses = element.weights * np.repeat(self.scale, element.size)

    def at(self, times: Array) -> tuple[Array, Array, Array]:
        """Return G, f and V (T, N) at times."""
        problem = self.problem
        drift, covariance, potential, constant = coefficients(
            problem.prepared, self.element, times, problem.interval.inside, problem.interval.rates, self.before
        )
        drift = np.where(np.abs(drift) < self.fastest, drift, self.fastest * np.sign(drift.real))
        covariance = covariance if covariance.ndim == 2 else covariance[:, None]
        return np.broadcast_to(covariance, drift.shape), drift, potential + constant[:, None] - self.offset

    def part(self, low: float, high: float) -> Callable[[float, float], list[Array]]:
        """Return the function that gives the B h of the exponentials of a step, between two times of a part of the interval."""
        problem, start = self.problem, self.problem.interval.start
        varying = problem.prepared.system.varying
        times = start + low + (high - low) * GAUSS_NODES if varying else np.array([start])
        known = self.at(within(times, start + low, start + high))

        def blocks(first: float, last: float) -> list[Array]:
            weights = np.full((1, 1), last - first)
            if varying:  # Magnus' integrator of order four without commutators
                moment = 2.0 * (GAUSS_NODES - 0.5)
                nodes = interpolation((first - low + (last - first) * GAUSS_NODES) / (high - low))
                weights = (last - first) * (GAUSS_WEIGHTS * np.array([0.5 - moment, 0.5 + moment])) @ nodes
            result = [weak_form(self.element, *(w @ one for one in known), self.scale) for w in weights]
            return [np.ascontiguousarray(B.transpose(0, 2, 1)) for B in result[::-1]] if problem.backward else result

        return blocks


JUMP = 1e-5  # relative difference of G on both sides of a cut from which it is a jump


def _solved(problem: Problem, element: Element, poles: Poles, allowed: float, least: int) -> Solution | None:
    """Return the function after the interval on panels, by at least so many steps; None where these are too many.

    Steps with the poles for motion are compared with two halves, as those with coefficients of time, which are extrapolated.
    """
    operator = _Operator(problem, element)
    masses, backward, varying = operator.masses, problem.backward, problem.prepared.system.varying
    compared, order = varying or poles is STABLE, 5.0 if varying else 8.0
    quadrature = joined(element, element.weights)
    mass, x = joined(element, masses), joined(element, element.weights * element.points) / quadrature
    values = (problem.message or problem.density)(element.points)
    v = joined(element, element.weights * values) / (quadrature if backward else mass)

    def size(v: Array) -> Number:
        return np.max(v.real) if backward else np.sum(mass * v)

    def advanced(v: Array, steps: list[tuple[float, float]]) -> Array:
        for step in steps[::-1] if backward else steps:
            for B in blocks(*step):
                v = exponential(element, B, masses, 1.0, poles, v)
        return v

    v, gained = v / size(v), np.log(size(v)) if backward else 0.0 * size(v)
    length, left = problem.interval.length, MOST_STEPS[poles is STABLE]
    for low, high in problem.parts.bounds[::-1] if backward else problem.parts.bounds:
        blocks, done, step = operator.part(low, high), 0.0, (high - low) / least
        while done < high - low:
            left, step = left - 1, min(step, high - low - done)
            first = high - done - step if backward else low + done
            middle, last = first + 0.5 * step, first + step
            result, error, wanted = advanced(v, [(first, last)]), 0.0, allowed * max(step / length, LEAST_SHARE)
            if compared:
                fine = advanced(v, [(first, middle), (middle, last)])
                change = np.abs((fine - result).real)
                weighted = np.max(change) if backward else (mass.real * _importance(x, mass.real * fine.real)) @ change
                error = float(weighted / np.abs(size(fine).real)) / (15.0 if varying else COARSE_STEP)
                result = (16.0 * fine - result) / 15.0 if varying else fine
            scale = size(result)
            if left < 0 or step < LEAST_STEP * length or not (compared or scale.real > 0.0):
                return None
            if not (error <= wanted and scale.real > 0.0):
                step *= max(0.1, 0.8 * (wanted / error) ** (1.0 / order)) if error < np.inf else 0.1
                continue
            done = high - low if step >= high - low - done else done + step
            step *= min(4.0, 0.8 * (wanted / max(error, 1e-300)) ** (1.0 / order)) if compared else 1.0
            v, gained = result / scale, gained + np.log(scale)
    u = separated(element, v)
    return Solution(element, u if backward else u * np.repeat(operator.scale, element.size), gained + operator.offset * length)


def _unresolved(problem: Problem, element: Element, values: Array, after: bool) -> Array:
    """Return what each panel (P,) leaves unresolved, relative to the function."""
    return np.asarray(element.tails(values.real) * element.sums(problem.weights(element, values, after)))


def _coarse(unresolved: Array, limit: float) -> Array:
    """Return which panels (P,) are bisected: the worst first, for what they leave unresolved shows in all others."""
    return np.asarray(unresolved > max(limit, WORST * float(np.max(unresolved))))


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


def _ended(problem: Problem, element: Element, poles: Poles, limit: float, allowed: float) -> Solution | None:
    """Return the solution on panels that hold and resolve the function after the interval, too; None where there is none."""
    for _ in range(ROUNDS):
        solution = _solved(problem, element, poles, allowed, 1)
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
            left, right = 4.0 * element.halves[[0, -1]] * sides
            ends = element.lower, *element.cuts, element.upper
            element = _within(problem, element.lower - left, element.upper + right, ends)
    return solution


def _reached(problem: Problem, solution: Solution) -> tuple[bool, bool]:
    """Return whether a density reaches the ends of its panels, beyond which there may be more of it."""
    density, element = np.abs(solution.values.real), solution.element
    low, high = domain_of(problem.prepared)
    left, right = density[[0, -1]] > EDGE * np.max(density)
    return bool(left and element.lower > low), bool(right and element.upper < high)


def _within(problem: Problem, low: float, high: float, cuts: tuple[float, ...] = ()) -> Element:
    """Return panels between two states in the domain, with ends at kinks, at `cuts`, or else of equal length."""
    prepared, start = problem.prepared, problem.interval.start
    middle = 0.5 * (problem.low + problem.high)
    low, high = np.clip([low, high], *domain_of(prepared)).tolist()
    low, high = (_defined(prepared, middle, end, start) for end in (low, high))
    more = cuts or np.linspace(low, high, FIRST_PANELS + 1)[1:-1]
    ends, apart = np.append(kinks_between(prepared, low, high, start), more), APART * (high - low)
    ends = np.unique(ends[(ends > low + apart) & (ends < high - apart)])
    return Element(low, high, SIZES[0], tuple(ends[np.diff(ends, prepend=-np.inf) > apart].tolist()))


def settled(problem: Problem, allowed: float) -> Solution | None:
    """Return the function after the interval on more panels until two solutions differ by less than allowed, or by the least."""
    element, best = _within(problem, problem.low, problem.high), None
    for poles in (FINE, STABLE):
        limit, before = TAIL * allowed, np.inf
        if problem.backward:
            forward = _ended(problem._replace(message=None), element, poles, limit, allowed)
            if forward is None:
                continue
            problem, element = problem._replace(after=forward.at), forward.element
        for _ in range(LEVELS):
            first = _ended(problem, _began(problem, element, limit), poles, limit, allowed)
            if first is None:
                break
            second = _solved(problem, first.element._replace(size=SIZES[1]), poles, 0.1 * allowed, 2)
            if second is None:
                break
            parts, element = _differences(problem, first, second), first.element
            error = float(np.sum(parts))
            if best is None or error < best.error:
                best = second._replace(error=error)
            if error < allowed:
                return best
            if error > 0.3 * before:
                break
            before, limit = error, TIGHTER * limit
            element = element.bisected(parts > 0.5 * allowed / len(parts))
    return best if best is not None and best.error < SETTLED else None


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
    top = float(np.max(logs(probes)))
    result = settled(problem._replace(message=lambda x: np.exp(logs(x) - top), probes=probes), SMOOTH)
    return None if result is None else result._replace(log_scale=result.log_scale + top)


APART = 1e-6  # of the range: ends of panels that are nearer to each other are one
PROBES = 65  # points between which a formula ceases to have values


def domain_of(prepared: Prepared) -> tuple[float, float]:
    """Return the reflecting ends of the domain."""
    if not prepared.system.reflecting:
        return -np.inf, np.inf
    domain = prepared.model.domain[prepared.model.state[0]]
    return domain.lower, domain.upper


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


KINK_PROBES = 1025  # points between which kinks are sought
ONE_KINK = 1e-10  # distance, of the interval, of the kinks of two coefficients that are one


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


FAST = 5.0  # ranges of a density that the drift crosses in an interval, below which a uniform grid serves
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
    if not (rough(prepared, inside) or fine or stiff or speed * length > FAST * width):
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
