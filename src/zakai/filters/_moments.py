"""The first two moments of a prior."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.densities import GaussianMixture
from zakai.errors import InputError
from zakai.filters._lattice_choice import first_lattice
from zakai.models.compile import jax_function
from zakai.models.model import Model
from zakai.models.prior import GaussianPrior, MixturePrior

NO_DIRECTION = 1e-9


def prior_moments(model: Model, prior: Any, theta: Any) -> tuple[Any, Any]:
    """The mean (n,) and the covariance (n, n): a Gaussian's own, else the first two moments.

    An angle has its mean direction, 0 where there is none (uniform: variance pi^2 / 3), and its deviations are wrapped.
    Where JAX traces `theta` (p,), the moments are taken on the lattice that fits the model's own parameters.
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
    points = np.asarray(lattice.points()).reshape(-1, model.n)
    logs: Any = np.asarray(lattice.log_values).ravel()
    xp: Any = np
    if not isinstance(theta, np.ndarray) and prior.log_density.free_symbols & set(model.parameter_symbols):
        log_density, xp = jax_function(prior.log_density, model), jnp
        logs = jax.vmap(log_density, (0, None, None))(points, model.start, theta)
    weights = xp.exp(logs - logs.max())
    weights = weights / weights.sum()
    turned = np.where(periodic, points, 0.0)
    cosine, sine = weights @ np.cos(turned), weights @ np.sin(turned)
    directed = xp.hypot(cosine, sine) > NO_DIRECTION
    circular = xp.where(directed, xp.arctan2(sine, xp.where(directed, cosine, 1.0)), 0.0)
    mean = xp.where(periodic, circular, weights @ points)
    deviation = points - mean
    deviation = xp.where(periodic, _wrap(deviation), deviation)
    return mean, xp.einsum("k,ki,kj->ij", weights, deviation, deviation)


def _wrap(angle: Any) -> Any:
    return np.pi - (np.pi - angle) % (2 * np.pi)
