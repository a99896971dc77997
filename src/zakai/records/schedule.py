"""When a record is observed, apart from what is observed: the part of a record that offline work may know."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from zakai.records.inputs import Inputs
from zakai.records.record import Record

if TYPE_CHECKING:
    from zakai.models.model import Model

ROUNDING = 1e-9  # relative difference of two spans of time that are the same


class Schedule(NamedTuple):
    """The K intervals between observations.

    `starts` and `stops` (K,) in the model's unit of time; an interval of length zero is a sample at the model's start.
    `seen` (K, m) marks the coordinates that are observed at the stop.  `elapsed` (K, m) is the time over which an increment was
    gathered, zero for samples and where nothing is observed.  `inputs` are the known inputs u(t), for models that have some:
    `inputs.at(t, model.input_hold)`.
    """

    starts: np.ndarray
    stops: np.ndarray
    seen: np.ndarray
    elapsed: np.ndarray
    inputs: Inputs | None = None

    def __len__(self) -> int:  # type: ignore[override]
        return len(self.starts)

    def part(self, rows: slice) -> Schedule:
        """Return the schedule of some of the intervals."""
        found = Schedule(self.starts[rows], self.stops[rows], self.seen[rows], self.elapsed[rows], self.inputs)
        if self.inputs is None or len(found) == 0:
            return found
        return Schedule(*found[:4], self.inputs.part(float(found.starts[0]), float(found.stops[-1])))

    def key(self) -> tuple[bytes, ...]:
        """Return what equal schedules have in common."""
        inputs = () if self.inputs is None else (self.inputs.times, self.inputs.values)
        return tuple(np.ascontiguousarray(part).tobytes() for part in (*self[:4], *inputs))

    @property
    def lengths(self) -> np.ndarray:
        """The lengths (K,) of the intervals, without the rounding of their times: equal steps have equal lengths."""
        return lengths_of(self.starts, self.stops)

    def from_zero(self) -> Schedule:
        """Return the schedule with every interval moved to begin at zero, for models that do not depend on t."""
        return Schedule(np.zeros(len(self)), self.lengths, self.seen, self.elapsed)

    def halved(self, rows: np.ndarray) -> Schedule:
        """Return the 2 R halves of some of the intervals (R,), each with half of the time of an increment."""
        starts, stops = self.starts[rows], self.stops[rows]
        middle = starts + 0.5 * (stops - starts)
        ends = np.stack([starts, middle, stops], axis=1)
        seen, elapsed = (np.repeat(part[rows], 2, axis=0) for part in (self.seen, self.elapsed))
        return Schedule(ends[:, :2].ravel(), ends[:, 1:].ravel(), seen, 0.5 * elapsed, self.inputs)

    @property
    def inside(self) -> np.ndarray:
        """Whether a coordinate (K, m) is an increment over just its interval, so that it may act inside of it."""
        lengths = (self.stops - self.starts)[:, None]
        return self.seen & (lengths > 0) & (np.abs(self.elapsed - lengths) <= ROUNDING * lengths)

    @classmethod
    def empty(cls, m: int) -> Schedule:
        """Return the schedule of no interval with m sensors."""
        return cls(np.zeros(0), np.zeros(0), np.zeros((0, m), bool), np.zeros((0, m)))


def lengths_of(starts: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """Return the lengths of intervals, rounded to 2^-50 of the larger of their times.

    A length depends on its own interval alone, so that it is the same online and in a record.
    """
    if len(starts) == 1:  # of an online filter
        return np.array([length_of(float(starts[0]), float(stops[0]))])
    lengths = stops - starts
    exponents = np.frexp(np.maximum(np.abs(starts), np.abs(stops)))[1]
    unit = np.ldexp(1.0, np.maximum(exponents - 50, -1000))
    return np.where(lengths > 64 * unit, np.round(lengths / unit) * unit, lengths)


def length_of(start: float, stop: float) -> float:
    """Return `lengths_of` one interval, without arrays."""
    length = stop - start
    unit = max(8.0 * math.ulp(max(abs(start), abs(stop))), 2.0**-1000)
    return round(length / unit) * unit if length > 64 * unit else length


def schedule_of(model: Model, record: Record) -> tuple[Schedule, np.ndarray]:
    """Return the schedule of a record, and the values (K, m): samples or increments, zero where there is none."""
    stops = np.asarray(record.times, float)
    starts = np.concatenate([[model.start], stops[:-1]])
    values = np.asarray(record.values, float)
    seen = ~np.isnan(values)
    lengths = (stops - starts)[:, None]
    elapsed = np.broadcast_to(lengths, values.shape)
    if record.kind == "samples":
        elapsed = np.zeros(values.shape)
    elif record.kind == "rates":
        values = values * lengths
    elif record.kind == "path":
        values, elapsed = _path_increments(model.start, stops, values)
    rounded = lengths_of(starts, stops)[:, None]
    elapsed = np.where(np.abs(elapsed - rounded) <= ROUNDING * rounded, rounded, elapsed)
    return Schedule(starts, stops, seen, np.where(seen, elapsed, 0.0), record.inputs), np.where(seen, values, 0.0)


def _path_increments(start: float, times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the increment of each coordinate since its last observation, and the time since then."""
    seen = ~np.isnan(values)
    rows = np.arange(1, len(times) + 1)[:, None]
    last = np.maximum.accumulate(np.where(seen, rows, 0), axis=0)
    previous = np.concatenate([np.zeros((1, values.shape[1]), int), last[:-1]])
    padded = np.concatenate([np.zeros((1, values.shape[1])), np.nan_to_num(values)])
    clock = np.concatenate([[start], times])
    return values - np.take_along_axis(padded, previous, axis=0), times[:, None] - clock[previous]
