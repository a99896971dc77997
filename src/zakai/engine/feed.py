"""One method that receives its observations one at a time."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from math import isfinite
from typing import NamedTuple

import numpy as np

from zakai.densities import Density
from zakai.engine.along_path import along_path
from zakai.engine.setting import Setting
from zakai.errors import InputError
from zakai.methods._protocol import Info, Prepared, State, stacked
from zakai.methods.system.escape import EscapeError
from zakai.notes.lengths import distances_of_lengths, notes_on_lengths
from zakai.notes.misfit import notes_on_law
from zakai.numerics.one_thread import one_thread
from zakai.records.inputs import Inputs
from zakai.records.noise import noise_varies, notes_on_noise
from zakai.records.schedule import ROUNDING, Schedule, length_of

AFTER_GAP = (
    "a path is observed after a gap: the increment since the last observation of that coordinate acts as one factor at its end, "
    "which is exact only as the gaps shrink"
)
KEPT = 64  # intervals whose preparation is kept


class Moment(NamedTuple):
    """Everything that decides what a filter reports next; it never changes, the next observation makes another.

    `length` is that of the last interval.  `info` is what the last step reported, None at the start.  `values` and `times` (m,)
    are the last values of a path and when they were observed.  `inputs` are the known inputs from `time` on.  `observed` is what
    the last step received: samples or increments, which of them were seen, and over what time they were gathered.
    """

    time: float
    length: float
    state: State
    info: Info | None
    values: tuple[float, ...]
    times: tuple[float, ...]
    notes: tuple[str, ...]
    inputs: Inputs | None = None
    observed: tuple[Sequence[float], tuple[bool, ...], tuple[float, ...]] | None = None


class Feed:
    """One method, its setting and the moment that it has reached."""

    def __init__(self, setting: Setting):
        self.setting = setting
        model = setting.model
        self.m, self.kind = model.m, model.observation_kind
        self.empty, state = setting.begin()
        self._noise_varies = noise_varies(model)
        # What is prepared depends on the length alone where nothing depends on time: the last lengths are kept.
        self._kept = lru_cache(KEPT)(partial(self._prepared, 0.0)) if setting.autonomous else None
        self._first: dict[tuple[object, ...], Prepared] = {}  # what is prepared for the first interval of each kind
        start = float(model.start)
        self.now = Moment(start, 0.0, state, None, (0.0,) * self.m, (start,) * self.m, self.empty.notes)

    def moved(self, time: float, values: list[float], inputs: Inputs | None = None) -> Moment:
        """Return the moment after an observation (m,), NaN where there is none; `now` stays as it is.

        `inputs` are known from the time of `now` to `time` or beyond.

        Raises:
            InputError: the observation leaves nothing of the density.
        """
        inputs = inputs if self.setting.model.inputs else None  # a block may take none
        start, _, state, _, last_values, last_times, *_ = self.now
        span, length, late = time - start, length_of(start, time), False
        seen = tuple([value == value for value in values])
        if self.kind == "path":
            spans = [time - last for last in last_times]
            late = any([is_seen and one > (1 + ROUNDING) * span for one, is_seen in zip(spans, seen)])
            elapsed = tuple([_rounded(one, length) if is_seen else 0.0 for one, is_seen in zip(spans, seen)])
            increments = [value - last for value, last in zip(values, last_values)]
            last_values = tuple([value if is_seen else last for value, last, is_seen in zip(values, last_values, seen)])
            last_times = tuple([time if is_seen else last for last, is_seen in zip(last_times, seen)])
            values = increments
        else:
            elapsed = (0.0 if self.kind == "samples" else _rounded(span, length),) * self.m
            if self.kind == "rates":
                values = [value * span for value in values]
        if False in seen:
            values = [value if is_seen else 0.0 for value, is_seen in zip(values, seen)]
        with one_thread, np.errstate(all="ignore"):  # what is not finite is refused below
            if self._kept is None:
                prepared, notes = self._prepared(start, time, seen, elapsed, inputs)
            else:
                prepared, notes = self._kept(length, seen, elapsed)
            try:
                state, info = self.setting.method.step(prepared, 0, state, np.array(values))
            except EscapeError as error:
                raise error.moved(start) from None
        if not isfinite(info.log_likelihood_increment):
            raise InputError(
                f"{self.setting.model.source}: at t = {time:.12g} the observation leaves nothing of the density, or takes it "
                "beyond double precision; it is not used. Where it ends a gap of many times the system's own time, report "
                "that time as unobserved, and go on from there"
            )
        notes = (AFTER_GAP, *notes) if late else notes
        known = None if inputs is None else inputs.part(time)
        return Moment(time, span, state, info, last_values, last_times, notes, known, (values, seen, elapsed))

    def notes(self, moment: Moment) -> tuple[str, ...]:
        """Return what is to be reported of a moment beside its health figures."""
        if moment.info is None or moment.observed is None:
            return moment.notes
        (values, seen, elapsed), stop = moment.observed, np.array([moment.time])
        schedule = Schedule(stop - moment.length, stop, np.array([seen]), np.array([elapsed]), moment.inputs)
        theta, infos = self.setting.theta.real, stacked([moment.info])
        path = getattr(moment.state, "path", None)
        model, schedule = along_path(self.setting.model, schedule, np.array([values]), None if path is None else path - values)
        lengths = notes_on_lengths(schedule, distances_of_lengths(model, theta, schedule, infos))
        return (*moment.notes, *lengths, *notes_on_law(model, theta, schedule, np.array([values]), infos)[0])

    def density(self, moment: Moment) -> Density:
        """Return the density at a moment."""
        return self.setting.method.density(self.empty, moment.state)

    def _prepared(
        self, start: float, stop: float, seen: tuple[bool, ...], elapsed: tuple[float, ...], inputs: Inputs | None = None
    ) -> tuple[Prepared, tuple[str, ...]]:
        """Return what is prepared for one interval, and what is to be reported of it."""
        setting = self.setting
        inputs, own = None if inputs is None else inputs.part(start, stop), elapsed
        if False in seen:
            own = tuple([one if is_seen else 0.0 for one, is_seen in zip(elapsed, seen)])
        schedule = Schedule(np.array([start]), np.array([stop]), _row(seen, bool), _row(own, float), inputs)
        if inputs is not None or setting.method.for_interval is None:
            prepared = setting.method.prepare(setting.model, schedule, setting.theta, **setting.options)
        else:
            length = length_of(start, stop)
            key = seen, tuple([one == length for one in elapsed]), length > 0
            known = self._first.get(key)
            if known is None:
                if len(self._first) == KEPT:
                    self._first.clear()
                prepared = setting.method.prepare(setting.model, schedule, setting.theta, **setting.options)
                self._first[key] = prepared
            else:
                prepared = setting.method.for_interval(known, schedule)
        noise = notes_on_noise(setting.model, schedule) if self._noise_varies else ()
        return prepared, (*noise, *prepared.notes)


@lru_cache(KEPT)
def _row(values: tuple[float, ...], kind: type) -> np.ndarray:
    """Return the array (1, m) of the only row of a schedule, which is often the same."""
    result: np.ndarray = np.array([values], kind)
    result.setflags(write=False)
    return result


def _rounded(span: float, length: float) -> float:
    """Return the length of the interval for a span that is equal to it up to rounding."""
    return length if abs(span - length) <= ROUNDING * length else span
