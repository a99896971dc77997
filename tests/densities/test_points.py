"""Weighted points as a density."""

from __future__ import annotations

import numpy as np
import pytest

import zakai
from zakai.densities import PointMasses


def cloud(count: int = 400, n: int = 1, angle: bool = False) -> PointMasses:
    rng = np.random.default_rng(0)
    weights = rng.random(count)
    points = rng.normal(3.0 if angle else 0.5, 0.4, (count, n))
    return PointMasses(weights / weights.sum(), points, ("x", "y")[:n], (angle,) * n)


def test_moments_are_those_of_the_points_and_of_the_density_made_of_them():
    points = cloud(n=2)
    assert np.allclose(points.mean(), np.average(points.points, axis=0, weights=points.weights))
    assert np.allclose(points.cov(), np.cov(points.points.T, aweights=points.weights, ddof=0))
    assert np.allclose(points.smoothed.mean(), points.mean(), rtol=0, atol=1e-12)
    assert np.allclose(points.smoothed.cov(), points.cov(), rtol=0, atol=1e-12)


def test_the_density_integrates_to_one_and_is_near_that_which_was_drawn_from():
    points = cloud(4000)
    x = np.linspace(-2, 3, 1001)
    density = np.exp(points.log_density(x))
    assert np.isclose(density.sum() * (x[1] - x[0]), 1, rtol=0, atol=1e-6)
    true = np.exp(-0.5 * ((x - 0.5) / 0.4) ** 2) / (0.4 * np.sqrt(2 * np.pi))
    assert np.abs(density - true).max() < 0.1 and abs(points.mode()[0] - 0.5) < 0.15


def test_quantiles_count_the_weights():
    points = PointMasses(np.array([0.5, 0.1, 0.4]), np.array([[3.0], [1.0], [2.0]]), ("x",), (False,))
    assert points.quantile([0.05, 0.3, 0.6, 1.0])[:, 0].tolist() == [1.0, 2.0, 3.0, 3.0]
    assert points.marginal("x").mean() == points.mean()
    assert set(points.sample(0, 50)[:, 0]) == {1.0, 2.0, 3.0}


def test_angles_have_their_mean_direction():
    points = cloud(angle=True)
    assert abs(abs(points.mean()[0]) - 3.0) < 0.2 and 0.1 < points.cov()[0, 0] < 0.25
    x = np.linspace(-np.pi, np.pi, 721)[1:]
    assert np.isclose(np.exp(points.log_density(x)).sum() * (x[1] - x[0]), 1, rtol=0, atol=1e-6)


def test_points_on_a_line_have_no_density():
    flat = PointMasses(np.full(2, 0.5), np.array([[0.0, 0.0], [1.0, 1.0]]), ("x", "y"), (False, False))
    with pytest.raises(zakai.InputError, match="do not spread in every direction"):
        flat.log_density([[0.0, 0.0]])
    assert flat.mean().tolist() == [0.5, 0.5]
