"""A message of one state over one interval, backward in time, where the compiled loop refuses it.

A Gaussian kernel is a sum over a grid.  On the circle the transposed exponentials of the filter act, on the line a grid that
moves (`line/gauged.py`) where the drift carries the density, and else panels (`line/panels.py`).
"""

from __future__ import annotations

import numpy as np

from zakai.methods.line.coefficients import covariance_at, resolved_parts, travel
from zakai.methods.line.domain import ends_of_leak
from zakai.methods.line.gauged import by_moving_grid
from zakai.methods.line.kernel import kernel_of
from zakai.methods.line.message import Message, points_of, reliable
from zakai.methods.line.panels import Problem, pulled_back
from zakai.methods.line.prepared import Prepared, State, TimeInterval
from zakai.methods.line.report import Report
from zakai.methods.line.transition import MOST_SUBSTEPS, Substep, parts_of_split, trial_substep
from zakai.numerics.arrays import Array
from zakai.numerics.line import window as lw
from zakai.numerics.line.backward import FEWEST, SMALLEST
from zakai.numerics.line.density import support
from zakai.numerics.line.resolution import TRIALS


def by_exponentials(
    prepared: Prepared, interval: TimeInterval, state: State, message: Message, accepted: float
) -> tuple[Message, float] | None:
    """Return what `pulled` returns, by transposed exponentials; None where they do not serve.  Less than `accepted` is none."""
    spacing = message.needed
    for _ in range(TRIALS):
        window = points_of(message.window, *message.ends, min(spacing, state.spacing))
        values = np.exp(message.at(window.offsets) - np.max(message.logs))
        values, top, error = _transposed(prepared, values, window, interval)
        check = lw.grid_check(values, True, accepted)
        if check.aliasing <= accepted or window.size >= lw.LARGEST:
            break
        spacing = window.spacing / 1.5
    else:
        return None
    density, least = reliable(state, window), SMALLEST * float(np.max(values))
    error += 2.0 * check.aliasing + least * float(np.sum(density) / (density @ values))
    needed = window.spacing * float(np.clip(check.resolving, 1.0, 2.0))
    logs = np.log(np.maximum(values, least)) + top + float(np.max(message.logs))
    return Message.of(logs, window, needed, message.error), error


def _transposed(prepared: Prepared, values: Array, window: lw.Window, interval: TimeInterval) -> tuple[Array, float, float]:
    """Return a message at the start of an interval, of the sum one, the logarithm of the sum before, and the error."""
    _, start, length, inside, rates = interval
    total = float(np.sum(values))
    values, top, error = values / total, float(np.log(total)), 0.0
    stack, count = [(0.0, 0.5 * length), (0.5 * length, length)], 0
    if prepared.system.varying:
        stack, error = resolved_parts(prepared, values, window, interval)
    while stack:
        first, last = stack.pop()
        trial = trial_substep(prepared, values, window, Substep(start + first, last - first, inside, rates), True)
        count += 1
        if trial.split and count + len(stack) < MOST_SUBSTEPS:
            stack += parts_of_split(prepared, first, last, trial.error)
            continue
        total = float(np.sum(trial.values))
        error += np.inf if trial.split else trial.error
        top += float(trial.offset.real + np.log(total))
        values = trial.values / total
    return values, top, error


SPACING_OF_NOISE = 0.25  # spacing in standard deviations of the noise
WIDTH = 0.8  # spacing in standard deviations of a Gaussian kernel at which sums are integrals
MOST_POINTS = 4000  # of such sums


def negligible(prepared: Prepared) -> float:
    """Return the values relative to the maximum that do not count."""
    return float(np.clip(1e-5 * prepared.tolerance, 1e-13, 1e-10))


def smoothing_tolerance(prepared: Prepared) -> float:
    """Return the error of an interval above which a smoother warns."""
    return max(prepared.tolerance, 1e-6)


def pulled(prepared: Prepared, interval: TimeInterval, state: State, message: Message) -> tuple[Message, float]:
    """Return the message at the start of an interval, and the error that the interval adds.

    Args:
        state: the filter's state at its start.
        message: the message at its end.
    """
    own, accepted = state.window, negligible(prepared)
    low, high = support(np.ascontiguousarray(state.values.real), 1e-13)
    ends = float(own.offsets[low]), float(own.offsets[high])
    result = _by_kernel(prepared, interval, ends, message)
    if result is not None:
        return result
    if message.closed:
        dense = by_exponentials(prepared, interval, state, message, accepted)
        if dense is not None:
            return dense
    leak = ends_of_leak(prepared, own, np.array(ends), interval.start, interval.length)
    dense = None
    if leak is None and travel(prepared, np.asarray(state.values), own, interval.start, interval.length) > 0.0:
        dense = by_moving_grid(prepared, interval, state, message, accepted)
        if dense is not None and dense[1] <= smoothing_tolerance(prepared):
            return dense
    result = _by_panels(prepared, interval, state, ends, message)
    return dense if dense is not None and dense[1] < result[1] else result


def _by_kernel(
    prepared: Prepared, interval: TimeInterval, ends: tuple[float, float], message: Message
) -> tuple[Message, float] | None:
    """Return the same of an interval whose kernel is Gaussian, None where it is not or needs many points."""
    if prepared.yau is None or message.closed:
        return None
    report, k = Report(), interval.k
    kernel = kernel_of(prepared, interval, message.window, report)
    if kernel is None or not kernel.variance.real > 0:
        return None
    deviation, (low, high) = float(np.sqrt(kernel.variance)), message.ends
    if (high - low) > MOST_POINTS * WIDTH * deviation:
        return None
    spacing = min(max(message.needed, SPACING_OF_NOISE * deviation) / max(abs(kernel.scale), 1e-3), (ends[1] - ends[0]) / FEWEST)
    fine = points_of(message.window, low, high, min(message.spacing, WIDTH * deviation))
    new = points_of(message.window, *ends, spacing)
    x, y, theta = fine.offsets, new.offsets, prepared.theta.real
    after = message.at(x) + prepared.yau.potential(fine.points, float(prepared.schedule.stops[k]), theta)
    logs = after - 0.5 * ((x - kernel.scale * y[:, None] - kernel.shift) / deviation) ** 2
    top = np.max(logs, axis=1)
    result = np.log(np.sum(np.exp(logs - top[:, None]), axis=1) * fine.spacing / (deviation * np.sqrt(2 * np.pi))) + top
    result += kernel.constant + y * (kernel.slope + kernel.curvature * y)
    result -= prepared.yau.potential(new.points, float(prepared.schedule.starts[k]), theta)
    return Message.of(result, new, new.spacing, message.error), report.time


def _by_panels(
    prepared: Prepared, interval: TimeInterval, state: State, ends: tuple[float, float], message: Message
) -> tuple[Message, float]:
    """Return the same by panels, of infinite error where they do not serve."""
    values, window = np.asarray(state.values).real, state.window
    problem = Problem.of_grid(prepared, interval, values, window)
    result = pulled_back(problem, lambda x: message.falling(x - state.origin), message.window.points)
    if result is None:
        return message._replace(logs=np.full(len(message.logs), np.nan)), np.inf
    least, _ = _noise(prepared, interval.k, *(state.origin + np.array(message.ends)))
    needed = min(max(message.needed, 0.5 * SPACING_OF_NOISE * least), window.spacing)
    new = points_of(window, *ends, needed)
    values = result.extended(new.points)
    logs = np.log(np.maximum(values, SMALLEST * np.max(values))) + float(result.log_scale.real)
    return Message.of(logs, new, needed, message.error), result.error


def _noise(prepared: Prepared, k: int, low: float, high: float) -> tuple[float, float]:
    """Return the smallest and the largest standard deviation of the noise of an interval between two states."""
    middle, length = 0.5 * (prepared.schedule.starts[k] + prepared.schedule.stops[k]), float(prepared.lengths[k])
    covariance = covariance_at(prepared.system, np.linspace(low, high, 9), middle, prepared.theta.real) * np.ones(9)
    return float(np.sqrt(max(np.min(covariance), 0.0) * length)), float(np.sqrt(np.max(covariance) * length))
