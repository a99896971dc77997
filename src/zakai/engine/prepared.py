"""Offline work by itself: the method is chosen, and every interval prepared, before any observation is known."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from zakai import _display
from zakai._progress import Progress
from zakai.engine.driver import check_model, check_noise, check_records, filter_planned, with_inputs
from zakai.engine.first_intervals import first_intervals
from zakai.engine.plan import plan_of
from zakai.engine.results import FilterResult
from zakai.engine.versions import other_versions, versions
from zakai.errors import InputError
from zakai.models.files import read_model
from zakai.models.model import Model
from zakai.records import Inputs, Record
from zakai.records.checkpoint import read_checkpoint, write_checkpoint
from zakai.records.writing import shown

KIND = "prepared"


def prepare(
    model: Model, times: ArrayLike | Record, method: str = "auto", *, inputs: Inputs | None = None, **options: Any
) -> Prepared:
    """Do what can be done before any observation is known.

    Args:
        model: the system, with a prior.
        times: (K,), when all coordinates will be observed, or a Record with those times and gaps, and the known inputs.
        method: as for `filter`.
        inputs: the known inputs of the model, in place of those of the record.
        **options: as for `filter`.

    Raises:
        InputError: wrong times or a wrong option.
        ConditionError: the method's theorem does not hold.

    Example:
        model = zakai.load_model("gallery:spiral-sensor")
        prepared = zakai.prepare(model, np.arange(0.01, 1.0, 0.01))
        prepared.save("spiral-sensor.prepared")
        truth, record = zakai.simulate(model, np.arange(0.01, 1.0, 0.01))
        result = zakai.Prepared.load("spiral-sensor.prepared").filter(record)
    """
    check_model(model)
    record = with_inputs(times if isinstance(times, Record) else _unobserved(model, times), inputs)
    (record,) = check_records(model, record)
    return Prepared(model, method, options, record)


def _unobserved(model: Model, times: ArrayLike | Record) -> Record:
    try:
        times = np.asarray(times, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"prepare: the times are a {type(times).__name__}; give a vector of numbers or a Record") from None
    if times.ndim != 1 or not len(times):
        raise InputError(f"prepare: the times have the shape {times.shape}; give a vector of at least one")
    return Record(times, np.zeros((len(times), model.m)))


class Prepared:
    """What `prepare` did, and `filter` with it.

    The choice of the method and the transitions of every interval; for other times, or other gaps, `filter` prepares what it does
    not find here.  A file of it holds the model, the method, the options and the times: preparing again takes less time than
    reading stored transitions.
    """

    def __init__(self, model: Model, method: str, options: Mapping[str, Any], record: Record):
        self.model, self.method, self.options, self.record = model, method, dict(options), record
        self._plan = plan_of(model, model.prior, method, self.options, unfit=first_intervals(model, record).fault)
        check_noise([self._plan], [record])
        for run in self._plan.runs(record, "moments"):
            run.prepare()

    def __repr__(self) -> str:
        return f"Prepared({self._plan.method} of {self.model.source}: {_display.counted(len(self.record), 'time')})"

    def _repr_html_(self) -> str:
        first, last = map(_display.number, self.record.times[[0, -1]])
        rows = [("model", repr(self.model)), ("times", f"{len(self.record):,}, {first} to {last}"), *self.options.items()]
        return _display.html_table(repr(self), ("", ""), rows)

    def filter(
        self, record: Record, *, inputs: Inputs | None = None, keep: str | None = None, progress: Progress | None = None
    ) -> FilterResult:
        """Return what `zakai.filter` returns for this model, method and options, to the bit."""
        (record,) = check_records(self.model, with_inputs(record, inputs))
        check_noise([self._plan], [record])
        return filter_planned([self._plan], [record], keep, progress)[0]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it to a file, atomically.

        Raises:
            InputError: the file cannot be written.
        """
        about, inputs = {**self._bound, "source": self.model.source}, self.record.inputs
        inputs = None if inputs is None else inputs.since(self.model.start)
        arrays = {"times": self.record.times, "seen": ~np.isnan(self.record.values)}
        arrays |= {} if inputs is None else {"input_times": inputs.times, "inputs": inputs.values}
        write_checkpoint(path, about, arrays, KIND)

    @classmethod
    def load(cls, path: str | os.PathLike[str], model: Model | None = None) -> Prepared:
        """Read what was saved; with a `model`, only if it was prepared for that one.

        Raises:
            InputError: the file is damaged, holds something else, or belongs to another model or to other versions.
        """
        about, arrays = read_checkpoint(path, KIND)
        name = shown(path)
        try:
            text, source, method, options = (about[key] for key in ("model", "source", "method", "options"))
            model = read_model(text, source) if model is None else model
            check_model(model)
            if about["model"] != model.text:
                raise InputError(f"{name}: was prepared for another model; prepare again")
            if wrong := other_versions(about["versions"]):
                raise InputError(f"{name}: was prepared with another version of {wrong}; prepare again")
            if arrays["seen"].dtype != bool or arrays["seen"].shape != (len(arrays["times"]), model.m):
                raise ValueError
            values = np.where(arrays["seen"], 0.0, np.nan)
            inputs = Inputs(arrays["input_times"], arrays["inputs"]) if model.inputs else None
            record = Record(arrays["times"], values, model.observation_kind, inputs)
            check_records(model, record)
            return cls(model, method, options, record)
        except (KeyError, IndexError, TypeError, ValueError, AttributeError):
            raise InputError(f"{name}: does not hold what zakai.prepare makes; prepare again") from None

    @property
    def _bound(self) -> dict[str, Any]:
        return {"model": self.model.text, "method": self.method, "options": self.options, "versions": versions()}
