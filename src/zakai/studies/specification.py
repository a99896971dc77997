"""What decides the numbers of a study: its models, methods, seeds and records, and the batches that they fall into."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from zakai.engine.versions import versions
from zakai.models.clock import clock
from zakai.models.model import Model
from zakai.records import Inputs, Record

BATCH = 25


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


def times_of(study: Study, model: Model) -> np.ndarray:
    """The times (K,) of a study's records."""
    if study.records:
        return np.array(study.records[0].times)
    return clock(model.start, study.until, study.step, ("times.until", "times.step"))
