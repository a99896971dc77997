"""Whether the arrays of a state that was read from a file fit together, before a kernel receives them."""

from __future__ import annotations

import numpy as np

from zakai.methods.particles.islands import Islands
from zakai.methods.particles.programs import Array
from zakai.methods.particles.state import Prepared, State
from zakai.methods.particles.window import INTERVALS, Window
from zakai.numerics.particles.motion import UPDATE


def valid(prepared: Prepared, state: State) -> bool:
    """Return whether a state has the shapes and the indices that a step of this filter makes."""
    n, count = prepared.system.n, len(state.log_weights)
    shapes = state.particles.shape == (n, count) and state.shift.shape == (prepared.model.n,)
    shapes = shapes and state.last_shift.shape == state.last_scale.shape == (n,)
    control = state.control
    shapes = shapes and control.stages in (2, 4) and min(control.interval, control.trusted, control.rest, control.failed) >= 0
    return count > 0 and shapes and _window(prepared, state.window, count) and _islands(state.islands, count, prepared.model.n)


def _within(index: Array, count: int) -> bool:
    return bool(index.size == 0 or (index.min() >= 0 and index.max() < count))


def _islands(islands: Islands, count: int, n: int) -> bool:
    bounds, founders = islands.bounds, islands.founders
    if bounds.ndim != 1 or len(bounds) < 3 or bounds[0] != 0 or bounds[-1] != count or (np.diff(bounds) < 0).any():
        return False
    if islands.excess.shape != (n, n) or islands.age < 0 or islands.epoch < 0 or islands.first < 1:
        return False
    return founders.shape == (count,) and _within(founders, islands.first)


def _window(prepared: Prepared, window: Window, count: int) -> bool:
    system = prepared.system
    n, rows, width = system.n, system.r if system.kind else system.n, system.width
    if not 0 <= window.length <= INTERVALS or window.mean.shape != (n,) or window.root.ndim != 2:
        return False
    I = window.length
    if window.times.shape != (I,) or len(window.given) != I or len(window.counted) != I:
        return False
    later = count
    for k in reversed(range(I)):
        ancestors, noise, events = window.ancestors[k], window.noises[k], window.events[k]
        own = noise.shape[1]
        if len(ancestors) and (len(ancestors) != later or not _within(ancestors, own)) or not len(ancestors) and own != later:
            return False
        if window.ends[k].size and window.ends[k].shape != (n, own):
            return False
        E, J = len(events.times), len(events.rows)
        if events.times.shape != (E, 2) or events.places.shape != (E, 3) or events.given.shape != (E, 2, width):
            return False
        if events.roots.shape[:2] != (J, rows) or events.rows.shape != (J, 3) or events.spreads.shape != (E, n) or not E:
            return False
        places = events.places
        if not np.isin(places[:, 2], (UPDATE, 2, 4)).all():
            return False
        if places[:, 0].min() < -1 or places[:, 0].max() >= J or places[:, 1].min() < -1 or places[:, 1].max() > 0:
            return False
        first = np.cumsum(events.rows[:, 1:].sum(axis=1))
        if J and (events.rows.min() < 0 or events.rows[:, 1].max() > events.roots.shape[2]):
            return False
        if not np.array_equal(events.rows[:, 0], np.append(0, first)[:J]) or events.width != len(noise):
            return False
        later = own
    size = window.start.shape[1] if not len(window.first) else window.first.shape[1]
    starts = window.start.shape[0] == n and window.first.shape[0] in (0, window.root.shape[1])
    return starts and size == later and window.start.shape[1] == later
