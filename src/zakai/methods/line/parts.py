"""Intervals cut into parts: where few nodes do not resolve the coefficients, or where noise makes a density far wider.

The observation is linear in time within an interval, so that each part has its share of an increment; a sample, or an increment
that was gathered over more than the interval, belongs to the last part.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from zakai.methods._protocol import Infos
from zakai.methods.line.system import Parts, Prepared, State
from zakai.numerics.line.density import support
from zakai.numerics.line.window import CUT, Window
from zakai.records.schedule import Schedule, lengths_of

WIDER = 2.0  # ranges of a density by which the noise of a part moves its ends
REACH = 8.6  # standard deviations to the end of a density
ROUNDS = 2  # of cutting, after which what is not resolved is left to adaptive substeps
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


def segment_of_parts(
    parts: Parts, rows: slice, state: State, observed: np.ndarray, run: Segment
) -> tuple[list[State], Infos]:
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


def parts_of(prepared: Prepared) -> Parts | None:
    """Return the parts of the intervals of a schedule, None where no interval needs any."""
    if not prepared.timed or prepared.kernels is not None or np.iscomplexobj(prepared.theta):
        return None
    found, owner = prepared, np.arange(len(prepared.schedule))
    for _ in range(ROUNDS):
        schedule = found.schedule
        needed = np.where(found.lengths > 0, found.coefficients.parts, 1)
        if not (needed > 1).any():
            break
        bounds = [_bounds(found, k, n) if n > 1 else [schedule.starts[k]] for k, n in enumerate(needed)]
        counts = np.array([len(bound) for bound in bounds])
        starts = np.concatenate(bounds)
        stops = np.append(starts[1:], schedule.stops[-1])
        ends = np.cumsum(counts) - 1
        stops[ends] = schedule.stops
        parent = np.repeat(np.arange(len(schedule)), counts)
        last = np.zeros(len(starts), bool)
        last[ends] = True
        whole, inside = lengths_of(starts, stops)[:, None], found.inside[parent]
        seen = schedule.seen[parent] & (inside | last[:, None])
        elapsed = np.where(inside, whole, np.where(seen, schedule.elapsed[parent], 0.0))
        schedule = Schedule(starts, stops, seen, elapsed, schedule.inputs)
        found = replace(found, schedule=schedule, lengths=schedule.lengths, inside=schedule.inside)
        owner = owner[parent]
    if found is prepared:
        return None
    first = np.searchsorted(owner, np.arange(len(prepared.schedule) + 1))
    shares = np.where(found.lengths < prepared.lengths[owner], found.lengths / prepared.lengths[owner], 1.0)
    found.shares = shares
    return Parts(found, first)


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
    while not most * (stop - bounds[-1]) <= (WIDER * width / REACH) ** 2:
        bounds.append(bounds[-1] + (WIDER * width / REACH) ** 2 / most)
        width *= 1.0 + 2.0 * WIDER
    count, schedule = len(bounds) + 1, prepared.schedule
    if count == 2 and not schedule.seen[k].any():
        return None
    seen = np.zeros((count, prepared.system.m), bool)
    seen[-1] = schedule.seen[k]
    starts, stops = np.array([*bounds, stop]), np.array([*bounds[1:], stop, stop])
    found = Schedule(starts, stops, seen, np.where(seen, schedule.elapsed[k], 0.0), schedule.inputs)
    shares = np.append(found.lengths[:-1] / length, 1.0)
    own = replace(prepared, schedule=found, lengths=found.lengths, inside=found.inside, shares=shares, cut_up=True)
    return Parts(own, np.array([0, count]))


def _bounds(prepared: Prepared, k: int, count: int) -> list[Any]:
    """Return where the parts of an interval begin: where inputs have a jump or a kink, else in equal steps."""
    start, stop = float(prepared.schedule.starts[k]), float(prepared.schedule.stops[k])
    pieces = [first for first, _ in prepared.system.pieces(start, stop)]
    return pieces if len(pieces) > 1 else list(start + (stop - start) / count * np.arange(count))
