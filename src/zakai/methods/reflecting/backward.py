"""The backward pass for one state between ends and kinks, and draws of the state at the start of an interval.

The message is on a uniform grid, the smoothed density on panels.  The transposed operator on panels takes a message back over an
interval (`line/panels.py`).  Draws follow the law p(x) T(x, z) of the state at the start, given z at the end, with the transition
T of exponentials of the operator on panels.  Where coefficients depend on t, it is a product of transitions with those at the
middles of substeps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from zakai.densities import IntervalDensity
from zakai.methods._protocol import Backward, Info
from zakai.methods.line.backward import accuracy
from zakai.methods.line.backward_interval import negligible
from zakai.methods.line.coefficients import covariance_at
from zakai.methods.line.message import SURE_OF_DENSITY, Message, points_of
from zakai.methods.line.panels import SIZES, Operator, Problem, panels_between, pulled_back
from zakai.methods.line.prepared import Prepared
from zakai.methods.line.update import factor_at_end
from zakai.methods.reflecting import filter as reflecting_filter
from zakai.methods.reflecting.elements import (
    SAMPLES,
    domain_of,
    logarithm,
    moments,
    negligible_of,
    placed,
    reached,
    sampled,
)
from zakai.methods.reflecting.filter import State
from zakai.numerics.arrays import Array
from zakai.numerics.line import window as lw
from zakai.numerics.line.backward import SMALLEST
from zakai.numerics.line.density import support
from zakai.numerics.line.rational import CONTRACTION, Factors, separated
from zakai.numerics.line.resolution import NOISE, SUPPORT
from zakai.numerics.lobatto import Element

PIECE = 10.0  # standard deviations of the noise in which states at the end share a transition
MOST_OF_TRANSITION = 24  # panels of a transition that are bisected
RESOLVED_LENGTH = 3.0  # of a panel in standard deviations of the noise
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
        piece = panels_between(prepared, lower, upper, start)._replace(size=SIZES[1])
        while len(piece.halves) < MOST_OF_TRANSITION and (coarse := piece.halves > 0.5 * RESOLVED_LENGTH * deviation).any():
            piece = piece.bisected(coarse)
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
    """Return T (N, N) from the points of panels to the densities at them, weighted by what is observed inside."""
    interval = prepared.interval(k, prepared.inside[k], observed)
    ends = np.array([piece.lower, piece.upper])
    problem = Problem.of(prepared, interval, piece, before * piece.weights, lambda x: before, ends)
    operator, result = Operator(problem, piece), np.eye(len(piece.points) - len(piece.cuts))
    for low, high in problem.parts.bounds:
        blocks, count = operator.part(low, high), SUBSTEPS if prepared.system.varying else 1
        step = (high - low) / count
        for first in np.linspace(low, high, count + 1)[:-1]:
            middle = np.array([first + 0.5 * step])
            result = Factors.of(piece, blocks(middle, step)[0], CONTRACTION.values).exponential(result)
    return separated(piece, operator.density(result, interval.length).T)


POINTS = 256  # of a message, on the whole element of the density


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
    known = values / element.weights
    floor = SURE_OF_DENSITY * (NOISE * np.max(known) + element.tails(known))

    def logs(x: Array) -> Array:
        density = element.at(values, x)
        return np.where(density > floor[element.panel(x)], logarithm(density), -np.inf) + message.at(x - message.origin)

    lower, upper = placed(logs, element.lower, element.upper, domain_of(prepared))
    lower, upper = max(lower, element.lower), min(upper, element.upper)
    top = float(np.max(logs(np.linspace(lower, upper, SAMPLES))))
    allowed = negligible_of(prepared, float(state.error) + message.error)
    new, result = sampled(prepared, lambda points: np.exp(logs(points.points) - top) * points.weights, lower, upper, allowed)
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

    element, values = state.element, np.asarray(state.values).real
    ends = np.array([element.lower, element.upper])
    interval = prepared.interval(k, inside, observed)
    problem = Problem.of(prepared, interval, element, values, lambda x: element.at(values, x), ends)
    solution = pulled_back(problem, logs, message.window.points)
    if solution is None:
        return last_message(prepared, state)._replace(error=np.inf)
    result = _on(prepared, state, solution.extended, float(solution.log_scale.real), solution.error)
    retained = float(np.clip(message.variance / np.sqrt(max(before * result.variance, 1e-300)), 0.3, 1.0))
    return result._replace(error=result.error + retained * message.error)


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
