"""One state with reflecting ends, kinks or jumps: the equation of `line/filter.py` on Gauss-Lobatto points between these.

    u_t = G u'' / 2 - (f u)' + (h'S^-1 dy/dt - h'S^-1 h / 2) u,      (G u)' / 2 - f u = 0 where the state is reflected

The points cover the part of the domain in which the density is; at an end that is not one of the domain nothing is there.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from zakai.densities import IntervalDensity
from zakai.errors import InputError
from zakai.methods._protocol import Info
from zakai.methods.line.domain import check_escape
from zakai.methods.line.prepared import Prepared
from zakai.methods.line.report import Report
from zakai.methods.line.update import error_remainder, factor_at_end, outside_tables, spread
from zakai.methods.reflecting.elements import (
    SAMPLES,
    coarse,
    domain_of,
    logarithm,
    moments,
    negligible_of,
    placed,
    propagated,
    sampled,
    support,
    with_margin,
    without_nan,
)
from zakai.models.numeric import numpy_function
from zakai.models.prior import DensityPrior, Prior
from zakai.numerics.arrays import Array, Number
from zakai.numerics.line.grid_choice import DEPTH
from zakai.numerics.line.product import General, Likelihood, normalized, place
from zakai.numerics.lobatto import Element
from zakai.numerics.prior_grid import mixture_log_density, prior_grid

NOISE = 4e-14  # error of a prediction relative to its maximum: that of the rational exponential
DEPTH_OF_PRODUCT = 70.0  # logarithm of the density below its maximum, from which a product does not come


class State(NamedTuple):
    """The probabilities (N,) of the Gauss-Lobatto points between `lower`, `cuts` (C,) and `upper`; an estimate of their error."""

    values: np.ndarray
    lower: float
    upper: float
    error: float
    cuts: np.ndarray

    @classmethod
    def of(cls, values: Array, element: Element, error: float) -> State:
        """Return the state with probabilities at the points of an element."""
        return cls(values, element.lower, element.upper, error, np.array(element.cuts, float))

    @property
    def element(self) -> Element:
        """The points."""
        size = len(self.values) // (len(self.cuts) + 1)
        return Element(float(self.lower), float(self.upper), size, tuple(np.asarray(self.cuts).tolist()))


def init(prepared: Prepared, prior: Prior) -> State:
    """Return the prior, which counts inside of the domain."""
    model, domain = prepared.model, domain_of(prepared)
    if isinstance(prior, DensityPrior):
        function = numpy_function([prior.log_density], model, ())

        def logs(x: Array) -> Array:
            return function(x[:, None], model.start, prepared.theta)

        lower, upper = _ends_of(prepared, lambda x: logs(x).real)
    else:
        weights, means, covs = prior.components
        if np.any(covs[:, 0, 0] <= 1e-28 * means[:, 0] ** 2):
            raise InputError("prior: a variance is zero; a grid needs a density, so give it a small variance")
        mixture = mixture_log_density(weights, means, covs, [False])
        reach = np.sqrt(2.0 * DEPTH * covs[:, 0, 0])
        lower, upper = np.clip([np.min(means[:, 0] - reach), np.max(means[:, 0] + reach)], domain.lower, domain.upper).tolist()

        def logs(x: Array) -> Array:
            return mixture(np.zeros(1), x[:, None])

    lower, upper = placed(lambda x: logs(x).real, lower, upper, domain)
    top, negligible = _top(logs, lower, upper), negligible_of(prepared)


    def probabilities(element: Element) -> Array:
        return np.exp(without_nan(logs(element.points)) - top) * element.weights

    element, values = sampled(prepared, probabilities, lower, upper, negligible)
    return State.of(values / np.sum(values), element, max(element.unresolved(values) - negligible, 0.0))


def _ends_of(prepared: Prepared, logs: Callable[[Array], Array]) -> tuple[float, float]:
    """Return ends between which a density of unknown scale lies, from its logarithm."""
    domain = domain_of(prepared)
    lower, upper = domain.lower, domain.upper
    if np.isfinite(upper - lower):
        return lower, upper
    if np.isinf(lower) and np.isinf(upper):
        grid = prior_grid(lambda points: logs(points[:, 0]), 1, [False])
        return float(grid.points[0, 0]), float(grid.points[-1, 0])
    end = lower if np.isfinite(lower) else upper  # powers of two
    points = np.unique(end + np.concatenate([[0.0], 2.0 ** np.arange(-60.0, 61.0, 0.5)]) * (1.0 if end == lower else -1.0))
    return support(points, logs(points))


def _top(logs: Callable[[Array], Array], lower: float, upper: float) -> float:
    return float(np.max(without_nan(logs(np.linspace(lower, upper, SAMPLES))).real))


def _multiplied(
    prepared: Prepared, values: Array, element: Element, likelihood: Likelihood, report: Report, negligible: float
) -> tuple[Array, Element, Number]:
    """Return the product with a likelihood, its points, and the logarithm of its mass."""
    # The maximum of a Gaussian with this integral of its square: at an end a density may have none.
    domain, largest = domain_of(prepared), 2.0**0.5 * float(np.sum(values.real**2 / element.weights))

    def product(points: Element) -> tuple[Array, Number, float, float]:
        density = values / element.weights if points == element else element.at(values, points.points)
        return normalized(density, without_nan(likelihood.logs(points.points)), points.weights, largest)

    new, (result, gained, depth, growth) = element, product(element)
    if coarse(result, new, negligible).any() or _narrow(result, new):
        logs = logarithm((values / element.weights).real)
        ends = place(element.offsets, np.maximum(logs, np.max(logs) - DEPTH_OF_PRODUCT), likelihood, element.lower)
        if ends is not None:
            low, high = with_margin(element.lower + ends[0], element.lower + ends[1], domain)
            low, high = max(low, element.lower), min(high, element.upper)
            new, _ = sampled(prepared, lambda points: product(points)[0], low, high, negligible)
            result, gained, depth, growth = product(new)
    report.aliasing, report.depth = max(report.aliasing, new.unresolved(result)), depth
    report.growth = max(report.growth, 1.0) * growth
    return result, new, gained


def _narrow(values: Array, element: Element) -> bool:
    """Return whether a density fills less than a quarter of an element."""
    density = logarithm((values / element.weights).real)
    here = element.points[density > np.max(density) - DEPTH]
    return bool(here[-1] - here[0] < 0.25 * (element.upper - element.lower))


def step(prepared: Prepared, k: int, state: State, observed: np.ndarray) -> tuple[State, Info]:
    """Return the state after interval k and the observation at its stop, and the report."""
    with np.errstate(all="ignore"):
        return _step(prepared, k, state, observed)


def _step(prepared: Prepared, k: int, state: State, observed: np.ndarray) -> tuple[State, Info]:
    schedule, length, inside = prepared.schedule, float(prepared.lengths[k]), prepared.inside[k]
    values, report, element = np.asarray(state.values), Report(), state.element
    gained: Number = 0.0
    check_escape(prepared, k, element.points, values)
    before, negligible = moments(values, element), negligible_of(prepared, float(state.error))
    if length > 0:
        interval = prepared.interval(k, inside, observed)
        values, element, gained = propagated(prepared, values, element, interval, report, negligible)
    # What panels leave unresolved stays where it is, and counts again in the product.
    predicted, floor = moments(values, element), NOISE + report.edge
    at_end = schedule.seen[k] & ~inside
    if at_end.any():
        likelihood = factor_at_end(prepared, k, at_end, observed, element)
        if isinstance(likelihood, General):
            report.lawless = float(np.sum(values.real[np.isnan(likelihood.log_density(element.points).real)]))
        values, element, more = _multiplied(prepared, values, element, likelihood, report, negligible)
        gained = gained + more
    mean, variance = moments(values, element)
    retained = error_remainder(before[1], predicted[1], variance, spread(prepared, k, length, float(mean.real)))
    spacings = float(np.sqrt(max(variance.real, 0.0))) / element.spacing
    error, health = report.figures(prepared, floor, state.error * retained, spacings)
    if prepared.system.tabulated:
        health["outside_tables"] = outside_tables(prepared, values, element, float(schedule.stops[k]))
    return State.of(values, element, error), Info(gained, np.array([mean]), np.array([[variance]]), health)


def valid(prepared: Prepared, state: State) -> bool:
    """Return whether the parts of a state fit together."""
    values, cuts, domain = np.asarray(state.values), np.asarray(state.cuts), domain_of(prepared)
    if values.ndim != 1 or cuts.ndim != 1 or len(values) < 8 * (len(cuts) + 1) or len(values) % (len(cuts) + 1):
        return False
    ends = np.array([state.lower, *cuts, state.upper], float)
    if not (np.isfinite(values).all() and np.isfinite(ends).all() and np.isfinite(state.error) and (np.diff(ends) > 0).all()):
        return False
    return bool(domain.lower <= state.lower and state.upper <= domain.upper and values.real.sum() > 0)


def density(prepared: Prepared, state: State) -> IntervalDensity:
    """Return the density of a state."""
    element = state.element
    values = np.asarray(state.values).real / element.weights
    return IntervalDensity(values, element.points, element.weights, prepared.model.state)
