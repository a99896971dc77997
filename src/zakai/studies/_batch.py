"""One batch of a study: some runs of one model with its parameters, filtered by every method, and what that comes to.

A batch is a function of its job alone: of no other batch, of no process and of no clock, but for its variables of cost.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import replace
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import xarray

from zakai import _registry
from zakai.engine.driver import filter as run_filter
from zakai.engine.results import FilterResult
from zakai.engine.versions import versions
from zakai.errors import InputError
from zakai.models.files import read_model
from zakai.models.model import Model
from zakai.records import Record
from zakai.simulation.simulate import simulate
from zakai.studies import metrics
from zakai.studies._cost import Cost
from zakai.studies.innovations import Innovations
from zakai.studies.specification import Entry, Job, times_of

FAILURES = ("", "raised", "not finite", "lost", "no truth")  # by the number in `failed`
COSTS = ("seconds", "first_call", "memory")  # variables that no two runs have in common
MOST_SAMPLES, LEAST_SAMPLES = 200, 10  # times of a run that are kept for curves over time
MOST_NUMBERS = 40_000_000  # in the curves of a point, of all runs and methods together
WORTH_AGAIN = 30.0  # seconds: a first call that takes longer is not repeated to know what a later one takes
_LONGEST_TEXT = 300

Advance = Callable[[float], None]
_one_at_a_time = Lock()
_warm: set[Hashable] = set()


class Sampled(NamedTuple):
    """The places among the K times: `curves` of what is kept over time, `scored` of where densities are asked."""

    curves: np.ndarray
    scored: np.ndarray


def run_batch(job: Job, advance: Advance = lambda share: None) -> xarray.Dataset:
    """All numbers of a batch; `advance` is called with the share that is done.

    A method that raises is tried run by run, and where it raises again the failure is what is recorded.
    """
    with _one_at_a_time:
        if dict(job.versions) != versions():
            raise InputError(f"the study is of {dict(job.versions)}, but here is {versions()}; install the same versions")
        return _dataset(job, advance)


def _dataset(job: Job, advance: Advance) -> xarray.Dataset:
    study = job.study
    model = read_model(job.point.text, job.point.label)
    for entry in study.methods:  # a missing library is no failure of the method
        if entry.method != "auto":
            _registry.load(entry.method)
    times = times_of(study, model)
    affordable = MOST_NUMBERS // (job.total * len(study.methods) * (model.n + 2))
    most = min(MOST_SAMPLES, max(LEAST_SAMPLES, affordable))
    sampled = Sampled(_spread(len(times), most), _spread(len(times), study.densities or most))
    truths, records, faults = _observed(job, model, times)
    batch = _Batch(job, model, truths, records, faults, sampled)
    order = sorted(study.methods, key=lambda entry: entry.label != study.reference)
    for number, entry in enumerate(order):
        begun = number / len(order)
        batch.run(entry, lambda share, begun=begun: advance(begun + share / len(order)))  # type: ignore[misc]
        advance((number + 1) / len(order))
    return batch.dataset(times)


def _spread(count: int, most: int) -> np.ndarray:
    """Up to `most` of the numbers from 0 to count - 1, evenly spread, the last among them."""
    return np.unique(np.round(np.linspace(count - 1, 0, min(count, most), endpoint=count <= most)).astype(int))


def _observed(job: Job, model: Model, times: np.ndarray) -> tuple[list[np.ndarray | None], list[Record | None], list[str]]:
    """The true states (K+1, n), the records, and why there is none; a run that cannot be simulated is nobody's failure."""
    study = job.study
    if study.records:
        truths: list[np.ndarray | None] = [None if one.truth is None else np.array(one.truth) for one in study.records]
        return truths, [study.record(model, one) for one in study.records], [""] * len(truths)
    truths, records, faults = [], list[Record | None](), list[str]()
    for seed in job.seeds:
        try:
            truth, record = simulate(model, times, seed=seed, substeps=study.substeps, inputs=study.known_inputs)
        except InputError as error:
            truths.append(None)
            records.append(None)
            faults.append(str(error)[:_LONGEST_TEXT])
        else:
            truths.append(truth.values)
            records.append(record)
            faults.append("")
    return truths, records, faults


class _Batch:
    """The arrays of a batch as they come, method by method."""

    def __init__(self, job, model, truths, records, faults, sampled):
        study = job.study
        self.job, self.model, self.truths, self.records, self.faults = job, model, truths, records, faults
        self.sampled, self.labels = sampled, [entry.label for entry in study.methods]
        self.periodic = tuple(name in model.periodic for name in model.state)
        self.reference: list[FilterResult | None] = [None] * len(records)
        self.innovations: dict[int, Innovations] = {}
        self.wanted = set(study.metrics)
        runs, count, n = len(records), len(self.labels), model.n
        each, curve = (runs, count), (runs, count, len(sampled.curves))
        self.variables: dict[str, tuple[tuple[str, ...], np.ndarray]] = {
            "failed": (("run", "filter"), np.zeros(each, np.int8)),
            "warnings": (("run", "filter"), np.zeros(each, np.int32)),
            "said": (("run", "filter"), np.full(each, "", object)),
            "log_likelihood": (("run", "filter"), np.full(each, np.nan)),
            **{name: (("filter",), np.full(count, np.nan)) for name in COSTS},
        }

        def of_runs(name: str, metric: str, *dims: str) -> None:
            sizes = {"state": n, "sample": curve[-1], "scored": len(sampled.scored)}
            if metric in self.wanted:
                shape = (*each, *(sizes[dim] for dim in dims))
                self.variables[name] = (("run", "filter", *dims), np.full(shape, np.nan))

        for name, metric in (
            ("squared_error", "squared-error"), ("distance", "distance"), ("nees", "nees"), ("nis", "nis"), ("crps", "crps"),
            ("log_score", "log-score"), ("hellinger", "hellinger"),
        ):  # fmt: skip
            of_runs(name, metric)
        of_runs("squared_error_of_state", "squared-error", "state")
        of_runs("crps_of_state", "crps", "state")
        of_runs("squared_error_at", "squared-error", "sample")
        of_runs("nees_at", "nees", "sample")
        of_runs("pit_at", "pit", "scored", "state")

    def put(self, name: str, run: int | slice, method: int, value: Any) -> None:
        if name in self.variables:
            self.variables[name][1][run, method] = value

    def run(self, entry: Entry, advance: Advance) -> None:
        """Filter all runs by one method, and keep what that comes to."""
        method = self.labels.index(entry.label)
        for run, fault in enumerate(self.faults):
            if fault:
                self.put("failed", run, method, FAILURES.index("no truth"))
                self.put("said", run, method, fault)
        there = [run for run, record in enumerate(self.records) if record is not None]
        if not there:
            return
        needs = self.job.study.densities and self.wanted & {"crps", "pit", "log-score", "hellinger"}
        call = _Call(self.model, _with_own_draws(entry, self.job), "densities" if needs else "moments", advance)
        results, costs = call.all([self.records[run] for run in there], (self.job.point.model, str(entry)))
        for name, value in costs.items():
            self.variables[name][1][method] = value
        for run, result in zip(there, results, strict=True):
            if isinstance(result, str):
                self.put("failed", run, method, FAILURES.index("raised"))
                self.put("said", run, method, result)
                continue
            if entry.label == self.job.study.reference:
                self.reference[run] = result
            with np.errstate(invalid="ignore", over="ignore"):
                self.keep(run, method, result)

    def keep(self, run: int, method: int, result: FilterResult) -> None:
        """The figures of one result."""
        self.put("warnings", run, method, len(result.warnings))
        self.put("said", run, method, result.warnings[0][:_LONGEST_TEXT] if result.warnings else "")
        self.put("log_likelihood", run, method, result.log_likelihood)
        if not (np.isfinite(result.mean[1:]).all() and np.isfinite(result.variance[1:]).all()):
            self.put("failed", run, method, FAILURES.index("not finite"))
            return
        reference = self.reference[run]
        if "distance" in self.wanted and reference is not None:
            self.put("distance", run, method, metrics.distance(result.mean[1:], reference.mean[1:], self.periodic))
        if "nis" in self.wanted:
            self.put("nis", run, method, self.nis(result))
        if "hellinger" in self.wanted and reference is not None:
            self.put("hellinger", run, method, self.hellinger(result, reference))
        truth = self.truths[run]
        if truth is not None:
            self.against(truth[1:], run, method, result)

    def against(self, truth: np.ndarray, run: int, method: int, result: FilterResult) -> None:
        """What needs the true states (K, n)."""
        periodic, curves, lost_above = self.periodic, self.sampled.curves, self.job.study.lost_above
        mean, variance = result.mean[1:], result.variance[1:]
        errors = metrics.deviations(truth, mean, periodic) ** 2
        total = errors.sum(axis=-1)
        self.put("squared_error", run, method, total.mean())
        self.put("squared_error_of_state", run, method, errors.mean(axis=0))
        self.put("squared_error_at", run, method, total[curves])
        if lost_above is not None and total.mean() > lost_above:
            self.put("failed", run, method, FAILURES.index("lost"))
        if "nees" in self.wanted:
            nees = self.nees(truth, result) / self.model.n
            self.put("nees", run, method, nees.mean())
            self.put("nees_at", run, method, nees[curves])
        if not self.wanted & {"crps", "pit", "log-score"}:
            return
        scored = self.sampled.scored
        if self.job.study.densities:
            scores = [metrics.density_scores(result.density(int(k) + 1), truth[k]) for k in scored]
            crps, pit, score = (np.array(column) for column in zip(*scores, strict=True))
        else:
            crps = metrics.crps_gaussian(truth, mean, variance, periodic)
            pit = metrics.pit_gaussian(truth[scored], mean[scored], variance[scored], periodic)
            score = self.log_score(truth, result)
        self.put("crps_of_state", run, method, crps.mean(axis=0))
        self.put("crps", run, method, crps.sum(axis=-1).mean())
        self.put("pit_at", run, method, pit)
        self.put("log_score", run, method, score.mean())

    def nees(self, truth: np.ndarray, result: FilterResult) -> np.ndarray:
        return self.by_block(
            result, lambda own, part: metrics.nees(truth[:, own], part.mean[1:], part.cov[1:], self.angles(own))
        )

    def log_score(self, truth: np.ndarray, result: FilterResult) -> np.ndarray:
        return self.by_block(
            result, lambda own, part: metrics.log_score_gaussian(truth[:, own], part.mean[1:], part.cov[1:], self.angles(own))
        )

    def by_block(self, result: FilterResult, figure: Callable[[list[int], FilterResult], Any]) -> Any:
        """A figure that is a sum over independent blocks, whose covariances are never put together."""
        place = {name: i for i, name in enumerate(self.model.state)}
        return sum(figure([place[name] for name in part.state], part) for part in result.blocks or (result,))

    def angles(self, own: list[int]) -> tuple[bool, ...]:
        return tuple(self.periodic[i] for i in own)

    def nis(self, result: FilterResult) -> float:
        """The sum of NIS over that of its degrees of freedom."""
        total, degrees = 0.0, 0
        for part in result.blocks or (result,):
            if part.model is None or part.record is None:
                return np.nan
            if id(part.model) not in self.innovations:
                self.innovations[id(part.model)] = Innovations(part.model)
            values, count = self.innovations[id(part.model)].nis(part.record, part.mean, part.cov)
            total, degrees = total + float(np.nansum(values)), degrees + int(count.sum())
        return total / degrees if degrees else np.nan

    def hellinger(self, result: FilterResult, reference: FilterResult) -> float:
        if result is reference:
            return 0.0
        places = [int(k) + 1 for k in self.sampled.scored]
        if self.job.study.densities:
            return float(np.mean([metrics.hellinger(result.density(k), reference.density(k)) for k in places]))
        return float(
            np.mean(
                metrics.hellinger_gaussian(
                    result.mean[places], result.cov[places], reference.mean[places], reference.cov[places], self.periodic
                )
            )
        )

    def dataset(self, times: np.ndarray) -> xarray.Dataset:
        return xarray.Dataset(
            self.variables,
            coords={
                "run": list(self.job.runs),
                "filter": self.labels,
                "state": list(self.model.state),
                "sample": times[self.sampled.curves],
                "scored": times[self.sampled.scored],
            },
            attrs={"observations": len(times), "point": self.job.point.label},
        )


def _with_own_draws(entry: Entry, job: Job) -> Entry:
    """The method with a `seed` of this batch, where it draws: its chance is then not the same in all runs of a study."""
    known = {} if entry.method == "auto" else _registry.load(entry.method).options
    if "seed" not in known:
        return entry
    seed = entry.options.get("seed", known["seed"]) + job.seeds[0]
    return replace(entry, options={**entry.options, "seed": seed})


class _Call:
    """A method and how it is called."""

    def __init__(self, model: Model, entry: Entry, keep: str, advance: Advance):
        self.model, self.entry, self.keep, self.advance = model, entry, keep, advance

    def all(self, records: list[Record], what: tuple[str, ...]) -> tuple[list[FilterResult | str], dict[str, float]]:
        """The results, or why there is none, and the costs.

        A process compiles what it calls first, so its first call is repeated, unless that takes long, and counts by itself.
        """
        key = (*what, len(records))
        first = key not in _warm
        with Cost() as cost:
            results = self.together(records)
        if results is None:
            return [self.alone(record) for record in records], {}
        observations = sum(map(len, records))
        costs = {"seconds": cost.seconds / observations, "memory": cost.bytes}
        if first:
            costs["first_call"] = cost.seconds
            if cost.seconds < WORTH_AGAIN:
                with Cost() as again:
                    self.together(records)
                costs["seconds"] = again.seconds / observations
        _warm.add(key)
        return list(results), costs

    def together(self, records: list[Record]) -> list[FilterResult] | None:
        try:
            return self.filter(records)
        except Exception as error:
            _check_machine(error)
            return None

    def alone(self, record: Record) -> FilterResult | str:
        try:
            return self.filter([record])[0]
        except Exception as error:
            _check_machine(error)
            kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
            return " ".join(f"{kind}{error}".split())[:_LONGEST_TEXT]

    def filter(self, records: list[Record]) -> list[FilterResult]:
        def progress(done: int, total: int) -> None:
            self.advance(done / total)

        return run_filter(self.model, records, self.entry.method, keep=self.keep, progress=progress, **self.entry.options)


def _check_machine(error: Exception) -> None:
    """A machine without memory says nothing about a method: the study ends, and may be gone on with elsewhere."""
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        raise InputError("the memory of this machine is too small for a batch; give the study a smaller batch") from error
