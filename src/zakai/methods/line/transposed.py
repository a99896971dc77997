"""A message of one state on the circle over one interval, backward in time, by the transposed exponentials of the filter."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.methods.line.attempt import Substep, attempted, parts_of_split
from zakai.methods.line.coefficients import resolved_parts
from zakai.methods.line.message import Message, covering, reliable
from zakai.methods.line.moves import MOST_SUBSTEPS
from zakai.methods.line.system import Prepared, State
from zakai.numerics.line import window as lw

Array = Any

ROUNDING = 1e-15  # of the maximum: smaller values are not kept
MOST_GRIDS = 7  # that are finer


def by_exponentials(
    prepared: Prepared, k: int, inside: np.ndarray, rates: np.ndarray, state: State, later: Message, accepted: float
) -> tuple[Message, float] | None:
    """Return the message at the start of interval k, and the error that the interval adds; None where this does not serve.

    Args:
        prepared: the system.
        k: the interval.
        inside, rates: which increments act within it, and their rates.
        state: the filter's state at its start.
        later: the message at its end.
        accepted: the values relative to the maximum that do not count.
    """
    start, length, spacing = float(prepared.schedule.starts[k]), float(prepared.lengths[k]), later.needed
    for _ in range(MOST_GRIDS):
        window = covering(later.window, 0.0, 0.0, min(spacing, state.spacing))
        values = np.exp(later.at(window.offsets) - np.max(later.logs))
        values, top, error = _transposed(prepared, values, window, start, length, inside, rates)
        look = lw.figures(values, True, accepted)
        if look.aliasing <= accepted or window.size >= lw.LARGEST:
            break
        spacing = window.spacing / 1.5
    else:
        return None
    density, least = reliable(state, window), ROUNDING * float(np.max(values))
    error += 2.0 * look.aliasing + least * float(np.sum(density) / (density @ values))
    needed = window.spacing * float(np.clip(look.resolving, 1.0, 2.0))
    logs = np.log(np.maximum(values, least)) + top + float(np.max(later.logs))
    return Message.of(logs, window, needed, later.error), error


def _transposed(
    prepared: Prepared, values: Array, window: lw.Window, start: float, length: float, inside: np.ndarray, rates: np.ndarray
) -> tuple[Array, float, float]:
    """Return a message at the start of an interval, of the sum one, the logarithm of the sum before, and the error."""
    total = float(np.sum(values))
    values, top, error = values / total, float(np.log(total)), 0.0
    stack, count = [(0.0, 0.5 * length), (0.5 * length, length)], 0
    if prepared.system.varying:
        stack, error = resolved_parts(prepared, values, window, start, length, inside)
    while stack:
        first, last = stack.pop()
        attempt = attempted(prepared, values, window, Substep(start + first, last - first, inside, rates), True)
        count += 1
        if attempt.split and count + len(stack) < MOST_SUBSTEPS:
            stack += parts_of_split(prepared, first, last, attempt.error)
            continue
        total = float(np.sum(attempt.values))
        error += np.inf if attempt.split else attempt.error
        top += attempt.offset + float(np.log(total))
        values = attempt.values / total
    return values, top, error
