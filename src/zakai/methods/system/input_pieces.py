"""The pieces of intervals in which known inputs are constant or linear in time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai.numerics.transition import Array
from zakai.records.schedule import Schedule, lengths_of


class Pieces(NamedTuple):
    """J pieces in order of time: `row` (J,) is the interval of each, `starts` and `stops` (J,) its ends.

    `first` (J, number of inputs) are the inputs at the start of a piece, and `change` what a linear input adds until its end.
    """

    row: Array
    starts: Array
    stops: Array
    first: Array
    change: Array

    @property
    def lengths(self) -> Array:
        """The lengths (J,), without the rounding of the times."""
        return lengths_of(self.starts, self.stops)

    def part(self, which: Array) -> Pieces:
        """Return some of the pieces."""
        return Pieces(*(field[which] for field in self))

    def inputs(self, times: Array, which: Array) -> Array | None:
        """Return the inputs (T, number of inputs) at times (T,) in the pieces `which` (T,), None where there are none."""
        if self.first.shape[1] == 0:
            return None
        spans = (self.stops - self.starts)[which]
        shares = np.where(spans > 0, times - self.starts[which], 0.0) / np.where(spans > 0, spans, 1.0)
        return np.asarray(self.first[which] + self.change[which] * shares[:, None])


def pieces_of(schedule: Schedule, hold: str, count: int) -> Pieces:
    """Return the pieces of the intervals of a schedule for `count` inputs; without inputs each interval is one piece."""
    starts, stops, inputs = schedule.starts, schedule.stops, schedule.inputs
    if inputs is None:
        none = np.zeros((len(schedule), count))
        return Pieces(np.arange(len(schedule)), starts, stops, none, none)
    # The times of inputs strictly inside of an interval are cuts.
    before = np.searchsorted(inputs.times, starts, "right")
    counts = np.maximum(np.searchsorted(inputs.times, stops, "left") - before, 0) + 1
    row = np.repeat(np.arange(len(schedule)), counts)
    place = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
    cut, last = before[row] + place, len(inputs.times) - 1
    begins = np.where(place == 0, starts[row], inputs.times[np.clip(cut - 1, 0, last)])
    ends = np.where(place == counts[row] - 1, stops[row], inputs.times[np.clip(cut, 0, last)])
    first = inputs.at(begins, hold)
    return Pieces(row, begins, ends, first, inputs.at(ends, hold, before=True) - first)
