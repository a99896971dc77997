"""The backward pass for one state between ends and kinks, and draws of the state at the start of an interval.

The message is on a uniform grid, the smoothed density on elements.  The modes of the operator take a message back over an
interval, and finite volumes where these do not serve.  Draws follow the law

    x ~ p(x) T(x, z),      T(x, z) = s(z) / s(x) sum_j psi_j(x) psi_j(z) exp(-tau lambda_j).

The transition T is that of the modes at Gauss-Lobatto points, in parts of the domain that resolve it.  Where coefficients
depend on t, it is a product of transitions with those at the middles of substeps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from zakai.densities import IntervalDensity
from zakai.methods._protocol import Backward, Info
from zakai.methods.line.backward import accuracy
from zakai.methods.line.backward_interval import negligible, smoothing_tolerance
from zakai.methods.line.coefficients import coefficients, covariance_at, resolved_parts
from zakai.methods.line.message import SURE_OF_DENSITY, Message, points_of
from zakai.methods.line.prepared import Prepared, TimeInterval
from zakai.methods.line.update import factor_at_end
from zakai.methods.line.volumes import cell_plan_of, pulled_back
from zakai.methods.reflecting import filter as reflecting_filter
from zakai.methods.reflecting.elements import (
    ELEMENT_SIZES,
    apart,
    decomposed,
    domain_of,
    element_of,
    logarithm,
    moments,
    negligible_of,
    operator_at,
    placed,
    reached,
    sampled,
    weighted,
)
from zakai.methods.reflecting.filter import State
from zakai.numerics.arrays import Array, Number
from zakai.numerics.line import window as lw
from zakai.numerics.line.backward import EXCURSION, SMALLEST
from zakai.numerics.line.density import support
from zakai.numerics.line.resolution import NOISE, ROUNDING, SMOOTHER_SHARE, SUPPORT
from zakai.numerics.lobatto import Element

PIECE = 10.0  # standard deviations of the noise in which states at the end share a transition
RESOLVING = 3.7  # points in a standard deviation
RESOLVED_DENSITY = 1e-6  # Legendre coefficient of a density that the points of the transition resolve
FINE = 4  # points in a spacing between which a distribution is interpolated
SUBSTEPS = 4  # of a part in which the coefficients are polynomials of time


@np.errstate(all="ignore")
def draw(
    prepared: Prepared, k: int, draws: Array, observed: np.ndarray, state: State, rng: np.random.Generator
) -> tuple[Array, float]:
    """Return draws (P, 1) of the state at the start of interval k given those at its end, and zero: their law is exact."""
    start, length = float(prepared.schedule.starts[k]), float(prepared.lengths[k])
    if length == 0:
        return draws, 0.0
    z, uniform = draws[:, 0], rng.uniform(size=len(draws))
    element, middle, theta = state.element, start + 0.5 * length, prepared.theta.real
    x = element.points
    drift = prepared.system.drift(x[:, None], middle, theta)[:, 0]
    G = covariance_at(prepared.system, x, middle, theta) * np.ones(len(x))
    slope = float(np.max(np.abs(element.derivative(drift))))
    deviation = float(np.sqrt(np.min(G) * min(length, 0.5 / max(slope, 1e-300))))
    wide = SUPPORT * float(np.sqrt(np.max(G) * length))
    low, high = min(element.lower, float(z.min())), max(element.upper, float(z.max()))
    result, order = np.empty(len(z)), np.argsort(z)
    pieces = np.floor((z[order] - low) / (PIECE * deviation)).astype(int)
    for places in np.split(order, np.flatnonzero(np.diff(pieces)) + 1):
        first, last = float(z[places].min()), float(z[places].max())
        near = np.abs(drift[(x >= first - wide) & (x <= last + wide)])
        reach = wide + length * float(np.max(near, initial=0.0))
        lower, upper = max(first - reach, low), min(last + reach, high)
        needed = RESOLVING * 2.0 * float(np.max(element_of(prepared, lower, upper, ELEMENT_SIZES[0]).halves)) / deviation
        piece = element_of(prepared, lower, upper, next((size for size in ELEMENT_SIZES if size >= needed), ELEMENT_SIZES[-1]))
        result[places] = _drawn(prepared, k, piece, z[places], observed, state, uniform[places])
    return np.clip(result, domain_of(prepared).lower, domain_of(prepared).upper)[:, None], 0.0


def _drawn(prepared: Prepared, k: int, piece: Element, z: Array, observed: np.ndarray, state: State, uniform: Array) -> Array:
    """Return the quantiles (P,) of the law of the state at the start, given those at the end z (P,)."""
    own, values = state.element, np.asarray(state.values).real
    before = np.maximum(own.at(values, piece.points), 0.0)
    likely = piece.interpolation(z) @ _transition(prepared, k, piece, before, observed)
    fine = np.linspace(max(piece.lower, own.lower), min(piece.upper, own.upper), FINE * max(len(before), len(values)) + 1)
    middles = 0.5 * (fine[1:] + fine[:-1])
    if piece.unresolved(before * piece.weights) < RESOLVED_DENSITY:
        mass = (likely * before) @ piece.interpolation(middles).T
    else:
        mass = likely @ piece.interpolation(middles).T * own.at(values, middles)
    mass = np.maximum(mass, 0.0)
    total = np.concatenate([np.zeros((len(mass), 1)), np.cumsum(mass, axis=1)], axis=1)
    return np.array([np.interp(u * row[-1], row, fine) for u, row in zip(uniform, total, strict=True)])


def _transition(prepared: Prepared, k: int, piece: Element, before: Array, observed: np.ndarray) -> Array:
    """Return T (N, N) from the points of an element to the densities at them, weighted by what is observed inside."""
    interval = prepared.interval(k, prepared.inside[k], observed)
    _, start, length, inside, rates = interval
    bounds, result = [(0.0, length)], np.eye(len(piece.points))
    if prepared.system.varying:
        parts = resolved_parts(prepared, before, piece, interval).bounds
        cuts = [np.linspace(*part, SUBSTEPS + 1) for part in parts]
        bounds = [(float(a), float(b)) for cut in cuts for a, b in zip(cut[:-1], cut[1:], strict=True)]
    for first, last in bounds:
        middle = np.array([start + 0.5 * (first + last)])
        known = operator_at(prepared, piece, float(middle[0]))
        if known is None:
            return np.full_like(result, np.nan)
        _, _, potential, _ = coefficients(prepared, piece, middle, inside, rates, before)
        modes = known.weighted(potential[0]) if inside.any() else known.modes
        s = modes.scale[:, None]
        result = s * modes.decayed(result / s, last - first)
    return np.asarray(result / piece.weights[:, None])


POINTS = 256  # of a message, on the whole element of the density
QUADRATURE = 192  # points at which a message is projected onto the modes


def _window(prepared: Prepared, lower: float, upper: float) -> lw.Window:
    """Return the grid of a message between two points, whose origin is an end of the domain."""
    domain, spacing = domain_of(prepared), (upper - lower) / POINTS
    origin = next((end for end in (domain.lower, domain.upper) if np.isfinite(end)), 0.0)
    return points_of(lw.Window(origin, 0.0, spacing, 0, False, spacing), lower - origin, upper - origin, spacing)


def last_message(prepared: Prepared, state: State) -> Message:
    """Return the message one at the last time."""
    window = _window(prepared, float(state.lower), float(state.upper))
    return Message.of(np.zeros(window.size), window, window.spacing, 0.0)


class _Product(NamedTuple):
    """The product of a state and a message, of sum one, its points, and the logarithm of the sum before."""

    values: Array
    element: Element
    log_mass: float


def _product(prepared: Prepared, state: State, message: Message) -> _Product:
    element, values = state.element, np.asarray(state.values).real
    floor = SURE_OF_DENSITY * (NOISE + element.unresolved(values)) * np.max(values / element.weights)

    def logs(x: Array) -> Array:
        density = element.at(values, x)
        return np.where(density > floor, logarithm(density), -np.inf) + message.at(x - message.origin)

    lower, upper = placed(logs, element.lower, element.upper, domain_of(prepared))
    lower, upper = max(lower, element.lower), min(upper, element.upper)
    top = float(np.max(logs(np.linspace(lower, upper, 4 * element.size))))
    allowed = negligible_of(prepared, float(state.error) + message.error)
    new, result = sampled(prepared, lambda x: np.exp(logs(x) - top), lower, upper, allowed)
    total = float(np.sum(result))
    return _Product(result / total, new, float(np.log(total)) + top)


@np.errstate(all="ignore")
def smoothed(prepared: Prepared, state: State, message: Message) -> tuple[Message, Info]:
    """Return the message, normalised and without what is negligible in its product with the state, and the product's report."""
    values, element, log_mass = _product(prepared, state, message)
    mean, variance = moments(values, element)
    health = {
        "error_estimate": float(state.error) + message.error,
        "tolerance_ratio": (message.error + 2.0 * element.unresolved(values)) / accuracy(prepared),
        "edge_mass": max(reached(values, element, domain_of(prepared))),
        "negative_mass": float(-np.minimum(values, 0.0).sum()),
        "aliasing": element.unresolved(values),
        "std_in_spacings": float(np.sqrt(max(variance.real, 0.0))) / element.spacing,
    }
    density = values / element.weights
    first, last = element.points[list(support(density, negligible(prepared)))] - message.origin
    retained = message._replace(logs=message.logs - log_mass).between(float(first), float(last))
    return retained, Info(log_mass, np.array([mean]), np.array([[variance]]), health)


@np.errstate(all="ignore")
def step(prepared: Prepared, k: int, message: Message, observed: np.ndarray, state: State) -> Message:
    """Return the message at the start of interval k from that at its end; `state` is the filter's at the start."""
    inside = prepared.inside[k]
    message, before = message.on(_window(prepared, *(message.origin + end for end in message.ends))), message.variance
    at_end, later = prepared.schedule.seen[k] & ~inside, message
    likelihood = factor_at_end(prepared, k, at_end, observed, None) if at_end.any() else None
    if likelihood is not None:
        message = message._replace(logs=message.logs + likelihood.logs(message.window.points).real)
    if prepared.lengths[k] == 0:
        return message

    def logs(x: Array) -> Array:
        """Return the logarithm of the message with the likelihood, whose jumps no grid holds."""
        return later.at(x - later.origin) + (0.0 if likelihood is None else likelihood.logs(x).real)

    interval = prepared.interval(k, inside, observed)
    result = None if prepared.system.varying else _by_modes(prepared, message, logs, interval, state)
    result = _by_volumes(prepared, message, logs, interval, state) if result is None else result
    retained = float(np.clip(message.variance / np.sqrt(max(before * result.variance, 1e-300)), 0.3, 1.0))
    return result._replace(error=result.error + retained * message.error)


def _by_modes(
    prepared: Prepared, message: Message, logs_at: Callable[[Array], Array], interval: TimeInterval, state: State
) -> Message | None:
    """Return the message at the start of an interval by the modes of the operator, None where they do not serve.

        b(start) = U exp(-tau lambda) U' s b(stop) / s

    s b is projected onto the modes by the quadrature of its own points.  The error of rounding, and of what is not resolved after
    the interval, counts where the density is.
    """
    _, start, length, inside, _ = interval
    own, values = state.element, np.asarray(state.values).real
    G = covariance_at(prepared.system, own.points, start, prepared.theta.real)
    reach = EXCURSION * float(np.sqrt(np.max(G) * length))
    domain = domain_of(prepared)
    low, high = np.clip([message.origin + end for end in message.ends], domain.lower, domain.upper).tolist()
    lower, upper = apart(min(own.lower, low) - reach, max(own.upper, high) + reach, domain)
    after = element_of(prepared, low, high, QUADRATURE)
    logs = logs_at(after.points)
    top = float(np.max(logs))
    constant: Number = 0.0
    bound = 1.0  # an expectation is at most the largest value; far out, where s is small, its rounding exceeds that
    weights = after.weights * np.exp(logs - top)
    for size in ELEMENT_SIZES[1:]:
        element = element_of(prepared, lower, upper, size)
        known = decomposed(prepared, element)
        if known is None:
            return None
        density, modes, root = own.at(values, element.points) * element.weights, known.modes, np.sqrt(element.weights)
        if inside.any():
            modes, potential, constant = weighted(prepared, known, element, interval, density)
            bound = float(np.exp(np.max((potential - constant).real)))
        between = element.interpolation(after.points)
        psi = (between.T @ (weights * np.exp(between @ known.logs - modes.top))) / root
        propagated = modes.decayed(psi, length)
        at, log_s, scaled = element.interpolation(own.points), modes.top - known.logs, propagated / root
        own_weights = np.abs(values) * np.exp(at @ log_s)
        wrong = max(ROUNDING * float(np.exp(-length * modes.rates[0])), element.unresolved(propagated * root))
        wrong = wrong * max(float(np.sqrt(psi @ psi)), float(np.max(np.abs(scaled))))
        error = wrong * float(np.sum(own_weights)) / float(own_weights @ (at @ scaled))
        if 0.0 <= error < SMOOTHER_SHARE * smoothing_tolerance(prepared):
            break
    else:
        return None

    def expectation(x: Array) -> Array:
        at = element.interpolation(x)
        return np.asarray(np.minimum((at @ scaled) * np.exp(at @ log_s), bound))

    return _on(prepared, state, expectation, top + float(constant.real), error)


def _by_volumes(
    prepared: Prepared, message: Message, logs_at: Callable[[Array], Array], interval: TimeInterval, state: State
) -> Message:
    """Return the message at the start of an interval by finite volumes."""
    element, values = state.element, np.asarray(state.values).real
    ends, (mean, variance) = np.array([0.0, element.upper - element.lower]), message.moments
    shift = element.lower - message.origin
    aim = mean - shift, variance**0.5
    plan = cell_plan_of(prepared, values, element, ends, interval, aim)
    result = pulled_back(
        prepared, lambda x: logs_at(x + element.lower), lambda x: element.at(values, element.lower + x), plan, interval
    )
    if result is None:
        return last_message(prepared, state)._replace(error=np.inf)
    expectation = result
    return _on(prepared, state, lambda x: expectation.at(x - element.lower), expectation.log_scale, expectation.error)


def _on(prepared: Prepared, state: State, expectation: Callable[[Array], Array], log_scale: float, error: float) -> Message:
    """Return a message by its values, of some scale, where the density is."""
    window = _window(prepared, float(state.lower), float(state.upper))
    values = expectation(np.clip(window.points, state.lower, state.upper))
    logs = np.log(np.maximum(values, SMALLEST * np.max(values))) + log_scale
    return Message.of(logs, window, window.spacing, error)


@np.errstate(all="ignore")
def density(prepared: Prepared, state: State, message: Message) -> IntervalDensity:
    """Return the smoothed density."""
    values, element, _ = _product(prepared, state, message)
    return reflecting_filter.density(prepared, State.of(values, element, float(state.error)))


BACKWARD: Backward[Prepared, State, Message] = Backward(last_message, step, smoothed, density, None, draw, accuracy)
