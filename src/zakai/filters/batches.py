"""Many records at once: one compiled scan serves all of one model that were taken at the same times with the same gaps."""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import Lock
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.filters._run import (
    RUN,
    WHOLE,
    Run,
    Scan,
    as_planned,
    run_steps,
    shape_of,
    size_of,
    taken,
    taken_some,
    with_lasting,
    without_lasting,
)
from zakai.filters.observations import Data

LANES = 32  # records that are filtered by one scan, at most: one that asks for a large lattice slows no more than these
FEW_LANES = 8  # what a scan of few records is made for: two sizes, few compilations
LANE_BYTES = 256 * 2**20  # what they give in one run of steps, at most
WORTH_A_CORE = 16  # records
ENOUGH = 1 / 16  # the share of a run after which a look at all lattices costs less than wider ones
RUN_AT_ONCE = 1024  # steps of a record, where one record is filtered after another
ROUND = RUN  # observations after which many records are grouped anew
MANY = 4 * LANES  # records
HOLDS = 4.0  # deviations on each side of a mean that a lattice holds, about
WIDEST = 32.0  # deviations of the narrowest density from end to end of a lattice that many share
FEW_ILL = 0.25  # the share of the records of a scan that may leave it at once for a lattice of their own


class _Count:
    """How many observations are done, of all records together."""

    def __init__(self, progress: Callable[[int, int], None] | None, total: int):
        self.progress, self.total, self.done, self.lock = progress, total, 0, Lock()

    def add(self, steps: int) -> None:
        with self.lock:
            self.done += steps
            if self.progress is not None:
                self.progress(self.done, self.total)

    def of_one(self, last: int = 0) -> Callable[[int, int], None]:
        """The same as the progress of a single record, which counts from its own beginning; `last` of it are done."""

        def progress(done: int, _: int) -> None:
            nonlocal last
            self.add(done - last)
            last = done

        return progress


def filter_all(runs: Sequence[Run], progress: Callable[[int, int], None] | None) -> None:
    """Filter every record: those that can be together side by side, the others one by one.

    Groups go to the cores of the machine; the work is in compiled code, which leaves Python to the others.
    """
    count = _Count(progress, sum(len(run.record.times) for run in runs))
    alike = [_Alike(runs) for runs in _alike(runs)]
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        while left := [records for records in alike if not records.done]:
            groups = [group for records in left for group in records.groups()]
            for done in [pool.submit(_together, group, size, count, until) for group, size, until in groups]:
                done.result()


def _alike(runs: Sequence[Run]) -> Iterator[list[Run]]:
    """The records of one system, filtered by one method, that were taken at the same times with the same gaps."""
    found: dict[Hashable, list[Run]] = {}
    for run in runs:
        what = id(run.setting.model), run.setting.method.name
        key = (*what, run.record.times.tobytes(), np.isnan(run.record.values).tobytes())
        found.setdefault(key, []).append(run)
    yield from found.values()


class _Alike:
    """Records that can be filtered side by side.

    Where a method follows densities with lattices, many records are grouped anew after every `ROUND` observations, so that those
    whose densities are near each other share a lattice and no more parts of an interval are taken than they need.
    """

    def __init__(self, runs: list[Run]):
        self.runs, self.method = runs, runs[0].setting.method
        self.total = len(runs[0].record.times)
        first = None
        for run in runs:
            # Without a reading at the start, one prior gives one first state.
            run.start(first if first and not run.at_start and run.setting.prior is first.setting.prior else None)
            first = run
        self.alone, self.at_once = len(runs) > 1 and runs[0].alone, runs[0].at_once
        regrouped = self.method.adapt_many is not None and len(runs) > MANY and not self.alone
        self.round = ROUND if regrouped else self.total

    @property
    def done(self) -> bool:
        return all(run.done == self.total for run in self.runs)

    def groups(self) -> Iterator[tuple[list[Run], int, int]]:
        """What is filtered by one scan, how many records that scan is made for (few sizes, few compilations), and how far."""
        method = self.method
        starts: dict[Hashable, list[Run]] = {}
        for run in self.runs:
            beside = (method.adapt is None or method.adapt_many) and not self.alone
            if run.done < self.total:
                starts.setdefault((run.done, run.keep, shape_of(run.state)) if beside else id(run), []).append(run)
        for alike in starts.values():
            n = alike[0].setting.model.n
            each = 8 * (n * n + n + 16) + (size_of(alike[0].state) if alike[0].keep else 0)
            each *= RUN_AT_ONCE if self.at_once else RUN
            most = max(1, min(LANES, LANE_BYTES // each))
            if self.round < self.total:
                # Where one record is filtered after another those that are not there take no time.
                size = min(most, FEW_LANES if len(alike) <= FEW_LANES and not self.at_once else LANES)
            else:
                parts = max(-(-len(alike) // most), min(os.cpu_count() or 1, len(alike) // WORTH_A_CORE))
                size = -(-len(alike) // max(1, parts))
            until = min(self.total, alike[0].done // self.round * self.round + self.round)
            together = _near(alike, size) if alike[0].infos else (alike[k : k + size] for k in range(0, len(alike), size))
            yield from ((group, size, until) for group in together)


def _near(runs: list[Run], most: int) -> Iterator[list[Run]]:
    """Groups of records whose means are next to each other, as many as `most`.

    Densities in one state share a lattice: there no group is so wide that the narrowest of them would ask for many points.
    """
    order = sorted(runs, key=lambda run: run.infos[-1].mean[-1].tolist())
    group: list[Run] = []
    low, high, narrow = np.inf, -np.inf, np.inf
    for run in order:
        mean, deviation = run.infos[-1].mean[-1], np.sqrt(np.diagonal(run.infos[-1].cov[-1]))
        begin, end = mean - HOLDS * deviation, mean + HOLDS * deviation
        wide = np.maximum(high, end) - np.minimum(low, begin) > WIDEST * np.minimum(narrow, deviation)
        if group and (len(group) == most or (len(mean) == 1 and wide.all())):
            yield group
            group, low, high, narrow = [], np.inf, -np.inf, np.inf
        group.append(run)
        low, high, narrow = np.minimum(low, begin), np.maximum(high, end), np.minimum(narrow, deviation)
    yield group


def _together(runs: list[Run], lanes: int, count: _Count, until: int) -> None:
    """Filter a group of records as far as `until`, or farther if a run of steps is longer; a scan that is made for more `lanes`
    repeats the last of them.

    A record that alone asks for a larger lattice leaves the group and goes on by itself.
    """
    if lanes == 1:
        return runs[0].all(count.of_one(runs[0].done), until)
    setting, total = runs[0].setting, len(runs[0].record.times)
    method = setting.method
    states = [run.state for run in runs]
    alone: list[Run] = []
    for rows in setting.chunks(runs[0].data, int(runs[0].at_start), LANES):
        if rows.stop <= runs[0].done:
            continue
        prepared = setting.prepared(runs[0].data.part(rows))
        if getattr(prepared, "at_once", False) and _at_once(runs, lanes, prepared, rows, until, count):
            return
        given = _observations(method, prepared, [run.data.part(rows) for run in runs])
        together = None
        stop = min(rows.stop, until)
        while runs and runs[0].done < stop:
            left = slice(runs[0].done - rows.start, stop - rows.start)
            fill = lanes - len(runs)
            adapt, own = _Adapt(method, len(runs)), _own(states)
            together = _stacked([*given, *given[-1:] * fill], 1) if together is None else together
            part, begin, ends, info, kept = run_steps(
                method, adapt if method.adapt_many else None, _scan, prepared,
                _stacked([*own, *own[-1:] * fill], 0),
                together, left, rows.stop == total, runs[0].keep, ENOUGH,
            )  # fmt: skip
            begins, states = (_lanes(each, len(runs), 0) for each in _own([begin, ends]))
            told = zip(begins, *(_lanes(each, len(runs), 1) for each in (info, kept)), strict=True)
            for lane, (run, (first, *of_one)) in enumerate(zip(runs, told, strict=True)):
                if lane in adapt.ill:
                    run.state = first
                    alone.append(run)
                elif part.stop > part.start:
                    run.take(prepared, first, *of_one)
            if adapt.ill:
                well = [lane for lane in range(len(runs)) if lane not in adapt.ill]
                runs, given, states = ([each[i] for i in well] for each in (runs, given, states))
                together = None
            count.add(len(runs) * (part.stop - part.start))
        if not runs or stop == until:
            break
    for run, state in zip(runs, states, strict=True):
        run.state = state
    for run in alone:
        run.all(count.of_one(run.done), until)


def _at_once(runs: list[Run], lanes: int, prepared: Any, rows: slice, until: int, count: _Count) -> bool:
    """One run of steps of each record of a group, one after another, each as far as it is well; or nothing where such a run
    cannot be.  A record that has taken no step goes on by itself."""
    method, done = runs[0].setting.method, runs[0].done - rows.start
    assert method.adapt_many is not None and method.rule is not None
    filled = [*runs, *runs[-1:] * (lanes - len(runs))]
    states = _stacked(_own([run.state for run in filled]), 0)
    for stop in (done + RUN_AT_ONCE, until - rows.start):
        part = slice(done, min(rows.stop - rows.start, stop))
        begin = method.adapt_many(prepared, states, part, None)
        if begin is not None and begin.together is not None:
            break
    else:
        return False
    most, last = part.stop - done, rows.start + part.stop == len(runs[0].record.times)
    # What comes after the last row does not count: one shape, one compilation.
    length = RUN_AT_ONCE if last or most % WHOLE == 0 else most
    steps = np.minimum(np.arange(done, done + length), part.stop - 1)
    intervals, rule = jax.tree.map(
        lambda array: np.asarray(array)[steps], (begin.needed(prepared.intervals), method.rule(prepared, runs[0].data.part(rows)))
    )
    values = np.stack([run.data.part(rows).filled[steps] for run in filled])
    given = jax.tree.map(lambda all, one: np.broadcast_to(all, (lanes, *one.shape)), rule(values), rule(values[0]))
    ends, told, taken = _one_after_another(
        method.step, method.healthy, begin.bare, intervals, given, runs[0].keep, (most, len(runs))
    )
    begins, ends = (_lanes(without_lasting(each), len(runs), 0) for each in (begin, as_planned(ends, begin)))
    told, took = jax.tree.map(np.asarray, told), np.asarray(taken).tolist()
    for lane, (run, first, end) in enumerate(zip(runs, begins, ends, strict=True)):
        if took[lane] > 0:
            run.take(prepared, first, *jax.tree.map(lambda array: np.array(array[lane, : took[lane]]), told))  # noqa: B023
            run.state = end
            count.add(took[lane])
    for run, steps_taken in zip(runs, took, strict=False):
        if steps_taken == 0:
            run.all(count.of_one(run.done), rows.start + part.stop)
    return True


def _observations(method: Any, prepared: Any, data: Sequence[Data]) -> list[Any]:
    """What `step` is given for records with readings at the same times: all but the values is the same for all of them."""
    if method.rule is None:
        return [method.observations(prepared, one) for one in data]
    rule = method.rule(prepared, data[0])
    return [rule(one.filled) for one in data]


class _Adapt:
    """`adapt_many`, given what the scan tells with the records in front; `ill` are the few records that alone ask for more."""

    def __init__(self, method: Any, count: int):
        self.method, self.count, self.ill = method, count, frozenset[int]()

    def __call__(self, prepared, states, rows, info):
        method = self.method
        info = jax.tree.map(lambda a: np.swapaxes(a, 0, 1), info)
        again = method.adapt_many(prepared, states, rows, info)
        # A run that ends early loses nothing by a record that asks for more, unless there is no more for it.
        if info is None or (again is None) != (method.healthy is not None):
            return again
        if method.healthy is None:
            lanes = zip(*(_lanes(each, self.count, 0) for each in (*_own([states]), info)), strict=True)
            asks = [method.adapt(prepared, state, rows, told) is not None for state, told in lanes]
        else:
            asks = ~np.asarray(method.healthy(info)).all(axis=1)
        ill = [k for k in range(self.count) if asks[k]]
        if not 0 < len(ill) <= self.count * FEW_ILL:
            return again
        self.ill = frozenset(ill)
        return None


def _own(states: list[Any]) -> list[Any]:
    """States without what the records of a batch have in common; `adapt_many` gives it again."""
    return [without_lasting(state) for state in states]


def _stacked(trees: Sequence[Any], axis: int) -> Any:
    return jax.tree.map(lambda *arrays: np.stack([np.asarray(a) for a in arrays], axis=axis), *trees)


def _lanes(tree: Any, count: int, axis: int) -> list[Any]:
    """The first `count` records of a pytree, each by itself."""
    leaves, structure = jax.tree.flatten(tree)
    arrays = [np.moveaxis(np.asarray(leaf), axis, 0) for leaf in leaves]
    return [jax.tree.unflatten(structure, [array[lane] for array in arrays]) for lane in range(count)]


@partial(Scan, lanes=True)
def _one_after_another(step, healthy, states, intervals, observations, keep, limit):
    """Runs that fit near the processor gain nothing by others beside them.

    Gives the last states, what is told of each step and how many were taken, each with a leading axis of records.  A lane that
    but fills the scan, after the first `limit[1]`, takes no step.
    """

    def one(of: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
        lane, state, given = of
        most = jnp.where(lane < limit[1], limit[0], 0)
        end, told, taken = states.together(with_lasting(state, states), intervals, given, keep, most, True)
        return without_lasting(end), told, taken

    lanes = np.arange(len(jax.tree.leaves(observations)[0]))
    return jax.lax.map(one, (lanes, without_lasting(states), observations))


@partial(Scan, lanes=True)
def _scan(step, healthy, states, intervals, observations, keep, limit):
    if (some := getattr(states, "some", None)) is not None:

        # What the records have in common is there once.
        axes = jax.tree.map(lambda a: 0, without_lasting(states))

        def of_some(interval, state, observation):
            new, info = some(interval, state, observation)
            return without_lasting(new), (info, getattr(new, "kept", new) if keep else None)

        def lanes(carry, slices):
            return jax.vmap(of_some, (None, axes, 1), 1)(slices[0], carry, slices[1])

        return taken_some(lanes, healthy, states, (intervals, observations), *limit, 1)

    def one_record(interval, state, observation):
        new, info = step(interval, with_lasting(state, states), observation)
        return without_lasting(new), (info, getattr(new, "kept", new) if keep else None)

    def one(carry, slices):
        return jax.vmap(one_record, (None, 0, 0))(slices[0], carry, slices[1])

    return taken(one, healthy, without_lasting(states), (intervals, observations), *limit)
