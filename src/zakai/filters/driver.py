"""The driver: one call from a model and a record to the posterior."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from typing import Any, overload

import numpy as np

from zakai import _registry
from zakai.algebra.conditions import Condition, all_hold
from zakai.errors import ConditionError, InputError
from zakai.filters._protocol import Method
from zakai.filters._run import KEPT_BYTES, Run, Setting
from zakai.filters.batches import filter_all
from zakai.filters.results import FilterResult
from zakai.models._errors import named
from zakai.models.checks import check_noise_at, check_noise_within
from zakai.models.model import Model
from zakai.records import Record


@overload
def filter(
    model: Model,
    record: Record,
    method: str = ...,
    *,
    keep: str | None = ...,
    progress: Callable[[int, int], None] | None = ...,
    **options: Any,
) -> FilterResult: ...
@overload
def filter(
    model: Model,
    record: Sequence[Record],
    method: str = ...,
    *,
    keep: str | None = ...,
    progress: Callable[[int, int], None] | None = ...,
    **options: Any,
) -> list[FilterResult]: ...
def filter(model, record, method="auto", *, keep=None, progress=None, **options):
    """The conditional density of the state given the record, at every time of the record.

    model: what the system is, with a prior. record: K observations of its kind, or a list of records, each of which is
    filtered by itself; those with the same times and gaps are then filtered side by side, in less time than one by one.
    method: a method's name, or "auto", the first that holds for this system. keep: "densities", "moments", or None: densities
    up to 512 MiB in all. progress: called with the number of observations done and K. options: those of the method.

    Gives a FilterResult, or a list of them for a list. Raises InputError for a wrong record or option, ConditionError if the
    method's theorem does not hold.

    Example:

        model = zakai.load_model("gallery:spiral-sensor")
        truth, record = zakai.simulate(model, np.arange(0.01, 1.0, 0.01))
        result = zakai.filter(model, record)
        result.mean[-1], result.density(-1).quantile([0.025, 0.975])
    """
    return _filter(model, record, None, method, keep, progress, options)


@overload
def filter_from(prior: Any, model: Model, record: Record, method: str = ..., **options: Any) -> FilterResult: ...
@overload
def filter_from(
    prior: Sequence[Any], model: Model, record: Sequence[Record], method: str = ..., **options: Any
) -> list[FilterResult]: ...
def filter_from(prior, model, record, method="auto", **options):
    """`filter` with another prior than the model's, moments only: many runs of one system are then compiled once.

    For lists of equally many priors and records a list of results. A result has no model, since none has this prior; the
    method is chosen for the model's own.
    """
    results = _filter(model, record, prior, method, "moments", None, options)
    for result in results if isinstance(results, list) else [results]:
        result.model = None
    return results


def _filter(model, record, prior, method, keep, progress, options):
    if keep not in (None, "densities", "moments"):
        raise InputError(f'keep: "{keep}" is neither "densities" nor "moments"')
    if not isinstance(record, list | tuple):
        setting, why, considered = setting_of(model, record, method, options)
        run = Run(setting if prior is None else setting._replace(prior=prior), record, keep)
        run.all(progress)
        return run.result(why, considered)
    if not record:
        return []
    priors = [prior] * len(record) if not isinstance(prior, list | tuple) else prior
    if len(priors) != len(record):
        raise InputError(f"filter_from: {len(priors)} priors do not go with {len(record)} records; give one for each")
    setting, why, considered = setting_of(model, record, method, options)
    settings = [setting if own is None else setting._replace(prior=own) for own in priors]
    runs = [Run(own, one, keep, most=KEPT_BYTES / len(record)) for own, one in zip(settings, record)]
    filter_all(runs, progress)
    return [run.result(why, considered) for run in runs]


def setting_of(
    model: Model, record: Record | Sequence[Record], method: str, options: Mapping[str, Any]
) -> tuple[Setting, str, Mapping[str, tuple[Condition, ...]]]:
    """What records are filtered by, all of it checked; why; and the conditions of every method that was looked at."""
    records: list[Any] = list(record) if isinstance(record, list | tuple) else [record]
    times: dict[bytes, np.ndarray] = {}
    for index, one in enumerate(records):
        for given, kind, how in ((model, Model, "zakai.load_model"), (one, Record, "zakai.read_record")):
            if not isinstance(given, kind):
                raise InputError(f"filter: expected a {kind.__name__}, got a {type(given).__name__}; {how} reads one from a file")
        with named(f"records[{index}]") if isinstance(record, list | tuple) else nullcontext():
            _check(model, one)
        times[one.times.tobytes()] = one.times
    chosen, why, considered = choose(model, method)
    unknown = set(options) - set(chosen.options)
    if unknown:
        listed = ", ".join(sorted(chosen.options)) or "none"
        raise InputError(f'{chosen.name} has no option "{sorted(unknown)[0]}"; its options are: {listed}')
    together = np.unique(np.concatenate([[model.start], *times.values()]))
    check_noise_at(model, together)
    check_noise_within(model, together)
    return Setting(model, model.prior, chosen, {**chosen.options, **options}), why, considered


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


def _check(model: Model, record: Record) -> None:
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
