"""The driver: one call from a model and a record to the posterior."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from typing import Any, overload

import numpy as np

from zakai._progress import Progress, announced
from zakai.engine.batch import filter_all
from zakai.engine.first_intervals import any_fault, first_intervals
from zakai.engine.loop import KEPT_BYTES
from zakai.engine.plan import Plan, plan_of
from zakai.engine.results import FilterResult
from zakai.engine.setting import Setting
from zakai.errors import InputError
from zakai.models._errors import named
from zakai.models.checks import check_noise_at, check_noise_within
from zakai.models.domain import check_prior
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.models.possible import check_possible
from zakai.models.prior import Prior
from zakai.records import Inputs, Record
from zakai.records.dates import dated


@overload
def filter(
    model: Model,
    record: Record,
    method: str = ...,
    *,
    inputs: Inputs | None = ...,
    keep: str | None = ...,
    progress: Progress | None = ...,
    **options: Any,
) -> FilterResult: ...
@overload
def filter(
    model: Model,
    record: Sequence[Record],
    method: str = ...,
    *,
    inputs: Inputs | Sequence[Inputs] | None = ...,
    keep: str | None = ...,
    progress: Progress | None = ...,
    **options: Any,
) -> list[FilterResult]: ...
def filter(
    model: Model,
    record: Record | Sequence[Record],
    method: str = "auto",
    *,
    inputs: Inputs | Sequence[Inputs] | None = None,
    keep: str | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> FilterResult | list[FilterResult]:
    """Return the conditional density of the state given the record, at every time of the record.

    Args:
        model: the system, with a prior.
        record: K observations of the model's kind, or a list of records, which are filtered on the threads of the machine.
        method: a method's name, or "auto", the first that holds for this system. A system that falls into independent blocks is
            filtered block by block, each by the best method for it.
        inputs: the known inputs of the model, in place of those of the record; for a list of records a list, or one for all.
        keep: "densities", "moments", or None: densities up to 512 MiB in all.
        progress: called with the number of observations done and K; without it long work has a bar on a terminal.
        **options: options of the method.

    Returns:
        A FilterResult, or a list of them for a list of records.

    Raises:
        InputError: a wrong record or option.
        ConditionError: the method's theorem does not hold.

    Example:
        model = zakai.load_model("gallery:spiral-sensor")
        truth, record = zakai.simulate(model, np.arange(0.01, 1.0, 0.01))
        result = zakai.filter(model, record)
        result.mean[-1], result.density(-1).quantile([0.025, 0.975])
    """
    return _filter(model, with_inputs(record, inputs), None, method, keep, progress, options)


@overload
def filter_from(prior: Prior, model: Model, record: Record, method: str = ..., **options: Any) -> FilterResult: ...
@overload
def filter_from(
    prior: Sequence[Prior], model: Model, record: Sequence[Record], method: str = ..., **options: Any
) -> list[FilterResult]: ...
def filter_from(
    prior: Prior | Sequence[Prior], model: Model, record: Record | Sequence[Record], method: str = "auto", **options: Any
) -> FilterResult | list[FilterResult]:
    """Return what `filter` returns for another prior than the model's, moments only.

    For lists of equally many priors and records a list of results. A result has no model, since none has this prior; the
    method is chosen for the model's own.
    """
    results = _filter(model, record, prior, method, "moments", None, options)
    for result in results if isinstance(results, list) else [results]:
        result.model = None
    return results


def _filter(
    model: Model,
    record: Record | Sequence[Record],
    prior: Prior | Sequence[Prior] | None,
    method: str,
    keep: str | None,
    progress: Progress | None,
    options: Mapping[str, Any],
) -> FilterResult | list[FilterResult]:
    many = isinstance(record, list | tuple)
    if many and not record:
        return []
    records = check_records(model, record)
    priors: list[Prior | None] = list(prior) if isinstance(prior, Sequence) else [prior] * len(records)
    if len(priors) != len(records):
        raise InputError(f"filter_from: {len(priors)} priors do not go with {len(records)} records; give one for each")
    found: dict[tuple[int, float, float, int], Plan] = {}
    plans = []
    for own, one in zip(priors, records, strict=True):
        first = first_intervals(model, one)
        key = id(own), first.first, first.typical, id(first.inputs)
        if key not in found:
            found[key] = planned(model, own, method, options, unfit=first.fault)
        plans.append(found[key])
    check_noise(found.values(), records)
    results = filter_planned(plans, records, keep, progress)
    if method == "auto":
        for index, (plan, own, one) in enumerate(zip(plans, priors, records, strict=True)):
            other = _instead(plan, own, one, results[index])
            if other is not None:
                again = filter_planned([other], [one], keep, progress)[0]
                results[index] = again if _lost(other, again) is None else results[index]
    return results if many else results[0]


def _instead(plan: Plan, prior: Prior | None, record: Record, result: FilterResult) -> Plan | None:
    """Return what "auto" takes for several coupled states where a method has lost their density, None where nothing is left."""
    time, name = _lost(plan, result), plan.method
    if time is None or plan.model.n == 1 or plan.division is not None:
        return None

    def lost(setting: Setting) -> str:
        return f"loses the density at t = {time:.12g}" if setting.method.name == name else ""

    _, options = plan.request
    other = planned(plan.model, prior, "auto", options, unfit=any_fault(lost, first_intervals(plan.model, record).fault))
    return None if other.method == name else other


def _lost(plan: Plan, result: FilterResult) -> float | None:
    """Return when a density was lost, None where it was not."""
    gone = ~(np.isfinite(result.log_likelihood_increments) & np.isfinite(result.mean).all(axis=1))
    for name, limit in plan.settings[0].method.losses.items():
        gone |= np.nan_to_num(result.health[name], nan=0.0) > limit if name in result.health else False
    return float(result.times[np.argmax(gone)]) if gone.any() else None


def filter_planned(
    plans: Sequence[Plan], records: Sequence[Record], keep: str | None, progress: Progress | None, warned: bool = True
) -> list[FilterResult]:
    """Return the result of every record by its plan; what only gives warnings is checked where it is `warned`."""
    if keep not in (None, "densities", "moments"):
        raise InputError(f'keep: "{keep}" is neither "densities" nor "moments"')
    runs = [plan.runs(one, keep, KEPT_BYTES / len(records)) for plan, one in zip(plans, records, strict=True)]
    flat = [run for of_one in runs for run in of_one]
    filter_all(flat, progress, len(flat) / len(records))
    results = []
    for plan, one, of_one in zip(plans, records, runs, strict=True):
        results.append(plan.result(of_one, warned))
        results[-1].record = one
        notes = [one._note] if one._note else []
        results[-1].warnings = dated([*notes, *results[-1].warnings], one.clock)
    return results


def planned(
    model: Model,
    prior: Prior | None,
    method: str,
    options: Mapping[str, Any],
    by_value: bool = True,
    unfit: Callable[[Setting], str] | None = None,
) -> Plan:
    """Return how a system is filtered from a prior; None stands for the model's own, and `unfit` is that of `plan_of`."""
    if prior is not None:
        check_prior(model, prior)
    decided: set[bool] = kept(model, (planned, str(method)), set)  # once made, a decision needs no thread
    with nullcontext() if decided else announced(f"{model.source}: deciding which method holds"):
        plan = plan_of(model, model.prior if prior is None else prior, method, options, by_value, unfit)
    decided.add(True)
    return plan


def check_noise(plans: Iterable[Plan], records: Sequence[Record]) -> None:
    """Raise InputError unless every noise is a covariance at the times of the records and between them."""
    times = {one.times.tobytes(): one.times for one in records}
    models = {id(setting.model): setting.model for plan in plans for setting in plan.settings}
    for part in models.values():
        together = np.unique(np.concatenate([[part.start], *times.values()]))
        check_noise_at(part, together)
        check_noise_within(part, together)


def with_inputs(record: Any, inputs: Any) -> Any:
    """Return a record with other inputs, or a list of records with those of a list, or with one for all; as it is for None."""
    if inputs is None:
        return record
    if not isinstance(record, list | tuple):
        return record.with_inputs(inputs) if isinstance(record, Record) else record
    every = list(inputs) if isinstance(inputs, list | tuple) else [inputs] * len(record)
    if len(every) != len(record):
        raise InputError(f"filter: {len(every)} inputs do not go with {len(record)} records; give one for each, or one for all")
    return [with_inputs(*pair) for pair in zip(record, every, strict=True)]


def check_records(model: Model, record: Record | Sequence[Record]) -> list[Record]:
    """Return the record, or the records of a list, with the kind and the order of the model's observations.

    Raises:
        InputError: the model and a record do not go together.
    """
    if isinstance(record, list | tuple) and record and not any(isinstance(one, Record) for one in record):
        what = f"a {type(record).__name__} of {type(record[0]).__name__}"
        raise InputError(f"filter: expected a Record or a list of them, got {what}; make one by zakai.Record(times, values)")
    records: list[Any] = list(record) if isinstance(record, list | tuple) else [record]
    found: list[Record] = []
    for index, one in enumerate(records):
        for given, kind, how in (
            (model, Model, "zakai.load_model reads one from a file"),
            (one, Record, "zakai.Record(times, values) makes one, zakai.read_record reads one from a file"),
        ):
            if not isinstance(given, kind):
                raise InputError(f"filter: expected a {kind.__name__}, got a {type(given).__name__}; {how}")
        with named(f"records[{index}]") if isinstance(record, list | tuple) else nullcontext():
            check_model(model)
            own = one.of(model)
            own.check(model)
            time = float(own.times[0])
            check_possible(model, time, None if own.inputs is None else own.inputs.at(time, model.input_hold))
        found.append(own)
    return found


def check_model(model: Model) -> None:
    """Raise InputError unless the model can be filtered."""
    if not isinstance(model, Model):
        raise InputError(f"expected a Model, got a {type(model).__name__}; zakai.load_model reads one from a file")
    if model.prior is None:
        raise InputError(f"{model.source}: prior: the table is missing; it is needed to filter")
    if model.functions:
        raise InputError(f"{model.source}: functions: a model with undetermined functions can be analysed and not filtered")
