"""The kernels of `guided-particles` against plain computations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.special import ndtr
from scipy.stats import qmc

from zakai.numerics.particles.even import Even, curve_places, directions, even_normals
from zakai.numerics.particles.noise import noise_about_middle, write_roots
from zakai.numerics.particles.population import Sums, carry, mean_directions, moments, sums_of_islands
from zakai.numerics.particles.random import key_of

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


def test_mean_directions_are_those_of_weighted_angles():
    x, weights = RNG.normal(2.5, 1.0, size=(2, 700)), RNG.random(700)
    mean = np.zeros(2)
    mean_directions(x, weights, np.array([False, True]), mean)
    assert np.allclose(mean, [0.0, np.angle(np.exp(1j * x[1]) @ weights)])


def test_sums_of_islands():
    bounds, weights, apart = np.array([0, 30, 30, 75, 90]), RNG.random(90), RNG.normal(size=(2, 90))
    masses, sums, squares, independent = out = Sums(np.empty(4), np.empty((4, 2)), np.empty((4, 2)), np.empty(2))
    sums_of_islands(bounds, weights, apart, out)
    parts = [slice(*pair) for pair in zip(bounds[:-1], bounds[1:])]
    assert np.allclose(sums, [apart[:, part] @ weights[part] for part in parts])
    assert np.allclose(squares, [apart[:, part] ** 2 @ weights[part] for part in parts])
    assert np.allclose(masses, [weights[part].sum() for part in parts])
    assert np.allclose(independent, 90 / 89 * (weights * apart) ** 2 @ np.ones(90))


def test_a_regression_on_the_states_before():
    cov = np.diag([1.0, 4.0, 0.0])
    across, T = RNG.normal(size=(3, 3)), np.empty((3, 3))
    carry(across, cov, T)
    assert np.allclose(T, across @ np.diag([1.0, 0.25, 0.0]))


def test_direction_numbers_are_those_of_sobol():
    points = qmc.Sobol(len(directions()), scramble=False, bits=32)
    for k in range(12):
        points.reset()
        points.fast_forward(2**k)  # the point of Gray's code of 2^k, which has the bits k and k - 1
        expected = (points.random(1)[0] * 2.0**32).astype(np.uint32)
        assert (expected == directions()[:, k] ^ (directions()[:, k - 1] if k else 0)).all()


def test_numbers_of_an_island_fill_each_coordinate_evenly_and_islands_are_independent():
    bounds, rank = np.array([0, 256, 256, 768]), np.append(np.arange(256), RNG.permutation(512)).astype(np.int32)
    out = np.empty((20, 768))
    even_normals(Even(key_of(3), rank, bounds, directions()), 0, 768, out)
    for low, high in ((0, 256), (256, 768)):
        size = high - low
        p = ndtr(out[:16, low:high])
        assert (np.sort(np.floor(p * size)) == np.arange(size)).all()  # one in each cell
        cells = np.floor(p[:2] * 16)  # and as many in each of 16 x 16
        assert (np.bincount((16 * cells[0] + cells[1]).astype(int), minlength=256) == size / 256).all()
    assert abs(np.corrcoef(out[:, :256].ravel(), out[:, 256:512].ravel())[0, 1]) < 0.05
    assert abs(np.mean(out[16:])) < 0.06 and abs(np.std(out[16:]) - 1.0) < 0.05  # beyond the table they are independent
    other = np.empty((20, 768))
    even_normals(Even(key_of(3), rank, bounds, directions()), 0, 300, other)
    even_normals(Even(key_of(3), rank, bounds, directions()), 300, 768, other)
    assert (other == out).all()


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_neighbours_on_the_curve_are_near(n):
    """Of 4,096 points the distance of neighbours is that of a grid, times a constant."""
    x = RNG.normal(size=(n, 4096))
    places = np.empty(4096, np.uint16)
    mixed = np.tril(np.ones((n, n))) @ x  # correlated coordinates are whitened
    curve_places(mixed, np.atleast_2d(np.cov(mixed)), places)
    along = x[:, np.argsort(places, kind="stable")]
    apart = np.linalg.norm(np.diff(along), axis=0).mean()
    assert apart < 8.0 * np.sqrt(n) * 4096 ** (-1 / n)
    assert places.max() < 2**16 and len(np.unique(places)) > 500


def test_particles_that_do_not_differ_have_one_place():
    places = np.empty(8, np.uint16)
    curve_places(np.zeros((2, 8)), np.zeros((2, 2)), places)
    assert (places == 0).all()
