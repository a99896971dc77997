"""The driver: one call from a model and a record to the posterior."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from typing import Any, overload

import numpy as np

from zakai.errors import InputError
from zakai.filters._plan import Plan, plan_of
from zakai.filters._run import KEPT_BYTES
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
    method: a method's name, or "auto", the first that holds for this system; a system that falls into independent blocks is
    filtered block by block, each by the best method for it. keep: "densities", "moments", or None: densities
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
    many = isinstance(record, list | tuple)
    if many and not record:
        return []
    records = list(record) if many else [record]
    priors = list(prior) if many and isinstance(prior, list | tuple) else [prior] * len(records)
    if len(priors) != len(records):
        raise InputError(f"filter_from: {len(priors)} priors do not go with {len(records)} records; give one for each")
    check_records(model, record)
    plans = {key: planned(model, own, method, options) for key, own in {id(own): own for own in priors}.items()}
    check_noise(plans.values(), records)
    results = filter_planned([plans[id(own)] for own in priors], records, keep, progress)
    return results if many else results[0]


def filter_planned(
    chosen: Sequence[Plan], records: Sequence[Record], keep: str | None, progress: Callable[[int, int], None] | None
) -> list[FilterResult]:
    """Every record by its plan, side by side."""
    if keep not in (None, "densities", "moments"):
        raise InputError(f'keep: "{keep}" is neither "densities" nor "moments"')
    runs = [plan.runs(one, keep, most=KEPT_BYTES / len(records)) for plan, one in zip(chosen, records, strict=True)]
    flat = [run for of_one in runs for run in of_one]
    if len(flat) == 1:
        flat[0].all(progress)
    else:
        filter_all(flat, None if progress is None else _per_record(progress, sum(map(len, records)), len(flat) / len(records)))
    results = []
    for plan, one, of_one in zip(chosen, records, runs, strict=True):
        results.append(plan.result(of_one))
        results[-1].record = one
    return results


def _per_record(progress: Callable[[int, int], None], total: int, blocks: float) -> Callable[[int, int], None]:
    """Progress that counts an observation once, not once for each block."""
    return lambda done, _: progress(min(total, int(done / blocks + 1e-6)), total)


def planned(model: Model, prior: Any, method: str, options: Mapping[str, Any], by_value: bool = True) -> Plan:
    """How a system is filtered from a prior, None being the model's own."""
    return plan_of(model, model.prior if prior is None else prior, method, options, by_value)


def check_noise(plans: Iterable[Plan], records: Sequence[Record]) -> None:
    """Raise InputError unless the noise of what is filtered is noise at the times of the records and between them."""
    times = {one.times.tobytes(): one.times for one in records}
    models = {id(setting.model): setting.model for plan in plans for setting in plan.settings}
    for part in models.values():
        together = np.unique(np.concatenate([[part.start], *times.values()]))
        check_noise_at(part, together)
        check_noise_within(part, together)


def check_records(model: Model, record: Record | Sequence[Record]) -> None:
    """Raise InputError unless the model and the record, or every record of a list, are such and go together."""
    records: list[Any] = list(record) if isinstance(record, list | tuple) else [record]
    for index, one in enumerate(records):
        for given, kind, how in ((model, Model, "zakai.load_model"), (one, Record, "zakai.read_record")):
            if not isinstance(given, kind):
                raise InputError(f"filter: expected a {kind.__name__}, got a {type(given).__name__}; {how} reads one from a file")
        with named(f"records[{index}]") if isinstance(record, list | tuple) else nullcontext():
            _check(model, one)


def check_model(model: Model) -> None:
    """Raise InputError unless the model is one that can be filtered."""
    if not isinstance(model, Model):
        raise InputError(f"expected a Model, got a {type(model).__name__}; zakai.load_model reads one from a file")
    if model.prior is None:
        raise InputError(f"{model.source}: prior: the table is missing; it is needed to filter")
    if model.functions:
        raise InputError(f"{model.source}: functions: a model with undetermined functions can be analysed and not filtered")


def _check(model: Model, record: Record) -> None:
    check_model(model)
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
