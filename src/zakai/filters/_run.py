"""One record on its way through one method: chunk by chunk what is prepared, run by run what is filtered."""

from __future__ import annotations

import math
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from threading import Lock
from types import MappingProxyType
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from zakai import _float64  # noqa: F401
from zakai.algebra.conditions import Condition
from zakai.densities import Density
from zakai.errors import InputError
from zakai.filters._protocol import Info, Method, Schedule
from zakai.filters.observations import Data, data_of, schedule_of
from zakai.filters.results import FilterResult, versions
from zakai.models.compile import jit_large, jit_loop
from zakai.models.model import Model
from zakai.models.numeric import explain_nonfinite, numpy_function
from zakai.records import Record

CHUNK = 4096  # intervals that are prepared at once, at most
CHUNK_BYTES = 512 * 2**20  # what is prepared for them, at most
RUN = 256  # intervals between two looks at the lattice
SOME = 16  # of them that are taken at once, where a method can
WHOLE = 16  # steps of a run that is taken together, of which some may be more than count, and what is told of them nothing
SHORT = 1 / 16  # of a run that is taken together: what is worth while
SETTLED = 16  # single steps of a run that are taken before a state is settled again
TRIES = 16
KEPT_BYTES = 512 * 2**20
SURELY = 3.0  # by how much a lattice of the first runs may be larger than those that follow
SMALL = 8192  # numbers in the largest array of a state, up to which its parts are not worth a thread

_PREPARED: WeakKeyDictionary[Model, OrderedDict[Any, Any]] = WeakKeyDictionary()
_LOCK = Lock()


def prepared_for(method: Method, model: Model, schedule: Any, options: Mapping[str, Any]) -> Any:
    """`prepare`, remembered for the last schedules of each model."""
    with _LOCK:
        kept = _PREPARED.setdefault(model, OrderedDict())
        key = (method.name, tuple(sorted(options.items())), *key_of(schedule))
        if key not in kept:
            kept[key] = method.prepare(model, schedule, **options)
            while len(kept) > 4 or (len(kept) > 1 and sum(size_of(one.intervals) for one in kept.values()) > 2 * CHUNK_BYTES):
                kept.popitem(last=False)
        kept.move_to_end(key)
        return kept[key]


def key_of(schedule: Schedule) -> tuple[bytes, ...]:
    """A schedule as the key of a dictionary."""
    return tuple(np.ascontiguousarray(a).tobytes() for a in schedule)


def size_of(tree: Any) -> int:
    """The bytes of all arrays of a pytree."""
    return sum(np.prod(np.shape(leaf), dtype=int) * 8 for leaf in jax.tree.leaves(tree))


def scanned(one: Callable[..., Any], state: Any, slices: Any) -> tuple[Any, Any]:
    """`lax.scan` of one(state, slice), whose first step alone may change the size of the state."""
    head = jax.tree.map(lambda a: a[0], slices)
    if jax.eval_shape(one, state, head)[0] == jax.eval_shape(lambda s: s, state):
        return jax.lax.scan(one, state, slices)
    state, first = one(state, head)
    state, rest = jax.lax.scan(one, state, jax.tree.map(lambda a: a[1:], slices))
    return state, jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)


class Scan:
    """A compiled function scan(step, healthy, state, intervals, observations, keep, limit), the first two and `keep` static; two
    threads may compile, but never the same.

    `lanes` says that states have a leading axis of records.
    """

    def __init__(self, function: Callable[..., Any], lanes: bool = False):
        self.function, self.lanes = function, lanes
        self.compiled: dict[Hashable, Callable[..., Any]] = {}
        self._compiling: defaultdict[Hashable, Lock] = defaultdict(Lock)

    @cached_property
    def _whole(self) -> Callable[..., Any]:
        return jit_large(self.function, (0, 1, 5))

    @cached_property
    def _part_by_part(self) -> Callable[..., Any]:
        return jit_loop(self.function, (0, 1, 5))

    def __call__(self, step: Any, healthy: Any, state: Any, intervals: Any, observations: Any, keep: bool, limit: Any) -> Any:
        key = step, healthy, keep, shape_of((state, intervals, observations))
        if (scan := self.compiled.get(key)) is not None:
            return scan(step, healthy, state, intervals, observations, keep, limit)
        with self._compiling[key]:
            small = max(math.prod(shape[self.lanes :]) for shape in shape_of(without_lasting(state))[1]) <= SMALL
            scan = self._part_by_part if small else self._whole
            result = scan(step, healthy, state, intervals, observations, keep, limit)
            self.compiled[key] = scan
        return result


def shape_of(tree: Any) -> tuple[Any, tuple[tuple[int, ...], ...]]:
    """The structure of a pytree and the shapes of its arrays."""
    return jax.tree.structure(tree), tuple(np.shape(leaf) for leaf in jax.tree.leaves(tree))


@Scan
def scan(step, healthy, state, intervals, observations, keep, limit):
    """Steps of a run: the last state; of every step its Info and, with `keep`, its state; and how many count.

    `limit` is how many steps count at most and, where `healthy` is given, whether the run ends before the first that is not well.
    """

    together = getattr(state, "together", None)
    if together is not None:
        return together(state, intervals, observations, keep, *limit)

    def told(states: Any, info: Info) -> Any:
        return info, getattr(states, "kept", states) if keep else None

    if (some := getattr(state, "some", None)) is not None:

        def of_some(state: Any, slices: Any) -> Any:
            states, info = some(slices[0], state, slices[1])
            return states, told(states, info)

        return taken_some(of_some, healthy, state, (intervals, observations), *limit)

    def one(carry: Any, slices: Any) -> Any:
        new, info = step(slices[0], carry, slices[1])
        return new, told(new, info)

    return taken(one, healthy, state, (intervals, observations), *limit)


def taken(one: Callable[..., Any], healthy: Callable[[Info], Any] | None, state: Any, slices: Any, most: Any, strict: Any) -> Any:
    """`scanned`, or where `healthy` is given the same up to the first step that is not well; with the number of steps."""
    if healthy is None:
        return *scanned(one, state, slices), most

    def at(k: Any) -> Any:
        return jax.tree.map(lambda a: a[k], slices)

    slices = jax.tree.map(jnp.asarray, slices)
    length = len(jax.tree.leaves(slices)[0])
    told = jax.tree.map(lambda a: np.zeros(a.shape), jax.eval_shape(one, state, at(0))[1])
    row, unravel = ravel_pytree(told)

    def go(carry: Any) -> Any:
        k, _, state, rows = carry
        new, told = one(state, at(k))
        well = jnp.all(healthy(told[0])) | jnp.logical_not(strict)
        state = jax.tree.map(lambda a, b: jnp.where(well, a, b), new, state)
        return k + well, well, state, rows.at[k].set(ravel_pytree(told)[0])

    # One array, for the compiler takes its time for each.
    start = jnp.zeros((), int), jnp.array(True), state, jnp.zeros((length, len(row)))
    k, _, state, rows = jax.lax.while_loop(lambda carry: carry[1] & (carry[0] < most), go, start)
    return state, jax.vmap(unravel)(rows), k


def taken_some(
    some: Callable[..., Any], healthy: Callable[[Info], Any], state: Any, slices: Any, most: Any, strict: Any, count: int = SOME
) -> Any:
    """`taken` by steps of which `count` are taken at once; what `some` gives has their number as its leading axis."""
    length = len(jax.tree.leaves(slices)[0])
    count = min(count, length)
    whole = jax.tree.map(lambda a: jnp.concatenate([a, jnp.repeat(a[-1:], -length % count, axis=0)]), slices)
    lasting = state

    def at(k: Any) -> Any:
        return jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, k, count), whole)

    def go(carry: Any) -> Any:
        k, _, state, rows = carry
        # What was not well ends the run, so that every block but the last begins where the one before ended.
        states, told = some(with_lasting(state, lasting), at(k))
        well = jnp.all(healthy(told[0]).reshape(count, -1), axis=1) | jnp.logical_not(strict)
        done = jnp.sum(jnp.cumprod(well & (k + np.arange(count) < most)))
        state = jax.tree.map(lambda a, b: jnp.where(done > 0, a[jnp.maximum(done, 1) - 1], b), without_lasting(states), state)
        rows = jax.tree.map(lambda a, b: jax.lax.dynamic_update_slice_in_dim(a, b, k, axis=0), rows, told)
        return k + done, done == count, state, rows

    told = jax.eval_shape(some, state, at(0))[1]
    rows = jax.tree.map(lambda a: jnp.zeros((length + -length % count, *a.shape[1:]), a.dtype), told)
    start = jnp.zeros((), int), jnp.array(True), without_lasting(state), rows
    k, _, state, rows = jax.lax.while_loop(lambda carry: carry[1] & (carry[0] < most), go, start)
    return with_lasting(state, lasting), rows, k


def without_lasting(state: Any) -> Any:
    """A state without what no step changes."""
    names = getattr(type(state), "LASTING", ())
    return replace(state, **dict.fromkeys(names)) if names else state


def with_lasting(state: Any, given: Any) -> Any:
    """A state with what no step changes as that which is `given` has it."""
    names = getattr(type(state), "LASTING", ())
    return replace(state, **{name: getattr(given, name) for name in names}) if names else state


def rows_of(tree: Any, rows: slice, length: int) -> Any:
    """Some rows of every array of a pytree, the last one repeated to `length`: one shape, one compilation."""

    def cut(array):
        part = np.asarray(array)[rows]
        missing = length - len(part)
        return part if missing == 0 else np.concatenate([part, np.repeat(part[-1:], missing, axis=0)])

    return jax.tree.map(cut, tree)


class Piece(NamedTuple):
    """A chunk of the record as it was filtered: what was prepared, its data, and for each run its rows and first state."""

    prepared: Any
    data: Data
    runs: list[tuple[slice, Any]]


class Setting(NamedTuple):
    """What is filtered by what: all but the record.

    `stored` is what was prepared before and kept: schedules with the method's Prepared, found by `key_of` the schedule.
    """

    model: Model
    prior: Any
    method: Method
    options: Mapping[str, Any]
    stored: Mapping[Any, tuple[Schedule, Any]] = MappingProxyType({})

    def prepared(self, data: Data) -> Any:
        """What the method prepares for the intervals of some data."""
        schedule = schedule_of(data, True)
        found = self.stored.get(key_of(schedule)) if self.stored else None
        return prepared_for(self.method, self.model, schedule, self.options) if found is None else found[1]

    def chunks(self, data: Data, first: int, lanes: int = 1) -> Iterator[slice]:
        """The rows that are prepared at once, from `first`, so that neither they nor `lanes` records of them fill the memory."""
        count = len(data.stops)
        if first == count:
            return
        one = size_of(self.prepared(data.part(slice(first, first + 1))).intervals)
        length = max(1, min(CHUNK, CHUNK_BYTES // max(one, 64 * lanes * self.model.m)))
        length = length // RUN * RUN or length
        for begin in range(first, count, length):
            yield slice(begin, min(begin + length, count))


def run_steps(method, adapt, scan, prepared, state, observations, rows: slice, ends: bool, keep: bool, enough: float = 0.25):
    """One run of steps from one look at the lattice to the next, tried until its health is good.

    `rows` are those of the chunk that are left; `ends` says that the record ends with them; a run that was well for the share
    `enough` of its steps ends there.  Gives the rows that were taken, the state they began with, the state they ended with, and
    what `scan` tells of each.
    """
    count, begin = 0, state
    while count < min(run := getattr(begin, "run_length", RUN), rows.stop - rows.start):
        count = min(run, rows.stop - rows.start)
        part = slice(rows.start, rows.start + count)
        begin = adapt(prepared, state, part, None) if adapt else state
    strict, shape = True, (0, False)
    for tries in range(TRIES + 2):
        run, together = getattr(begin, "run_length", RUN), getattr(begin, "together", None) is not None
        count = min(count, run)
        if shape != (shape := (_length(method, begin, count, run, ends), together)):
            some = slice(part.start, part.start + count)
            intervals = begin.needed(prepared.intervals) if together else prepared.intervals
            intervals, given = rows_of(intervals, some, shape[0]), rows_of(observations, some, shape[0])
        bare, most = getattr(begin, "bare", begin), min(count, getattr(begin, "worth_while", count))
        end, told, taken = scan(method.step, method.healthy, bare, intervals, given, keep, (most, strict))
        end, taken = as_planned(end, begin), int(taken)
        # The more was tried in vain, the less is enough.
        early = method.healthy is not None or (together and not scan.lanes)
        # Such a run has lost nothing by ending early but the time to begin the next.
        share = min(enough, SHORT) if together else enough
        if not strict or (early and taken >= max(1.0, share * most / 2**tries)):
            break
        info = first_of(told[0], min(taken + (begin.look if together else 1), most))
        tried = state.tried(begin) if hasattr(state, "tried") else begin
        again = adapt(prepared, tried, part, info) if adapt and tries < TRIES else None
        if again is None and (not early or getattr(adapt, "ill", False) or taken > 0):
            break
        # Where nothing better can be had the run is taken as it is, and its health says so; a short one, if it can be.
        begin, strict = (begin, False) if again is None else (again, True)
        count = min(count, 4 * begin.look) if together and not strict else count
    if not strict:
        # What comes after a number that does not exist is begun anew, from before it.
        there = _existing(told[0].log_likelihood_increment, taken)
        if 0 < there < taken:
            end, told, _ = scan(method.step, method.healthy, bare, intervals, given, keep, (there, strict))
            end, taken = as_planned(end, begin), there
    info, kept = first_of(told, taken)
    return slice(part.start, part.start + taken), begin, end, info, kept


def _length(method: Method, begin: Any, count: int, run: int, ends: bool) -> int:
    """What a scan of `count` steps is padded to: few shapes, few compilations."""
    if method.healthy is not None:
        return run  # it may end early
    if getattr(begin, "together", None) is not None and (ends or count % WHOLE == 0):
        return max(count, begin.run_length)
    short = run > 64 and 2 * count <= run
    return (max(16, 2 ** int(np.ceil(np.log2(count)))) if short else run) if ends else count


def as_planned(end: Any, begin: Any) -> Any:
    """The end of a run with what no step changes as it was at the beginning: on the device it would have to be fetched."""
    names = getattr(type(end), "PLANNED", ())
    return replace(end, **{name: getattr(begin, name) for name in names}) if names else end


def _existing(increments: Any, count: int) -> int:
    """How many steps of all records there are before a number that does not exist."""
    exist = np.isfinite(np.asarray(increments)[:count]).reshape(count, -1).all(axis=1)
    return count if exist.all() else int(np.argmin(exist))


def first_of(tree: Any, count: int) -> Any:
    """The first rows of every array of a pytree, copied: small pieces of memory of their own, not views of what JAX holds."""
    return jax.tree.map(lambda a: np.array(np.asarray(a)[:count]), tree)


class Run:
    """One record on its way through one method."""

    def __init__(self, setting: Setting, record: Record, keep: str | None, recorded: bool = False, most: float = KEPT_BYTES):
        self.setting, self.record, self.most = setting, record, most
        self.data = data_of(setting.model, record)
        self.infos: list[Info] = []
        self.notes: dict[str, None] = dict.fromkeys(_after_gaps(self.data))
        self.states: list[tuple[int, Any, Any]] = []
        self.keep, self.must_keep = keep != "moments", keep == "densities"
        self.pieces: list[Piece] | None = [] if recorded else None
        self.first: Any = None
        self.corrected: Any = None
        self.state: Any = None
        self.bytes = 0
        self.done = 0

    def all(self, progress: Callable[[int, int], None] | None, until: int | None = None) -> None:
        """Filter the whole record, or the first `until` of it, chunk by chunk."""
        method, count = self.setting.method, len(self.record.times)
        if self.state is None:
            self.start()
        # A run that goes on from where it was left finds the same chunks.
        for rows in self.setting.chunks(self.data, int(self.at_start)):
            stop = rows.stop if until is None else min(rows.stop, until)
            if stop <= self.done:
                continue
            data = self.data.part(rows)
            prepared = self.setting.prepared(data)
            observations = method.observations(prepared, data)
            if self.pieces is not None:
                self.pieces.append(Piece(prepared, data, []))
            while self.done < stop:
                left = slice(self.done - rows.start, stop - rows.start)
                part, begin, self.state, info, kept = run_steps(
                    method, method.adapt, scan, prepared, self.state, observations, left, rows.stop == count, self.keep
                )
                if self.pieces is not None:
                    self.pieces[-1].runs.append((part, begin if method.adapt else None))
                self.take(prepared, begin, info, kept)
                if progress is not None:
                    progress(self.done, count)

    def prepared(self) -> Iterator[tuple[Schedule, Any]]:
        """All that is prepared for the record, each with its schedule."""
        parts = [self._first_interval(), *(self.data.part(rows) for rows in self.setting.chunks(self.data, int(self.at_start)))]
        if len(parts) > 1:
            parts.append(parts[1].part(slice(0, 1)))  # by which the size of a chunk is chosen
        for data in parts:
            yield schedule_of(data, True), self.setting.prepared(data)

    def start(self, same: Run | None = None) -> None:
        """The first state: that of another run with the same prior, or the prior, after a sample at the start if there is one."""
        if same is not None:
            self.first, self.state, self.states = same.first, same.state, list(same.states)
            self.notes.update(dict.fromkeys(getattr(same.first, "notes", ())))
            return
        method, prior = self.setting.method, self.setting.prior
        self.first = prepared = self.setting.prepared(self._first_interval())
        self.state = method.init(prepared, prior)
        self.notes.update(dict.fromkeys(getattr(prepared, "notes", ())))
        self._keep_one(prepared, 0)
        if self.at_start:
            observation = method.observations(prepared, self.data.part(slice(0, 1)))
            self.state, info = method.correct(prepared, prior, observation)
            self.corrected = self.state
            self.infos.append(jax.tree.map(lambda a: np.asarray(a)[None], info))
            self._keep_one(prepared, 1)
            self.done = 1

    @property
    def at_start(self) -> bool:
        """Whether the first reading is a sample at the start itself."""
        return self.data.stops[0] == self.setting.model.start

    @property
    def alone(self) -> bool:
        """Whether the record had better be filtered by itself."""
        prepared, method = self._first_prepared, self.setting.method
        return prepared is not None and method.alone is not None and method.alone(prepared)

    @property
    def at_once(self) -> bool:
        """Whether many records had better be filtered one after another, each for a run of steps."""
        return getattr(self._first_prepared, "at_once", False)

    @property
    def _first_prepared(self) -> Any:
        rows = next(self.setting.chunks(self.data, int(self.at_start)), None)
        return None if rows is None else self.setting.prepared(self.data.part(rows))

    def _first_interval(self) -> Data:
        first = self.data.part(slice(0, 1))
        if not self.at_start:
            return first
        # The interval before a sample at the start has no length, so the first one that has stands in for it.
        return self.data.part(slice(1, 2)) if len(self.data.stops) > 1 else first._replace(stops=first.stops + 1.0)

    def _keep_one(self, prepared: Any, index: int) -> None:
        if self.keep:
            kept = getattr(self.state, "kept", self.state)
            self.states.append((index, prepared, jax.tree.map(lambda a: np.asarray(a)[None], kept)))

    def take(self, prepared: Any, begin: Any, info: Info, kept: Any) -> None:
        """Keep what a run of steps gave."""
        self.notes.update(dict.fromkeys(getattr(prepared, "notes", ())))
        self._explain(info, begin)
        self.infos.append(info)
        if self.keep:
            self.states.append((self.done + 1, prepared, kept))
            bytes_now = sum(leaf.nbytes for leaf in jax.tree.leaves(kept))
            self.bytes += bytes_now
            # What is surely not going to be kept to the end is not made either.
            left = len(self.record.times) - self.done - len(info.log_likelihood_increment)
            expected = self.bytes + left * bytes_now / len(info.log_likelihood_increment)
            if (self.bytes > self.most or expected > SURELY * self.most) and not self.must_keep:
                self.keep, self.states = False, []
        self.done += len(info.log_likelihood_increment)

    def _explain(self, info: Info, begin: Any) -> None:
        """A number that does not exist is said with the formula and the state at which it was met."""
        bad = ~np.isfinite(info.log_likelihood_increment)
        if not bad.any():
            return
        model = self.setting.model
        k = int(np.argmax(bad))
        time = float(self.data.stops[self.done + k])
        lattice = getattr(begin, "lattice", None)
        points = np.asarray(lattice.points()).reshape(-1, model.n) if lattice is not None else info.mean[:k]
        # Where a mean has itself overflowed, no formula is to blame.
        points = points[np.isfinite(points).all(axis=-1)]
        for key in ("drift", "observation"):
            values = numpy_function(getattr(model, key), model)(points, time, model.theta())
            wrong = ~np.isfinite(values).all(axis=-1)
            if wrong.any():
                said = explain_nonfinite(model, key, getattr(model, key), points[wrong][0], time)
                raise InputError(f"{model.source}: {said}, which the density reaches")

    def prior_moments(self) -> tuple[np.ndarray, np.ndarray]:
        """The mean (n,) and the covariance (n, n) at the start."""
        method = self.setting.method
        first = self.density(0) if self.states else method.density(self.first, method.init(self.first, self.setting.prior))
        return first.mean(), first.cov()

    def result(
        self,
        why: str,
        considered: Mapping[str, tuple[Condition, ...]],
        prior_moments: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> FilterResult:
        """Everything put together; the moments of a prior that many runs share need be found but once."""
        model, method = self.setting.model, self.setting.method
        first_mean, first_cov = self.prior_moments() if prior_moments is None else prior_moments
        joined = jax.tree.map(lambda *parts: np.concatenate(parts), *self.infos)
        increments = np.concatenate([[0.0], joined.log_likelihood_increment])
        health = {name: np.concatenate([[np.nan], values]) for name, values in joined.health.items()}
        cov = np.concatenate([first_cov[None], joined.cov])
        result = FilterResult(
            times=np.concatenate([[model.start], self.record.times]),
            mean=np.concatenate([first_mean[None], joined.mean]),
            variance=np.diagonal(cov, axis1=1, axis2=2),
            log_likelihood_increments=increments,
            health=health,
            warnings=[],
            method=method.name,
            why=why,
            model=model,
            record=self.record,
            conditions=considered,
            bounds=method.bounds,
            state=model.state,
            attributes={"source": method.source, "exactness": method.exactness, **versions()},
            _cov=cov,
            _density=self.density if self.states else None,
            _no_density=(
                f"the densities of {len(self.record.times)} steps were not kept: they need more than "
                f'{self.most / 2**20:.3g} MiB; keep="densities" keeps them all'
                if self.keep is False and self.bytes
                else 'the densities were not kept; keep="densities" keeps them'
            ),
        )
        result.warnings.extend([*self.notes, *_warnings(result)])
        return result

    def density(self, index: int) -> Density:
        """The density at an index of the result."""
        for first, prepared, states in reversed(self.states):
            if first <= index:
                state = jax.tree.map(lambda a: a[index - first], states)  # noqa: B023
                return self.setting.method.density(prepared, state)
        raise IndexError(index)


def _after_gaps(data: Data) -> list[str]:
    """A sentence where an increment was gathered over more than its interval."""
    late = np.any(data.elapsed > (1 + 1e-9) * (data.stops - data.starts)[:, None], axis=1)
    if not late.any():
        return []
    return [
        f"at {int(late.sum())} of {len(late)} times a path is read after a gap: the increment since the last reading of that "
        "coordinate acts as one factor at its end, which is exact only as the gaps shrink, and leaves aside what noise it has in "
        "common with other coordinates that were read in between"
    ]


def _warnings(result: FilterResult) -> list[str]:
    """A sentence for every bound that was not kept and for numbers that do not exist."""
    said = []
    bad = ~np.isfinite(result.log_likelihood_increments)
    if bad.any():
        time = result.times[np.argmax(bad)]
        said.append(f"the density was lost at t = {time:g}; nothing after that time is to be trusted")
    for name, (bound, what) in result.bounds.items():
        over = result.health[name] > bound
        if over.any():
            worst = int(np.nanargmax(np.where(over, result.health[name], -np.inf)))
            said.append(
                f"{name} exceeded {bound:g} at {int(over.sum())} of {len(over) - 1} times, most at t = "
                f"{result.times[worst]:g} ({result.health[name][worst]:.2g}): {what}"
            )
    return said
