"""A density between ends and kinks on Gauss-Lobatto panels: the panels that resolve it, and its transition (`line/panels.py`)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from zakai.errors import InputError
from zakai.methods.line.panels import MOST_PANELS, ROUNDS, SIZES, Problem, panels_between, settled
from zakai.methods.line.prepared import Prepared, TimeInterval
from zakai.methods.line.report import Report
from zakai.models.domain import Interval
from zakai.numerics.arrays import Array, Number
from zakai.numerics.line.grid_choice import DEPTH
from zakai.numerics.line.resolution import RESOLVED, TRANSITION_SHARE
from zakai.numerics.lobatto import Element

SAMPLES = 1001  # points at which the place of a density is sought


def domain_of(prepared: Prepared) -> Interval:
    return prepared.model.domain.get(prepared.model.state[0], Interval())


def negligible_of(prepared: Prepared, error: float = 0.0) -> float:
    """Return the Legendre coefficient, relative to the largest, that need not be resolved of a density with an error."""
    return max(RESOLVED, 1e-5 * prepared.tolerance, 1e-2 * min(error, prepared.tolerance))


def without_nan(logs: Array) -> Array:
    return np.where(np.isnan(logs.real), -np.inf, logs)


def support(points: Array, logs: Array) -> tuple[float, float]:
    """Return the neighbours of the points at which a density counts."""
    logs = without_nan(logs)
    here = np.flatnonzero(logs > np.max(logs) - DEPTH)
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
    return with_margin(lower, upper, domain)


def with_margin(lower: float, upper: float, domain: Interval) -> tuple[float, float]:
    """Return ends with a margin inside of the domain."""
    margin = 0.1 * (upper - lower)
    return max(lower - margin, domain.lower), min(upper + margin, domain.upper)


def sampled(
    prepared: Prepared, probabilities: Callable[[Element], Array], lower: float, upper: float, negligible: float
) -> tuple[Element, Array]:
    """Return panels between two states that resolve a density, and its probabilities at their points."""
    element = panels_between(prepared, lower, upper, prepared.model.start)._replace(size=SIZES[1])
    for _ in range(ROUNDS):
        values = probabilities(element)
        where = coarse(values, element, negligible)
        if not where.any() or len(where) > MOST_PANELS:
            break
        element = element.bisected(where)
    return element, probabilities(element)


def coarse(values: Array, element: Element, negligible: float) -> Array:
    """Return which panels (P,) do not resolve a density, by what they leave in the mean over all: small jumps do not count."""
    density = (values / element.weights).real
    return element.tails(density) * element.halves > negligible * float(np.max(np.abs(density))) * (element.upper - element.lower)


def reached(values: Array, element: Element, domain: Interval) -> tuple[float, float]:
    """Return the density at the two ends that are not those of the domain, relative to the maximum."""
    density = np.abs((values / element.weights).real)
    left, right = density[[0, -1]] / density.max()
    return (0.0 if element.lower <= domain.lower else left), (0.0 if element.upper >= domain.upper else right)


def logarithm(values: Array) -> Array:
    return np.log(np.maximum(values, 1e-300))


def moments(values: Array, element: Element) -> tuple[Number, Number]:
    x = element.points - element.lower
    mean = np.dot(x, values)
    return element.lower + mean, np.dot((x - mean) ** 2, values)


def propagated(
    prepared: Prepared, values: Array, element: Element, interval: TimeInterval, report: Report, negligible: float
) -> tuple[Array, Element, Number]:
    """Return the density after an interval, its points, and the logarithm of its mass."""

    def density(x: Array) -> Array:
        return element.at(values, x)

    problem = Problem.of(prepared, interval, element, values, density, np.array([element.lower, element.upper]))
    solution = settled(problem, TRANSITION_SHARE * prepared.tolerance)
    if solution is None:
        report.time = np.inf
        return values, element, 0.0 * values[0]
    report.time += solution.error + problem.parts.error
    element, values = solution.element, solution.values * solution.element.weights
    report.aliasing = max(report.aliasing, element.unresolved(values))
    report.edge = max(report.edge, *reached(values, element, domain_of(prepared)))
    report.negative = max(report.negative, float(-np.minimum(values.real, 0.0).sum() / np.abs(values.real).sum()))
    values, element = trimmed(values, element)
    mass = np.sum(values)
    return values / mass, element, solution.log_scale + np.log(mass)


def trimmed(values: Array, element: Element) -> tuple[Array, Element]:
    """Return a density without the outermost panels in which it is negligible."""
    largest = np.abs((values / element.weights).real).reshape(-1, element.size).max(axis=1)
    here = np.flatnonzero(largest > np.exp(-DEPTH) * largest.max())
    first, last = int(here[0]), int(here[-1]) + 1
    ends = [element.lower, *element.cuts, element.upper][first : last + 1]
    return values[first * element.size : last * element.size], Element(ends[0], ends[-1], element.size, tuple(ends[1:-1]))
