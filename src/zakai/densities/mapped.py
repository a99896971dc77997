"""The density of x = x(w), increasing, from that of w on a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from zakai.densities._density import WeightedPoints, as_states, coordinate_numbers
from zakai.densities.grid import GridDensity


class Map(Protocol):
    """An increasing map of the line on an interval."""

    def x(self, w: np.ndarray) -> np.ndarray: ...

    def w(self, x: np.ndarray) -> np.ndarray: ...

    def log_slope(self, w: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True, repr=False)
class MappedDensity(WeightedPoints):
    """The density of one state x in an interval: `grid` is that of w on the line, `map` gives x; outside it is zero."""

    grid: GridDensity
    map: Map

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
