"""Elements for a density between ends and kinks, and the operator on them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from zakai.errors import InputError
from zakai.methods.line.coefficients import offset_of, potential_of, precision_of
from zakai.methods.line.course import kinks_between
from zakai.methods.line.system import Prepared
from zakai.methods.line.tables import covariance_at, tables
from zakai.models.domain import Interval
from zakai.numerics.line.operator import Spectral
from zakai.numerics.line.panels import GAUSS_NODES, GAUSS_WEIGHTS
from zakai.numerics.lobatto import Element

Array = Any

SIZES = (24, 32, 48, 64, 96, 128, 192, 256)
SIZES_OF_PRIORS = (*SIZES, 512, 1024)  # of which no operator is decomposed
CUT = 36.0  # nats below the maximum where a density ends
FLOOR = 1e-11  # Legendre coefficient, relative to the largest, that rounding leaves
SAMPLES = 1001  # points at which the place of a density is sought
MARGIN = 0.02  # of the length of an element, within which of its end a kink does not count
BESIDE = 1e-6  # the same for an end of the domain


def domain_of(prepared: Prepared) -> Interval:
    return prepared.model.domain.get(prepared.model.state[0], Interval())


def element_of(prepared: Prepared, lower: float, upper: float, size: int) -> Element:
    """Return an element with cuts where coefficients have kinks or jumps, except near ends where the density is negligible."""
    if prepared.system.kinks is None:
        return Element(lower, upper, size)
    unit, width, domain = 2.0 ** np.ceil(np.log2(upper - lower)), upper - lower, domain_of(prepared)
    low, high = float(unit * np.floor(lower / unit)), float(unit * np.ceil(upper / unit))
    known = prepared.once(("kinks", low, high), lambda: kinks_between(prepared, low, high, prepared.model.start).tolist())
    first = lower + width * (BESIDE if lower <= domain.lower else MARGIN)
    last = upper - width * (BESIDE if upper >= domain.upper else MARGIN)
    return Element(lower, upper, size, tuple(kink for kink in known if first < kink < last))


def negligible_of(prepared: Prepared, error: float = 0.0) -> float:
    """Return the Legendre coefficient, relative to the largest, that need not be resolved of a density with an error."""
    return max(FLOOR, 1e-5 * prepared.tolerance, 1e-2 * min(error, prepared.tolerance))


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
    sizes: tuple[int, ...] = SIZES,
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
    found: tuple[Operator | None] = prepared.once(
        ("modes", element), lambda: (operator_at(prepared, element, prepared.model.start),)
    )
    return found[0]


def operator_at(prepared: Prepared, element: Element, t: float) -> Operator | None:
    """Return the operator on an element at a time and its decomposition; None where there is none."""
    system, theta, x = prepared.system, prepared.theta, element.points
    G = covariance_at(system, x, np.asarray(t), theta) * np.ones(len(x))
    if not (G.real > 0).all():
        return None
    drift, steps = system.drift(x[:, None], t, theta)[:, 0], np.diff(x)
    nodes = (x[:-1, None] + steps[:, None] * GAUSS_NODES).reshape(-1)
    slopes = system.drift(nodes[:, None], t, theta)[:, 0] / covariance_at(system, nodes, np.asarray(t), theta)
    gauge = np.concatenate([np.zeros(1), np.cumsum(steps * (slopes.reshape(len(steps), -1) @ GAUSS_WEIGHTS))])
    logs = gauge - 0.5 * np.log(G)
    if not np.isfinite(logs.real).all() or not np.isfinite(drift.real).all():
        return None
    joined = element.joined(logs.real)
    operator = element.symmetric(G, (drift - 0.5 * element.derivative(G)) / G, joined)
    return Operator.of(operator, gauge, np.sqrt(element.weights / G), logs, joined)


def weighted(
    prepared: Prepared, known: Operator, element: Element, start: float, length: float, inside: Array, rates: Array, values: Array
) -> tuple[Spectral, Array, Any]:
    """Return the modes with the potential of increments less a number, its integral over time, and that of the number."""
    h, precision = tables(prepared, element).observation, precision_of(prepared, start, inside)  # type: ignore[arg-type]
    potential, constant = potential_of(h, precision, rates, values)
    offset, _ = offset_of(length * potential, values)
    return known.weighted(potential - offset / length), length * (potential + constant), offset + length * constant


def logarithm(values: Array) -> Array:
    return np.log(np.maximum(values, 1e-300))


def moments(values: Array, element: Element) -> tuple[Any, Any]:
    x = element.points - element.lower
    mean = x @ values
    return element.lower + mean, ((x - mean) ** 2) @ values
