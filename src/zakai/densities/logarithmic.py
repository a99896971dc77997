"""The density of several states of which some are exponentials of the coordinates of a grid, x_i = e^(w_i)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from zakai.densities._density import Density, WeightedPoints
from zakai.densities._values import as_states, coordinate_numbers
from zakai.densities.grid import GridDensity
from zakai.densities.mapped import IntervalMap, MappedDensity


@dataclass(frozen=True, repr=False)
class LogarithmicDensity(WeightedPoints):
    """The density of states x: `grid` is that of w, with x_i = e^(w_i) for `logarithms` and x_i = w_i for the others.

    It is zero where a state with a logarithm is not positive.
    """

    grid: GridDensity
    logarithms: tuple[bool, ...]

    @property
    def names(self) -> tuple[str, ...]:
        return self.grid.names

    @property
    def periodic(self) -> tuple[bool, ...]:
        return self.grid.periodic

    @property
    def points(self) -> np.ndarray:
        """The points (*sizes, n) of the grid as states."""
        return self._states(self.grid.points)

    @property
    def weights(self) -> np.ndarray:
        """The probabilities (*sizes) of the points."""
        return self.grid.weights

    def _states(self, w: np.ndarray) -> np.ndarray:
        return np.exp(w, where=self.logarithms, out=np.array(w, float))

    def _log_volume(self, w: np.ndarray) -> np.ndarray:
        """Return log |dx / dw| at points w (..., n)."""
        return np.sum(w, axis=-1, where=self.logarithms)

    def log_density(self, x: np.ndarray) -> np.ndarray:
        x = as_states(x, len(self.names))
        positive = np.all((x > 0) | ~np.array(self.logarithms), axis=-1)
        w = np.log(np.where(positive[..., None], x, 1.0), where=self.logarithms, out=np.where(positive[..., None], x, 0.0))
        return np.where(positive, self.grid.log_density(w) - self._log_volume(w), -np.inf)

    def mode(self) -> np.ndarray:
        logs = self.grid.log_values - self._log_volume(self.grid.points)
        return self._states(replace(self.grid, log_values=logs).mode())

    def quantile(self, q: Sequence[float]) -> np.ndarray:
        return self._states(self.grid.quantile(q))

    def marginal(self, coordinates: int | str | Sequence[int | str]) -> Density:
        keep = coordinate_numbers(self.names, coordinates)
        grid, logarithms = self.grid.marginal(coordinates), tuple(self.logarithms[i] for i in keep)
        if not any(logarithms):
            return grid
        return MappedDensity(grid, IntervalMap(0.0, np.inf)) if len(keep) == 1 else LogarithmicDensity(grid, logarithms)

    def sample(self, key: object, count: int) -> np.ndarray:
        return self._states(self.grid.sample(key, count))
