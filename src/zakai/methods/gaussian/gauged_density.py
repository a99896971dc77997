"""The posterior e^phi v of a gauge whose exponential is no sum of exponentials, v being a mixture of Gaussians."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from zakai.densities import Density, GaussianMixture, GridDensity
from zakai.densities._density import DensityMethods
from zakai.densities._values import as_states
from zakai.methods.gaussian.gauge import Gauge, Posterior, posterior
from zakai.models.model import Model
from zakai.numerics.families import Family, log_terms
from zakai.numerics.transition import Array, transposed

# Half the points along an axis of the first grid and of the last one, by the number of states.
_HALVES = {1: (200, 12_800), 2: (64, 256)}
# Bound on points times Gaussians of a refined grid.
_MOST_TERMS = 2**26
# Bound on the error of the sums over a grid against the known moments, in standard deviations.
_RESOLVED = 1e-8


@dataclass(frozen=True, eq=False, repr=False)
class GaugedDensity(DensityMethods):
    """The density exp(potential(x)) times a mixture of Gaussians, with known moments.

    `mixture` is v of mass one, `potential` takes x (..., n) to phi and what normalises (...), `average` (n,) and `spread` (n, n)
    are mean and covariance; the mass lies within `margins` (K, n) around `points` (K, n).  Densities and moments need no grid;
    the mode, quantiles, marginals and samples are those of a grid that reproduces these moments; otherwise there is a warning.
    """

    mixture: GaussianMixture
    potential: Callable[[np.ndarray], np.ndarray]
    average: np.ndarray
    spread: np.ndarray
    points: np.ndarray
    margins: np.ndarray

    @property
    def names(self) -> tuple[str, ...]:
        return self.mixture.names

    @property
    def periodic(self) -> tuple[bool, ...]:
        return self.mixture.periodic

    def log_density(self, x: np.ndarray) -> np.ndarray:
        n = len(self.names)
        x = as_states(x, n)
        flat = x.reshape(-1, n)
        return np.reshape(self.mixture.log_density(flat) + self.potential(flat), x.shape[:-1])

    def mean(self) -> np.ndarray:
        return self.average

    def cov(self) -> np.ndarray:
        return self.spread

    def resultant(self) -> np.ndarray:
        return self.grid.resultant()

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
        """The values on a grid that covers the mass; its points are doubled until every other point gives the known moments."""
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
            # The sums over every other point have the error of the interpolation.
            error = self._error(GridDensity(logs[(slice(None, None, 2),) * n], centre, 2.0 * basis, *named), whiten)
            if error <= _RESOLVED:
                return GridDensity(logs, centre, basis, *named)
            if half >= most or 2**n * logs.size * len(self.mixture.weights) > _MOST_TERMS:
                break
            half *= 2
        warnings.warn(
            f"{len(logs)} points along an axis do not resolve this density (error {error:.1e}): its mode, quantiles, marginals "
            "and samples are coarse; log_density, mean and cov are not affected",
            stacklevel=3,
        )
        return GridDensity(logs, centre, basis, *named)

    def _error(self, density: GridDensity, whiten: np.ndarray) -> float:
        """Return the largest error of the mass, mean and covariance summed over a grid, in standard deviations."""
        with np.errstate(invalid="ignore"):
            values = np.exp(density.log_values)
            mass = values.sum() * abs(np.linalg.det(density.basis))
            mean = (density.mean() - self.average) @ whiten
            cov = whiten.T @ density.cov() @ whiten - np.eye(len(whiten))
        error = max(abs(mass - 1.0), np.abs(mean).max(), np.abs(cov).max())
        return float(error) if np.isfinite(error) else np.inf


def density_of(model: Model, gauge: Gauge, time: float, families: Family) -> Density:
    """Return e^phi times the families, normalised."""
    found = posterior(gauge, gauge.at_one(time), time, families)
    # A density without width in some direction, as of a known start, is on no grid.
    if not gauge.exact and np.all(np.linalg.eigvalsh(families.cov)[:, 0] > 1e-14 * np.trace(families.cov, axis1=1, axis2=2)):
        return _gauged(model, gauge, time, families, found)
    return mixture_of(model, gauge.origin, families, found)


def _weighted(origin: Array, families: Family, found: Posterior) -> tuple[Array, Array]:
    """Return the weights (J, N, E) of the Gaussians of a posterior and their means (J, N, E, n)."""
    displacements = families.nodes @ transposed(families.response)
    return found.signs * np.exp(found.logs - found.log_mass), found.centres[:, None] + displacements[:, :, None] + origin


def mixture_of(model: Model, origin: Array, families: Family, found: Posterior) -> GaussianMixture:
    """Return the Gaussians of a posterior as a density."""
    weights, means = _weighted(origin, families, found)
    covs = np.broadcast_to(found.covs[:, None, None], (*weights.shape, model.n, model.n))
    used = weights != 0.0
    return GaussianMixture(weights[used], means[used], covs[used], model.state, (False,) * model.n)


def _gauged(model: Model, gauge: Gauge, time: float, families: Family, found: Posterior) -> GaugedDensity:
    """Return e^phi v by its formula."""
    shares, points = _weighted(gauge.origin, families, found)
    shares = np.abs(shares)
    logs = log_terms(families)
    weights = families.signs * np.exp(logs - logs.max())
    means = families.mean[:, None] + families.nodes @ transposed(families.response) + gauge.origin
    covs = np.broadcast_to(families.cov[:, None], (*weights.shape, model.n, model.n))
    used, mass = weights != 0.0, weights.sum()
    mixture = GaussianMixture(weights[used] / mass, means[used], covs[used], model.state, (False,) * model.n)
    scale = logs.max() + np.log(mass) - float(found.log_mass)
    # A Gaussian is followed to ten deviations, where it is e^-50 of its maximum: its points end at nine.
    rest, own = (np.sqrt(np.maximum(np.diagonal(c, axis1=1, axis2=2), 0.0)) for c in (found.covs, families.cov))
    margins = np.broadcast_to((10.0 * rest + own)[:, None, None], points.shape)
    near = shares >= np.exp(-50.0) * shares.max()
    return GaugedDensity(
        mixture,
        lambda x: gauge.potential(x - gauge.origin, time) + scale,
        found.mean + gauge.origin,
        found.cov,
        points[near],
        margins[near],
    )
