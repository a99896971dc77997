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


def density(sum_):
    variance = np.asarray(sum_.covs)[:, 0, 0]
    z = (LINE[:, None] - np.asarray(sum_.means)[:, 0]) ** 2 / variance
    values = np.exp(-0.5 * z + np.asarray(sum_.log_weights) - 0.5 * np.log(2 * np.pi * variance)).sum(axis=1)
    return values * (LINE[1] - LINE[0])


def lost(p, q):
    p, q = p / p.sum(), q / q.sum()
    return np.sum(p * (np.log(p + 1e-300) - np.log(q + 1e-300)))


def test_neighbours_carry_the_shape_that_a_product_loses_and_modes_keep_their_mass():
    means = np.array([-6.0, -5.4, -4.8, 1.25, 1.75, 2.25, 2.75, 3.25, 3.75, 9.0])
    weights = np.array([0.02, 0.03, 0.02, 0.04, 0.15, 0.27, 0.27, 0.15, 0.04, 0.01])
    covs = np.full((10, 1, 1), 0.3)
    before = components(jnp.log(weights), means[:, None], covs)
    whole = refit(before, lambda x: 0.1 * x[..., 0] * jnp.sin(x[..., 0]), np.eye(1), False).sum
    # Each alone: the Gaussian with the moments of its product, by sums over the line.
    table = weights * np.exp(-0.5 * (LINE[:, None] - means) ** 2 / 0.3) / np.sqrt(0.6 * np.pi) * (LINE[1] - LINE[0])
    table *= np.exp(0.1 * LINE * np.sin(LINE))[:, None]
    mass = table.sum(axis=0)
    centre = LINE @ table / mass
    variance = ((LINE[:, None] - centre) ** 2 * table).sum(axis=0) / mass
    alone = components(np.log(mass), centre[:, None], variance[:, None, None])
    exact = table.sum(axis=1)
    heavy = (LINE > 0) & (LINE < 6)
    assert lost(exact[heavy], density(whole)[heavy]) <= 0.4 * lost(exact[heavy], density(alone)[heavy])
    assert lost(exact, density(whole)) <= 0.7 * lost(exact, density(alone))
    parts = [slice(0, 3), slice(3, 9), slice(9, 10)]
    kept = np.exp(np.asarray(whole.log_weights))
    assert np.allclose([kept[part].sum() for part in parts], [mass[part].sum() for part in parts], rtol=1e-4)


def spiral(variance, **changes):
    keys = {
        "state": ["x"], "drift": ["t/40 * x"], "observation": ["x*sin(x)", "x*cos(x)"], "observation_kind": "increments",
        "prior": {"kind": "gaussian", "mean": [0.0], "cov": [[variance]]},
    }  # fmt: skip
    return zakai.Model(**(keys | changes))


@pytest.mark.slow
def test_the_gradient_of_increments_is_the_slope():
    from zakai.filters.likelihood import log_likelihood

    model = spiral(1.0, observation=["a*x*sin(x)", "a*x*cos(x)"], parameters={"a": 1.1})
    _, record = zakai.simulate(model, np.arange(1, 21) * 0.01, seed=3)
    value, step = log_likelihood(model, record, "general-direct"), 1e-6
    expected = (value(model.theta() + step) - value(model.theta() - step)) / (2 * step)
    assert jax.grad(value)(model.theta()) == pytest.approx(np.array([expected]), rel=1e-4)


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
