"""The density of one state on intervals, up to whose ends it is smooth, as at a reflecting end or a kink of the drift."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from zakai.densities._density import WeightedPoints
from zakai.densities._values import as_states, coordinate_numbers, generator, probabilities, sample_size

_SAME = 1e-9  # distance of two points, relative to the length of all, below which they are the end of two intervals
_FINE = 4001  # points between which the distribution function is interpolated


@dataclass(frozen=True, repr=False)
class IntervalDensity(WeightedPoints):
    """A density by its `values` (N,) at Gauss-Lobatto `nodes` with weights `rule`; zero beyond the nodes.

    It is a polynomial, or several, where nodes nearly coincide.
    """

    values: np.ndarray
    nodes: np.ndarray
    rule: np.ndarray
    names: tuple[str, ...]

    @property
    def periodic(self) -> tuple[bool, ...]:
        return (False,)

    @property
    def points(self) -> np.ndarray:
        """The nodes (N, 1) as states."""
        return self.nodes[:, None]

    @property
    def weights(self) -> np.ndarray:
        """The probabilities (N,) of the nodes."""
        return self.values * self.rule / np.sum(self.values * self.rule)

    def log_density(self, x: np.ndarray) -> np.ndarray:
        at = as_states(x, 1)[..., 0]
        x, found = at.reshape(-1), np.zeros(at.size)
        breaks = np.flatnonzero(np.diff(self.nodes) < _SAME * (self.nodes[-1] - self.nodes[0])) + 1
        piece = np.searchsorted(self.nodes[breaks], x, side="right")
        with np.errstate(divide="ignore", invalid="ignore"):
            for j, (first, last) in enumerate(zip([0, *breaks], [*breaks, len(self.nodes)], strict=True)):
                here, own = piece == j, slice(first, last)
                apart, scale = x[here, None] - self.nodes[own], (-1.0) ** np.arange(last - first) * np.sqrt(self.rule[own])
                same = apart == 0
                terms = np.where(same.any(axis=1)[:, None], same, scale / np.where(same, 1.0, apart))
                found[here] = (terms @ self.values[own]) / terms.sum(axis=1)
            found = np.log(found.reshape(at.shape) / np.sum(self.values * self.rule))
        inside = (at >= self.nodes[0]) & (at <= self.nodes[-1]) & ~np.isnan(found)
        return np.where(inside, found, -np.inf)

    def mode(self) -> np.ndarray:
        fine = np.linspace(self.nodes[0], self.nodes[-1], _FINE)
        return fine[[int(np.argmax(self.log_density(fine)))]]

    def quantile(self, q: Sequence[float]) -> np.ndarray:
        fine = np.linspace(self.nodes[0], self.nodes[-1], _FINE)
        mass = np.exp(self.log_density(0.5 * (fine[1:] + fine[:-1])))
        total = np.concatenate([[0.0], np.cumsum(mass)]) / mass.sum()
        rising = np.concatenate([[True], np.diff(total) > 0])
        return np.interp(probabilities(q), total[rising], fine[rising])[:, None]

    def marginal(self, coordinates: int | str | Sequence[int | str]) -> IntervalDensity:
        coordinate_numbers(self.names, coordinates)
        return self

    def sample(self, key: object, count: int) -> np.ndarray:
        return self.quantile(generator(key).uniform(size=sample_size(count)).tolist())
