"""The smoothers of `wei-norman` and `kolmogorov-series`, whose message is that of `yau-yau`."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

import zakai


def test_wei_norman_agrees_with_the_exact_smoother_in_one_to_three_states():
    rng = np.random.default_rng(0)
    for n, steps, mean_error, variance_error in ((1, 12, 1e-6, 1e-6), (2, 6, 2e-4, 5e-4), (3, 2, 1e-3, 2e-3)):
        model = zakai.Model(
            state=["x", "y", "z"][:n], drift=["-x", "x - y", "y"][:n], observation=[["x"], ["x", "y"], ["x", "z"]][n - 1],
            prior={"kind": "gaussian", "mean": [0.5, 0.0, 0.0][:n], "cov": (0.3 * np.eye(n)).tolist()},
        )  # fmt: skip
        times = np.cumsum(rng.uniform(0.01, 0.05, steps))
        record = zakai.Record(times, 0.1 * rng.normal(size=(steps, model.m)), "increments")
        exact, result = (zakai.smooth(model, record, method) for method in ("kalman-bucy", "wei-norman"))
        np.testing.assert_allclose(result.mean, exact.mean, atol=mean_error)
        np.testing.assert_allclose(result.cov, exact.cov, atol=variance_error)
        np.testing.assert_allclose(result.density(1).mean(), exact.mean[1], atol=mean_error)
        assert result.warnings == []


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_the_series_smooths_a_double_well(kind):
    noise, length, count = 0.2, 0.1, 12
    model = zakai.Model(
        state=["x"], drift=["x - x**3"], observation=["x"], observation_kind=kind, observation_noise=[[noise]],
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[0.3]]},
    )  # fmt: skip
    _, record = zakai.simulate(model, length * np.arange(1, count + 1), seed=1)
    result = zakai.smooth(model, record, "kolmogorov-series")

    # Central differences for the generator of dx = (x - x^3) dt + dv; y is linear between observations.
    x = np.linspace(-3.5, 3.5, 281)
    spacing, f = x[1] - x[0], x - x**3
    up, down = 0.5 / spacing**2 + 0.5 * f / spacing, 0.5 / spacing**2 - 0.5 * f / spacing
    backward = np.diag(up[:-1], 1) + np.diag(down[1:], -1) - np.diag(up * (x < x[-1]) + down * (x > x[0]))
    densities, moves, likelihoods = [np.exp(-0.5 * x**2 / 0.3)], [], []
    for value in record.values[:, 0]:
        inside = (x * value / length - 0.5 * x**2) / noise if kind == "increments" else np.zeros_like(x)
        moves.append(expm(length * (backward + np.diag(inside))))
        likelihoods.append(np.exp(-0.5 * (value - x) ** 2 / noise) if kind == "samples" else np.ones_like(x))
        densities.append(likelihoods[-1] * (densities[-1] @ moves[-1]))
    message = np.ones_like(x)
    for k in reversed(range(count + 1)):
        smoothed = densities[k] * message / np.sum(densities[k] * message)
        mean = smoothed @ x
        bound = 1e-3 if kind == "samples" else 5e-3  # the splitting of the series
        assert result.mean[k, 0] == pytest.approx(mean, abs=bound)
        assert result.variance[k, 0] == pytest.approx(smoothed @ (x - mean) ** 2, abs=bound)
        if k:
            message = moves[k - 1] @ (likelihoods[k - 1] * message)
    assert result.warnings == []
    paths = result.sample_paths(4000, seed=2)[:, :, 0]
    np.testing.assert_allclose(paths.mean(axis=0), result.mean[:, 0], atol=0.05)
    np.testing.assert_allclose(paths.var(axis=0), result.variance[:, 0], rtol=0.15)
