"""The backward pass for one state between ends and kinks: the message on a uniform grid, the smoothed density on elements.

The modes of the operator take a message back over an interval, and finite volumes where these do not serve.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from zakai.densities import IntervalDensity
from zakai.methods._protocol import Backward, Info
from zakai.methods.line.backward import accuracy
from zakai.methods.line.course import course_of
from zakai.methods.line.message import SURE, Message, points_of
from zakai.methods.line.system import NOISE, Prepared
from zakai.methods.line.tables import covariance_at
from zakai.methods.line.update import factor_at_end
from zakai.methods.line.volumes import pulled_back
from zakai.methods.line.way import negligible, smoothing_tolerance
from zakai.methods.reflecting import filter as reflecting_filter
from zakai.methods.reflecting.elements import (
    SIZES,
    apart,
    decomposed,
    domain_of,
    element_of,
    logarithm,
    moments,
    negligible_of,
    placed,
    reached,
    sampled,
    weighted,
)
from zakai.methods.reflecting.filter import State
from zakai.methods.reflecting.paths import draw
from zakai.numerics.line import window as lw
from zakai.numerics.line.density import support
from zakai.numerics.lobatto import Element

Array = Any

POINTS = 256  # of a message, on the whole element of the density
MODES_REACH = 4.0  # standard deviations of the noise around the supports of density and message
QUADRATURE = 192  # points at which a message is projected onto the modes
SHARE = 1e-2  # of the tolerance that modes may leave
ROUNDING = 1e-15  # of the maximum: smaller values of a message are not kept


def _window(prepared: Prepared, lower: float, upper: float) -> lw.Window:
    """Return the grid of a message between two points, whose origin is an end of the domain."""
    domain, spacing = domain_of(prepared), (upper - lower) / POINTS
    origin = next((end for end in (domain.lower, domain.upper) if np.isfinite(end)), 0.0)
    return points_of(lw.Window(origin, 0.0, spacing, 0, False, spacing), lower - origin, upper - origin, spacing)


def message(prepared: Prepared, state: State) -> Message:
    """Return the message one at the last time."""
    window = _window(prepared, float(state.lower), float(state.upper))
    return Message.of(np.zeros(window.size), window, window.spacing, 0.0)


class _Product(NamedTuple):
    """The product of a state and a message, of sum one, its points, and the logarithm of the sum before."""

    values: Array
    element: Element
    log_mass: float


def _product(prepared: Prepared, state: State, later: Message) -> _Product:
    element, values = state.element, np.asarray(state.values).real
    floor = SURE * (NOISE + element.unresolved(values)) * np.max(values / element.weights)

    def logs(x: Array) -> Array:
        density = element.at(values, x)
        return np.where(density > floor, logarithm(density), -np.inf) + later.at(x - later.origin)

    lower, upper = placed(logs, element.lower, element.upper, domain_of(prepared))
    lower, upper = max(lower, element.lower), min(upper, element.upper)
    top = float(np.max(logs(np.linspace(lower, upper, 4 * element.size))))
    allowed = negligible_of(prepared, float(state.error) + later.error)
    new, found = sampled(prepared, lambda x: np.exp(logs(x) - top), lower, upper, allowed)
    total = float(np.sum(found))
    return _Product(found / total, new, float(np.log(total)) + top)


@np.errstate(all="ignore")
def smoothed(prepared: Prepared, state: State, later: Message) -> tuple[Message, Info]:
    """Return the message, normalised and without what is negligible in its product with the state, and the product's report."""
    values, element, log_mass = _product(prepared, state, later)
    mean, variance = moments(values, element)
    health = {
        "error_estimate": float(state.error) + later.error,
        "tolerance_ratio": (later.error + 2.0 * element.unresolved(values)) / accuracy(prepared),
        "edge_mass": max(reached(values, element, domain_of(prepared))),
        "negative_mass": float(-np.minimum(values, 0.0).sum()),
        "aliasing": element.unresolved(values),
        "std_in_spacings": float(np.sqrt(max(variance, 0.0))) / element.spacing,
    }
    density = values / element.weights
    first, last = element.points[list(support(density, negligible(prepared)))] - later.origin
    kept = later._replace(logs=later.logs - log_mass).between(float(first), float(last))
    return kept, Info(log_mass, np.array([mean]), np.array([[variance]]), health)


@np.errstate(all="ignore")
def step(prepared: Prepared, k: int, later: Message, observed: np.ndarray, state: State) -> Message:
    """Return the message at the start of interval k from that at its end; `state` is the filter's at the start."""
    start, length, inside = float(prepared.schedule.starts[k]), float(prepared.lengths[k]), prepared.inside[k]
    later, before = later.on(_window(prepared, *(later.origin + end for end in later.ends))), later.variance
    at_end = prepared.schedule.seen[k] & ~inside
    if at_end.any():
        likelihood = factor_at_end(prepared, k, at_end, observed, None)
        later = later._replace(logs=later.logs + likelihood.logs(later.window.points).real)
    if length == 0:
        return later
    rates = np.where(inside, observed, 0.0) / length
    found = None if prepared.system.varying else _by_modes(prepared, later, start, length, inside, rates, state)
    found = _by_volumes(prepared, later, start, length, inside, rates, state) if found is None else found
    kept = float(np.clip(later.variance / np.sqrt(max(before * found.variance, 1e-300)), 0.3, 1.0))
    return found._replace(error=found.error + kept * later.error)


def _by_modes(
    prepared: Prepared, later: Message, start: float, length: float, inside: Array, rates: Array, state: State
) -> Message | None:
    """Return the message at the start of an interval by the modes of the operator, None where they do not serve.

        b(start) = U exp(-tau lambda) U' s b(stop) / s

    s b is projected onto the modes by the quadrature of its own points.  The error of rounding, and of what is not resolved after
    the interval, counts where the density is.
    """
    own, values = state.element, np.asarray(state.values).real
    G = covariance_at(prepared.system, own.points, np.asarray(start), prepared.theta.real)
    reach = MODES_REACH * float(np.sqrt(np.max(G) * length))
    domain = domain_of(prepared)
    low, high = np.clip([later.origin + end for end in later.ends], domain.lower, domain.upper).tolist()
    lower, upper = apart(min(own.lower, low) - reach, max(own.upper, high) + reach, domain)
    after = element_of(prepared, low, high, QUADRATURE)
    logs = later.at(after.points - later.origin)
    top, constant = float(np.max(logs)), 0.0
    weights = after.weights * np.exp(logs - top)
    for size in SIZES[1:]:
        element = element_of(prepared, lower, upper, size)
        known = decomposed(prepared, element)
        if known is None:
            return None
        density, modes, root = own.at(values, element.points) * element.weights, known.modes, np.sqrt(element.weights)
        if inside.any():
            modes, _, constant = weighted(prepared, known, element, start, length, inside, rates, density)
        between = element.interpolation(after.points)
        psi = (between.T @ (weights * np.exp(between @ known.logs - modes.top))) / root
        moved = modes.decayed(psi, length)
        at, log_s, scaled = element.interpolation(own.points), modes.top - known.logs, moved / root
        own_weights = np.abs(values) * np.exp(at @ log_s)
        wrong = max(4e-16 * float(np.exp(-length * modes.rates[0])), element.unresolved(moved * root))
        wrong = wrong * max(float(np.sqrt(psi @ psi)), float(np.max(np.abs(scaled))))
        error = wrong * float(np.sum(own_weights)) / float(own_weights @ (at @ scaled))
        if 0.0 <= error < SHARE * smoothing_tolerance(prepared):
            break
    else:
        return None

    def worth(x: Array) -> Array:
        at = element.interpolation(x)
        return (at @ scaled) * np.exp(at @ log_s)

    return _on(prepared, state, worth, top + constant, error)


def _by_volumes(
    prepared: Prepared, later: Message, start: float, length: float, inside: Array, rates: Array, state: State
) -> Message:
    """Return the message at the start of an interval by finite volumes."""
    element, values = state.element, np.asarray(state.values).real
    ends, (mean, variance) = np.array([0.0, element.upper - element.lower]), later.moments
    shift = element.lower - later.origin
    aim = mean - shift, variance**0.5
    course = course_of(prepared, values, element, ends, start, length, inside, aim)  # type: ignore[arg-type]  # by its points
    found = pulled_back(
        prepared, lambda x: later.at(x + shift), lambda x: element.at(values, element.lower + x), course, start, inside, rates
    )
    if found is None:
        return message(prepared, state)._replace(error=np.inf)
    worth = found
    return _on(prepared, state, lambda x: worth.at(x - element.lower), worth.log_scale, worth.error)


def _on(prepared: Prepared, state: State, worth: Callable[[Array], Array], log_scale: float, error: float) -> Message:
    """Return a message by its values, of some scale, where the density is."""
    window = _window(prepared, float(state.lower), float(state.upper))
    values = worth(np.clip(window.points, state.lower, state.upper))
    logs = np.log(np.maximum(values, ROUNDING * np.max(values))) + log_scale
    return Message.of(logs, window, window.spacing, error)


@np.errstate(all="ignore")
def density(prepared: Prepared, state: State, later: Message) -> IntervalDensity:
    """Return the smoothed density."""
    values, element, _ = _product(prepared, state, later)
    return reflecting_filter.density(prepared, State.of(values, element, float(state.error)))


BACKWARD: Backward[Prepared, State, Message] = Backward(message, step, smoothed, density, None, draw, accuracy)
