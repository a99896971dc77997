"""The kernels of `guided-particles` against plain computations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from zakai.numerics.particles.noise import noise_about_middle, write_roots
from zakai.numerics.particles.population import DEPTH, carry, lineage, moments

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("length", [0.3, 9.0])
def test_the_noise_of_a_substep_about_its_middle_is_the_integral(length):
    A, G = np.array([[0.0, 1.0], [-1.0, -0.3]]), np.diag([0.0, 0.5])
    nodes, weights = np.polynomial.legendre.leggauss(60)
    flows = [expm(-0.5 * length * s * A) for s in nodes]
    expected = sum(0.5 * length * w * F @ G @ F.T for F, w in zip(flows, weights))
    found = np.empty((2, 2))
    noise_about_middle(A, G, length, found)
    assert np.allclose(found, expected, rtol=1e-10)


def test_the_roots_of_singular_covariances_have_as_few_columns_as_the_largest_rank():
    R = RNG.normal(size=(3, 2)) * [[1e-6], [1.0], [1e4]]
    Q, out = np.array([R @ R.T, np.zeros((3, 3))]), np.empty((2, 3, 3))
    assert write_roots(Q, out) == 2
    assert np.allclose(out @ out.transpose(0, 2, 1), Q, rtol=1e-9)


def test_moments_are_those_of_weighted_particles_and_angles_wrap():
    x, weights = RNG.normal(size=(2, 700)), RNG.random(700)
    weights /= weights.sum()
    mean, apart, cov = np.array([0.0, 3.0]), np.empty((2, 700)), np.empty((2, 2))
    moments(x, weights, np.array([False, True]), mean, apart, cov)
    expected = np.array([x[0] - weights @ x[0], np.remainder(x[1] - 3.0 + np.pi, 2 * np.pi) - np.pi])
    assert np.allclose(apart, expected, atol=1e-12)
    assert np.allclose(cov, expected * weights @ expected.T)


def test_families_of_each_generation_and_of_the_first_ancestors():
    parents = [np.sort(RNG.integers(0, 90, 90)).astype(np.int32) for _ in range(3)]
    weights, apart = RNG.random(90), RNG.normal(size=(2, 90))
    weights /= weights.sum()
    padded = (np.zeros(0, np.int32),) * (DEPTH - 3) + tuple(parents)
    founders = parents[0][parents[1][parents[2]]] // 2
    founders = founders.astype(np.int32)
    means, between, counts = np.empty((5, 2)), np.empty(2), np.empty((2, 5))
    lineage(padded, np.array([90, 90, 90, 90, 45]), 99, founders, weights, apart, (means, between, counts))
    labels = [np.arange(90), parents[2], parents[1][parents[2]], parents[0][parents[1][parents[2]]], founders]
    for k, label in enumerate(labels):
        size = 45 if k == 4 else 90
        sums, mass = np.array([np.bincount(label, weights * row, size) for row in apart]), np.bincount(label, weights, size)
        assert np.allclose(means[k], size / (size - 1) * (sums**2).sum(axis=1))
        assert np.allclose(counts[:, k], [mass @ mass, np.count_nonzero(mass)])
        if k == 3:
            alive = mass > 0
            assert np.allclose(between, (sums[:, alive] ** 2 / mass[alive]).sum(axis=1))


def test_excess_is_carried_by_the_regression_on_the_states_before():
    cov = np.diag([1.0, 4.0, 0.0])
    across, X, T = RNG.normal(size=(3, 3)), np.array([np.eye(3)]), np.empty((3, 3))
    carry(X, across, cov, T)
    assert np.allclose(T, across @ np.diag([1.0, 0.25, 0.0]))
    assert np.allclose(X[0], T @ T.T)
