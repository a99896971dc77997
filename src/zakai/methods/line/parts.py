"""Filtering an interval of one state in parts: what is observed in each of them, and what they report together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from zakai.methods._protocol import Infos
from zakai.methods.line.prepared import Parts, Prepared, State
from zakai.numerics.line.density import support
from zakai.numerics.line.resolution import SUPPORT
from zakai.numerics.line.window import CUT, Window
from zakai.records.schedule import Schedule

WIDER = 2.0  # ranges of a density by which the noise of a part moves its ends
SUMS = ("time_error", "tolerance_ratio")  # figures of parts that add up

Segment = Callable[[Prepared, slice, State, np.ndarray], tuple[Sequence[State], Infos]]


def cut(parts: Parts, rows: slice, observed: np.ndarray) -> tuple[slice, np.ndarray, np.ndarray]:
    """Return the parts of some intervals, what is observed in them, and which ones are the last of their intervals."""
    prepared, first = parts.prepared, parts.first[rows.start : rows.stop + 1]
    assert prepared.shares is not None
    inner = slice(int(first[0]), int(first[-1]))
    own = np.where(prepared.inside[inner], prepared.shares[inner, None], 1.0)
    values = np.repeat(observed, np.diff(first), axis=0) * own
    return inner, np.where(prepared.schedule.seen[inner], values, 0.0), first[1:] - first[0] - 1


def segment_of_parts(parts: Parts, rows: slice, state: State, observed: np.ndarray, run: Segment) -> tuple[list[State], Infos]:
    """Return the states after the intervals of a slice, and their reports, by `run` for the parts."""
    inner, values, last = cut(parts, rows, observed)
    states, infos = run(parts.prepared, inner, state, values)
    begin = np.append(0, last[:-1] + 1)
    health = {
        name: figures[last] if name in ("error_estimate", "std_in_spacings")
        else (np.add if name in SUMS else np.fmax).reduceat(figures, begin)
        for name, figures in infos.health.items()
    }  # fmt: skip
    gained = np.add.reduceat(infos.log_likelihood_increment, begin)
    return [states[i] for i in last], Infos(gained, infos.mean[last], infos.cov[last], health)


def parts_of_step(prepared: Prepared, k: int, values: np.ndarray, window: Window) -> Parts | None:
    """Return the parts of interval k over which a density grows by a few times each, and its sample; None where it needs none.

    Args:
        prepared: a system whose transitions the compiled loop splits.
        k: an interval without increments inside.
        values, window: the density before it, and its grid.
    """
    start, stop, length = (float(part[k]) for part in (prepared.schedule.starts, prepared.schedule.stops, prepared.lengths))
    split = prepared.gaussian and prepared.divides and prepared.kernels is None and length > 0
    if prepared.cut_up or not split or window.closed or prepared.inside[k].any():
        return None
    if np.iscomplexobj(values) or np.iscomplexobj(prepared.theta):
        return None
    t = np.linspace(start, stop, 9)
    most = float(np.max(prepared.system.covariance(np.zeros((9, 1)), t, prepared.theta)[..., 0, 0]))
    first, last = support(np.ascontiguousarray(values), CUT)
    width, bounds = max(last - first, 1) * window.spacing, [start]
    while not most * (stop - bounds[-1]) <= (WIDER * width / SUPPORT) ** 2:
        bounds.append(bounds[-1] + (WIDER * width / SUPPORT) ** 2 / most)
        width *= 1.0 + 2.0 * WIDER
    count, schedule = len(bounds) + 1, prepared.schedule
    if count == 2 and not schedule.seen[k].any():
        return None
    seen = np.zeros((count, prepared.system.m), bool)
    seen[-1] = schedule.seen[k]
    starts, stops = np.array([*bounds, stop]), np.array([*bounds[1:], stop, stop])
    result = Schedule(starts, stops, seen, np.where(seen, schedule.elapsed[k], 0.0), schedule.inputs)
    shares = np.append(result.lengths[:-1] / length, 1.0)
    return Parts(prepared.over(result, shares, True), np.array([0, count]))
