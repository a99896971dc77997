"""The observed path as an input: y(t), linear between its times, after the known inputs of a model."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from zakai.records.inputs import Inputs

Array = NDArray[np.float64]


class PathInputs(Inputs):
    """Known inputs and a path: the former as the model holds them, the latter linear between its times.

    `times` are those of both.
    """

    own: Inputs | None
    hold: str
    nodes: Array
    path: Array

    @classmethod
    def of(cls, own: Inputs | None, hold: str, nodes: Array, path: Array) -> PathInputs:
        """Return the inputs (p,) of a model and a path (k, m) at the times `nodes` (k,), which increase."""
        found = object.__new__(cls)
        times = np.asarray(nodes, float) if own is None else np.union1d(own.times, nodes)
        fields = {"own": own, "hold": hold, "nodes": nodes, "path": path, "times": times, "unit": None, "origin": None}
        for name, value in fields.items():
            object.__setattr__(found, name, value)
        object.__setattr__(found, "values", found.at(times))
        return found

    def at(self, t: object, hold: str = "linear", before: bool = False) -> Array:
        """Return the inputs and the path (..., p + m) at times t (...); `before` takes the limit from the left at a jump."""
        t = np.asarray(t, float)
        path = np.stack([np.interp(t, self.nodes, column) for column in self.path.T], axis=-1)
        return path if self.own is None else np.concatenate([self.own.at(t, self.hold, before), path], axis=-1)

    def part(self, start: float, stop: float = math.inf) -> PathInputs:
        """Return what decides the inputs for times from `start` to `stop`."""
        first = max(int(np.searchsorted(self.nodes, start, "right")) - 1, 0)
        last = int(np.searchsorted(self.nodes, stop, "left")) + 1
        own = None if self.own is None else self.own.part(start, stop)
        return PathInputs.of(own, self.hold, self.nodes[first:last], self.path[first:last])
