"""The first two moments of a prior, and a grid for one that is given by its density."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.densities import GaussianMixture
from zakai.densities._values import wrap
from zakai.errors import InputError
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.prior import DensityPrior, GaussianPrior, MixturePrior
from zakai.numerics.complex_step import angle
from zakai.numerics.prior_grid import PriorGrid, prior_grid

_FINER = {1: 32, 2: 4}  # factor of the points of an angle, by the number of states
_MOST_STATES = 4  # of a density, whose grid must be small
_VANISHED = 1e-3  # density at an end of a domain, relative to the largest: below the errors of draws
NO_DIRECTION = 1e-9  # length of a mean direction below which an angle has none


def prior_moments(model: Model, prior: Any, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (n,) and the covariance (n, n): a Gaussian's own, else the first two moments.

    An angle has its mean direction, 0 where there is none (uniform: variance pi^2 / 3), and its deviations are wrapped.  The
    moments of a density are sums over a grid that fits the real part of `theta` (p,).

    Raises:
        InputError: a density in more than four coordinates.
    """
    periodic = np.array([name in model.periodic for name in model.state])
    if isinstance(prior, GaussianPrior):
        return wrapped(model, prior.mean), np.array(prior.cov)
    if isinstance(prior, MixturePrior):
        mixture = GaussianMixture(prior.weights, prior.means, prior.covs, model.state, tuple(periodic.tolist()))
        return mixture.mean(), mixture.cov()
    if model.n > _MOST_STATES:
        what = f"a density in {model.n} coordinates has no grid; give a gaussian, wide where an angle is not known"
        raise InputError(f"{model.source}: prior: {what}")
    grid = density_grid(model, prior, theta)
    if periodic.any():
        # Wrapped deviations jump half a turn away from the mean, and need more points than the density.
        finer = _FINER.get(model.n, 1)
        sizes = tuple(finer * size for size in grid.log_values.shape)
        grid = grid._replace(basis=grid.basis / finer, log_values=np.zeros(sizes))
    points = grid.points.reshape(-1, model.n)
    logs = numpy_function(prior.log_density, model)(wrapped(model, points), model.start, theta)
    with np.errstate(all="ignore"):
        weights = np.exp(logs - np.nanmax(logs.real))
    weights = np.where(np.isfinite(weights), weights, 0.0)
    weights = weights / weights.sum()
    turned = np.where(periodic, points, 0.0)
    cosine, sine = weights @ np.cos(turned), weights @ np.sin(turned)
    directed = np.hypot(cosine.real, sine.real) > NO_DIRECTION
    circular = np.where(directed, angle(sine, np.where(directed, cosine, 1.0)), 0.0)
    mean = np.where(periodic, circular, weights @ points)
    deviation = wrapped(model, points - mean)
    return mean, (deviation * weights[:, None]).T @ deviation


def density_grid(model: Model, prior: DensityPrior, theta: np.ndarray, tolerance: float = 1e-12) -> PriorGrid:
    """Return a grid for a prior that is given by the logarithm of its density, at the real part of `theta` (p,).

    The density of several states counts inside of the domain only, at whose ends it must vanish.

    Raises:
        InputError: no grid fits the density, or it does not vanish at an end of the domain.
    """
    formula, ends = numpy_function(prior.log_density, model), model.domain if model.n > 1 else {}

    def log_density(x: np.ndarray, t: float, theta: np.ndarray) -> np.ndarray:
        inside = [interval.contains(x[:, model.state.index(name)]) for name, interval in ends.items()]
        values = formula(x, t, theta)
        return np.where(np.all(inside, axis=0), values, -np.inf) if inside else values

    periodic = [name in model.periodic for name in model.state]
    source = f"{model.source}: prior: log_density"
    grid = prior_grid(lambda x: log_density(x, model.start, theta.real), model.n, periodic, tolerance=tolerance, source=source)
    shares = np.exp(grid.log_values.real - grid.log_values.real.max())
    for name, interval in ends.items():
        i = model.state.index(name)
        for end in (interval.lower, interval.upper):
            near = np.abs(grid.points[..., i] - end) <= abs(grid.basis[i, i])
            if shares[near].max(initial=0.0) > _VANISHED:
                raise InputError(f"{source} does not vanish at the end {end:g} of the domain of {name!r}")
    return grid


def wrapped(model: Model, points: np.ndarray) -> np.ndarray:
    """Return points (..., n) with angles in (-pi, pi]."""
    return np.where([name in model.periodic for name in model.state], wrap(points), points) if model.periodic else points
