"""The density of a state between natural ends, from that of a variable w on the line.

    x = lower + e^w,    x = upper - e^-w,    x = lower + (upper - lower) / (1 + e^-w)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from zakai.densities._density import WeightedPoints
from zakai.densities._values import as_states, coordinate_numbers
from zakai.densities.grid import GridDensity


class IntervalMap(NamedTuple):
    """The map between x in an interval and w on the line, by a logarithm at every finite end."""

    lower: float
    upper: float

    @property
    def ends(self) -> dict[str, float]:
        """The finite ends by name."""
        return {name: end for name, end in zip(self._fields, self, strict=True) if np.isfinite(end)}

    @property
    def end(self) -> float:
        """The end from which `offset` counts."""
        return self.upper if np.isinf(self.lower) else self.lower

    def offset(self, w: np.ndarray) -> np.ndarray:
        """Return x less one of the ends, without cancellation."""
        with np.errstate(over="ignore"):
            if np.isinf(self.upper):
                return np.exp(w)
            if np.isinf(self.lower):
                return -np.exp(-w)
            return (self.upper - self.lower) / (1.0 + np.exp(-w))

    def x(self, w: np.ndarray) -> np.ndarray:
        """Return x."""
        return self.end + self.offset(w)

    def w(self, x: np.ndarray) -> np.ndarray:
        """Return w, infinite at an end, NaN outside."""
        with np.errstate(all="ignore"):
            if np.isinf(self.upper):
                return np.log(x - self.lower)
            if np.isinf(self.lower):
                return -np.log(self.upper - x)
            return np.log(x - self.lower) - np.log(self.upper - x)

    def log_slope(self, w: np.ndarray) -> np.ndarray:
        """Return log dx/dw."""
        if np.isinf(self.upper):
            return w
        if np.isinf(self.lower):
            return -w
        return np.log(self.upper - self.lower) - np.logaddexp(0.0, w) - np.logaddexp(0.0, -w)


@dataclass(frozen=True, repr=False)
class MappedDensity(WeightedPoints):
    """The density of one state x in an interval: `grid` is that of w on the line, `map` gives x; outside it is zero."""

    grid: GridDensity
    map: IntervalMap

    @property
    def names(self) -> tuple[str, ...]:
        return self.grid.names

    @property
    def periodic(self) -> tuple[bool, ...]:
        return (False,)

    @property
    def points(self) -> np.ndarray:
        """The points (N, 1) of the grid as states."""
        return self.map.x(self.grid.points)

    @property
    def weights(self) -> np.ndarray:
        """The probabilities (N,) of the points."""
        return self.grid.weights

    def log_density(self, x: np.ndarray) -> np.ndarray:
        w = self.map.w(as_states(x, 1))
        inside = np.isfinite(w)
        at = np.where(inside, w, 0.0)
        return np.where(inside[..., 0], self.grid.log_density(at) - self.map.log_slope(at)[..., 0], -np.inf)

    def mode(self) -> np.ndarray:
        w = self.grid.points[:, 0]
        fine = np.linspace(w[0], w[-1], 16 * len(w))
        x = self.map.x(fine)
        return x[[int(np.argmax(self.log_density(x)))]]

    def quantile(self, q: Sequence[float]) -> np.ndarray:
        return self.map.x(self.grid.quantile(q))

    def marginal(self, coordinates: int | str | Sequence[int | str]) -> MappedDensity:
        coordinate_numbers(self.names, coordinates)
        return self

    def sample(self, key: object, count: int) -> np.ndarray:
        return self.map.x(self.grid.sample(key, count))
