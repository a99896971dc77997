"""The posterior e^phi v of a gauge whose exponential is no sum of exponentials, v being a mixture of Gaussians."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from zakai.densities import GaussianMixture, GridDensity
from zakai.densities._density import as_states

# Half the points along an axis of the first grid and of the last one, by the number of states.
_HALVES = {1: (200, 12_800), 2: (64, 256)}
# The most points times Gaussians of a grid after the first.
_MOST_TERMS = 2**26
# How far the sums over a grid may be from the moments that are known, in standard deviations.
_RESOLVED = 1e-8


@dataclass(frozen=True, eq=False, repr=False)
class GaugedDensity:
    """The density exp(potential(x)) bare(x), whose moments are known.

    `bare` is v of mass one, `potential` takes x (..., n) to phi and what normalises (...), `average` (n,) and `spread` (n, n)
    are mean and covariance; `points` (K, n) and `margins` (K, n) tell where the mass is: around each point, and how far.
    Densities and moments need no grid; the mode, quantiles, marginals and samples are those of one that is as fine as these
    moments ask for, and a warning says where none is.
    """

    bare: GaussianMixture
    potential: Callable[[np.ndarray], np.ndarray]
    average: np.ndarray
    spread: np.ndarray
    points: np.ndarray
    margins: np.ndarray

    def __repr__(self) -> str:
        return f"GaugedDensity({', '.join(self.names)}: mean {self.average.tolist()})"

    @property
    def names(self) -> tuple[str, ...]:
        return self.bare.names

    @property
    def periodic(self) -> tuple[bool, ...]:
        return self.bare.periodic

    def log_density(self, x: np.ndarray) -> np.ndarray:
        n = len(self.names)
        x = as_states(x, n)
        flat = x.reshape(-1, n)
        return np.reshape(self.bare.log_density(flat) + self.potential(flat), x.shape[:-1])

    def mean(self) -> np.ndarray:
        return self.average

    def cov(self) -> np.ndarray:
        return self.spread

    def mode(self) -> np.ndarray:
        return self.grid.mode()

    def quantile(self, q: Sequence[float]) -> np.ndarray:
        return self.grid.quantile(q)

    def marginal(self, coordinates: int | str | Sequence[int | str]) -> GridDensity:
        return self.grid.marginal(coordinates)

    def sample(self, key: object, count: int) -> np.ndarray:
        return self.grid.sample(key, count)

    @cached_property
    def grid(self) -> GridDensity:
        """The values on a grid that holds the mass, with twice the points until half of them would give the moments."""
        n = len(self.names)
        half, most = _HALVES[n]
        named = self.names, self.periodic
        values, vectors = np.linalg.eigh(self.spread)
        reach = self.margins @ np.abs(vectors)
        low, high = (self.points @ vectors - reach).min(axis=0), (self.points @ vectors + reach).max(axis=0)
        centre, whiten = vectors @ (0.5 * (low + high)), vectors / np.sqrt(values)
        while True:
            basis = vectors * (0.5 * (high - low) / half)
            index = np.stack(np.meshgrid(*[np.arange(-half, half + 1.0)] * n, indexing="ij"), axis=-1)
            logs = self.log_density(centre + index @ basis.T)
            # Sums over every other point err as much as what is read between the points.
            error = self._error(GridDensity(logs[(slice(None, None, 2),) * n], centre, 2.0 * basis, *named), whiten)
            if error <= _RESOLVED:
                return GridDensity(logs, centre, basis, *named)
            if half >= most or 2**n * logs.size * len(self.bare.weights) > _MOST_TERMS:
                break
            half *= 2
        warnings.warn(
            f"{len(logs)} points along an axis do not resolve this density (error {error:.1e}): its mode, quantiles, marginals "
            "and samples are coarse; log_density, mean and cov are not affected",
            stacklevel=3,
        )
        return GridDensity(logs, centre, basis, *named)

    def _error(self, density: GridDensity, whiten: np.ndarray) -> float:
        """How far the mass, mean and covariance that a grid sums up are from what they are, in standard deviations."""
        with np.errstate(invalid="ignore"):
            values = np.exp(density.log_values)
            mass = values.sum() * abs(np.linalg.det(density.basis))
            mean = (density.mean() - self.average) @ whiten
            cov = whiten.T @ density.cov() @ whiten - np.eye(len(whiten))
        error = max(abs(mass - 1.0), np.abs(mean).max(), np.abs(cov).max())
        return float(error) if np.isfinite(error) else np.inf
