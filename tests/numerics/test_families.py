"""Families of Gaussians against their Gaussians one by one, and nodes against the functions that they represent."""

from __future__ import annotations

import numpy as np
import pytest

from zakai.numerics.families import Family, gaussians, log_terms, move, observe, solve, weigh
from zakai.numerics.flow import Transition
from zakai.numerics.nodes import NodeGrid, representation_error, resolve

RNG = np.random.default_rng(5)
N, K, INPUTS = 3, 2, 2


def covariance(n):
    root = RNG.standard_normal((n, n))
    return root @ root.T


def log_normal(away, cov):
    return -0.5 * away @ np.linalg.solve(cov, away) - 0.5 * np.linalg.slogdet(2 * np.pi * cov)[1]


def product(mean, cov, information, vector):
    """N(mean, cov) exp(-x'Ix/2 + v.x) by completing the square: mean, covariance and, from a value, log-mass."""
    new_cov = np.linalg.inv(np.linalg.inv(cov) + information)
    new = new_cov @ (np.linalg.solve(cov, mean) + vector)
    point = np.ones(len(mean))
    value = log_normal(point - mean, cov) - 0.5 * point @ information @ point + vector @ point
    return new, new_cov, value - log_normal(point - new, new_cov)


def test_a_family_is_moved_and_observed_as_its_gaussians_are_one_by_one():
    information, transition = covariance(N), RNG.standard_normal((N, N))
    own = Transition(
        transition,
        RNG.standard_normal((N, INPUTS)),
        covariance(N),
        information,
        RNG.standard_normal((N, INPUTS)),
        covariance(INPUTS),
    )
    inputs = np.array([1.0, 0.7])
    mean, cov, response, nodes = RNG.standard_normal(N), covariance(N), RNG.standard_normal((N, K)), RNG.standard_normal((4, K))
    none = np.zeros((1, 4)), np.ones((1, 4))
    family = Family(nodes[None], *none, mean[None], cov[None], response[None], np.zeros((1, K)), np.zeros((1, K, K)), np.zeros(1))
    slope, residual, noise = RNG.standard_normal((2, N)), RNG.standard_normal(2), np.eye(2)
    alone = [(mean + response @ s, cov, 0.0) for s in nodes]
    for _ in range(3):
        family = move(family, own, inputs)
        for row, value in zip(slope, residual, strict=True):
            family = observe(family, row, value)
        moved = []
        for m, P, log_mass in alone:
            m, P, gained = product(m, P, information, own.vector @ inputs)
            m, P = transition @ m + own.offset @ inputs, transition @ P @ transition.T + own.noise
            energy = np.linalg.inv(noise)
            new, new_cov, more = product(m, P, slope.T @ energy @ slope, slope.T @ energy @ residual)
            more -= 0.5 * residual @ energy @ residual + 0.5 * np.linalg.slogdet(noise)[1]
            moved.append((new, new_cov, log_mass + gained + more + inputs @ own.constant @ inputs))
        alone = moved
    for i, (m, P, log_mass) in enumerate(alone):
        assert family.mean[0] + family.response[0] @ nodes[i] == pytest.approx(m, abs=1e-10)
        assert family.cov[0] == pytest.approx(P, abs=1e-10)
        assert log_terms(family)[0, i] == pytest.approx(log_mass, abs=1e-9)


def test_a_mass_without_width_moves_as_a_narrow_gaussian_does():
    information, vector = covariance(N), RNG.standard_normal(N)
    starts = [gaussians(np.zeros(1), np.ones((1, N)), scale * np.eye(N)[None]) for scale in (0.0, 1e-14)]
    point, narrow = (weigh(start, information, vector, 0.3) for start in starts)
    assert point.mean == pytest.approx(narrow.mean, abs=1e-10) and point.log_mass == pytest.approx(narrow.log_mass, abs=1e-10)
    assert (point.cov == 0).all()


def test_a_sharp_sample_leaves_its_own_variance():
    wide = gaussians(np.zeros(1), np.zeros((1, 2)), 1e4 * np.eye(2)[None])
    for _ in range(2):  # two equal sensors
        wide = observe(wide, np.array([1e9, 0.0]), 30e9)
    assert wide.mean[0] == pytest.approx([30.0, 0.0]) and np.diag(wide.cov[0]) == pytest.approx([0.5e-18, 1e4], rel=1e-9)
    assert wide.log_mass[0] == pytest.approx(-0.5 * 900 / 1e4 - 0.5 * np.log(1e22) - 0.5 * np.log(2), abs=1e-9)


def test_a_singular_system_raises_nothing():
    with np.errstate(divide="ignore"):
        solved, log_volume = solve(np.zeros((1, 2, 2)), np.ones((1, 2, 1)))
    assert np.isinf(solved).all() and log_volume[0] == -np.inf


def quotient(z):
    """log of N(z; 1/2, 9) / cosh z, not normalised."""
    return -((z[:, 0] - 0.5) ** 2) / 18 - np.logaddexp(z[:, 0], -z[:, 0])


def test_nodes_represent_a_quotient_to_rounding_relative_to_the_density_itself():
    start = NodeGrid(np.array([-26.0]), np.array([[53 / 48]]), (49,))
    grid, error = resolve(quotient, lambda z: np.logaddexp(z[:, 0], -z[:, 0]), start, 1e-12, 2000)
    assert error <= 1e-12 and grid.count < 800
    z = np.linspace(-20, 20, 777)[:, None]
    away = z - grid.points()[:, 0]
    variance = grid.covariance[0, 0]
    kernel = np.exp(-(away**2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)
    found = kernel @ grid.weights(np.exp(quotient(grid.points())))
    # Relative to the prior, that is multiplied by cosh z: far out the quotient itself is 1e-8.
    assert np.abs(found / np.exp(quotient(z)) - 1).max() <= 1e-8
    assert np.abs((found - np.exp(quotient(z))) * np.cosh(z[:, 0])).max() <= 1e-11


def test_nodes_that_are_too_far_apart_are_reported():
    coarse = NodeGrid(np.array([-26.0]), np.array([[53 / 48]]), (49,))
    assert representation_error(quotient, lambda z: 0 * z[:, 0], coarse) > 1e-6
