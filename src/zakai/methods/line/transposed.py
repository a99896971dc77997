"""A message of one state over one interval, backward in time, by the transposed exponentials of the filter's operator.

They serve on the circle, and on the line where increments act within the interval or the drift carries the density far: the grid
is about the message, with which it moves then, since the observation holds the paths there.  The products with the filter's
density show whether it does.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.methods.line.attempt import attempted, parts_of_split
from zakai.methods.line.coefficients import resolved_parts
from zakai.methods.line.message import PAD, Message, covering, reliable, taper
from zakai.methods.line.moves import MOST_SUBSTEPS
from zakai.methods.line.moving import speed_of
from zakai.methods.line.system import Prepared, State
from zakai.numerics.line import window as lw

Array = Any

ROUNDING = 1e-15  # of the maximum: smaller values are not kept
MOST_DENSE = 384  # points of a grid on the line
MOST_GRIDS = 7  # that are finer or wider


def by_exponentials(
    prepared: Prepared, k: int, inside: np.ndarray, rates: np.ndarray, state: State, later: Message, accepted: float, moving: bool
) -> tuple[Message, float] | None:
    """Return the message at the start of interval k, and the error that the interval adds; None where this does not serve.

    Args:
        prepared: the system.
        k: the interval.
        inside, rates: which increments act within it, and their rates.
        state: the filter's state at its start.
        later: the message at its end.
        accepted: the values relative to the maximum that do not count.
        moving: whether the grid moves with the message.
    """
    start, length, spacing = float(prepared.schedule.starts[k]), float(prepared.lengths[k]), later.needed
    margin, tried = PAD * spacing, None
    for _ in range(MOST_GRIDS):
        if later.closed:
            window = covering(later.window, 0.0, 0.0, min(spacing, state.spacing))
        else:
            window = lw.quantized(later.window, later.ends[0] - margin, later.ends[1] + margin, spacing, margin=0.0)
            if window == tried or window.size > MOST_DENSE:
                return None
            tried = window
        values = np.exp(later.at(window.offsets) - np.max(later.logs))
        values = values if later.closed else values * taper(window.offsets, later.ends, window.spacing)
        found = _transposed(prepared, values, window, start, length, inside, rates, moving)
        window = found.window
        values, look = found.values[-1], lw.figures(found.values[-1], later.closed, accepted)
        coarse = look.aliasing > accepted and window.size < lw.LARGEST
        cut = coarse and max(look.left, look.right) > look.aliasing  # waves of the ends
        if cut or not (coarse or later.closed or _held(prepared, state, found, start, inside, rates, accepted)):
            margin = 1.5 * margin
        elif coarse:
            spacing = window.spacing / 1.5
        else:
            break
    else:
        return None
    density = reliable(state, window)
    least = ROUNDING * float(np.max(values))
    error = found.error + 2.0 * look.aliasing + least * float(np.sum(density) / (density @ values))
    if not (later.closed or np.isfinite(error)):
        return None
    needed = window.spacing * float(np.clip(look.resolving, 1.0, 2.0))
    logs = np.log(np.maximum(values, least)) + found.top + float(np.max(later.logs))
    return Message.of(logs, window, needed, later.error), error


class _Transposed(NamedTuple):
    """A message after each substep backward, of the sum one, and the substeps with the speeds of the grid.

    There are the last grid, the logarithm of the last sum, and the error.
    """

    values: list[Array]
    substeps: list[tuple[float, float, float]]
    window: lw.Window
    top: float
    error: float


def _transposed(
    prepared: Prepared, values: Array, window: lw.Window, start: float, length: float, inside: np.ndarray, rates: np.ndarray,
    moving: bool,
) -> _Transposed:  # fmt: skip
    """Take a message back over an interval on one grid, which may move with it."""
    total = float(np.sum(values))
    found, substeps, top, error, speed = [values / total], [], float(np.log(total)), 0.0, 0.0
    stack, count = [(0.0, 0.5 * length), (0.5 * length, length)], 0
    if prepared.system.varying:
        stack, error = resolved_parts(prepared, found[0], window, start, length, inside)
    while stack:
        first, last = stack.pop()
        if moving:
            speed = speed_of(prepared, found[-1], window, start + last, first - last)
        before = lw.moved(window, speed * (first - last))
        attempt = attempted(prepared, found[-1], before, start, first, last, inside, rates, True, speed)
        count += 1
        if attempt.split and count + len(stack) < MOST_SUBSTEPS:
            stack += parts_of_split(prepared, first, last, attempt.error)
            continue
        total = float(np.sum(attempt.values))
        error += np.inf if attempt.split else attempt.error
        top += attempt.offset + float(np.log(total))
        found.append(attempt.values / total)
        substeps.append((first, last, speed))
        window = before
    return _Transposed(found, substeps, window, top, error)


def _held(
    prepared: Prepared, state: State, found: _Transposed, start: float, inside: np.ndarray, rates: np.ndarray, accepted: float
) -> bool:
    """Return whether the products of a message and the density end on a grid, at the start and after each substep."""
    window, density = found.window, reliable(state, found.window)
    for values, substep in zip(found.values[::-1], [*found.substeps[::-1], None], strict=True):
        product = np.maximum(density * values, 0.0)
        look = lw.figures(product / np.sum(product), False, accepted)
        if not max(look.left, look.right) <= accepted:
            return False
        if substep is not None:
            first, last, speed = substep
            density = attempted(prepared, density, window, start, first, last, inside, rates, speed=speed).values
            density, window = density / np.sum(density), lw.moved(window, speed * (last - first))
    return True
