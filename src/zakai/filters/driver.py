"""The driver: one call from a model and a record to the posterior."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import jax
import jax.numpy as jnp
import numpy as np

from zakai import (
    _float64,  # noqa: F401
    _registry,
)
from zakai.algebra.conditions import Condition, all_hold
from zakai.densities import Density
from zakai.errors import ConditionError, InputError
from zakai.filters._protocol import Info, Method
from zakai.filters.observations import data_of, schedule_of
from zakai.filters.results import FilterResult, versions
from zakai.models.checks import check_noise_at
from zakai.models.model import Model
from zakai.models.numeric import explain_nonfinite
from zakai.records import Record

CHUNK = 4096  # intervals that are prepared at once
RUN = 256  # intervals between two looks at the lattice
TRIES = 12
KEPT_BYTES = 512 * 2**20


def filter(
    model: Model,
    record: Record,
    method: str = "auto",
    *,
    keep: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> FilterResult:
    """The conditional density of the state given the record, at every time of the record.

    model: what the system is, with a prior. record: K observations of its kind. method: a method's name, or "auto", the
    first that holds for this system. keep: "densities", "moments", or None: densities up to 512 MiB. progress: called with
    the number of observations done and K. options: those of the method.

    Raises InputError for a wrong record or option, ConditionError if the method's theorem does not hold.

    Example:

        model = zakai.load_model("gallery:spiral-sensor")
        truth, record = zakai.simulate(model, np.arange(0.01, 1.0, 0.01))
        result = zakai.filter(model, record)
        result.mean[-1], result.density(-1).quantile([0.025, 0.975])
    """
    for given, kind, how in ((model, Model, "zakai.load_model"), (record, Record, "zakai.read_record")):
        if not isinstance(given, kind):
            raise InputError(f"filter: expected a {kind.__name__}, got a {type(given).__name__}; {how} reads one from a file")
    return _filter(model, record, model.prior, method, keep, progress, options)


def filter_from(prior: Any, model: Model, record: Record, method: str = "auto", **options: Any) -> FilterResult:
    """`filter` with another prior than the model's, moments only: many runs of one system are then compiled once.

    The result has no model, since none has this prior; the method is chosen for the model's own.
    """
    result = _filter(model, record, prior, method, "moments", None, options)
    result.model = None
    return result


def _filter(model, record, prior, method, keep, progress, options) -> FilterResult:
    _check(model, record, keep)
    chosen, why, considered = choose(model, method)
    unknown = set(options) - set(chosen.options)
    if unknown:
        listed = ", ".join(sorted(chosen.options)) or "none"
        raise InputError(f'{chosen.name} has no option "{sorted(unknown)[0]}"; its options are: {listed}')
    check_noise_at(model, np.concatenate([[model.start], record.times]))
    run = _Run(model, record, prior, chosen, {**chosen.options, **options}, keep)
    run.all(progress)
    return run.result(why, considered)


def choose(model: Model, method: str) -> tuple[Method, str, Mapping[str, tuple[Condition, ...]]]:
    """The method of that name, or the first that holds; why; and the conditions of every method that was looked at."""
    if method != "auto":
        chosen = _registry.load(method)
        conditions = chosen.theorem(model)
        if all_hold(conditions) is not True:
            raise ConditionError(f"{model.source}: {chosen.name} does not hold: {_failure(conditions)}")
        return chosen, "asked for by name, and every assumption of its theorem holds", {method: conditions}
    considered: dict[str, tuple[Condition, ...]] = {}
    for name in _registry.AUTO:
        candidate = _registry.load(name)
        considered[name] = candidate.theorem(model)
        if all_hold(considered[name]) is True:
            return candidate, "the first method whose every assumption holds for this system", considered
    reasons = "; ".join(f"{name}: {_failure(conditions)}" for name, conditions in considered.items())
    raise ConditionError(
        f"{model.source}: no method holds for this system ({reasons}); "
        "`extended-kalman-bucy` approximates it if it is named"
    )


def _failure(conditions: tuple[Condition, ...]) -> str:
    for condition in sorted(conditions, key=lambda c: c.holds is None):
        if condition.holds is not True:
            verb = "it fails that" if condition.holds is False else "it is undecided whether"
            return f"{verb} {condition.statement} ({condition.evidence}) [{condition.source}]"
    return "nothing failed"


def _check(model: Model, record: Record, keep: str | None) -> None:
    if keep not in (None, "densities", "moments"):
        raise InputError(f'keep: "{keep}" is neither "densities" nor "moments"')
    if model.prior is None:
        raise InputError(f"{model.source}: prior: the table is missing; it is needed to filter")
    if model.functions:
        raise InputError(f"{model.source}: functions: a model with undetermined functions can be analysed and not filtered")
    if record.kind != model.observation_kind:
        raise InputError(
            f"record: its kind is {record.kind}, but {model.source} observes {model.observation_kind} (observation_kind)"
        )
    if record.values.shape[1] != model.m:
        raise InputError(
            f"record: it has {record.values.shape[1]} columns of observations, but {model.source} has {model.m}"
        )
    first = record.times[0]
    if first < model.start or (first == model.start and record.kind != "samples"):
        raise InputError(f"record: row 1: time {first:g} is not after the start {model.start:g} of {model.source}")


_PREPARED: WeakKeyDictionary[Model, OrderedDict[Any, Any]] = WeakKeyDictionary()


def _prepared(method: Method, model: Model, schedule: Any, options: Mapping[str, Any]) -> Any:
    """`prepare`, remembered for the last schedules of each model."""
    kept = _PREPARED.setdefault(model, OrderedDict())
    key = (method.name, tuple(sorted(options.items())), *(np.ascontiguousarray(a).tobytes() for a in schedule))
    if key not in kept:
        kept[key] = method.prepare(model, schedule, **options)
        while len(kept) > 4:
            kept.popitem(last=False)
    kept.move_to_end(key)
    return kept[key]


@partial(jax.jit, static_argnums=(0, 4))
def _scan(step, state, intervals, observations, keep):
    def one(carry, slices):
        new, info = step(slices[0], carry, slices[1])
        return new, (info, getattr(new, "kept", new) if keep else None)

    slices = (intervals, observations)
    head = jax.tree.map(lambda a: a[0], slices)
    if jax.eval_shape(one, state, head)[0] == jax.eval_shape(lambda s: s, state):
        return jax.lax.scan(one, state, slices)
    # The first step changes the size of the lattice; a scan cannot.
    state, first = one(state, head)
    state, rest = jax.lax.scan(one, state, jax.tree.map(lambda a: a[1:], slices))
    return state, jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)


def _rows(tree: Any, rows: slice, length: int) -> Any:
    """Some rows of every array of a pytree, the last one repeated to `length`: one shape, one compilation."""

    def cut(array):
        part = np.asarray(array)[rows]
        missing = length - len(part)
        return part if missing == 0 else np.concatenate([part, np.repeat(part[-1:], missing, axis=0)])

    return jax.tree.map(cut, tree)


class _Run:
    """One record on its way through one method."""

    def __init__(
        self, model: Model, record: Record, prior: Any, method: Method, options: Mapping[str, Any], keep: str | None
    ):
        self.model, self.record, self.prior, self.method, self.options = model, record, prior, method, options
        self.data = data_of(model, record)
        self.infos: list[Info] = []
        self.notes: dict[str, None] = {}
        self.states: list[tuple[int, Any, Any]] = []
        self.keep, self.must_keep = keep != "moments", keep == "densities"
        self.bytes = 0
        self.done = 0

    def all(self, progress: Callable[[int, int], None] | None) -> None:
        """Filter the whole record, chunk by chunk."""
        count = len(self.record.times)
        at_start = self.data.stops[0] == self.model.start
        state = self._start(at_start)
        self.done = 1 if at_start else 0
        while self.done < count:
            rows = slice(self.done, min(self.done + CHUNK, count))
            data = self.data.part(rows)
            schedule = schedule_of(data, True)
            prepared = _prepared(self.method, self.model, schedule, self.options)
            self.notes.update(dict.fromkeys(getattr(prepared, "notes", ())))
            observations = self.method.observations(prepared, data)
            while self.done < rows.stop:
                state = self._run(prepared, state, observations, self.done - rows.start, rows)
                if progress is not None:
                    progress(self.done, count)

    def _start(self, at_start: bool) -> Any:
        data = self.data.part(slice(0, 1))
        schedule = schedule_of(data, True)
        if not at_start:
            prepared = _prepared(self.method, self.model, schedule, self.options)
            state = self.method.init(prepared, self.prior)
            self._keep_one(prepared, state, 0)
            return state
        # A sample at the start itself: the interval has no length, so the first one that has stands in for it.
        after = self.data.part(slice(1, 2)) if len(self.record.times) > 1 else data._replace(stops=data.stops + 1.0)
        prepared = _prepared(self.method, self.model, schedule_of(after, True), self.options)
        self._keep_one(prepared, self.method.init(prepared, self.prior), 0)
        observation = self.method.observations(prepared, data)
        state, info = self.method.correct(prepared, self.prior, observation)
        self.infos.append(jax.tree.map(lambda a: np.asarray(a)[None], info))
        self._keep_one(prepared, state, 1)
        return state

    def _keep_one(self, prepared: Any, state: Any, index: int) -> None:
        if self.keep:
            self.states.append((index, prepared, jax.tree.map(lambda a: np.asarray(a)[None], getattr(state, "kept", state))))

    def _run(self, prepared: Any, state: Any, observations: Any, first: int, rows: slice) -> Any:
        """A run of steps from one look at the lattice to the next, tried until its health is good."""
        run = getattr(state, "run_length", RUN)
        count = min(run, rows.stop - rows.start - first)
        # A short rest is padded to a power of two: few shapes, few compilations.
        length = run if run <= 64 or 2 * count > run else max(16, 2 ** int(np.ceil(np.log2(count))))
        part = slice(first, first + count)
        intervals = _rows(prepared.intervals, part, length)
        given = _rows(observations, part, length)
        adapt = self.method.adapt
        begin = adapt(prepared, state, part, None) if adapt else state
        for _ in range(TRIES):
            end, (info, kept) = _scan(self.method.step, begin, intervals, given, self.keep)
            info = jax.tree.map(lambda a, n=count: np.asarray(a)[:n], info)
            again = adapt(prepared, begin, part, info) if adapt else None
            if again is None:
                break
            begin = again
        self._explain(prepared, info, begin)
        self.infos.append(info)
        if self.keep:
            kept = jax.tree.map(lambda a: np.asarray(a)[:count], kept)
            self.states.append((self.done + 1, prepared, kept))
            self.bytes += sum(leaf.nbytes for leaf in jax.tree.leaves(kept))
            if self.bytes > KEPT_BYTES and not self.must_keep:
                self.keep, self.states = False, []
        self.done += count
        return end

    def _explain(self, prepared: Any, info: Info, begin: Any) -> None:
        """A number that does not exist is said with the formula and the state at which it was met."""
        bad = ~np.isfinite(info.log_likelihood_increment)
        if not bad.any():
            return
        k = int(np.argmax(bad))
        time = float(self.data.stops[self.done + k])
        theta = self.model.theta()
        lattice = getattr(begin, "lattice", None)
        points = np.asarray(lattice.points()).reshape(-1, self.model.n) if lattice is not None else info.mean[:k]
        # Where a mean has itself overflowed, no formula is to blame.
        points = points[np.isfinite(points).all(axis=-1)]
        from zakai.models.numeric import numpy_function

        for key in ("drift", "observation"):
            values = numpy_function(getattr(self.model, key), self.model)(points, time, theta)
            wrong = ~np.isfinite(values).all(axis=-1)
            if wrong.any():
                said = explain_nonfinite(self.model, key, getattr(self.model, key), points[wrong][0], time)
                raise InputError(f"{self.model.source}: {said}, which the density reaches")

    def result(self, why: str, considered: Mapping[str, tuple[Condition, ...]]) -> FilterResult:
        """Everything put together."""
        if self.states:
            first = self.density(0)
        else:
            prepared = _prepared(self.method, self.model, schedule_of(self.data.part(slice(0, 1)), True), self.options)
            first = self.method.density(prepared, self.method.init(prepared, self.prior))
        joined = jax.tree.map(lambda *parts: np.concatenate(parts), *self.infos)
        increments = np.concatenate([[0.0], joined.log_likelihood_increment])
        health = {name: np.concatenate([[np.nan], values]) for name, values in joined.health.items()}
        result = FilterResult(
            times=np.concatenate([[self.model.start], self.record.times]),
            mean=np.concatenate([first.mean()[None], joined.mean]),
            cov=np.concatenate([first.cov()[None], joined.cov]),
            log_likelihood_increments=increments,
            health=health,
            warnings=[],
            method=self.method.name,
            why=why,
            model=self.model,
            record=self.record,
            conditions=considered,
            bounds=self.method.bounds,
            state=self.model.state,
            attributes={"source": self.method.source, "exactness": self.method.exactness, **versions()},
            _density=self.density if self.states else None,
            _no_density=(
                f"the densities of {len(self.record.times)} steps were not kept: they need more than "
                f'{KEPT_BYTES // 2**20} MiB; keep="densities" keeps them all'
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
                return self.method.density(prepared, state)
        raise IndexError(index)


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
