"""Means, deviations and covariances of weighted particles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai.densities._values import wrap
from zakai.methods.particles.programs import Array
from zakai.methods.particles.system import System


def moments(particles: Array, weights: Array, angles: Array) -> tuple[Array, Array, Array]:
    """Return the mean (n,), the deviations from it (n, N), and the covariance (n, n); angles have their mean direction."""
    mean = particles @ weights
    if angles.any():
        x, y = (function(particles[angles]) @ weights for function in (np.cos, np.sin))
        mean[angles] = np.where(np.hypot(x, y) < 1e-9, 0.0, np.arctan2(y, x))
    deviations = particles - mean[:, None]
    if angles.any():
        deviations[angles] = wrap(deviations[angles])
    return mean, deviations, (deviations * weights) @ deviations.T


class Moments(NamedTuple):
    """The mean (n',) of the coordinates, deviations (n, N) and covariance (n, n) of the states, the spread (n',) of particles."""

    mean: Array
    deviations: Array
    cov: Array
    spread: Array


def moments_of(system: System, particles: Array, weights: Array) -> Moments:
    """Return the moments of weighted particles of a system."""
    mean, deviations, cov = moments(particles, weights, system.angles)
    n, spread = system.model.n, np.sqrt(np.maximum(np.diag(cov), 0.0))
    return Moments(mean, deviations[:n], system.widened(mean, cov[:n, :n]), spread)
