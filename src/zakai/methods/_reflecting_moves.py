"""How a density between reflecting ends moves: its Gauss-Lobatto points, and substeps on them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from zakai.errors import InputError
from zakai.methods import _line_coefficients, _line_moves
from zakai.methods._line_moves import Report
from zakai.methods._line_system import Prepared, covariance_at
from zakai.models.domain import Interval
from zakai.numerics.line_operator import exponential_action
from zakai.numerics.line_panels import GAUSS_NODES, GAUSS_WEIGHTS
from zakai.numerics.lobatto import Element

Array = Any

SIZES = (24, 32, 48, 64, 96, 128, 192, 256)
CUT = 36.0  # nats below the maximum where a density ends
EDGE = 1e-12  # density at an end that is not one of the domain, relative to the maximum
SAMPLES = 1001  # points at which the place of a density is sought
WIDER = 30.0  # factor of the variance in one substep
RESOLVED = 1e-2  # of the tolerance that more points may change
MOST_SUBSTEPS = 2000

_MOVES: Any = _line_moves  # which serves grids and elements alike
_COEFFICIENTS: Any = _line_coefficients


def domain_of(prepared: Prepared) -> Interval:
    return prepared.model.domain[prepared.model.state[0]]


def negligible_of(prepared: Prepared) -> float:
    """Return the Legendre coefficient, relative to the largest, that need not be resolved."""
    return max(prepared.negligible, 1e-5 * prepared.tolerance)


def without_nan(logs: Array) -> Array:
    return np.where(np.isnan(logs.real), -np.inf, logs)


def support(points: Array, logs: Array) -> tuple[float, float]:
    """Return the neighbours of the points at which a density counts."""
    logs = without_nan(logs)
    here = np.flatnonzero(logs > np.max(logs) - CUT)
    if not len(here):
        raise InputError("prior: log_density has no finite value inside of the domain")
    return float(points[max(here[0] - 1, 0)]), float(points[min(here[-1] + 1, len(points) - 1)])


def placed(logs: Callable[[Array], Array], lower: float, upper: float, domain: Interval) -> tuple[float, float]:
    """Return an interval that holds a density, with a margin inside of the domain."""
    for _ in range(40):
        points = np.linspace(lower, upper, SAMPLES)
        low, high = support(points, logs(points))
        shrunk = high - low < 0.5 * (upper - lower)
        lower, upper = low, high
        if not shrunk:
            break
    margin = 0.1 * (upper - lower)
    return max(lower - margin, domain.lower), min(upper + margin, domain.upper)


def sampled(density: Callable[[Array], Array], lower: float, upper: float, negligible: float) -> tuple[Element, Array]:
    """Return the fewest points that resolve a density, and its probabilities there."""
    for size in SIZES:
        element = Element(lower, upper, size)
        values = density(element.points) * element.weights
        if element.unresolved(values) < negligible:
            break
    return element, values


def reached(values: Array, element: Element, domain: Interval) -> tuple[float, float]:
    """Return the density at the two ends that are not those of the domain, relative to the maximum."""
    density = np.abs((values / element.weights).real)
    left, right = density[[0, -1]] / density.max()
    return (0.0 if element.lower <= domain.lower else left), (0.0 if element.upper >= domain.upper else right)


def moved(values: Array, element: Element, lower: float, upper: float, least: int, negligible: float) -> tuple[Element, Array]:
    """Return a density on other ends, with at least so many points."""
    sizes = [size for size in SIZES if size >= least] or [SIZES[-1]]
    for size in sizes:
        new = Element(lower, upper, size)
        found = element.at(values, new.points) * new.weights
        if new.unresolved(found) < negligible:
            break
    return new, found


def propagated(
    prepared: Prepared, values: Array, element: Element, k: int, inside: np.ndarray, rates: np.ndarray, report: Report
) -> tuple[Array, Element, Any]:
    """Return the density after interval k, its points, and the logarithm of its mass."""
    start, length, domain = float(prepared.schedule.starts[k]), float(prepared.lengths[k]), domain_of(prepared)
    stack, gained, substeps, negligible = [(0.0, length)], 0.0, 0, negligible_of(prepared)
    if not prepared.system.steady:
        parts = _COEFFICIENTS.resolved_parts(prepared, values, element, start, length, inside)
        stack, report.time = parts.bounds[::-1], report.time + parts.error
    while stack:
        first, last = stack.pop()
        substeps += 1
        mean, variance = moments(values, element)
        noise = float(np.max(covariance_at(prepared.system, np.array([mean.real]), start + first, prepared.theta).real))
        if noise * (last - first) > WIDER * variance.real and substeps < MOST_SUBSTEPS:
            middle = first + WIDER * variance.real / noise
            if first < middle < last:
                stack.append((middle, last))
                last = middle
        reach = 6.0 * float(np.sqrt(noise * (last - first)))
        lower, upper = max(element.lower - reach, domain.lower), min(element.upper + reach, domain.upper)
        before, own = moved(values, element, lower, upper, element.size, negligible)
        while True:
            tried = _attempt(prepared, own, before, start, first, last, inside, rates)
            total = float(np.sum(tried.values.real))
            lost = not 1e-250 < total < 1e6
            if tried.split or lost:
                break
            left, right = reached(tried.values, before, domain)
            unresolved = before.unresolved(tried.values)
            coarse = unresolved > 30.0 * negligible
            # Oscillations of what is not resolved reach the ends as well.
            edge = unresolved if coarse else EDGE
            width = before.upper - before.lower
            lower = max(before.lower - 0.4 * width * (left > edge), domain.lower)
            upper = min(before.upper + 0.4 * width * (right > edge), domain.upper)
            least = before.size + 1 if coarse else before.size
            if (lower, upper) == (before.lower, before.upper) and (not coarse or before.size == SIZES[-1]):
                # What the points do not resolve within the substep, as layers at the ends, shows with more of them only.
                finer, more = moved(values, element, lower, upper, before.size + 1, negligible)
                check = _attempt(prepared, more, finer, start, first, last, inside, rates)
                change = _difference(tried, before, check, finer)
                if finer.size > before.size:
                    before, own, tried = finer, more, check
                if change < max(RESOLVED * prepared.tolerance, 10.0 * check.error) or finer.size == SIZES[-1]:
                    tried = tried._replace(error=tried.error + change)
                    break
                continue
            wider, values_there = moved(values, element, lower, upper, least, negligible)
            if wider.unresolved(values_there) > 30.0 * negligible and max(left, right) > edge:
                tried = tried._replace(split=True)
                break
            before, own = wider, values_there
        if (tried.split or lost) and substeps < MOST_SUBSTEPS and last - first > 1e-12 * length:
            middle = first + 0.25 * (last - first)
            stack += [(middle, last), (first, middle)]
            continue
        report.aliasing = max(report.aliasing, before.unresolved(tried.values), before.unresolved(own))
        report.edge = max(report.edge, *reached(tried.values, before, domain))
        report.negative = max(report.negative, float(-np.minimum(tried.values.real, 0.0).sum() / np.abs(tried.values.real).sum()))
        report.time += tried.error
        mass = np.sum(tried.values)
        values, element, gained = tried.values / mass, before, gained + np.log(mass) + tried.offset
        if stack:
            values, element = fitted(prepared, values, element)
    if substeps >= MOST_SUBSTEPS:
        report.time = np.inf
    return values, element, gained


def _attempt(
    prepared: Prepared, values: Array, element: Element, start: float, first: float, last: float, inside: Array, rates: Array
) -> Any:
    """Return the density after the part from start + first to start + last of an interval, as `_line_moves._attempt`.

    Where coefficients depend on time a step is compared with two of half its length, and extrapolated: the condition of no flux
    depends on time too, which leaves an error of second order near the ends.
    """
    if prepared.system.steady:
        return _MOVES._attempt(prepared, values, element, start, first, last, inside, rates)
    stack, offset, error, count = [(first, last)], 0.0, 0.0, 0
    while stack:
        a, b = stack.pop()
        middle, count = 0.5 * (a + b), count + 1
        whole = _two_exponentials(prepared, values, element, start, a, b, inside, rates)
        half = _two_exponentials(prepared, values, element, start, a, middle, inside, rates)
        halves = _two_exponentials(prepared, half.values, element, start, middle, b, inside, rates)
        halves = halves._replace(offset=half.offset + halves.offset)
        change = np.inf if whole.split or half.split or halves.split else _difference(whole, element, halves, element)
        if not change < 0.1 * prepared.tolerance and count < MOST_SUBSTEPS and middle > a:
            stack += [(middle, b), (a, middle)]
            continue
        more = (halves.values - np.exp(whole.offset - halves.offset) * whole.values) / 3.0
        values, offset, error = halves.values + more, offset + halves.offset, error + 0.1 * change
    return halves._replace(values=values, offset=offset, error=error)


def _two_exponentials(
    prepared: Prepared, values: Array, element: Element, start: float, first: float, last: float, inside: Array, rates: Array
) -> Any:
    """Return the density after a substep by the integrator of `_line_moves._magnus`, without its error."""
    length = last - first
    drift, covariance, potential, constant = _COEFFICIENTS.coefficients(
        prepared, element, start + first + length * GAUSS_NODES, inside, rates, values
    )
    zeroth, moment = length * GAUSS_WEIGHTS, 2.0 * length * GAUSS_WEIGHTS * (GAUSS_NODES - 0.5)
    offset, split = _COEFFICIENTS.offset_of(zeroth @ potential, values)
    error = 0.0
    for w in (0.5 * zeroth - moment, 0.5 * zeroth + moment):
        matrix = element.generator(w @ covariance, w @ drift, w @ potential - 0.5 * offset)
        values, rounding = exponential_action(matrix, values)
        error += rounding
    return _MOVES._Attempt(values, offset + zeroth @ constant, error, split)


def _difference(one: Any, element: Element, other: Any, finer: Element) -> float:
    """Return the relative difference of two solutions, as the integral of its modulus."""
    found = other.values.real
    own = element.at(one.values.real, finer.points) * finer.weights * np.exp(one.offset - other.offset)
    return float(np.sum(np.abs(found - own)) / np.sum(found))


def fitted(prepared: Prepared, values: Array, element: Element) -> tuple[Array, Element]:
    """Return a density on points that fit it: the same unless it fills less than half of them, or fewer resolve it."""
    domain = domain_of(prepared)
    lower, upper = placed(lambda x: logarithm(element.at(values, x).real), element.lower, element.upper, domain)
    if upper - lower > 0.5 * (element.upper - element.lower):
        lower, upper = element.lower, element.upper
    least = SIZES[max(SIZES.index(element.size) - 2, 0)]  # the step needs more points than its result
    new, found = moved(values, element, lower, upper, least, negligible_of(prepared))
    if new == element:
        return values, element
    return found / np.sum(found), new


def logarithm(values: Array) -> Array:
    return np.log(np.maximum(values, 1e-300))


def moments(values: Array, element: Element) -> tuple[Any, Any]:
    x = element.points - element.lower
    mean = x @ values
    return element.lower + mean, ((x - mean) ** 2) @ values
