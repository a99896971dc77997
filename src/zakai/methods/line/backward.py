"""The backward pass for one state: what the observations after t say of the state at t, as a function on a grid.

Backward in time a message b obeys the adjoint of the filter's equation,

    -b_t = G b'' / 2 + f b' + V b.

Only the product of b with the filter's density matters: a message is kept where this product is not negligible.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from zakai.densities import Density
from zakai.methods._protocol import Backward, Info, Infos, joined, stacked
from zakai.methods._states import Joined
from zakai.methods.line import filter as line_filter
from zakai.methods.line.backward_interval import negligible, pulled, smoothing_tolerance
from zakai.methods.line.backward_loop import back
from zakai.methods.line.message import Message, points_of, reliable
from zakai.methods.line.parts import cut
from zakai.methods.line.paths import draw
from zakai.methods.line.prepared import Parts, Prepared, State
from zakai.methods.line.update import acting_inside, factor_of, state_moments
from zakai.numerics.arrays import Array
from zakai.numerics.line import window as lw
from zakai.numerics.line.density import support
from zakai.numerics.line.product import NODES_OF_SPACING


def last_message(prepared: Prepared, state: State) -> Message:
    """Return the message one at the last time."""
    return Message.of(np.zeros(len(state.values)), state.window, state.window.spacing, 0.0)


class _Product(NamedTuple):
    """The product of a state and a message on the finer of their grids, of sum one, and the logarithm of the sum before."""

    values: Array
    window: lw.Window
    log_mass: float


def _product(state: State, message: Message) -> _Product:
    finer = state.window
    if message.spacing < 0.9999 * finer.spacing:
        low, high = float(finer.offsets[0]), float(finer.offsets[-1])
        if not finer.closed and message.spacing < 0.25 * finer.spacing:  # a message that is far narrower than the density
            low, high = max(low, message.ends[0]), min(high, message.ends[1])
        finer = points_of(finer, low, high, message.spacing)
    density = reliable(state, finer)
    logs = np.where(density > 0, np.log(density) + message.at(finer.offsets), -np.inf)
    top = float(np.max(logs))
    values = np.exp(logs - top)
    first, last = support(values, lw.CUT)
    values[:first], values[last + 1 :] = 0.0, 0.0
    total = float(np.sum(values))
    return _Product(values / total, finer, float(np.log(total)) + top)


@np.errstate(all="ignore")
def smoothed(prepared: Prepared, state: State, message: Message) -> tuple[Message, Info]:
    """Return the message, normalised and without what is negligible in its product with the state, and the product's report."""
    return _smoothed(prepared, state, message, _product(state, message))


def segment(
    prepared: Prepared, rows: slice, states: Sequence[State], message: Message, observed: np.ndarray
) -> tuple[Message, Infos]:
    """Return the message at the start of the intervals of a slice, and the reports after each."""
    if prepared.parts is None:
        return _of_whole(prepared, rows, states, message, observed)
    return _of_parts(prepared.parts, rows, states[0], message, observed)


def _of_parts(parts: Parts, rows: slice, state: State, message: Message, observed: np.ndarray) -> tuple[Message, Infos]:
    # What a report says of the step after it belongs to that interval's gain.
    inner, values, last = cut(parts, rows, observed)
    between, _ = line_filter.segment_of_whole(parts.prepared, inner, state, values)
    result, infos = _of_whole(parts.prepared, inner, Joined([[state], between]), message, values)
    gained = infos.log_likelihood_increment
    health = {name: np.fmax.reduceat(figures, last) for name, figures in infos.health.items()}
    reports = Infos(np.add.reduceat(gained, last), infos.mean[last], infos.cov[last], health)
    return result._replace(logs=result.logs + np.sum(gained[: last[0]])), reports


@np.errstate(all="ignore")
def _of_whole(
    prepared: Prepared, rows: slice, states: Sequence[State], message: Message, observed: np.ndarray
) -> tuple[Message, Infos]:
    """Return the same of intervals that are not cut into parts."""
    parts: list[Infos] = []
    stop = rows.stop
    while stop > rows.start:
        place = stop - rows.start
        result = _product(states[place], message)
        message, info = _smoothed(prepared, states[place], message, result)
        parts.append(stacked([info]))
        completed = back(prepared, slice(rows.start, stop), states, message, result.values, result.window, observed)
        if completed is None:
            stop -= 1
            message = step(prepared, stop, message, observed[place - 1], states[place - 1])
        else:
            message, stop = completed.message, stop - completed.number
            parts.append(completed.infos)
    return message, joined(parts[::-1])


def _smoothed(prepared: Prepared, state: State, message: Message, result: _Product) -> tuple[Message, Info]:
    window = result.window
    check = lw.grid_check(result.values, window.closed, prepared.negligible)
    mean, variance = lw.moments(result.values, window)
    centre, deviation = float(mean), float(np.sqrt(max(variance, 0.0)))
    spacings = deviation / window.spacing
    mean, variance = state_moments(prepared, result.values, window, mean, variance)
    health = {
        "error_estimate": float(state.error) + message.error,
        "tolerance_ratio": message.error / smoothing_tolerance(prepared),
        "edge_mass": max(check.left, check.right),
        "negative_mass": check.negative,
        "aliasing": check.aliasing,
        "std_in_spacings": spacings,
    }
    first, last = support(result.values, negligible(prepared))
    needed = min(message.needed, window.spacing * max(check.resolving, 1.0), float(state.spacing))
    low, high = float(window.offsets[first]), float(window.offsets[last])
    finer = message.spacing > 2.0 * needed  # few points hold more than the product
    retained = message.on(points_of(message.window, low, high, needed)) if finer else message.between(low, high)
    retained = retained._replace(logs=retained.logs - result.log_mass, needed=needed, mean=centre, deviation=deviation)
    return retained, Info(result.log_mass, np.array([mean]), np.array([[variance]]), health)


@np.errstate(all="ignore")
def step(prepared: Prepared, k: int, message: Message, observed: np.ndarray, state: State) -> Message:
    """Return the message at the start of interval k from that at its end; `state` is the filter's at the start."""
    length = float(prepared.lengths[k])
    finer = NODES_OF_SPACING if prepared.weak and prepared.schedule.seen[k].any() else 1.0
    message = message.on(points_of(message.window, *message.ends, message.needed / finer)).between(*message.ends)
    before = message.variance
    inside, likelihood = acting_inside(prepared, k), factor_of(prepared, k, observed, message.window)
    if likelihood is not None:
        logs = message.logs + likelihood.logs(message.window.points).real
        # Of a law whose density underflows: what is between points follows from them.
        finite = np.isfinite(logs)
        message = message._replace(logs=np.where(finite, logs, np.min(logs[finite]) if finite.any() else np.nan))
    if length == 0:
        return message
    between = message.variance
    message, made = pulled(prepared, prepared.interval(k, inside, observed), state, message)
    retained = float(np.clip(message.scaled * between / np.sqrt(max(before * message.variance, 1e-300)), 0.3, 1.0))
    return message._replace(error=made + retained * message.error, scaled=1.0)


@np.errstate(all="ignore")
def density(prepared: Prepared, state: State, message: Message) -> Density:
    """Return the smoothed density."""
    result = _product(state, message)
    return line_filter.density(prepared, State.of(result.values, result.window, state.error, state.log_floor))


def accuracy(prepared: Prepared) -> float:
    """Return the error of the evidence above which a smoother warns: several intervals leave `smoothing_tolerance` each."""
    return max(1e-5, prepared.promised)


BACKWARD: Backward[Prepared, State, Message] = Backward(last_message, step, smoothed, density, segment, draw, accuracy)
