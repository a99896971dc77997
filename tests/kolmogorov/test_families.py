"""Families of Gaussians against their Gaussians one by one, and nodes against the functions that they represent."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from zakai.kolmogorov.families import Family, gaussian, log_terms, move, read
from zakai.kolmogorov.flow import Coefficients, integrate, integrate_explicitly, move_gaussian
from zakai.kolmogorov.nodes import NodeLattice, representation_error, resolve

RNG = np.random.default_rng(5)
N, K, INPUTS = 3, 2, 2
L0, L1, ROOT, SINK = RNG.standard_normal((4, N, N))


def coefficients(t):
    angles = t + jnp.arange(N)
    return Coefficients(
        L0 + jnp.cos(t) * L1,
        jnp.outer(jnp.sin(angles), jnp.array([1.0, 0.3])),
        ROOT @ ROOT.T * (1 + t),
        -SINK @ SINK.T,
        jnp.outer(jnp.cos(angles), jnp.array([0.2, 1.0])),
        jnp.array([t, 0.5]),
    )


@pytest.mark.slow
def test_a_family_moves_and_is_read_as_its_gaussians_are_one_by_one():
    flow, inputs = integrate(coefficients, 0.1, 0.4, 2), jnp.array([1.0, 0.7])
    root, response, mean, nodes = (RNG.standard_normal(s) for s in ((N, N), (N, K), N, (4, K)))
    cov = root @ root.T
    family = Family(nodes, np.zeros(4), np.ones(4), mean, cov, response, jnp.zeros(K), jnp.zeros((K, K)), 0.0)
    slope, intercept, after = RNG.standard_normal((2, N)), RNG.standard_normal(2), RNG.standard_normal(2)
    energy = np.array([[2.0, 0.3], [0.3, 1.0]])
    alone = [(mean + response @ s, cov, 0.0) for s in nodes]
    for _ in range(3):
        family = read(move(family, flow, inputs), slope, intercept, after, energy, 0.3)
        moved = []
        for m, P, log_mass in alone:
            m, P, gained = (np.asarray(a) for a in move_gaussian(flow, m, P, inputs))
            # Bayes' rule by completing the square, and the mass by the value of all three densities at one point.
            new_cov = np.linalg.inv(np.linalg.inv(P) + slope.T @ energy @ slope)
            new = new_cov @ (np.linalg.solve(P, m) + slope.T @ (after - energy @ intercept))
            h, away = slope @ new + intercept, new - m
            mass = after @ h - h @ energy @ h / 2 + 0.3 - away @ np.linalg.solve(P, away) / 2
            mass += (np.linalg.slogdet(new_cov)[1] - np.linalg.slogdet(P)[1]) / 2
            moved.append((new, new_cov, log_mass + gained + mass))
        alone = moved
    for i, (m, P, log_mass) in enumerate(alone):
        assert np.asarray(family.mean + family.response @ nodes[i]) == pytest.approx(m, abs=1e-11)
        assert np.asarray(family.cov) == pytest.approx(P, abs=1e-12)
        assert float(log_terms(family)[i]) == pytest.approx(log_mass, abs=1e-10)


def test_a_mass_without_width_moves_as_a_narrow_gaussian_does():
    flow = integrate(coefficients, 0.1, 0.4, 2)
    point, narrow = (move(gaussian(np.ones(N), scale * np.eye(N)), flow, jnp.ones(INPUTS)) for scale in (0.0, 1e-14))
    assert np.asarray(point.mean) == pytest.approx(np.asarray(narrow.mean), abs=1e-10)
    assert np.asarray(point.cov) == pytest.approx(np.asarray(narrow.cov), abs=1e-10)


def test_the_explicit_integrator_gives_the_flow_of_the_implicit_one():
    implicit, explicit = integrate(coefficients, 0.1, 0.6, 4), integrate_explicitly(coefficients, 0.1, 0.6, 16)
    for a, b in zip(implicit, explicit, strict=True):
        assert np.asarray(b) == pytest.approx(np.asarray(a), abs=1e-12)


def quotient(z):
    """log of N(z; 1/2, 9) / cosh z, not normalised."""
    return -((z[:, 0] - 0.5) ** 2) / 18 - np.logaddexp(z[:, 0], -z[:, 0])


def test_nodes_represent_a_quotient_to_rounding_relative_to_the_density_itself():
    start = NodeLattice(np.array([-26.0]), np.array([[53 / 48]]), (49,))
    lattice, error = resolve(quotient, lambda z: np.logaddexp(z[:, 0], -z[:, 0]), start, 1e-12, 2000)
    assert error <= 1e-12 and lattice.count < 800
    z = np.linspace(-20, 20, 777)[:, None]
    away = z - lattice.points()[:, 0]
    variance = lattice.covariance[0, 0]
    kernel = np.exp(-(away**2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)
    found = kernel @ lattice.weights(np.exp(quotient(lattice.points())))
    # Relative to the prior, that is multiplied by cosh z: far out the quotient itself is 1e-8.
    assert np.abs(found / np.exp(quotient(z)) - 1).max() <= 1e-8
    assert np.abs((found - np.exp(quotient(z))) * np.cosh(z[:, 0])).max() <= 1e-11


def test_nodes_that_are_too_far_apart_say_so():
    coarse = NodeLattice(np.array([-26.0]), np.array([[53 / 48]]), (49,))
    assert representation_error(quotient, lambda z: 0 * z[:, 0], coarse) > 1e-6
