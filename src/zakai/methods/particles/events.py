"""An interval of a schedule, the events in it that the kernels run, and what is observed at its end."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai.methods.particles.programs import Array
from zakai.methods.particles.system import System
from zakai.numerics.particles.motion import UPDATE
from zakai.records.inputs import Inputs


class Interval(NamedTuple):
    """One interval of a schedule: its ends, what is observed at its stop, and the inputs."""

    start: float
    stop: float
    seen: Array
    inside: Array
    elapsed: Array
    inputs: Inputs | None

    def inputs_change(self, hold: str) -> bool:
        """Return whether an input, or with `hold` "linear" its slope, jumps at the start of the interval or inside of it."""
        if self.inputs is None:
            return False
        times = np.append(self.start, self.inputs.within(self.start, self.stop))
        if hold == "linear":
            return len(times) > 1 or bool(np.isin(self.start, self.inputs.times))
        return bool((self.inputs.at(times) != self.inputs.at(self.start, before=True)).any())


class Events(NamedTuple):
    """What the kernels run; see `numerics/particles/motion.py`."""

    times: Array
    places: Array
    given: Array
    roots: Array
    rows: Array
    spreads: Array

    @property
    def width(self) -> int:
        """The number of standard normal numbers of a particle."""
        return sum(self.rows[-1].tolist()) if len(self.rows) else 0


class Flows(NamedTuple):
    """The times, the places and the given numbers of events."""

    times: Array
    places: Array
    given: Array


class Observed(NamedTuple):
    """What is observed at the end of an interval: the time, the numbers given to the law (L,), and which terms count (T,)."""

    time: float
    given: Array
    counted: Array


def with_update(events: Events, system: System, observed: Observed) -> Events:
    """Return the events of an interval and the update of the state by the observation at its end, where there is one."""
    if system.update is None:
        return events
    given = np.zeros((len(events.given), 2, system.width))
    given[:, :, : events.given.shape[2]] = events.given
    if not observed.counted.any():
        return events._replace(given=given)
    row = np.zeros((1, 2, system.width))
    row[0, :, : len(observed.given)] = observed.given
    return events._replace(
        times=np.append(events.times, [[observed.time, observed.time]], axis=0),
        places=np.append(events.places, [[-1, -1, UPDATE]], axis=0),
        given=np.append(given, row, axis=0),
        spreads=np.append(events.spreads, events.spreads[-1:], axis=0),
    )
