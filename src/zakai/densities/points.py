"""Weighted points: the density of filters that sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from zakai.densities._density import WeightedPoints, deviations
from zakai.densities._values import as_states, coordinate_numbers, generator, probabilities, sample_size, wrap
from zakai.densities.gaussian import GaussianMixture
from zakai.errors import InputError


@dataclass(frozen=True, repr=False)
class PointMasses(WeightedPoints):
    """sum_i w_i delta(x - x_i): `weights` (N,), which sum to one, at `points` (N, n); angles (`periodic`) on (-pi, pi].

    Moments, quantiles, marginals and samples are those of the points.  Points have no density: `log_density` and `mode` are
    those of Gaussian kernels around them, drawn towards the mean so that mean and covariance stay the same,

        sum_i w_i N(a x_i + (1 - a) mean, (1 - a^2) cov),   1 - a^2 = (4 / (N' (n + 2)))^(2 / (n + 4)) with N' = 1 / sum_i w_i^2

    (Liu and West 2001, section 10.3; the width for a Gaussian, Silverman 1986, equation 4.14).
    """

    weights: np.ndarray
    points: np.ndarray
    names: tuple[str, ...]
    periodic: tuple[bool, ...]

    @cached_property
    def smoothed(self) -> GaussianMixture:
        """Return the kernels around the points.

        Raises:
            InputError: The points lie on one point, line or plane.
        """
        n, mean, cov = len(self.names), self.mean(), self.cov()
        try:
            np.linalg.cholesky(cov)
        except np.linalg.LinAlgError:
            raise InputError(
                "log_density: the points do not spread in every direction, so nothing near a density can be made of them; "
                "mean, cov, quantile and sample are theirs"
            ) from None
        width = min(1.0, (4.0 / (n + 2.0) * np.sum(self.weights**2)) ** (2.0 / (n + 4.0)))
        used = self.weights > 0
        means = mean + np.sqrt(1.0 - width) * deviations(self)[used]
        covs = np.broadcast_to(width * cov, (len(means), n, n))
        return GaussianMixture(self.weights[used], means, covs, self.names, self.periodic)

    def log_density(self, x: np.ndarray) -> np.ndarray:
        return self.smoothed.log_density(as_states(x, len(self.names)))

    def mode(self) -> np.ndarray:
        return self.smoothed.mode()

    def quantile(self, q: Sequence[float]) -> np.ndarray:
        wanted = probabilities(q)
        out = np.empty((len(wanted), len(self.names)))
        values = self.mean() + deviations(self)
        for i in range(len(self.names)):
            order = np.argsort(values[:, i])
            total = np.cumsum(self.weights[order])
            out[:, i] = values[order[np.minimum(np.searchsorted(total, wanted * total[-1]), len(order) - 1)], i]
        return out

    def marginal(self, coordinates: int | str | Sequence[int | str]) -> PointMasses:
        keep = coordinate_numbers(self.names, coordinates)
        names, periodic = tuple(self.names[i] for i in keep), tuple(self.periodic[i] for i in keep)
        return PointMasses(self.weights, self.points[:, keep], names, periodic)

    def sample(self, key: object, count: int) -> np.ndarray:
        rng, count = generator(key), sample_size(count)
        x = self.points[rng.choice(len(self.weights), size=count, p=self.weights / self.weights.sum())]
        return np.where(self.periodic, wrap(x), x)
