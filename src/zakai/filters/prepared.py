"""Offline work by itself: done once for a model, a method and times of observation, kept in a file, used for many records."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from zakai import _compiled
from zakai.errors import InputError
from zakai.filters._plan import ByBlocks, Plan, plan_of
from zakai.filters._protocol import Schedule
from zakai.filters._run import Setting, key_of
from zakai.filters._saved import put_together, shared_by, taken_apart
from zakai.filters.driver import check_model, check_noise, check_records, filter_planned
from zakai.filters.results import FilterResult, versions
from zakai.models.files import read_model
from zakai.models.model import Model
from zakai.records import Record
from zakai.records.checkpoint import read_checkpoint, write_checkpoint
from zakai.records.writing import shown

KIND = "prepared"


def prepare(model: Model, times: Any, method: str = "auto", **options: Any) -> Prepared:
    """Do now what can be done before any observation is known.

    model: what the system is, with a prior. times: (K,), when all coordinates will be observed, or a Record with those times
    and gaps. method and options: as for `filter`.

    Raises InputError for wrong times or a wrong option, ConditionError if the method's theorem does not hold.

    Example:

        model = zakai.load_model("gallery:spiral-sensor")
        prepared = zakai.prepare(model, np.arange(0.01, 1.0, 0.01))
        prepared.save("spiral-sensor.prepared")
        truth, record = zakai.simulate(model, np.arange(0.01, 1.0, 0.01))
        result = zakai.Prepared.load("spiral-sensor.prepared").filter(record)
    """
    _compiled.keep()
    check_model(model)
    record = times if isinstance(times, Record) else _nothing_read(model, times)
    check_records(model, record)
    prepared = Prepared(model, method, options)
    check_noise([prepared._plan], [record])
    for run in prepared._plan.runs(record, "moments"):
        for schedule, found in run.prepared():
            prepared._stored[run.setting.model][key_of(schedule)] = schedule, found
    return prepared


def _nothing_read(model: Model, times: Any) -> Record:
    try:
        times = np.asarray(times, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"prepare: the times are a {type(times).__name__}; give a vector of numbers or a Record") from None
    if times.ndim != 1 or not len(times):
        raise InputError(f"prepare: the times have the shape {times.shape}; give a vector of at least one")
    return Record(times, np.zeros((len(times), model.m)), model.observation_kind)


class Prepared:
    """What `prepare` did, and `filter` with it.

    The transitions of every interval, and the choice of the method, are those of its model, method, options and times.  For other
    times, or other gaps, `filter` prepares anew what it does not find here.
    """

    def __init__(self, model: Model, method: str, options: Mapping[str, Any]):
        self.model, self.method, self.options = model, method, dict(options)
        plan = plan_of(model, model.prior, method, self.options)
        # Blocks that are equal share one model, and what was prepared for it.
        self._stored: dict[Model, dict[Any, tuple[Schedule, Any]]] = {setting.model: {} for setting in plan.settings}
        settings = tuple(setting._replace(stored=self._stored[setting.model]) for setting in plan.settings)
        self._plan: Plan = plan._replace(settings=settings) if isinstance(plan, ByBlocks) else plan._replace(setting=settings[0])

    def __repr__(self) -> str:
        return f"Prepared({self.method} of {self.model.source})"

    def filter(
        self, record: Record, *, keep: str | None = None, progress: Callable[[int, int], None] | None = None
    ) -> FilterResult:
        """What `zakai.filter` gives for this model, method and options, to the bit."""
        check_records(self.model, record)
        check_noise([self._plan], [record])
        return filter_planned([self._plan], [record], keep, progress)[0]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all of it to a file, atomically.

        Raises InputError where the file cannot be written.
        """
        arrays: list[np.ndarray] = []
        stored = [[taken_apart(pair, arrays) for pair in of_one.values()] for of_one in self._stored.values()]
        about = {**self._bound, "source": self.model.source, "stored": stored}
        write_checkpoint(path, about, {str(k): array for k, array in enumerate(arrays)}, KIND)

    @classmethod
    def load(cls, path: str | os.PathLike[str], model: Model | None = None) -> Prepared:
        """Read what was saved; with a `model`, only if it was prepared for that one.

        Raises InputError where the file is no such thing, is damaged, or is that of another model or of other versions.
        """
        _compiled.keep()
        about, arrays = read_checkpoint(path, KIND)
        name = shown(path)
        try:
            text, source, method, options = (about[key] for key in ("model", "source", "method", "options"))
            prepared = cls(read_model(text, source) if model is None else model, method, options)
            for what, own in prepared._bound.items():
                if about[what] != own:
                    raise InputError(f"{name}: was prepared for another {what}; prepare anew")
            numbered = iter([(k, arrays[str(k)]) for k in range(len(arrays))])
            settings = {setting.model: setting for setting in prepared._plan.settings}
            for (of_one, found), said in zip(prepared._stored.items(), about["stored"], strict=True):
                found.update(_put_together(settings[of_one], said, numbered))
        except (KeyError, IndexError, TypeError, ValueError, AttributeError):
            raise InputError(f"{name}: does not hold what zakai.prepare makes; prepare anew") from None
        return prepared

    @property
    def _bound(self) -> dict[str, Any]:
        return {"model": self.model.text, "method": self.method, "options": self.options, "versions": versions()}


def _put_together(setting: Setting, said: list[Any], numbered: Iterator[tuple[int, Any]]) -> dict[Any, tuple[Schedule, Any]]:
    """What was prepared for a setting, of the next of the arrays; the functions in it are those that are prepared now for the
    first interval."""
    found: dict[Any, tuple[Schedule, Any]] = {}
    shared: Mapping[str, Any] = {}
    for pair in said:
        schedule = put_together(pair["tuple"][0], numbered, {})
        if not shared:
            first = Schedule(*(part[:1] for part in schedule))
            shared = shared_by(setting.method.prepare(setting.model, first, **setting.options))
        found[key_of(schedule)] = schedule, put_together(pair["tuple"][1], numbered, shared)
    return found
