"""The first two moments of a prior."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.densities import GaussianMixture
from zakai.errors import InputError
from zakai.filters._lattice_choice import first_lattice
from zakai.models.model import Model
from zakai.models.prior import GaussianPrior, MixturePrior

NO_DIRECTION = 1e-9


def prior_moments(model: Model, prior: Any) -> tuple[np.ndarray, np.ndarray]:
    """The mean (n,) and the covariance (n, n): a Gaussian's own, else the first two moments.

    An angle has its mean direction, 0 where there is none (uniform: variance pi^2 / 3), and its deviations are wrapped.
    Raises InputError for a density in more than two coordinates.
    """
    periodic = np.array([name in model.periodic for name in model.state])
    if isinstance(prior, GaussianPrior):
        return np.where(periodic, _wrap(prior.mean), prior.mean), np.array(prior.cov)
    if isinstance(prior, MixturePrior):
        mixture = GaussianMixture(prior.weights, prior.means, prior.covs, model.state, tuple(periodic))
        return mixture.mean(), mixture.cov()
    if model.n > 2:
        raise InputError(f"{model.source}: prior: a density in {model.n} coordinates has no lattice; give a gaussian")
    lattice, _ = first_lattice(model, prior, None)
    logs = np.asarray(lattice.log_values)
    weights = np.exp(logs - logs.max()).ravel()
    weights /= weights.sum()
    points = np.asarray(lattice.points()).reshape(-1, model.n)
    direction = weights @ np.exp(1j * np.where(periodic, points, 0.0))
    circular = np.where(np.abs(direction) > NO_DIRECTION, np.angle(direction), 0.0)
    mean = np.where(periodic, circular, weights @ points)
    deviation = points - mean
    deviation = np.where(periodic, _wrap(deviation), deviation)
    return mean, np.einsum("k,ki,kj->ij", weights, deviation, deviation)


def _wrap(angle: np.ndarray) -> np.ndarray:
    return np.pi - np.mod(np.pi - angle, 2 * np.pi)
