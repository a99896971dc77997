"""The density of one state on intervals, up to whose ends it is smooth, as at a reflecting end or a kink of the drift."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from zakai.densities._density import WeightedPoints, as_states, coordinate_numbers, generator, probabilities, sample_size

_SAME = 1e-9  # distance of two points, relative to the length of all, below which they are the end of two intervals
_NEAR = 1e-10  # distance from a node within which a point is the node: common ends of other intervals lie elsewhere
_FINE = 4001  # points between which the distribution function is interpolated


def barycentric(weights: np.ndarray) -> np.ndarray:
    """Return the barycentric weights that belong to those of the quadrature."""
    return np.asarray((-1.0) ** np.arange(len(weights)) * np.sqrt(weights))


def interpolation(nodes: np.ndarray, weights: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the matrix (J, N) from values at nodes to those of the polynomials through them at points (J,).

    Args:
        nodes: Gauss-Lobatto points (N,), of one interval or of several side by side, whose common ends nearly coincide.
        weights: the weights of the quadrature (N,).
        points: (J,).
    """
    breaks, near = np.flatnonzero(np.diff(nodes) < _SAME * (nodes[-1] - nodes[0])) + 1, _NEAR * (nodes[-1] - nodes[0])
    found, piece = np.zeros((len(points), len(nodes))), np.searchsorted(nodes[breaks], points, side="right")
    for j, (first, last) in enumerate(zip([0, *breaks], [*breaks, len(nodes)], strict=True)):
        here = piece == j
        apart = points[here, None] - nodes[first:last]
        same = np.abs(apart) <= near
        terms = np.where(same.any(axis=1)[:, None], same, barycentric(weights[first:last]) / np.where(same, 1.0, apart))
        found[here, first:last] = terms / terms.sum(axis=1)[:, None]
    return found


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
        with np.errstate(divide="ignore", invalid="ignore"):
            terms = interpolation(self.nodes, self.rule, at.reshape(-1)) @ self.values
            found = np.log(terms.reshape(at.shape) / np.sum(self.values * self.rule))
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
