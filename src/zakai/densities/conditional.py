"""Weighted particles that carry a Gaussian: the density of `guided-particles` where states are linear given the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from zakai.densities._density import DensityMethods, deviations
from zakai.densities._values import coordinate_numbers, generator, probabilities, sample_size, wrap
from zakai.densities.gaussian import GaussianMixture
from zakai.densities.particles import ParticleDensity

_MOST_KERNELS = 1000  # of which a mode is sought
_HALVINGS = 60  # of the bracket of a quantile


@dataclass(frozen=True, repr=False)
class ConditionalParticleDensity(DensityMethods):
    """sum_i w_i delta(u - u_i) N(v; m_i, P_i): particles (u_i, m_i) with the covariances of the states v that they carry.

    `weights` (N,), which sum to one, at `points` (N, n), of which the coordinates `linear` are means; `covs` (N, k, k) are their
    covariances, in the order of `linear`.  Mean, covariance, quantiles and draws are those of this law, and so is the density of
    linear states alone.  Of others the logarithm of the density, its mode and its pictures are those of Gaussian kernels around
    the particles, as of `ParticleDensity`, with the covariance P_i added.
    """

    weights: np.ndarray
    points: np.ndarray
    names: tuple[str, ...]
    periodic: tuple[bool, ...]
    linear: tuple[int, ...]
    covs: np.ndarray

    @cached_property
    def particles(self) -> ParticleDensity:
        """The particles without their covariances."""
        return ParticleDensity(self.weights, self.points, self.names, self.periodic)

    @cached_property
    def full_covs(self) -> np.ndarray:
        """The covariances (N, n, n) of all states given the particle; zero but for linear ones."""
        full = np.zeros((len(self.weights), len(self.names), len(self.names)))
        full[:, np.array(self.linear)[:, None], self.linear] = self.covs
        return full

    @cached_property
    def smoothed(self) -> GaussianMixture:
        """The mixture of Gaussians whose density is that of this one.

        Raises:
            InputError: The points lie on one point, line or plane.
        """
        if len(self.linear) == len(self.names):
            means, covs = self.points, self.covs
        else:
            others = [i for i in range(len(self.names)) if i not in self.linear]
            kernels = self.particles.marginal(others).smoothed  # whose width fits the number of these states
            used = self.weights > 0
            width = kernels.covs[0][0, 0] / self.particles.cov()[others[0], others[0]]
            mean, cov = self.particles.mean(), self.particles.cov()
            means = mean + np.sqrt(1.0 - width) * deviations(self.particles)[used]
            covs = width * cov + self.full_covs[used]
            return GaussianMixture(self.weights[used], means, covs, self.names, self.periodic)
        return GaussianMixture(self.weights, means, covs, self.names, self.periodic)

    def log_density(self, x: np.ndarray) -> np.ndarray:
        return self.smoothed.log_density(x)

    def mode(self) -> np.ndarray:
        return self.thinned(_MOST_KERNELS).smoothed.mode()

    def mean(self) -> np.ndarray:
        return self.particles.mean()

    def cov(self) -> np.ndarray:
        return np.asarray(self.particles.cov() + np.einsum("p,pij->ij", self.weights, self.full_covs))

    def resultant(self) -> np.ndarray:
        """Return E exp(i x) of each angle (n,); 1 for other states."""
        return self.particles.resultant()

    def quantile(self, q: Sequence[float]) -> np.ndarray:
        from scipy.special import ndtr

        wanted = probabilities(q)
        out = self.particles.quantile(q)
        for place, i in enumerate(self.linear):
            means, spread = self.points[:, i], np.sqrt(np.maximum(self.covs[:, place, place], 0.0))
            if not spread.any():
                continue
            low = np.full(len(wanted), (means - 40 * spread).min())
            high = np.full(len(wanted), (means + 40 * spread).max())
            spread = np.maximum(spread, 1e-300)
            for _ in range(_HALVINGS):
                middle = 0.5 * (low + high)
                below = ndtr((middle[:, None] - means) / spread) @ self.weights < wanted
                low, high = np.where(below, middle, low), np.where(below, high, middle)
            out[:, i] = 0.5 * (low + high)
            out[wanted == 0.0, i], out[wanted == 1.0, i] = -np.inf, np.inf
        return out

    def marginal(self, coordinates: int | str | Sequence[int | str]) -> ConditionalParticleDensity | ParticleDensity:
        keep = coordinate_numbers(self.names, coordinates)
        names, periodic = tuple(self.names[i] for i in keep), tuple(self.periodic[i] for i in keep)
        own = [place for place, i in enumerate(keep) if i in self.linear]
        if not own:
            return ParticleDensity(self.weights, self.points[:, keep], names, periodic)
        order = [self.linear.index(keep[place]) for place in own]
        covs = self.covs[:, np.array(order)[:, None], order]
        return ConditionalParticleDensity(self.weights, self.points[:, keep], names, periodic, tuple(own), covs)

    def thinned(self, most: int) -> ConditionalParticleDensity:
        """Return equally weighted particles of at most this number, by systematic resampling."""
        if len(self.weights) <= most:
            return self
        total = np.cumsum(self.weights) / self.weights.sum()
        places = np.searchsorted(total, (np.arange(most) + 0.5) / most).clip(0, len(total) - 1)
        weights, points, covs = np.full(most, 1.0 / most), self.points[places], self.covs[places]
        return ConditionalParticleDensity(weights, points, self.names, self.periodic, self.linear, covs)

    def drawn(self) -> ParticleDensity:
        """Return the particles with one draw of the linear states each, always the same."""
        points = self._with_draws(np.arange(len(self.weights)), generator(0))
        return ParticleDensity(self.weights, points, self.names, self.periodic)

    def sample(self, key: object, count: int) -> np.ndarray:
        rng, count = generator(key), sample_size(count)
        places = np.searchsorted(np.cumsum(self.weights) / self.weights.sum(), rng.random(count))
        x = self._with_draws(places.clip(0, len(self.weights) - 1), rng)
        return np.where(self.periodic, wrap(x), x)

    def _with_draws(self, places: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return draws (count, n) from the Gaussians of particles."""
        values, vectors = np.linalg.eigh(self.covs[places])
        normal = rng.standard_normal((len(places), len(self.linear)))
        x = self.points[places]
        x[:, self.linear] += np.einsum("cij,cj,cj->ci", vectors, np.sqrt(np.maximum(values, 0.0)), normal)
        return x
