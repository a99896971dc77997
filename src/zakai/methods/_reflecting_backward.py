"""The backward pass for one state between reflecting ends: the message on a uniform grid, the smoothed density on elements.

Finite volumes without flux at the ends take a message back over an interval (`_line_volumes.py`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.densities import IntervalDensity
from zakai.methods import _reflecting
from zakai.methods._line_backward import accuracy
from zakai.methods._line_course import course_of
from zakai.methods._line_message import SURE, Message, points_of
from zakai.methods._line_system import NOISE, Prepared
from zakai.methods._line_update import factor_at_end
from zakai.methods._line_volumes import pulled_back
from zakai.methods._protocol import Backward, Info
from zakai.methods._reflecting import State
from zakai.methods._reflecting_moves import domain_of, logarithm, moments, negligible_of, placed, reached, sampled
from zakai.methods._reflecting_paths import draw
from zakai.numerics import line_window as lw
from zakai.numerics.lobatto import Element

Array = Any

POINTS = 256  # of a message, on the whole element of the density
ROUNDING = 1e-15  # of the maximum: smaller values of a message are not kept


def _window(prepared: Prepared, lower: float, upper: float) -> lw.Window:
    """Return the grid of a message between two points, whose origin is an end of the domain."""
    domain, spacing = domain_of(prepared), (upper - lower) / POINTS
    origin = next((end for end in (domain.lower, domain.upper) if np.isfinite(end)), 0.0)
    return points_of(lw.Window(origin, 0.0, spacing, 0, False, spacing), lower - origin, upper - origin, spacing)


def message(prepared: Prepared, state: State) -> Message:
    """Return the message one at the last time."""
    origin, centre, spacing, size, closed, unit = _window(prepared, float(state.lower), float(state.upper))
    return Message(np.zeros(size), origin, centre, spacing, unit, closed, spacing, 0.0)


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
    negligible = negligible_of(prepared, float(state.error) + later.error)
    new, found = sampled(prepared, lambda x: np.exp(logs(x) - top), lower, upper, negligible)
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
    kept = later._replace(logs=later.logs - log_mass).between(element.lower - later.origin, element.upper - later.origin)
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
    element, values = state.element, np.asarray(state.values).real
    ends = np.array([0.0, element.upper - element.lower])
    sharpest = float(np.sqrt(later.variance))
    course = course_of(prepared, values, element, ends, start, length, inside, sharpest)  # type: ignore[arg-type]  # by its points
    rates = np.where(inside, observed, 0.0) / length
    shift = element.lower - later.origin
    found = pulled_back(
        prepared, lambda x: later.at(x + shift), lambda x: element.at(values, element.lower + x), course, start, inside, rates
    )
    window = _window(prepared, element.lower, element.upper)
    origin, centre, spacing, _, closed, unit = window
    if found is None:
        return Message(np.zeros(window.size), origin, centre, spacing, unit, closed, spacing, np.inf)
    worth = found.at(window.offsets - shift)
    logs = np.log(np.maximum(worth, ROUNDING * np.max(worth))) + found.log_scale
    new = Message(logs, origin, centre, spacing, unit, closed, spacing, 0.0)
    kept = float(np.clip(later.variance / np.sqrt(max(before * new.variance, 1e-300)), 0.3, 1.0))
    return new._replace(error=found.error + kept * later.error)


@np.errstate(all="ignore")
def density(prepared: Prepared, state: State, later: Message) -> IntervalDensity:
    """Return the smoothed density."""
    values, element, _ = _product(prepared, state, later)
    return _reflecting.density(prepared, State.of(values, element, float(state.error)))


BACKWARD: Backward[Prepared, State, Message] = Backward(message, step, smoothed, density, None, draw, accuracy)
