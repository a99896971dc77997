"""The online filter: one observation in, one estimate out."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from itertools import pairwise
from threading import RLock
from typing import Any, NamedTuple

import numpy as np

from zakai.algebra.independent import IndependentBlock
from zakai.engine.checkpoint import restored, stored
from zakai.engine.driver import check_model, planned
from zakai.engine.estimate import Estimate
from zakai.engine.feed import Feed, Moment
from zakai.engine.first_intervals import INTERVALS, FirstIntervals, asked
from zakai.engine.plan import Plan
from zakai.engine.setting import Setting
from zakai.engine.versions import other_versions, versions
from zakai.errors import InputError
from zakai.models._errors import named
from zakai.models.checks import check_noise_at
from zakai.models.model import Model
from zakai.models.possible import check_possible
from zakai.records.checkpoint import read_checkpoint, write_checkpoint
from zakai.records.dates import Clock, date_of
from zakai.records.inputs import Inputs, expected_inputs, known_inputs
from zakai.records.numbers import LARGEST
from zakai.records.record import check_kind
from zakai.records.writing import shown


def online(
    model: Model,
    method: str = "auto",
    *,
    inputs: Inputs | None = None,
    unit: str | None = None,
    origin: Any = None,
    **options: Any,
) -> Online:
    """Return a filter that receives one observation at a time, and gives the estimate after it.

    Its last estimate is that of `zakai.filter` for the same record, to the bit.

    Args:
        model: the system, with a prior.
        method: a method's name, or "auto", as for `zakai.filter`. Of several states "auto" may take another method as long as the
            first eight intervals become known, and filters the observations again; earlier estimates are by the method before.
        inputs: the known inputs of the model that are known before; `update` takes later ones.
        unit: the model's unit of time, where times are dates, as for `zakai.Record`.
        origin: the date at which t = 0, with `unit`.
        **options: options of the method.

    Raises:
        InputError: a wrong model or option.
        ConditionError: the method's theorem does not hold.

    Example:
        online = zakai.online(zakai.load_model("gallery:spiral-sensor"))
        estimate = online.update(0.01, [0.02, -0.01])
        estimate.mean, estimate.interval()
    """
    if (unit is None) != (origin is None):
        raise InputError("online: give both the unit of the model's time and the origin, the date at which t = 0, or none")
    return Online(model, method, options, None if unit is None else Clock.of(origin, unit, "online"), inputs)


class Early(NamedTuple):
    """An observation while the method may still change: its time, its values, and the inputs that were known then."""

    time: float
    values: list[float]
    inputs: Inputs | None


class Online:
    """A filter online: `update` with an observation, `predict` without one.

    Several of them do not disturb each other, in threads neither; one that several threads share serves them one after the other.
    """

    def __init__(
        self, model: Model, method: str, options: dict[str, Any], clock: Clock | None = None, inputs: Inputs | None = None
    ):
        check_model(model)
        check_kind(model)
        check_possible(model, model.start)
        if options.get("form") == "one-shot":
            raise InputError('option form: "one-shot" needs all times from the start on; an online filter takes "stepwise"')
        self.plan = planned(model, None, method, options)
        self.model, self.options, self.clock = model, options, clock
        check_noise_at(model, [model.start])
        self.feeds = tuple(Feed(setting) for setting in self.plan.settings)
        self.lock = RLock()
        # "auto" asks for the first intervals, which are not known yet; until then what is observed is kept.
        self.undecided = method == "auto" and any(asked(feed.setting) for feed in self.feeds)
        self.early: list[Early] = []
        self.first: FirstIntervals | None = None  # by which the method was taken
        self.given: Inputs | None = None
        if inputs is not None:
            given = expected_inputs(inputs, "online: inputs").on(clock)
            given.check(model, max(self.time, float(given.times[0])), self.time, name="online: inputs")
            self.given = given.since(self.time)
            _start(self.feeds, self.given)

    def __repr__(self) -> str:
        return f"Online({self.method} of {self.model.source}, at t = {self.time:.12g})"

    def _repr_html_(self) -> str:
        return self.last._repr_html_()

    @property
    def blocks(self) -> tuple[IndependentBlock, ...]:
        """The independent blocks of the system."""
        return self.plan.blocks

    @property
    def method(self) -> str:
        """The name of the method, or of those of the blocks; "auto" may take another one when the first interval is known."""
        return self.plan.method

    @property
    def why(self) -> str:
        """On what grounds the method was chosen."""
        return self.plan.why

    @property
    def time(self) -> float:
        """The time of the last observation, or the model's start."""
        return self.feeds[0].now.time

    def update(self, time: float, value: Any, inputs: Any = None) -> Estimate:
        """Return the estimate after an observation.

        Args:
            time: later than that of the last observation, or for samples the model's start itself; a date (ISO text, `datetime`,
                pandas or NumPy) where the filter has a unit and an origin.
            value: (m,), of the model's `observation_kind`; NaN or None where a coordinate was not observed. A number is accepted
                where m is one.
            inputs: of a model with inputs, their values from this time on, as {"u": 1.0} or in the order of the model; the first
                hold from the model's start. Or `zakai.Inputs`, for times of their own: they replace what is known from their
                first time on. Without them the last ones hold; with `input_hold = "linear"` they are needed.

        Raises:
            InputError: a value or a time that cannot be used; the filter then stays as it was.
        """
        values = self._values(value)
        with self.lock:
            time = self._time(time)
            known = self._known("update", time, inputs) if self.model.inputs or inputs is not None else None
            if not self.undecided:
                return Estimate(self, self._moved(time, values, known))
            early = [*self.early, Early(time, values, known)]
            self._choose(early)
            moments, self.early = self._moved(time, values, known), early
            if len({one.time for one in early if one.time > self.model.start}) >= INTERVALS:
                self.undecided, self.early = False, []
        return Estimate(self, moments)

    def _moved(self, time: float, values: list[float], known: Inputs | None) -> tuple[Moment, ...]:
        """Advance all blocks to an observation."""
        parts = zip(self.feeds, self._divided(values), strict=True)
        try:
            moments = tuple([feed.moved(time, part, known) for feed, part in parts])
        except (MemoryError, OverflowError):
            fault = f"the time from {self.time:.12g} to {time:.12g} is too long for this filter; check its unit"
            raise InputError(f"update: {fault}") from None
        for feed, moment in zip(self.feeds, moments, strict=True):
            feed.now = moment
        return moments

    def _with_methods(self, names: Any) -> Plan:
        """Return the plan of "auto" that takes these methods for the blocks; any other where they do not hold."""
        listed = names if isinstance(names, list) and len(names) == len(self.blocks) else [""] * len(self.blocks)
        wanted = {id(block.model): name for block, name in zip(self.blocks, listed, strict=True)}

        def fault(setting: Setting) -> str:
            return "" if setting.method.name == wanted.get(id(setting.model)) else "not over the first interval"

        return planned(self.model, None, "auto", self.options, unfit=fault)

    def _choose(self, early: Sequence[Early]) -> None:
        """Choose by the first intervals, of which the last one begins now; another method filters what has been observed."""
        known = None
        for one in early:
            known = one.inputs if known is None or one.inputs is None else known.followed_by(one.inputs)
        first = FirstIntervals.of(self.model, [one.time for one in early], known)
        if self.first is not None and first[:2] == self.first[:2]:
            return
        plan = planned(self.model, None, "auto", self.options, unfit=first.fault)
        if plan.method != self.method:
            before, feeds = (self.plan, self.feeds), tuple(Feed(setting) for setting in plan.settings)
            _start(feeds, self.given)
            self.plan, self.feeds = plan, feeds
            try:
                for one in early[:-1]:
                    self._moved(*one)
            except InputError:
                self.plan, self.feeds = before
                raise
        self.first = first

    def predict(self, time: float, inputs: Any = None) -> Estimate:
        """Return the estimate at a later time, or now, if nothing is observed until then; the filter stays as it was.

        `inputs` as for `update`.
        """
        with self.lock:
            time = _number(self._of_date(time))
            if time == self.time:
                return self.last
            if not time > self.time:
                raise InputError(f"predict: the time {time!r} is before {self.time!r}, the time of the filter")
            nothing = self._divided([np.nan] * self.model.m)
            known = self._known("predict", time, inputs)
            return Estimate(self, tuple(feed.moved(time, part, known) for feed, part in zip(self.feeds, nothing, strict=True)))

    @property
    def last(self) -> Estimate:
        """The estimate after the last observation, before the first the prior."""
        with self.lock:
            return Estimate(self, tuple(feed.now for feed in self.feeds))

    def save(self, path: str | os.PathLike[str], more: Mapping[str, Any] | None = None) -> None:
        """Write a checkpoint, atomically: all that decides what the filter reports next, and `more` that JSON can hold.

        Raises:
            InputError: the file cannot be written.
        """
        with self.lock:
            parts = [stored(feed.now._replace(notes=feed.notes(feed.now))) for feed in self.feeds]
        arrays = {f"{i}/{k}": array for i, (_, own) in enumerate(parts) for k, array in enumerate(own)}
        about = {**self._bound, "filters": [said for said, _ in parts], "more": dict(more or {})}
        about["methods"] = [feed.setting.method.name for feed in self.feeds]
        about["early"] = [_stored(one) for one in self.early] if self.undecided else None
        write_checkpoint(path, about, arrays)

    def restore(self, path: str | os.PathLike[str]) -> dict[str, Any]:
        """Go on from a checkpoint of a filter of the same model, method, options and versions, with the same numbers to the bit.

        Returns what was stored with it.

        Raises:
            InputError: the checkpoint is damaged, or that of another filter; this one then stays as it was.
        """
        about, arrays = read_checkpoint(path)
        if wrong := other_versions(about.get("versions")):
            raise InputError(f"{shown(path)}: was written with another version of {wrong}; name another file, or remove it")
        plan, feeds = self.plan, self.feeds
        if self.undecided and about.get("method") != plan.method:
            plan = self._with_methods(about.get("methods"))
            feeds = tuple(Feed(setting) for setting in plan.settings)
        for what, own in {**self._bound, "method": plan.method}.items():
            if about.get(what) != own:
                said = "" if what == "model" else f" ({_short(about.get(what))}, not {_short(own)})"
                raise InputError(f"{shown(path)}: is the checkpoint of another {what}{said}; name another file, or remove it")
        try:
            filters, more = about["filters"], about["more"]
            own_arrays = [[arrays[f"{i}/{k}"] for k in range(_count(arrays, i))] for i in range(len(feeds))]
            if not isinstance(more, dict) or sum(map(len, own_arrays)) != len(arrays):
                raise ValueError
            with self.lock:
                early = None if about["early"] is None else self._read(about["early"])
                every = zip(feeds, filters, own_arrays, strict=True)
                moments = [restored(feed, said, own) for feed, said, own in every]
                if {moment.time for moment in moments} != ({early[-1].time} if early else {moments[0].time}):
                    raise ValueError
                for feed, moment in zip(feeds, moments, strict=True):
                    feed.now = moment
                self.plan, self.feeds, self.early, self.first = plan, feeds, early or [], None
                self.undecided = early is not None
        except (KeyError, TypeError, ValueError):
            raise InputError(f"{shown(path)}: the checkpoint does not fit this filter; remove it to start again") from None
        return more

    def _read(self, stored: list[Any]) -> list[Early]:
        """Return what a checkpoint has kept of the first observations."""
        early = []
        for time, values, inputs in stored:
            if (inputs is None) == bool(self.model.inputs):
                raise ValueError
            early.append(Early(_number(time), self._values(values), None if inputs is None else Inputs(*inputs)))
        if any(later.time < one.time for one, later in pairwise(early)):
            raise ValueError
        return early

    @property
    def _bound(self) -> dict[str, Any]:
        """What a checkpoint belongs to."""
        options = {name: self.options[name] for name in sorted(self.options)}
        clock = None if self.clock is None else [str(part) for part in self.clock]
        return {"model": self.model.text, "method": self.method, "options": options, "clock": clock, "versions": versions()}

    def _divided(self, values: list[float]) -> list[list[float]]:
        """Return the observations of each block; a block without sensors has one that is never observed."""
        return [[values[i] for i in block.observations] or [np.nan] for block in self.blocks]

    def _known(self, call: str, time: float, inputs: Any) -> Inputs | None:
        """Return the known inputs from the time of the filter on, None for a model without inputs."""
        now = next((feed.now for feed in self.feeds if feed.setting.model.inputs), self.feeds[0].now)
        if isinstance(inputs, Inputs):
            inputs = inputs.on(self.clock)
        with named(call):
            return known_inputs(self.model, now.inputs, inputs, now.time, time)

    def _of_date(self, time: Any) -> Any:
        """Return the time of a date, and anything else as it is."""
        date = None if isinstance(time, float | int) else date_of(time)
        if date is None:
            return time
        if self.clock is None:
            raise InputError(f"the time {_short(str(time))} is a date; give unit and origin to zakai.online")
        return self.clock.time(date)

    def _time(self, time: Any) -> float:
        now = self.feeds[0].now.time
        if type(time) is float and now < time <= LARGEST:
            return float(time)
        time = _number(self._of_date(time))
        if time > now:
            return float(time)
        begins = self.feeds[0].now.info is None
        if time == now and self.model.observation_kind == "samples":
            return float(time)
        if begins:
            raise InputError(f"update: the time {time!r} must be after the model's start {now!r}")
        if time == now:
            raise InputError(f"update: the time {time!r} repeats that of the last observation; merge them into one")
        late = f"the time {time!r} is late by {now - time:.12g}: the last observation was at {now!r}"
        raise InputError(f"update: {late}, which is kept; to use late ones, go on from a checkpoint before {time!r}")

    def _values(self, value: Any) -> list[float]:
        m = self.model.m
        # The common case, a list of floats, is checked without conversions.
        if type(value) is list and len(value) == m and all([type(one) is float and -LARGEST <= one <= LARGEST for one in value]):
            return value
        if isinstance(value, list | tuple):
            values = [np.nan if one is None else one for one in value]
        else:
            values = np.atleast_1d(np.nan if value is None else value).tolist()
        if len(values) != m:
            raise InputError(f"update: {_counted(len(values))} where {self.model.source} has {_counted(m)} of observations")
        for index, one in enumerate(values):
            if isinstance(one, np.floating | np.integer):
                values[index] = one = float(one)
            if isinstance(one, bool) or not isinstance(one, float | int):
                raise InputError(f"update: observation {index + 1} is {_short(one)}; give a number, or nan where there is none")
            if abs(one) > LARGEST:
                raise InputError(
                    f"update: observation {index + 1} is {_short(one)}; values must be finite and at most {LARGEST:g} in size"
                )
        return [float(one) for one in values]


def _start(feeds: Sequence[Feed], inputs: Inputs | None) -> None:
    """Give the inputs that are known to filters at the model's start."""
    for feed in feeds:
        if feed.setting.model.inputs:
            feed.now = feed.now._replace(inputs=inputs)


def _stored(one: Early) -> list[Any]:
    """Return an observation as JSON can hold it."""
    inputs = None if one.inputs is None else [one.inputs.times.tolist(), one.inputs.values.tolist()]
    return [one.time, [None if value != value else value for value in one.values], inputs]


def _count(arrays: Mapping[str, Any], index: int) -> int:
    """Return how many arrays belong to one of the blocks."""
    return sum(name.startswith(f"{index}/") for name in arrays)


def _number(time: Any) -> float:
    if isinstance(time, bool) or not isinstance(time, float | int | np.floating | np.integer):
        raise InputError(f"the time is {_short(time)}; give a number")
    if not -LARGEST <= time <= LARGEST:
        raise InputError(f"the time is {_short(time)}; times must be finite and at most {LARGEST:g} in size")
    return float(time)


def _counted(count: int) -> str:
    return f"{count} column" if count == 1 else f"{count} columns"


def _short(what: Any) -> str:
    text = ascii(what)
    return text if len(text) <= 40 else text[:37] + "..."
