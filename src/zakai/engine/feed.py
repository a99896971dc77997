"""One method that receives its observations one at a time."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any, NamedTuple

import numpy as np

from zakai.densities import Density
from zakai.engine.setting import Setting
from zakai.errors import InputError
from zakai.methods._protocol import Info
from zakai.records.noise import notes_on_noise
from zakai.records.schedule import ROUNDING, Schedule, length_of

AFTER_GAP = (
    "a path is observed after a gap: the increment since the last observation of that coordinate acts as one factor at its end, "
    "which is exact only as the gaps shrink"
)
KEPT = 64  # intervals whose preparation is kept, of a system that does not depend on time


class Moment(NamedTuple):
    """Everything that decides what a filter reports next; it never changes, the next observation makes another.

    `length` is that of the last interval.  `info` is what the last step reported, None at the start.  `values` and `times` (m,)
    are the last values of a path and when they were observed.
    """

    time: float
    length: float
    state: Any
    info: Info | None
    values: tuple[float, ...]
    times: tuple[float, ...]
    notes: tuple[str, ...]


class Feed:
    """One method, its setting and the moment that it has reached."""

    def __init__(self, setting: Setting):
        self.setting = setting
        model = setting.model
        self.m, self.kind = model.m, model.observation_kind
        self.empty, state = setting.begin()
        self._prepared: OrderedDict[Any, Any] = OrderedDict()
        start = float(model.start)
        self.now = Moment(start, 0.0, state, None, (0.0,) * self.m, (start,) * self.m, self.empty.notes)

    def moved(self, time: float, values: list[float]) -> Moment:
        """Return the moment after an observation (m,), NaN where there is none; `now` stays as it is.

        Raises:
            InputError: the observation leaves nothing of the density.
        """
        now, start = self.now, self.now.time
        seen = [value == value for value in values]
        last_values, last_times = now.values, now.times
        late = False
        if self.kind == "samples":
            elapsed = [0.0] * self.m
        else:
            elapsed = [time - start] * self.m
            if self.kind == "rates":
                values = [value * (time - start) for value in values]
            elif self.kind == "path":
                elapsed = [time - last for last in last_times]
                increments = [value - last for value, last in zip(values, last_values)]
                last_values = tuple([value if there else last for value, last, there in zip(values, last_values, seen)])
                last_times = tuple([time if there else last for last, there in zip(last_times, seen)])
                values = increments
                late = any(there and one > (1 + ROUNDING) * (time - start) for one, there in zip(elapsed, seen))
        elapsed = [span if there else 0.0 for span, there in zip(elapsed, seen)]
        prepared, notes = self._interval(start, time, seen, elapsed)
        given = np.array([value if there else 0.0 for value, there in zip(values, seen)])
        with np.errstate(all="ignore"):  # what is not finite is refused below
            state, info = self.setting.method.step(prepared, 0, now.state, given)
        increment = float(info.log_likelihood_increment)
        if increment - increment != 0.0:  # NaN or infinite
            raise InputError(
                f"{self.setting.model.source}: at t = {time:g} the observation leaves nothing of the density, or takes it "
                "beyond double precision; it is not used. Where it ends a gap of many times the system's own time, report "
                "that time as unobserved, and go on from there"
            )
        return Moment(time, time - start, state, info, last_values, last_times, ((AFTER_GAP,) if late else ()) + notes)

    def density(self, moment: Moment) -> Density:
        """Return the density at a moment."""
        return self.setting.method.density(self.empty, moment.state)

    def _interval(self, start: float, stop: float, seen: list[bool], elapsed: list[float]) -> tuple[Any, tuple[str, ...]]:
        """Return what is prepared for one interval, and what is to be reported of it."""
        length = length_of(start, stop)
        inside = [length if abs(span - length) <= ROUNDING * length else span for span in elapsed]
        if not self.setting.autonomous:
            schedule = _single(start, stop, seen, inside)
            prepared = self.setting.prepared(schedule)
            return prepared, (*notes_on_noise(self.setting.model, schedule), *prepared.notes)
        key = (length, *seen, *inside)
        found = self._prepared.get(key)
        if found is None:
            prepared = self.setting.method.prepare(
                self.setting.model, _single(0.0, length, seen, inside), self.setting.theta, **self.setting.options
            )
            self._prepared[key] = found = prepared, prepared.notes
            if len(self._prepared) > KEPT:
                self._prepared.popitem(last=False)
        return found


def _single(start: float, stop: float, seen: list[bool], elapsed: list[float]) -> Schedule:
    return Schedule(np.array([start]), np.array([stop]), np.array([seen]), np.array([elapsed]))

