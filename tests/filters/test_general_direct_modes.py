"""Gaussian sums with several modes: what their weights lose by one reading, and over whole paths of the spiral sensor."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zakai
from zakai.densities.components import components
from zakai.densities.quadrature import refit

LINE = np.linspace(-12, 12, 6001)
SPACE = LINE[1] - LINE[0]


def density(log_weights, means, variances):
    z = (LINE[:, None] - means) ** 2 / variances
    return np.exp(-0.5 * z + log_weights - 0.5 * np.log(2 * np.pi * variances)).sum(axis=1) * SPACE


def of(sum_):
    return density(np.asarray(sum_.log_weights), np.asarray(sum_.means)[:, 0], np.asarray(sum_.covs)[:, 0, 0])


def alone(weights, means, variances, factor):
    """The masses of the products with factor, the sum of the Gaussians with their moments, the sum of the products."""
    table = weights / np.sqrt(2 * np.pi * variances) * np.exp(-0.5 * (LINE[:, None] - means) ** 2 / variances)
    table = table * factor[:, None] * SPACE
    mass = table.sum(axis=0)
    centre = LINE @ table / mass
    variance = ((LINE[:, None] - centre) ** 2 * table).sum(axis=0) / mass
    return mass, density(np.log(mass), centre, variance), table.sum(axis=1)


def lost(p, q):
    p, q = p / p.sum(), q / q.sum()
    return np.sum(p * (np.log(p + 1e-300) - np.log(q + 1e-300)))


@pytest.mark.slow
def test_neighbours_carry_the_shape_that_a_product_loses_and_modes_keep_their_mass():
    means = np.array([-6.0, -5.4, -4.8, 1.25, 1.75, 2.25, 2.75, 3.25, 3.75, 9.0])
    weights = np.array([0.02, 0.03, 0.02, 0.04, 0.15, 0.27, 0.27, 0.15, 0.04, 0.01])
    before = components(jnp.log(weights), means[:, None], np.full((10, 1, 1), 0.3))
    whole = refit(before, lambda x: 0.1 * x[..., 0] * jnp.sin(x[..., 0]), np.eye(1), False, 1).sum
    mass, plain, exact = alone(weights, means, np.full(10, 0.3), np.exp(0.1 * LINE * np.sin(LINE)))
    heavy = (LINE > 0) & (LINE < 6)
    assert lost(exact[heavy], of(whole)[heavy]) <= 0.4 * lost(exact[heavy], plain[heavy])
    assert lost(exact, of(whole)) <= 0.7 * lost(exact, plain)
    parts = [slice(0, 3), slice(3, 9), slice(9, 10)]
    kept = np.exp(np.asarray(whole.log_weights))
    assert np.allclose([kept[part].sum() for part in parts], [mass[part].sum() for part in parts], rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_among_near_duplicates_a_large_factor_leaves_the_mean_and_the_shape(seed):
    rng = np.random.default_rng(seed)
    means, variances = rng.uniform(-4.0, 4.0, 60), rng.uniform(0.02, 0.2, 60)
    weights = np.exp(rng.normal(0.0, 2.0, 60) - 0.25 * means**2)
    weights /= weights.sum()
    before = components(jnp.log(weights), means[:, None], variances[:, None, None])
    whole = of(refit(before, lambda x: 0.5 * x[..., 0] * jnp.sin(2.0 * x[..., 0]), np.eye(1), False, 1).sum)
    _, plain, exact = alone(weights, means, variances, np.exp(0.5 * LINE * np.sin(2.0 * LINE)))
    assert lost(exact, whole) <= lost(exact, plain)
    mean, deviation = LINE @ exact / exact.sum(), np.sqrt(exact @ LINE**2 / exact.sum() - (LINE @ exact / exact.sum()) ** 2)
    assert abs(LINE @ whole / whole.sum() - mean) <= 2e-3 * deviation
    assert whole.sum() == pytest.approx(exact.sum(), rel=1e-3)


def spiral(variance, **changes):
    keys = {
        "state": ["x"], "drift": ["t/40 * x"], "observation": ["x*sin(x)", "x*cos(x)"], "observation_kind": "increments",
        "prior": {"kind": "gaussian", "mean": [0.0], "cov": [[variance]]},
    }  # fmt: skip
    return zakai.Model(**(keys | changes))


@pytest.mark.longest
@pytest.mark.slow
def test_the_gradient_of_increments_is_the_slope():
    from zakai.filters.likelihood import log_likelihood

    model = spiral(1.0, observation=["a*x*sin(x)", "a*x*cos(x)"], parameters={"a": 1.1})
    _, record = zakai.simulate(model, np.arange(1, 21) * 0.01, seed=3)
    value, step = log_likelihood(model, record, "general-direct"), 1e-6
    expected = (value(model.theta() + step) - value(model.theta() - step)) / (2 * step)
    assert jax.grad(value)(model.theta()) == pytest.approx(np.array([expected]), rel=1e-4)


@pytest.mark.longest
@pytest.mark.slow
def test_paths_that_begin_anywhere_in_the_prior_keep_the_weights_of_their_modes():
    model = spiral(3.0)
    truths, records = zip(*(zakai.simulate(model, np.arange(1, 1001) * 0.01, seed=seed) for seed in range(4000, 4020)))
    exact, told = (
        zakai.filter(model, list(records), method, keep="moments") for method in ("limited-direct", "general-direct")
    )

    def squared(results):
        pairs = zip(results, truths)
        return np.array([np.mean((one.mean[-1000:, 0] - truth.values[-1000:, 0]) ** 2) for one, truth in pairs])

    ratio = squared(told) / squared(exact)
    assert abs(squared(told).mean() / squared(exact).mean() - 1) <= 0.02 and np.abs(ratio - 1).max() <= 0.1
    away = [(one.mean - other.mean)[:, 0] / np.sqrt(other.variance[:, 0]) for one, other in zip(told, exact)]
    assert np.sqrt(np.mean(np.square(away))) <= 0.015
    assert all(result.warnings or np.abs(error).max() <= 0.1 for result, error in zip(told, away))
