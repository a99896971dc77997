"""A density between ends and kinks on Gauss-Lobatto points: the elements, the operator on them, and its transition.

The modes of the symmetric operator serve every interval in which no coefficient depends on t and no increment acts:

    exp(tau L) = s U exp(-tau lambda) U' / s,      s'/s = (f - G'/2) / G.

A density on other points is projected onto the modes by the quadrature of its own points.  Finite volumes without flux at the
ends (`line/volumes.py`) take the other intervals.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from zakai.errors import InputError
from zakai.methods.line.cache import Derived
from zakai.methods.line.coefficients import covariance_at, offset_of, potential_of, precision_of, tables
from zakai.methods.line.prepared import Prepared, TimeInterval
from zakai.methods.line.report import Report
from zakai.methods.line.volumes import advanced_by, cell_plan_of, kinks_between
from zakai.models.domain import Interval
from zakai.numerics.arrays import Array, Number
from zakai.numerics.line.averages import GAUSS_NODES, GAUSS_WEIGHTS
from zakai.numerics.line.grid_choice import DEPTH, WIDENING
from zakai.numerics.line.operator import Spectral
from zakai.numerics.line.resolution import RESOLVED, TRANSITION_SHARE, rounding_bound
from zakai.numerics.line.window import CUT, LARGE
from zakai.numerics.lobatto import Element

ELEMENT_SIZES = (24, 32, 48, 64, 96, 128, 192, 256)
SIZES_OF_PRIORS = (*ELEMENT_SIZES, 512, 1024)  # of which no operator is decomposed
SAMPLES = 1001  # points at which the place of a density is sought
FEW_KINKS = 2, 5  # from which half and a third of the points serve
MOST_OF_PART = 64  # points on one part of an interval: the rounding of longer ones exceeds the tolerance
BESIDE = 1e-6  # of the length of an element, within which of its end a kink does not count


def domain_of(prepared: Prepared) -> Interval:
    return prepared.model.domain.get(prepared.model.state[0], Interval())


def element_of(prepared: Prepared, lower: float, upper: float, size: int) -> Element:
    """Return an element with cuts where coefficients have kinks or jumps, except near ends where the density is negligible.

    Between two of these are `size` points, fewer where kinks are many, and on equal parts where points are many.
    """
    if prepared.system.kinks is None:
        return _divided([lower, upper], size)
    unit, beside = 2.0 ** np.ceil(np.log2(upper - lower)), BESIDE * (upper - lower)
    low, high = float(unit * np.floor(lower / unit)), float(unit * np.ceil(upper / unit))
    known = prepared.once(Derived.KINKS, (low, high), lambda: kinks_between(prepared, low, high, prepared.model.start).tolist())
    kinks = [kink for kink in known if lower + beside < kink < upper - beside]
    return _divided([lower, *kinks, upper], size // (1 + (len(kinks) >= FEW_KINKS[0]) + (len(kinks) >= FEW_KINKS[1])))


def _divided(bounds: list[float], size: int) -> Element:
    """Return an element with `size` points in each interval, on equal parts of it where they are many."""
    parts = 2 ** max(int(np.ceil(np.log2(size / MOST_OF_PART))), 0)
    low, high = np.array(bounds[:-1]), np.array(bounds[1:])
    ends = low[:, None] + (high - low)[:, None] * np.arange(parts) / parts
    return Element(bounds[0], bounds[-1], size // parts, tuple(ends.reshape(-1)[1:].tolist()))


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
    prepared: Prepared,
    density: Callable[[Array], Array],
    lower: float,
    upper: float,
    negligible: float,
    sizes: tuple[int, ...] = ELEMENT_SIZES,
) -> tuple[Element, Array]:
    """Return the fewest points that resolve a density, and its probabilities there."""
    for size in sizes:
        element = element_of(prepared, lower, upper, size)
        values = density(element.points) * element.weights
        if element.unresolved(values) < negligible:
            break
    return element, values


def reached(values: Array, element: Element, domain: Interval) -> tuple[float, float]:
    """Return the density at the two ends that are not those of the domain, relative to the maximum."""
    density = np.abs((values / element.weights).real)
    left, right = density[[0, -1]] / density.max()
    return (0.0 if element.lower <= domain.lower else left), (0.0 if element.upper >= domain.upper else right)


def apart(lower: float, upper: float, domain: Interval) -> tuple[float, float]:
    """Return ends out of few that hold two others, so that decompositions serve many times."""
    unit = 2.0 ** np.floor(np.log2((upper - lower) / 4.0))
    low, high = unit * np.floor(lower / unit), unit * np.ceil(upper / unit)
    return max(float(low), domain.lower), min(float(high), domain.upper)


class Operator(NamedTuple):
    """-L as a symmetric operator (N - C, N - C), what it acts on, and its modes.

    `gauge` is int f / G, `scale` s W^(1/2) over the exponential of that, `logs` log s (N,); `joined` is that of the element.
    """

    operator: Array
    gauge: Array
    scale: Array
    logs: Array
    joined: Array
    modes: Spectral

    @classmethod
    def of(cls, operator: Array, gauge: Array, scale: Array, logs: Array, joined: Array) -> Operator:
        """Return the operator with its modes at the points."""
        modes = Spectral(operator, gauge, scale)
        modes.modes = joined @ modes.modes
        return cls(operator, gauge, scale, logs, joined, modes)

    def weighted(self, potential: Array) -> Spectral:
        """Return the decomposition of the operator with a potential (N,)."""
        operator = self.operator - (self.joined.T * potential) @ self.joined
        return self.of(operator, self.gauge, self.scale, self.logs, self.joined).modes


def decomposed(prepared: Prepared, element: Element) -> Operator | None:
    """Return the operator on an element where no coefficient depends on t, None where it has no decomposition."""
    result: tuple[Operator | None] = prepared.once(
        Derived.LOBATTO_MODES, element, lambda: (operator_at(prepared, element, prepared.model.start),)
    )
    return result[0]


def operator_at(prepared: Prepared, element: Element, t: float) -> Operator | None:
    """Return the operator on an element at a time and its decomposition; None where there is none."""
    system, theta, x = prepared.system, prepared.theta, element.points
    G = covariance_at(system, x, t, theta) * np.ones(len(x))
    if not (G.real > 0).all():
        return None
    drift, steps = system.drift(x[:, None], t, theta)[:, 0], np.diff(x)
    nodes = (x[:-1, None] + steps[:, None] * GAUSS_NODES).reshape(-1)
    slopes = system.drift(nodes[:, None], t, theta)[:, 0] / covariance_at(system, nodes, t, theta)
    gauge = np.concatenate([np.zeros(1), np.cumsum(steps * (slopes.reshape(len(steps), -1) @ GAUSS_WEIGHTS))])
    logs = gauge - 0.5 * np.log(G)
    if not np.isfinite(logs.real).all() or not np.isfinite(drift.real).all():
        return None
    joined = element.joined(logs.real)
    operator = element.symmetric(G, (drift - 0.5 * element.derivative(G)) / G, joined)
    return Operator.of(operator, gauge, np.sqrt(element.weights / G), logs, joined)


def weighted(
    prepared: Prepared, known: Operator, element: Element, interval: TimeInterval, values: Array
) -> tuple[Spectral, Array, Number]:
    """Return the modes with the potential of increments less a number, its integral over time, and that of the number."""
    _, start, length, inside, rates = interval
    h, precision = tables(prepared, element).observation, precision_of(prepared, start, inside)
    potential, constant = potential_of(h, precision, rates, values)
    offset, _ = offset_of(length * potential, values)
    return known.weighted(potential - offset / length), length * (potential + constant), offset + length * constant


def logarithm(values: Array) -> Array:
    return np.log(np.maximum(values, 1e-300))


def moments(values: Array, element: Element) -> tuple[Number, Number]:
    x = element.points - element.lower
    mean = np.dot(x, values)
    return element.lower + mean, np.dot((x - mean) ** 2, values)


TRIALS = 24  # elements that are tried
MOST_PARTS = 64  # of an interval that the volumes do not take as a whole
PEAK = 1.5  # points in a standard deviation of the noise with which the first element begins


def propagated(
    prepared: Prepared, values: Array, element: Element, interval: TimeInterval, report: Report, negligible: float
) -> tuple[Array, Element, Number]:
    """Return the density after an interval, its points, and the logarithm of its mass."""
    arguments = prepared, values, element, interval, report, negligible
    result = None if prepared.system.varying else _by_modes(*arguments)
    values, element, gained = _by_volumes(*arguments) if result is None else result
    report.aliasing = max(report.aliasing, element.unresolved(values))
    report.edge = max(report.edge, *reached(values, element, domain_of(prepared)))
    real = values.real
    report.negative = max(report.negative, float(-np.minimum(real, 0.0).sum() / np.abs(real).sum()))
    mass = np.sum(values)
    return values / mass, element, gained + np.log(mass)


def _by_modes(
    prepared: Prepared, values: Array, element: Element, interval: TimeInterval, report: Report, negligible: float
) -> tuple[Array, Element, Number] | None:
    """Return the density after an interval, its points, and the logarithm of its mass; None where modes do not serve."""
    domain, allowed = domain_of(prepared), rounding_bound(prepared.tolerance)
    _, start, length, inside, _ = interval
    G = covariance_at(prepared.system, element.points, start, prepared.theta).real
    noise = np.sqrt(np.maximum([np.min(G), np.max(G)], 0.0) * length)
    counts = np.flatnonzero((values / element.weights).real > CUT * np.max((values / element.weights).real))
    low, high = element.points[[max(counts[0] - 1, 0), min(counts[-1] + 1, len(values) - 1)]]
    lower, upper = apart(float(low - WIDENING * noise[1]), float(high + WIDENING * noise[1]), domain)
    longest = float(np.max(element_of(prepared, lower, upper, ELEMENT_SIZES[0]).halves))
    needed = min(2.0 * PEAK * longest / max(noise[0], 1e-300), element.size * longest / float(np.max(element.halves)))
    size = next((size for size in ELEMENT_SIZES if size >= min(needed, ELEMENT_SIZES[4])), ELEMENT_SIZES[-1])
    for _ in range(TRIALS):
        new = element_of(prepared, lower, upper, size)
        offset: Number = 0.0
        known = decomposed(prepared, new)
        if known is None:
            return None
        modes, inner = known.modes, _projected(values, element, new, known, negligible)
        if inside.any():
            modes, weight, offset = weighted(prepared, known, new, interval, modes.scale * inner)
        result, error = modes.carried(inner, length)
        if not np.isfinite(result.real).all():
            return None
        unresolved, growth = new.unresolved(result), 0.0
        if inside.any():  # increments mix all waves of the density before, and may raise errors in its tails
            before = modes.scale * inner
            unresolved = max(unresolved, new.unresolved(before))
            raised = new.weights * np.exp((weight - offset).real) * float(np.max((before / new.weights).real))
            growth = float(np.sum(raised) / np.sum(result.real))
        coarse = unresolved > negligible
        # Oscillations of what is not resolved reach the ends as well.
        left, right = (float(end) > (unresolved if coarse else RESOLVED) for end in reached(result, new, domain))
        if coarse and size < ELEMENT_SIZES[-1] and len(result) <= LARGE:  # else volumes are faster
            size = ELEMENT_SIZES[ELEMENT_SIZES.index(size) + 1]
        elif coarse:  # even more points take longer than volumes
            return None
        elif left or right:
            width = upper - lower
            lower, upper = apart(lower - 0.4 * width * left, upper + 0.4 * width * right, domain)
        elif error < allowed and (inside.any() or abs(np.sum(result.real) - 1.0) < 1e-3):
            report.time, report.growth = report.time + error, growth
            report.aliasing = max(report.aliasing, unresolved)
            return result, new, offset
        else:
            return None
    return None


def _projected(values: Array, element: Element, new: Element, known: Operator, negligible: float) -> Array:
    """Return a density on some points, divided by s, on those of an operator.

    Where the new points do not resolve it, it is its projection, by the quadrature of its own points.
    """
    if element == new:
        return np.asarray(values / known.modes.scale)
    result = element.at(values, new.points) * new.weights
    if new.unresolved(result) < negligible:
        return np.asarray(result / known.modes.scale)
    between = new.interpolation(element.points)
    s = np.exp(between @ known.logs - known.modes.top)
    return np.asarray((between.T @ (values / s)) / np.sqrt(new.weights))


def _by_volumes(
    prepared: Prepared, values: Array, element: Element, interval: TimeInterval, report: Report, negligible: float
) -> tuple[Array, Element, Number]:
    """Return the density after an interval, its points, and the logarithm of its mass, in parts where volumes do not settle."""
    stack, gained, count = [(0.0, interval.length)], 0.0 * values[0], 0
    while stack:
        first, last = stack.pop()
        count += 1
        result = _part(prepared, values, element, interval.part(first, last), report, negligible)
        if result is not None:
            values, element, more = result
            gained = gained + more
        elif count + len(stack) < MOST_PARTS:
            middle = first + 0.25 * (last - first)
            stack += [(middle, last), (first, middle)]
        else:
            report.time = np.inf
            break
    return values, element, gained


def _part(
    prepared: Prepared, values: Array, element: Element, interval: TimeInterval, report: Report, negligible: float
) -> tuple[Array, Element, Number] | None:
    """Return the density after a part of an interval from finite volumes, None where these do not settle."""
    domain, at = domain_of(prepared), element

    def before(offsets: Array) -> Array:
        return at.at(values, at.lower + offsets)

    ends = np.array([0.0, at.upper - at.lower])
    plan = cell_plan_of(prepared, values, at, ends, interval)
    if plan is None:
        return None
    result = advanced_by(prepared, before, plan, interval, TRANSITION_SHARE * prepared.tolerance)
    if result is None:
        return None
    report.time += result.error + plan.unresolved
    cells = result.cells
    density = np.log(np.maximum((result.values / cells.widths).real, 1e-300))
    here = np.flatnonzero(density > np.max(density) - DEPTH)
    faces, tiny = cells.origin + cells.faces, 1e-9 * (cells.faces[-1] - cells.faces[0])
    if faces[0] - domain.lower < tiny:
        faces[0] = domain.lower
    if domain.upper - faces[-1] < tiny:
        faces[-1] = domain.upper
    lower, upper = with_margin(float(faces[here[0]]), float(faces[here[-1] + 1]), domain)
    lower, upper = max(lower, float(faces[0])), min(upper, float(faces[-1]))
    interpolated = cells.density(result.values)

    def after(x: Array) -> Array:
        return interpolated(np.clip(x - cells.origin, *cells.faces[[0, -1]]))

    element, values = sampled(prepared, after, lower, upper, max(negligible, 1e-2 * result.error))
    return values / np.sum(values), element, result.log_scale
