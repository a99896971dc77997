"""Weighted particles: the density of `guided-particles`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zakai.densities._values import coordinate_numbers, generator, sample_size, wrap
from zakai.densities.points import PointMasses


@dataclass(frozen=True, repr=False)
class ParticleDensity(PointMasses):
    """The density of which weighted particles are draws: `weights` (N,), which sum to one, at `points` (N, n).

    Mean, covariance, quantiles and draws are those of the particles.  The logarithm of the density, its mode and its pictures
    are those of Gaussian kernels around the particles, with the same mean and covariance as the particles have; their width
    falls with the number of particles, and details finer than it are not seen.  A file of it, and a prior made of it, hold a
    mixture of at most 1,000 kernels.
    """

    def marginal(self, coordinates: object) -> ParticleDensity:
        keep = coordinate_numbers(self.names, coordinates)  # type: ignore[arg-type]
        names, periodic = tuple(self.names[i] for i in keep), tuple(self.periodic[i] for i in keep)
        return ParticleDensity(self.weights, self.points[:, keep], names, periodic)

    def thinned(self, most: int) -> ParticleDensity:
        """Return equally weighted particles of at most this number, by systematic resampling."""
        if len(self.weights) <= most:
            return self
        total = np.cumsum(self.weights) / self.weights.sum()
        places = np.searchsorted(total, (np.arange(most) + 0.5) / most).clip(0, len(total) - 1)
        return ParticleDensity(np.full(most, 1.0 / most), self.points[places], self.names, self.periodic)

    def sample(self, key: object, count: int) -> np.ndarray:
        rng, count = generator(key), sample_size(count)
        places = np.searchsorted(np.cumsum(self.weights) / self.weights.sum(), rng.random(count))
        x = self.points[places.clip(0, len(self.weights) - 1)]
        return np.where(self.periodic, wrap(x), x)
