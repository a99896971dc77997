"""Means, deviations and covariances of weighted particles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai.methods.particles.programs import Array
from zakai.methods.particles.system import System
from zakai.numerics.particles import population


def moments(particles: Array, weights: Array, angles: Array) -> tuple[Array, Array, Array]:
    """Return the mean (n,), the deviations from it (n, N), and the covariance (n, n); angles have their mean direction."""
    n = len(particles)
    mean, deviations, cov = np.empty(n), np.empty(particles.shape), np.empty((n, n))
    particles = np.ascontiguousarray(particles)
    if angles.any():
        population.mean_directions(particles, weights, angles, mean)
    population.moments(particles, weights, angles, mean, deviations, cov)
    return mean, deviations, cov


class Moments(NamedTuple):
    """The mean (n',) of the coordinates, the covariance (n, n) of the states, the spread (n',) of particles, and these."""

    mean: Array
    cov: Array
    spread: Array
    particles: Weighted

    @property
    def deviations(self) -> Array:
        """The standard deviations (n,) of the states."""
        return np.sqrt(np.maximum(np.diag(self.cov), 0.0))


class Weighted(NamedTuple):
    """Deviations (n, N) of particles from their mean, their weights (N,), and the covariance (n, n) of the particles.

    That is without what each carries by a filter of its own.
    """

    deviations: Array
    weights: Array
    cov: Array


def moments_of(system: System, particles: Array, weights: Array) -> Moments:
    """Return the moments of weighted particles of a system."""
    mean, deviations, cov = moments(particles, weights, system.angles)
    n, spread = system.model.n, np.sqrt(np.maximum(np.diag(cov), 0.0))
    own = np.ascontiguousarray(cov[:n, :n])
    return Moments(mean, system.widened(mean, own), spread, Weighted(deviations[:n], weights, own))
