"""What is done to Gaussian sums, against sums over a fine line."""

from __future__ import annotations

import numpy as np
import pytest

from zakai.numerics.sums.mixture import components, moments, shares
from zakai.numerics.sums.quadrature import refit, refit_affine
from zakai.numerics.sums.reduction import FIVE, THREE, exchange, gathered, groups, split

LINE = np.linspace(-12, 12, 6001)
SPACE = LINE[1] - LINE[0]


def density(log_weights, means, variances):
    z = (LINE[:, None] - means) ** 2 / variances
    return np.exp(-0.5 * z + log_weights - 0.5 * np.log(2 * np.pi * variances)).sum(axis=1) * SPACE


def on_line(sum_):
    return density(sum_.log_weights, sum_.means[:, 0], sum_.covs[:, 0, 0])


def alone(weights, means, variances, factor):
    """Return the masses of the products with factor, the sum of the Gaussians with their moments, the sum of the products."""
    table = weights / np.sqrt(2 * np.pi * variances) * np.exp(-0.5 * (LINE[:, None] - means) ** 2 / variances)
    table = table * factor[:, None] * SPACE
    mass = table.sum(axis=0)
    centre = LINE @ table / mass
    variance = ((LINE[:, None] - centre) ** 2 * table).sum(axis=0) / mass
    return mass, density(np.log(mass), centre, variance), table.sum(axis=1)


def lost(p, q):
    p, q = p / p.sum(), q / q.sum()
    return np.sum(p * (np.log(p + 1e-300) - np.log(q + 1e-300)))


def test_neighbours_carry_the_shape_that_a_product_loses_and_modes_keep_their_mass():
    means = np.array([-6.0, -5.4, -4.8, 1.25, 1.75, 2.25, 2.75, 3.25, 3.75, 9.0])
    weights = np.array([0.02, 0.03, 0.02, 0.04, 0.15, 0.27, 0.27, 0.15, 0.04, 0.01])
    before = components(np.log(weights), means[:, None], np.full((10, 1, 1), 0.3))
    whole = refit(before, lambda x, _: 0.1 * x[..., 0] * np.sin(x[..., 0]), np.eye(1), False, 1).sum
    mass, plain, exact = alone(weights, means, np.full(10, 0.3), np.exp(0.1 * LINE * np.sin(LINE)))
    heavy = (LINE > 0) & (LINE < 6)
    assert lost(exact[heavy], on_line(whole)[heavy]) <= 0.4 * lost(exact[heavy], plain[heavy])
    assert lost(exact, on_line(whole)) <= 0.7 * lost(exact, plain)
    parts = [slice(0, 3), slice(3, 9), slice(9, 10)]
    kept = np.exp(whole.log_weights)
    assert np.allclose([kept[part].sum() for part in parts], [mass[part].sum() for part in parts], rtol=1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_among_near_duplicates_a_large_factor_leaves_the_mean_and_the_shape(seed):
    rng = np.random.default_rng(seed)
    means, variances = rng.uniform(-4.0, 4.0, 60), rng.uniform(0.02, 0.2, 60)
    weights = np.exp(rng.normal(0.0, 2.0, 60) - 0.25 * means**2)
    weights /= weights.sum()
    before = components(np.log(weights), means[:, None], variances[:, None, None])
    whole = on_line(refit(before, lambda x, _: 0.5 * x[..., 0] * np.sin(2.0 * x[..., 0]), np.eye(1), False, 1).sum)
    _, plain, exact = alone(weights, means, variances, np.exp(0.5 * LINE * np.sin(2.0 * LINE)))
    assert lost(exact, whole) <= lost(exact, plain)
    mean, deviation = LINE @ exact / exact.sum(), np.sqrt(exact @ LINE**2 / exact.sum() - (LINE @ exact / exact.sum()) ** 2)
    assert abs(LINE @ whole / whole.sum() - mean) <= 2e-3 * deviation
    assert whole.sum() == pytest.approx(exact.sum(), rel=1e-3)


@pytest.mark.parametrize("width", [3.0, 0.1, 1e-3, 1e-6])
def test_a_product_much_narrower_than_a_component_or_with_two_peaks_has_its_moments(width):
    before = components(np.zeros(1), np.full((1, 1), 0.3), np.full((1, 1, 1), 4.0))
    one = refit(before, lambda x, _: -0.5 * ((x[..., 0] - 1.7) / width) ** 2, np.eye(1), True)
    variance = 1 / (1 / 4 + 1 / width**2)
    assert one.sum.covs[0, 0, 0] == pytest.approx(variance, rel=1e-5)
    assert abs(one.sum.means[0, 0] - variance * (0.3 / 4 + 1.7 / width**2)) <= 1e-5 * np.sqrt(variance)
    assert one.loss[0] <= 1e-6 and one.doubt[0] <= 1e-2
    width = max(width, 0.05)
    two = refit(before, lambda x, _: -0.5 * ((np.abs(x[..., 0] - 0.3) - 1.5) / width) ** 2, np.eye(1), True)
    mass, _, exact = alone(np.ones(1), np.full(1, 0.3), np.full(1, 4.0), np.exp(-0.5 * ((np.abs(LINE - 0.3) - 1.5) / width) ** 2))
    near = abs(two.sum.log_weights[0] - np.log(mass[0])) <= 0.02
    assert two.doubt[0] > 1e-2 or near and two.sum.covs[0, 0, 0] == pytest.approx(exact @ (LINE - 0.3) ** 2 / mass[0], rel=0.03)


def test_an_affine_likelihood_is_bayes_rule():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(2, 3, 3))
    prior = components(np.zeros(2), rng.normal(size=(2, 3)), root @ np.swapaxes(root, 1, 2))
    C, c, z, S = rng.normal(size=(2, 3)), rng.normal(size=2), rng.normal(size=2), np.array([[0.5, 0.1], [0.1, 0.3]])
    found = refit_affine(prior, C, c - z, np.linalg.inv(S))
    for k in range(2):
        m, P = prior.means[k], prior.covs[k]
        gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + S)
        away = z - C @ m - c
        spread = C @ P @ C.T + S
        logs = -0.5 * (away @ np.linalg.solve(spread, away) + np.linalg.slogdet(spread @ np.linalg.inv(S))[1])
        assert np.allclose(found.means[k], m + gain @ away) and np.allclose(found.covs[k], P - gain @ C @ P)
        assert found.log_weights[k] == pytest.approx(logs)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_splits_and_merges_keep_mass_mean_and_covariance(n):
    rng = np.random.default_rng(n)
    root = rng.normal(size=(30, n, n))
    sum_ = components(rng.normal(size=30), rng.normal(size=(30, n)), 0.2 * root @ np.swapaxes(root, 1, 2))
    axes = np.sqrt(np.einsum("kii->ki", sum_.covs))[:, :1] * np.eye(n)[:1]
    share, log_mass = shares(sum_)
    mean, cov = moments(share, sum_.means, sum_.covs)
    label, cost = groups(share, sum_.means, sum_.covs, None, 7)
    exchanged, pruned, merged = exchange(sum_, share, rng.uniform(size=30), lambda rows: axes[rows] * 0.1, 1e-3, 30)
    assert label.max() == 6 and cost > 0 and len(exchanged.signs) <= 30 and pruned == 0 and merged >= 0
    for other in (gathered(sum_, label), split(sum_, 0.1 * axes, THREE), split(sum_, 0.1 * axes, FIVE), exchanged):
        part, total = shares(other)
        assert total == pytest.approx(log_mass, abs=1e-12)
        found = moments(part, other.means, other.covs)
        assert np.allclose(found[0], mean, atol=1e-12) and np.allclose(found[1], cov, atol=1e-12)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("n", [1, 2])
def test_groups_of_nan_and_of_equal_points_are_found(n):
    for means in (np.zeros((5, n)), np.arange(5.0)[:, None] * np.ones(n), np.full((5, n), np.nan)):
        label, _ = groups(np.full(5, 0.2), means, np.zeros((5, n, n)), np.zeros(5), 2)
        assert len(label) == 5 and label.max() <= 1
    three = np.array([[0.0], [1e-3], [9.0]]) * np.ones(n)
    label, _ = groups(np.full(3, 1 / 3), three, np.zeros((3, n, n)), np.zeros(3), 2)
    assert label[0] == label[1] != label[2]
