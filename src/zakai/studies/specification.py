"""Study files: which models, methods and seeds, read from TOML and checked; and the batches that they fall into."""

from __future__ import annotations

import hashlib
import json
import os
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from decimal import Decimal
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from zakai import _registry
from zakai.errors import ConditionError, InputError
from zakai.filters.driver import check_noise, check_records, planned
from zakai.filters.results import versions
from zakai.models import _entries
from zakai.models._errors import did_you_mean, echo, listing, named
from zakai.models.clock import clock
from zakai.models.files import _LONG_KEY, MAX_BYTES, load_model
from zakai.models.model import Model
from zakai.records import Record, read_record, read_truth
from zakai.records.writing import shown

KEYS = (
    "name", "models", "parameters", "methods", "seeds", "times", "records",
    "reference", "metrics", "densities", "lost_above", "batch",
)  # fmt: skip
OF_TRUTH = ("squared-error", "nees", "crps", "pit", "log-score")
METRICS = (*OF_TRUTH, "nis", "distance", "hellinger")
OF_REFERENCE = ("distance", "hellinger")
BATCH = 25
MOST_TOGETHER = 31  # records of one scan, whatever the machine: the driver divides more of them by the number of cores
MOST_RUNS, MOST_POINTS, MOST_DENSITIES = 10_000_000, 10_000, 1000


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
    """A record from a file, with the true states (K+1, n) where they are known; nan at the start if it is not."""

    label: str
    times: tuple[float, ...]
    values: tuple[tuple[float, ...], ...]
    truth: tuple[tuple[float, ...], ...] | None


@dataclass(frozen=True)
class Study:
    """All that decides the numbers of a study, and nothing else: two with the same `key` have the same numbers.

    `first` and `count` are the seeds, `until`, `step` and `substeps` the times, where records are simulated; else `records`.
    Runs are the seeds or the records; a batch is up to `batch` runs of one point, by every method.
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

    @property
    def runs(self) -> tuple[str, ...]:
        """What each run is called: its seed, or its file."""
        return tuple(one.label for one in self.records) or tuple(str(self.first + k) for k in range(self.count))

    @property
    def batches(self) -> list[tuple[int, slice]]:
        """The point and the runs of every batch: the same whatever was done before, and by whom."""
        starts = range(0, len(self.runs), self.batch)
        return [(p, slice(k, min(k + self.batch, len(self.runs)))) for p in range(len(self.points)) for k in starts]

    def key(self) -> str:
        """A hash of all that decides the numbers: not of the name, nor of the versions of the libraries."""
        return hashlib.sha256(json.dumps(asdict(replace(self, name="")), sort_keys=True).encode()).hexdigest()

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


def read_study(path: str | os.PathLike[str]) -> Study:
    """Read and check a study file (docs/studies.md); models and records are looked for beside it.

    Every method is asked whether it holds for every model, before anything runs.  Raises InputError, in one line that names the
    file and the key, for what cannot be used; ConditionError where a method does not hold.
    """
    where = Path(path)
    with named(shown(path)):
        keys = _toml(where)
        _entries.known_keys(keys, KEYS)
        for key in ("models", "methods"):
            if key not in keys:
                raise InputError(f"{key}: missing; a study needs models and methods, and seeds with times, or records")
        models = _models(keys, where.parent)
        methods = _methods(keys["methods"])
        given = {
            "name": _text("name", keys.get("name", where.stem)),
            "methods": methods,
            "points": tuple(point for point, _ in models),
            **_runs(keys, [model for _, model in models], where.parent),
            **_numbers(keys),
        }
        reference = keys.get("reference")
        labels = [entry.label for entry in methods]
        if reference is not None and reference not in labels:
            hint = did_you_mean(str(reference), labels)
            raise InputError(f"reference: {echo(reference, 40)} is not a label of the methods{hint}; labels: {listing(labels)}")
        truth = not given.get("records") or all(one.truth is not None for one in given["records"])
        study = Study(**given, reference=reference, metrics=_metrics(keys.get("metrics"), reference, truth))
        for point, model in models:
            _check(study, model, first=point is study.points[0])
    return study


def _toml(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise InputError("larger than 1 MiB, which no study file is")
        text = data.decode("utf-8-sig")
        if _LONG_KEY.search(text):
            raise InputError("has a key of nine or more parts with dots, which no study has")
        return tomllib.loads(text, parse_float=Decimal)
    except FileNotFoundError:
        raise InputError("there is no such file; give a study file (TOML)") from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}; give a study file (TOML)") from None
    except UnicodeDecodeError as error:
        raise InputError(f"byte {error.start + 1} is not UTF-8 text; a study file is TOML") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"is not TOML: {' '.join(str(error).split())[:200]}") from None
    except (ValueError, ArithmeticError, RecursionError):
        raise InputError("is not TOML that can be read: a number is too long, or lists are nested too deep") from None


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
    for number, entry in enumerate(entries):
        with named(f"models[{number}]"):
            source, own = _model_entry(entry)
            at = source if source.startswith("gallery:") else str(folder / source)
            model = load_model(at)
            grid = {**{name: values for name, values in shared.items() if name in model.parameters}, **own}
            used |= set(grid)
            label = source.removeprefix("gallery:").removesuffix(".toml")
            found += _points(label, source, model, grid)
    for name in shared:
        if name not in used:
            known = [parameter for _, model in found for parameter in model.parameters]
            raise InputError(f"parameters.{name}: no model has this parameter{did_you_mean(name, known)}; take it out")
    if len(found) > MOST_POINTS:
        raise InputError(f"parameters: the grid has {len(found):,} points; at most {MOST_POINTS:,} fit one study")
    labels = [point.label for point, _ in found]
    for label in labels:
        if labels.count(label) > 1:
            raise InputError(f"models: {label} is there twice; take one out")
    return found


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
        with named(f"parameters.{name}"):
            values = values if isinstance(values, list) else [values]
            if not values:
                raise InputError("the list is empty; give at least one value, or take the key out")
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
    entries = []
    for label, given in table.items():
        key = f"methods.{label}"
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
    raise InputError(f"options.{key}: expected a number, a text, true, false or a list of them, got {_entries.kind_of(value)}")


def _runs(keys: Mapping[str, Any], models: list[Model], folder: Path) -> dict[str, Any]:
    if "records" in keys:
        for key in ("seeds", "times"):
            if key in keys:
                raise InputError(f"{key}: the records are given, so nothing is simulated; take {key} or records out")
        return {"records": _records(keys["records"], models, folder)}
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
        clock(model.start, numbers["until"], numbers["step"], ("times.until", "times.step"))
    substeps = times.get("substeps")
    return {
        **numbers,
        "first": _whole("seeds.first", seeds.get("first", 0), 0, 2**53),
        "count": _whole("seeds.count", seeds["count"], 1, MOST_RUNS),
        "substeps": None if substeps is None else _whole("times.substeps", substeps, 1, 100_000),
    }


def _records(value: Any, models: list[Model], folder: Path) -> tuple[Given, ...]:
    if not isinstance(value, list) or not value:
        raise InputError('records: expected a list of tables, as in [[records]] with file = "a.csv"')
    found: list[Given] = []
    for number, entry in enumerate(value):
        with named(f"records[{number}]"):
            table = _table("", {"file": entry} if isinstance(entry, str) else entry, ("file", "truth"), ("file",))
            file = _text("file", table["file"])
            record, truth = read_record(folder / file, models[0]), None
            if "truth" in table:
                truth = _truth(folder / _text("truth", table["truth"]), models[0], record)
            for model in models:
                check_records(model, record)
                if truth is not None and len(truth[0]) != model.n:
                    raise InputError(f"truth: it has {len(truth[0])} states, but {model.source} has {model.n}")
            times = tuple(record.times.tolist())
            if found and times != found[0].times:
                raise InputError(f"file: its times are not those of {found[0].label}; give it a study of its own")
            found.append(Given(file, times, tuple(map(tuple, record.values.tolist())), truth))
    labels = [one.label for one in found]
    for label in labels:
        if labels.count(label) > 1:
            raise InputError(f"records: {label} is there twice; take one out")
    return tuple(found)


def _truth(path: Path, model: Model, record: Record) -> tuple[tuple[float, ...], ...]:
    truth = read_truth(path, model)
    times = np.concatenate([[model.start], record.times])
    near = np.abs(truth.times - times[:, None]).argmin(axis=1)
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
    """Whether every method holds for the model, and, once, takes the values of its options, before anything runs."""
    times = times_of(study, model)
    record = Record(times, np.zeros((len(times), model.m)), model.observation_kind)
    check_records(model, record)
    for entry in study.methods:
        with named(f"methods.{entry.label}"):
            try:
                plan = planned(model, None, entry.method, entry.options)
            except ConditionError as error:
                raise ConditionError(f"methods.{entry.label}: {error}") from None
            check_noise([plan], [record])
            if first and entry.options:
                for run in plan.runs(record, "moments"):
                    run.setting.prepared(run.data.part(slice(0, 1)))


def times_of(study: Study, model: Model) -> np.ndarray:
    """The times (K,) of a study's records."""
    if study.records:
        return np.array(study.records[0].times)
    return clock(model.start, study.until, study.step, ("times.until", "times.step"))
