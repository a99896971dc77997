"""Study files: which models, methods and seeds, read from TOML and checked."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from zakai.engine.driver import check_noise, check_records, planned
from zakai.errors import ConditionError, InputError
from zakai.models import _entries
from zakai.models._errors import did_you_mean, echo, listing, named
from zakai.models._text import read_text
from zakai.models.clock import clock
from zakai.models.files import read_keys
from zakai.models.model import Model
from zakai.records import Inputs, Record, read_inputs, read_record, read_truth
from zakai.records.writing import shown
from zakai.studies._study_models import checked_table, checked_text, checked_whole, methods_of, models_of, shown_name
from zakai.studies.specification import BATCH, Given, Study, times_of

KEYS = (
    "name", "models", "parameters", "methods", "seeds", "times", "records",
    "reference", "metrics", "densities", "lost_above", "batch",
)  # fmt: skip
OF_TRUTH = ("squared-error", "nees", "crps", "pit", "log-score")
METRICS = (*OF_TRUTH, "nis", "distance", "hellinger")
OF_REFERENCE = ("distance", "hellinger")
MOST_TOGETHER = 31  # records of a batch
MOST_RUNS, MOST_DENSITIES = 1_000_000, 1000
MOST_RECORDS, MOST_BATCHES = 10_000, 1_000_000
MOST_NUMBERS = 100_000_000  # of the observations of one record, or of its states


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
    methods = methods_of(keys["methods"])
    models = models_of(keys, folder)
    known = None if inputs is None else read_inputs(inputs, models[0][1])
    if any(model.inputs != models[0][1].inputs for _, model in models):
        raise InputError("models: their inputs differ; give models with other inputs a study of their own")
    given = {
        "name": checked_text("name", keys.get("name", name)),
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


def _rows_of(inputs: Inputs | None) -> tuple[tuple[float, ...], ...]:
    return () if inputs is None else tuple(map(tuple, np.column_stack([inputs.times, inputs.values]).tolist()))


def _runs(keys: Mapping[str, Any], models: list[Model], folder: Path, known: Inputs | None) -> dict[str, Any]:
    if "records" in keys:
        for key in ("seeds", "times"):
            if key in keys:
                raise InputError(f"{key}: the records are given, so nothing is simulated; take {key} or records out")
        return {"records": _records(keys["records"], models, folder, known)}
    for key in ("seeds", "times"):
        if key not in keys:
            raise InputError(f"{key}: missing; give seeds and times for simulated records, or records")
    seeds = checked_table("seeds", keys["seeds"], ("first", "count"), ("count",))
    times = checked_table("times", keys["times"], ("until", "step", "substeps"), ("until", "step"))
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
        "first": checked_whole("seeds.first", seeds.get("first", 0), 0, 2**53),
        "count": checked_whole("seeds.count", seeds["count"], 1, MOST_RUNS),
        "substeps": None if substeps is None else checked_whole("times.substeps", substeps, 1, 100_000),
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
            table = checked_table("", {"file": entry} if isinstance(entry, str) else entry, ("file", "truth"), ("file",))
            file = checked_text("file", table["file"])
            if file in files:
                raise InputError(f"{file[:80]} is there twice; take one out")
            files.add(file)
            record, truth = read_record(folder / file, models[0]), None
            if "truth" in table:
                truth = _truth(folder / checked_text("truth", table["truth"]), models[0], record)
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
        "densities": checked_whole("densities", keys.get("densities", 0), 0, MOST_DENSITIES),
        "batch": checked_whole("batch", keys.get("batch", BATCH), 1, MOST_TOGETHER),
    }


def _check(study: Study, model: Model, first: bool) -> None:
    """Check that every method holds for the model, and, once, that it accepts its options, before anything runs."""
    times = times_of(study, model)
    record = Record(times, np.zeros((len(times), model.m)), model.observation_kind, study.known_inputs)
    record = study.record(model, study.records[0]) if study.records else record
    check_records(model, record)
    for entry in study.methods:
        with named(f"methods.{shown_name(entry.label)}"):
            try:
                plan = planned(model, None, entry.method, entry.options)
            except ConditionError as error:
                raise ConditionError(f"methods.{shown_name(entry.label)}: {error}") from None
            check_noise([plan], [record])
            if first and entry.options:
                for run in plan.runs(record, "moments"):
                    run.setting.prepared(run.schedule.part(slice(0, 1)))
