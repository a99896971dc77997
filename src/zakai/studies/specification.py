"""Study files: which models, methods and seeds, read from TOML and checked; and the batches that they fall into."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from decimal import Decimal
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from zakai import _registry
from zakai.engine.driver import check_noise, check_records, planned
from zakai.engine.results import versions
from zakai.errors import ConditionError, InputError
from zakai.models import _entries
from zakai.models._errors import did_you_mean, echo, listing, named
from zakai.models._text import read_text
from zakai.models.clock import clock
from zakai.models.files import load_model, read_keys
from zakai.models.model import Model
from zakai.records import Inputs, Record, read_inputs, read_record, read_truth
from zakai.records.writing import shown

KEYS = (
    "name", "models", "parameters", "methods", "seeds", "times", "records",
    "reference", "metrics", "densities", "lost_above", "batch",
)  # fmt: skip
OF_TRUTH = ("squared-error", "nees", "crps", "pit", "log-score")
METRICS = (*OF_TRUTH, "nis", "distance", "hellinger")
OF_REFERENCE = ("distance", "hellinger")
BATCH = 25
MOST_TOGETHER = 31  # records of a batch
MOST_RUNS, MOST_POINTS, MOST_DENSITIES = 1_000_000, 10_000, 1000
MOST_METHODS, MOST_RECORDS, MOST_BATCHES = 100, 10_000, 1_000_000
MOST_NUMBERS = 100_000_000  # of the observations of one record, or of its states


@dataclass(frozen=True)
class Point:
    """A model with its parameters: `text` is its whole file; `parameters` are those of the grid, as they were given."""

    label: str
    model: str
    text: str
    parameters: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Entry:
    """A method with its options, under a label of its own."""

    label: str
    method: str
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Given:
    """A record from a file, with the true states (K+1, n) where they are known; nan at the start if it is not.

    `inputs` are rows of a time and the values of the known inputs, where the record has columns for them.
    """

    label: str
    times: tuple[float, ...]
    values: tuple[tuple[float, ...], ...]
    truth: tuple[tuple[float, ...], ...] | None
    inputs: tuple[tuple[float, ...], ...] = ()


@dataclass(frozen=True)
class Study:
    """All that decides the numbers of a study, and nothing else: two with the same `key` have the same numbers.

    `first` and `count` are the seeds, `until`, `step` and `substeps` the times, where records are simulated; else `records`.
    `inputs` are rows of a time and the values of the known inputs then. Runs are the seeds or the records; a batch is up to
    `batch` runs of one point, by every method.
    """

    name: str
    points: tuple[Point, ...]
    methods: tuple[Entry, ...]
    metrics: tuple[str, ...]
    reference: str | None = None
    first: int = 0
    count: int = 0
    until: float = 0.0
    step: float = 0.0
    substeps: int | None = None
    records: tuple[Given, ...] = ()
    densities: int = 0
    lost_above: float | None = None
    batch: int = BATCH
    inputs: tuple[tuple[float, ...], ...] = ()

    @property
    def known_inputs(self) -> Inputs | None:
        """The inputs of every run, or None where there are none or each record has its own."""
        return _inputs_of(self.inputs)

    def record(self, model: Model, given: Given) -> Record:
        """Return a given record, with its own inputs or those of the study."""
        inputs = _inputs_of(given.inputs) if given.inputs else self.known_inputs
        return Record(np.array(given.times), np.array(given.values), model.observation_kind, inputs)

    @cached_property
    def runs(self) -> tuple[str, ...]:
        """What each run is called: its seed, or its file."""
        return tuple(one.label for one in self.records) or tuple(str(self.first + k) for k in range(self.count))

    @cached_property
    def batches(self) -> list[tuple[int, slice]]:
        """The point and the runs of every batch: the same whatever was done before, and by whom."""
        count = len(self.runs)
        slices = [slice(k, min(k + self.batch, count)) for k in range(0, count, self.batch)]
        return [(p, runs) for p in range(len(self.points)) for runs in slices]

    def key(self) -> str:
        """A hash of all that decides the numbers: not of the name, nor of the versions of the libraries."""
        values = asdict(replace(self, name=""))
        for part in (values, *values["records"]):
            if not part["inputs"]:
                del part["inputs"]
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()

    def job(self, index: int) -> Job:
        """One batch, by itself."""
        point, runs = self.batches[index]
        own = replace(self, records=self.records[runs])
        seeds = range(self.first + runs.start, self.first + runs.stop)
        return Job(own, index, self.points[point], self.runs[runs], seeds, len(self.runs))


@dataclass(frozen=True)
class Job:
    """A batch with all that is needed to run it, on whatever machine.

    `study` has the records of these runs alone; `total` counts the runs of all batches of the point.
    """

    study: Study
    index: int
    point: Point
    runs: tuple[str, ...]
    seeds: range
    total: int
    versions: Mapping[str, str] = field(default_factory=lambda: dict(versions()))


def _inputs_of(rows: tuple[tuple[float, ...], ...]) -> Inputs | None:
    table = np.array(rows)
    return Inputs(table[:, 0], table[:, 1:]) if rows else None


def _rows_of(inputs: Inputs | None) -> tuple[tuple[float, ...], ...]:
    return () if inputs is None else tuple(map(tuple, np.column_stack([inputs.times, inputs.values]).tolist()))


def read_study(path: str | os.PathLike[str], inputs: str | os.PathLike[str] | None = None) -> Study:
    """Read and check a study file (docs/how-to/compare-filters.md); models and records are looked for beside it.

    `inputs` is a CSV file with the known inputs of its models, for records without columns for them.

    Every method is asked whether it holds for every model, before anything runs.  Raises InputError, in one line that names the
    file and the key, for what cannot be used; ConditionError where a method does not hold.
    """
    where, source = Path(path), shown(path)
    text = read_text(where, source, "study")
    with named(source):
        study, models = study_of(read_keys(text, "study"), where.stem, where.parent, inputs)
        for model in models:
            _check(study, model, first=model is models[0])
    return study


def study_of(
    keys: Mapping[str, Any], name: str, folder: Path, inputs: str | os.PathLike[str] | None = None
) -> tuple[Study, list[Model]]:
    """Return the study of these keys, and the model of each of its points, before any method is asked whether it holds.

    name: what it is called where it does not say so. folder: where models and records are. inputs: as for `read_study`.
    """
    _entries.known_keys(keys, KEYS)
    for key in ("models", "methods"):
        if key not in keys:
            raise InputError(f"{key}: missing; a study needs models and methods, and seeds with times, or records")
    methods = _methods(keys["methods"])
    models = _models(keys, folder)
    known = None if inputs is None else read_inputs(inputs, models[0][1])
    if any(model.inputs != models[0][1].inputs for _, model in models):
        raise InputError("models: their inputs differ; give models with other inputs a study of their own")
    given = {
        "name": _text("name", keys.get("name", name)),
        "methods": methods,
        "points": tuple(point for point, _ in models),
        "inputs": _rows_of(known),
        **_runs(keys, [model for _, model in models], folder, known),
        **_numbers(keys),
    }
    reference = keys.get("reference")
    labels = [entry.label for entry in methods]
    if reference is not None and reference not in labels:
        hint = did_you_mean(str(reference), labels)
        raise InputError(f"reference: {echo(reference, 40)} is not a label of the methods{hint}; labels: {listing(labels)}")
    truth = not given.get("records") or all(one.truth is not None for one in given["records"])
    study = Study(**given, reference=reference, metrics=_metrics(keys.get("metrics"), reference, truth))
    if len(study.points) * -(-len(study.runs) // study.batch) > MOST_BATCHES:
        fault = f"it has more than {MOST_BATCHES:,} batches of {study.batch} runs"
        raise InputError(f"{fault}; take fewer points, fewer runs, or a larger batch")
    return study, [model for _, model in models]


def _table(key: str, value: Any, allowed: tuple[str, ...] | None = None, required: tuple[str, ...] = ()) -> Mapping[str, Any]:
    with named(key):
        if not isinstance(value, Mapping):
            raise InputError(f"expected a table, got {_entries.kind_of(value)}")
        if allowed is not None:
            _entries.known_keys(value, allowed)
        for name in required:
            if name not in value:
                raise InputError(f"{name}: missing; the table needs {listing(required)}")
    return value


def _text(key: str, value: Any) -> str:
    if not isinstance(value, str) or not value or not value.isprintable():
        raise InputError(f"{key}: expected a text, got {_entries.kind_of(value)}")
    return value


def _whole(key: str, value: Any, least: int, most: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise InputError(f"{key}: expected a whole number from {least} to {most:,}, got {_entries.kind_of(value)}")
    return value


def _models(keys: Mapping[str, Any], folder: Path) -> list[tuple[Point, Model]]:
    entries = keys["models"]
    if not isinstance(entries, list) or not entries:
        raise InputError('models: expected a list, as in models = ["gallery:benes", "system.toml"]')
    shared = _table("parameters", keys.get("parameters", {}))
    found: list[tuple[Point, Model]] = []
    used: set[str] = set()
    read: dict[str, Model] = {}
    for number, entry in enumerate(entries):
        with named(f"models[{number}]"):
            source, own = _model_entry(entry)
            at = source if source.startswith("gallery:") else str(folder / source)
            if at not in read:
                read[at] = load_model(at)
            model = read[at]
            grid = {**{name: values for name, values in shared.items() if name in model.parameters}, **own}
            used |= set(grid)
            label = source.removeprefix("gallery:").removesuffix(".toml")
            found += _points(label, source, model, grid)
        if len(found) > MOST_POINTS:
            raise InputError(f"parameters: the grid has more than {MOST_POINTS:,} points, the most that fit one study")
    for name in shared:
        if name not in used:
            known = [parameter for _, model in found for parameter in model.parameters]
            raise InputError(f"parameters.{_shown(name)}: no model has this parameter{did_you_mean(name, known)}; take it out")
    _check_different("models", [point.label for point, _ in found])
    return found


def _check_different(key: str, labels: list[str]) -> None:
    twice = next((label for label, count in Counter(labels).items() if count > 1), None)
    if twice is not None:
        raise InputError(f"{key}: {twice[:80]} is there twice; take one out")


def _shown(name: str) -> str:
    """A name out of the file, as a part of an error."""
    return name if name.isprintable() and len(name) <= 40 else echo(name, 40)


def _model_entry(entry: Any) -> tuple[str, Mapping[str, Any]]:
    if isinstance(entry, str):
        return entry, {}
    table = _table("", entry, ("model", "parameters"), ("model",)) if isinstance(entry, Mapping) else None
    if table is None:
        raise InputError(f"expected a file, gallery:NAME or a table with the key model, got {_entries.kind_of(entry)}")
    return _text("model", table["model"]), _table("parameters", table.get("parameters", {}))


def _points(label: str, source: str, model: Model, grid: Mapping[str, Any]) -> list[tuple[Point, Model]]:
    axes = []
    for name, values in grid.items():
        with named(f"parameters.{_shown(name)}"):
            values = values if isinstance(values, list) else [values]
            if not values:
                raise InputError("the list is empty; give at least one value, or take the key out")
            if len(values) > MOST_POINTS:
                raise InputError(f"the list has {len(values):,} values; at most {MOST_POINTS:,} fit one study")
            axes.append([(name, value, _entries.formula(value)) for value in values])
            for value in values:
                _entries.exact_number(value)
    if np.prod([len(axis) for axis in axes], dtype=float) > MOST_POINTS:
        raise InputError(f"parameters: the grid has more than {MOST_POINTS:,} points, the most that fit one study")
    points = []
    for chosen in product(*axes):
        own = model.with_parameters(**{name: value for name, value, _ in chosen}) if chosen else model
        said = ", ".join(f"{name} = {text}" for name, _, text in chosen)
        points.append((Point(f"{label}, {said}" if said else label, source, own.to_toml(), {n: t for n, _, t in chosen}), own))
    return points


def _methods(value: Any) -> tuple[Entry, ...]:
    table = _table("methods", value)
    if not table:
        raise InputError("methods: is empty; give a table for each, as in [methods.limited-direct]")
    if len(table) > MOST_METHODS:
        raise InputError(f"methods: there are {len(table):,}; at most {MOST_METHODS} fit one study")
    entries = []
    for label, given in table.items():
        key = f"methods.{_shown(label)}"
        own = _table(key, given, ("method", "options"))
        with named(key):
            _text("label", label)
            name = _text("method", own.get("method", label))
            options = {name: _plain(name, value) for name, value in _table("options", own.get("options", {})).items()}
            if name != "auto":
                known = _registry.load(name).options
                for option in options:
                    if option not in known:
                        hint = did_you_mean(option, known)
                        raise InputError(f"options: {name} has no option {echo(option, 40)}{hint}; its options: {listing(known)}")
        entries.append(Entry(label, name, options))
    return tuple(entries)


def _plain(key: str, value: Any) -> Any:
    """An option as Python has it; decimals are doubles."""
    if isinstance(value, list):
        return [_plain(key, entry) for entry in value]
    if isinstance(value, Decimal):
        return float(value)
    if isinstance(value, str | int | float | bool):
        return value
    kind = _entries.kind_of(value)
    raise InputError(f"options.{_shown(key)}: expected a number, a text, true, false or a list of them, got {kind}")


def _runs(keys: Mapping[str, Any], models: list[Model], folder: Path, known: Inputs | None) -> dict[str, Any]:
    if "records" in keys:
        for key in ("seeds", "times"):
            if key in keys:
                raise InputError(f"{key}: the records are given, so nothing is simulated; take {key} or records out")
        return {"records": _records(keys["records"], models, folder, known)}
    for key in ("seeds", "times"):
        if key not in keys:
            raise InputError(f"{key}: missing; give seeds and times for simulated records, or records")
    seeds = _table("seeds", keys["seeds"], ("first", "count"), ("count",))
    times = _table("times", keys["times"], ("until", "step", "substeps"), ("until", "step"))
    numbers = {}
    for key in ("until", "step"):
        with named(f"times.{key}"):
            numbers[key] = _entries.number(times[key])
    for model in models:
        count = len(clock(model.start, numbers["until"], numbers["step"], ("times.until", "times.step")))
        if count * max(model.n, model.m) > MOST_NUMBERS:
            raise InputError(f"times: {count:,} observations of {model.source} are more numbers than one record may hold")
    substeps = times.get("substeps")
    return {
        **numbers,
        "first": _whole("seeds.first", seeds.get("first", 0), 0, 2**53),
        "count": _whole("seeds.count", seeds["count"], 1, MOST_RUNS),
        "substeps": None if substeps is None else _whole("times.substeps", substeps, 1, 100_000),
    }


def _records(value: Any, models: list[Model], folder: Path, known: Inputs | None) -> tuple[Given, ...]:
    if not isinstance(value, list) or not value:
        raise InputError('records: expected a list of tables, as in [[records]] with file = "a.csv"')
    if len(value) > MOST_RECORDS:
        raise InputError(f"records: there are {len(value):,}; at most {MOST_RECORDS:,} fit one study")
    found: list[Given] = []
    files: set[str] = set()
    for number, entry in enumerate(value):
        with named(f"records[{number}]"):
            table = _table("", {"file": entry} if isinstance(entry, str) else entry, ("file", "truth"), ("file",))
            file = _text("file", table["file"])
            if file in files:
                raise InputError(f"{file[:80]} is there twice; take one out")
            files.add(file)
            record, truth = read_record(folder / file, models[0]), None
            if "truth" in table:
                truth = _truth(folder / _text("truth", table["truth"]), models[0], record)
            own = record.inputs
            if own is not None and known is not None:
                raise InputError(f"{file[:80]} has columns for the inputs, and --inputs gives them too; give them once")
            record = record if own is not None else replace(record, inputs=known)
            for model in models:
                check_records(model, record)
                if truth is not None and len(truth[0]) != model.n:
                    raise InputError(f"truth: it has {len(truth[0])} states, but {model.source} has {model.n}")
            times = tuple(record.times.tolist())
            if found and times != found[0].times:
                raise InputError(f"file: its times are not those of {found[0].label}; give it a study of its own")
            found.append(Given(file, times, tuple(map(tuple, record.values.tolist())), truth, _rows_of(own)))
    return tuple(found)


def _truth(path: Path, model: Model, record: Record) -> tuple[tuple[float, ...], ...]:
    truth = read_truth(path, model)
    times = np.concatenate([[model.start], record.times])
    after = np.clip(np.searchsorted(truth.times, times), 1, max(1, len(truth.times) - 1))
    near = np.minimum(after, len(truth.times) - 1)
    near = np.where(np.abs(truth.times[after - 1] - times) <= np.abs(truth.times[near] - times), after - 1, near)
    there = np.isclose(truth.times[near], times, rtol=1e-9, atol=1e-12)
    if not there[1:].all():
        missing = float(times[1:][~there[1:]][0])
        raise InputError(f"{shown(path)}: there is no state at the time {missing:.12g} of the record; give one for each")
    values = np.where(there[:, None], truth.values[near], np.nan)
    if not np.isfinite(values[1:]).all():
        time = float(times[1:][~np.isfinite(values[1:]).all(axis=1)][0])
        raise InputError(f"{shown(path)}: the state at the time {time:.12g} is not known; a study needs all of them, or none")
    return tuple(map(tuple, values.tolist()))


def _metrics(value: Any, reference: str | None, truth: bool) -> tuple[str, ...]:
    possible = [m for m in METRICS if (reference or m not in OF_REFERENCE) and (truth or m not in OF_TRUTH)]
    if value is None:
        return tuple(possible)
    if not isinstance(value, list):
        raise InputError(f"metrics: expected a list of names, got {_entries.kind_of(value)}")
    for name in value:
        if name not in METRICS:
            hint = did_you_mean(str(name), METRICS)
            raise InputError(f"metrics: there is no metric {echo(name, 40)}{hint}; metrics: {listing(METRICS)}")
        if name not in possible:
            if name in OF_REFERENCE:
                raise InputError(f"metrics: {name} needs a reference; name one of the methods")
            raise InputError(f"metrics: {name} needs the true states; give each record its truth")
    return tuple(m for m in METRICS if m in value)


def _numbers(keys: Mapping[str, Any]) -> dict[str, Any]:
    lost = None
    if "lost_above" in keys:
        with named("lost_above"):
            lost = _entries.number(keys["lost_above"])
            if lost <= 0:
                raise InputError(f"expected a positive number, got {lost:g}")
    return {
        "lost_above": lost,
        "densities": _whole("densities", keys.get("densities", 0), 0, MOST_DENSITIES),
        "batch": _whole("batch", keys.get("batch", BATCH), 1, MOST_TOGETHER),
    }


def _check(study: Study, model: Model, first: bool) -> None:
    """Check that every method holds for the model, and, once, that it accepts its options, before anything runs."""
    times = times_of(study, model)
    record = Record(times, np.zeros((len(times), model.m)), model.observation_kind, study.known_inputs)
    record = study.record(model, study.records[0]) if study.records else record
    check_records(model, record)
    for entry in study.methods:
        with named(f"methods.{_shown(entry.label)}"):
            try:
                plan = planned(model, None, entry.method, entry.options)
            except ConditionError as error:
                raise ConditionError(f"methods.{_shown(entry.label)}: {error}") from None
            check_noise([plan], [record])
            if first and entry.options:
                for run in plan.runs(record, "moments"):
                    run.setting.prepared(run.schedule.part(slice(0, 1)))


def times_of(study: Study, model: Model) -> np.ndarray:
    """The times (K,) of a study's records."""
    if study.records:
        return np.array(study.records[0].times)
    return clock(model.start, study.until, study.step, ("times.until", "times.step"))
