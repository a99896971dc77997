"""Many intervals backward in time in one compiled loop (`numerics/line/backward.py`), for `line/backward.py`.

The message is moved on the grids of the filter.  An interval that the loop refuses is filtered by `line/backward_interval.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from zakai.methods._protocol import Infos
from zakai.methods.line.backward_interval import negligible, smoothing_tolerance
from zakai.methods.line.coefficients import covariance_at, displaced
from zakai.methods.line.loop import INTERVALS_TOGETHER, grid_of
from zakai.methods.line.message import LOWEST, PAD, SURE_OF_DENSITY, Message, gauged, taper
from zakai.methods.line.prepared import SHARE, Prepared, State
from zakai.methods.line.update import factor_at_end, state_moments
from zakai.numerics.arrays import Array
from zakai.numerics.line import backward as lb
from zakai.numerics.line import window as lw
from zakai.numerics.line.backward import EXCURSION, by_adjoints
from zakai.numerics.line.density import support
from zakai.numerics.line.resolution import ROUNDING, SMOOTHER_SHARE
from zakai.numerics.line.steps import SPLIT, SPLIT_FACTOR

STRIDES = (1, 2, 4)  # points of psi in a spacing of the filter's grid
SPACINGS_APART = 32  # the ends of a grid for a decomposition are multiples of so many spacings


class BackwardSegment(NamedTuple):
    """The message before the last `number` intervals, and what is reported at the times between them."""

    message: Message
    number: int
    infos: Infos


def back(
    prepared: Prepared, rows: slice, states: Sequence[State], message: Message, product: Array, grid: lw.Window, observed: Array
) -> BackwardSegment | None:
    """Take a message back over the last of some intervals, None where the loop takes none of them.

    Args:
        states: those of the filter before and after them.
        message: the message after the last interval.
        product, grid: the smoothed density at the same time, and its grid.
        observed: the observations (K, m).
    """
    k, first = rows.stop - 1, rows.start
    split = prepared.gaussian
    if prepared.kinked or not _served(prepared, k) or not (split or _exact(prepared, k, states[k - first])):
        return None
    shared = _shared(states[k - first], states[k - first + 1].window, message, product, grid)
    if split and shared and not shared[-1].closed:
        shared.append(lw.refined(shared[-1], 2.0))  # for a kernel that is narrow in spacings
    for window in shared:
        begin, most = k, INTERVALS_TOGETHER
        own = states[k - first].window
        if not _holds(window, *own.offsets[[0, -1]]) or (split and window.spacing < own.spacing):
            most = 1
        while begin > first and k - begin < most - 1 and _served(prepared, begin - 1):
            earlier = states[begin - 1 - first].window
            shifted = split and own.spacing == window.spacing and own.origin == window.origin
            if earlier != own and not (shifted and earlier.spacing == own.spacing and earlier.size == own.size == window.size):
                break
            begin -= 1
        here = slice(begin, k + 1)
        before = states[begin - first : k + 1 - first]
        for stride in (0,) if split else STRIDES:
            values = observed[begin - first : k + 1 - first]
            completed = _on_one_grid(prepared, here, before, message, (product, grid), window, stride, values)
            if completed is not None:
                return completed
    return None


def _served(prepared: Prepared, k: int) -> bool:
    """Return whether the loop may take an interval."""
    if prepared.gaussian:
        return bool(prepared.kinds[k] in (SPLIT, SPLIT_FACTOR))
    return prepared.system.samples and not prepared.system.moving and bool(prepared.lengths[k] > 0)


def _exact(prepared: Prepared, k: int, state: State) -> bool:
    """Return whether rounding in psi may be negligible at the start of an interval, as a decomposition takes long.

    With a gauge of the slope s' = f / G a drift that carries the state far loses digits: psi is smaller where the density is than
    at its own maximum by about exp(-(s' P s' + f^2 tau / G)), with the variance P of the density.
    """
    if state.window.closed:
        return True
    values, length, start = np.asarray(state.values), float(prepared.lengths[k]), float(prepared.schedule.starts[k])
    mean, variance = lw.moments(values, state.window)
    displacement, _ = displaced(prepared, values, state.window, start, length)
    noise = length * covariance_at(prepared.system, np.array([state.origin + mean]), start, prepared.theta.real)
    lost = displacement**2 / noise * (1.0 + variance / noise)
    return bool(np.all(lost < np.log(SMOOTHER_SHARE * smoothing_tolerance(prepared) / ROUNDING)))


def _on_one_grid(
    prepared: Prepared, here: slice, before: Sequence[State], message: Message, smoothed: tuple[Array, lw.Window],
    window: lw.Window, stride: int, observed: Array,
) -> BackwardSegment | None:  # fmt: skip
    """Return the message before intervals, on one grid, None where none is accurate."""
    limits = lb.Limits(smoothing_tolerance(prepared), SHARE * prepared.tolerance, negligible(prepared), prepared.cut)
    product, start, longer, gauge = lw.resampled(*smoothed, window), 0, window, np.zeros(1)
    filtered, centres = _before(before, window)
    if not stride:
        table = grid_of(prepared, window, here)
        if table is None:
            return None
        start = table.start
        filtered, ends = filtered._replace(starts=filtered.starts + start), np.append(centres[1:], window.centre)
        logs = log_likelihoods(prepared, here, observed, window.origin + ends[:, None] + window.spacing * lw.index(window.size))
        on_grid, steps = _on(message, window, start, product), prepared.steps.part(here)
        observed = np.ascontiguousarray(observed, float)
        completed = by_adjoints(on_grid, filtered, table, steps, lb.Observed(logs, observed, window.closed), limits)
    else:
        lengths = np.ascontiguousarray(prepared.lengths[here])
        longer = _longer(prepared, window, stride, float(np.max(lengths)))
        operator = gauged(prepared, longer)
        if operator is None:
            return None
        logs, gauge = log_likelihoods(prepared, here, observed, longer.points[None]), operator.logs
        known = lb.Gauged(np.ascontiguousarray(operator.modes.T), operator.rates, gauge, _place(window, longer, stride), stride)
        completed = lb.by_modes(_psi(message, longer, gauge, product), filtered, known, logs, lengths, window.closed, limits)
    if not completed.number:
        return None
    reports, result = completed.reports, completed.message
    first, last = result.first, result.last
    logs = (np.log(np.maximum(result.values, 1e-300)) - gauge)[first : last + 1] + result.scale + reports[0, lb.LOG_MASS]
    middle = result.start - start + first + len(logs) // 2 - longer.size // 2
    own = longer._replace(centre=longer.centre + longer.spacing * middle)
    retained = Message.of(logs, own, longer.spacing, result.error)
    errors = np.array([float(state.error) for state in before[len(before) - completed.number + 1 :]])
    centres = centres[len(centres) - completed.number + 1 :]
    infos = _infos(prepared, window, centres, errors, completed.products[1:], reports[1:])
    return BackwardSegment(retained, completed.number, infos)


def _before(states: Sequence[State], window: lw.Window) -> tuple[lb.Filtered, Array]:
    """Return the filter's densities on grids of one spacing and size, and the centres of these."""
    own, values = states[0].window, np.array([state.values for state in states])
    floors = SURE_OF_DENSITY * np.exp(np.minimum([float(state.log_floor) for state in states], LOWEST))
    centres = np.array([state.centre for state in states])
    if (own.spacing, own.size) != (window.spacing, window.size) or (len(states) == 1 and own != window):
        values, centres = np.array([lw.resampled(one, own, window) for one in values]), np.full(len(states), window.centre)
    return lb.Filtered(values, np.round((centres - window.centre) / window.spacing).astype(int), floors), centres


def log_likelihoods(prepared: Prepared, here: slice, observed: Array, points: Array) -> Array:
    """Return the log-likelihoods of what is observed at the ends of intervals at points (K, N), or (1, N), zero for none."""
    system, logs = prepared.system, np.zeros((len(observed), points.shape[1]), prepared.theta.dtype)
    at_end = prepared.schedule.seen[here] & ~prepared.inside[here]
    if system.general or (at_end.any() and system.separated is None):
        for i in np.flatnonzero(at_end.any(axis=1)):
            logs[i] = factor_at_end(prepared, here.start + i, at_end[i], observed[i], None).logs(points[i % len(points)])
    elif at_end.any():
        c, stops = prepared.coefficients, prepared.schedule.stops[here, None]
        rest = observed[:, None] - system.observation(points[..., None], stops, prepared.theta)
        rest = np.where(np.abs(rest) < 1e150, rest, 1e150)
        logs = c.constants[here, None] - 0.5 * np.einsum("kni,kij,knj->kn", rest, c.precisions[here, 0], rest)
    return np.where(logs.real > -1e8, logs, -1e8)


def _shared(state: State, after: lw.Window, message: Message, product: Array, grid: lw.Window) -> list[lw.Window]:
    """Return the grids that may serve for all of an interval: those before and after it, and finer ones."""
    own = state.window
    first, last = support(np.ascontiguousarray(state.values.real), lw.CUT)
    low, high = min(own.offsets[first], message.ends[0]), max(own.offsets[last], message.ends[1])
    result = []
    for window in sorted({own, after}, key=lambda window: window.spacing, reverse=True):
        if _holds(window, low, high):
            on_it = lw.resampled(product, grid, window)
            whole = abs(float(np.sum(on_it)) - 1.0) <= lb.UNRESOLVED  # or it lies between the points
            result += [window] if whole and lw.grid_check(on_it, window.closed).aliasing <= lb.UNRESOLVED else []
    return result


def _holds(window: lw.Window, low: float, high: float) -> bool:
    """Return whether a grid holds what is between two offsets."""
    first, last = window.offsets[[0, -1]] + 0.01 * window.spacing * np.array([-1.0, 1.0])
    return bool(window.closed or first <= low <= high <= last)


def _on(message: Message, window: lw.Window, start: int, product: Array) -> lb.Message:
    """Return a message on a grid."""
    offsets, size = window.offsets, window.size
    first, last = 0, size - 1
    if not window.closed:
        first = int(np.searchsorted(offsets, message.ends[0] - 1e-6 * window.spacing))
        last = int(np.searchsorted(offsets, message.ends[1] + 1e-6 * window.spacing)) - 1
    logs = np.full(size, -np.inf)
    logs[first : last + 1] = message.at(offsets[first : last + 1])
    scale = float(np.max(logs))
    return lb.Message(np.exp(logs - scale), scale, first, last, start, message.error, product)


def _psi(message: Message, window: lw.Window, gauge: Array, product: Array) -> lb.Message:
    """Return psi = F e^s b of a message on a grid."""
    logs = message.at(window.offsets) + gauge
    scale = float(np.max(logs))
    values = np.exp(logs - scale)
    if not window.closed:
        values = values * taper(window.offsets, message.ends, window.spacing)
    return lb.Message(values, scale, 0, window.size - 1, 0, message.error, product)


def _longer(prepared: Prepared, window: lw.Window, stride: int, length: float) -> lw.Window:
    """Return the grid, with so many points in a spacing, that holds the paths around another one and the fall of F beyond."""
    if window.closed:
        return window._replace(size=window.size * stride, spacing=window.spacing / stride)
    spacing = window.spacing / stride
    covariance = covariance_at(prepared.system, window.points, prepared.model.start, prepared.theta.real)
    reach = EXCURSION * float(np.sqrt(np.max(covariance) * length)) / spacing
    reach = PAD + 2.0 ** (1.0 + 2.0 * np.ceil(0.5 * np.log2(np.clip(reach, 8.0, lw.LARGE) / 2.0)))
    begin = stride * _first(window)
    low = int(SPACINGS_APART * np.floor((begin - reach) / SPACINGS_APART))
    size = int(SPACINGS_APART * np.ceil((begin + stride * window.size + reach) / SPACINGS_APART)) - low
    return window._replace(centre=spacing * (low + size // 2), size=size, spacing=spacing)


def _first(window: lw.Window) -> int:
    """Return the number of the first point of a grid, which is zero at the origin."""
    return round(window.centre / window.spacing) - window.size // 2


def _place(window: lw.Window, longer: lw.Window, stride: int) -> int:
    """Return which point of the longer grid is the first of the other one."""
    return 0 if window.closed else stride * _first(window) - _first(longer)


def _infos(prepared: Prepared, window: lw.Window, centres: Array, own: Array, products: Array, reports: Array) -> Infos:
    """Return what is reported of smoothed densities, from the errors of the filter and those of the message."""
    mean = window.origin + centres + window.spacing * reports[:, lb.MEAN_AT]
    variance = window.spacing**2 * reports[:, lb.VARIANCE]
    if prepared.model.domain:
        grids = [window._replace(centre=centre) for centre in centres]
        pairs = [state_moments(prepared, *pair, 0.0, 0.0) for pair in zip(products, grids, strict=True)]
        mean, variance = (np.array([pair[i] for pair in pairs]) for i in range(2))
    errors = reports[:, lb.ERROR]
    health = {
        "error_estimate": errors + own,
        "tolerance_ratio": errors / smoothing_tolerance(prepared),
        "edge_mass": reports[:, lb.EDGE],
        "negative_mass": np.zeros(len(own)),
        "aliasing": reports[:, lb.ALIASING],
        "std_in_spacings": np.sqrt(reports[:, lb.VARIANCE]),
    }
    return Infos(reports[:, lb.LOG_MASS], mean[:, None], variance[:, None, None], health)
