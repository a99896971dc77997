"""Residuals: uniform for the true model, and equal to closed forms."""

import numpy as np
import pytest
from scipy.stats import kstest, norm

import zakai


def _model(noise=1.0, **keys):
    parts = {
        "state": ["x"], "drift": ["-x"], "observation": ["x"], "observation_noise": [["s"]], "observation_kind": "samples",
        "parameters": {"s": noise}, "prior": {"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
    }  # fmt: skip
    return zakai.Model(**{**parts, **keys})


@pytest.mark.parametrize("method", ["kalman-bucy", "limited-direct"])
def test_residuals_of_samples_equal_a_kalman_filter(method):
    model = _model(0.2)
    times = np.cumsum(np.random.default_rng(0).uniform(0.05, 0.5, 30))
    _, record = zakai.simulate(model, times, seed=1)
    found = zakai.filter(model, record, method).residuals()[:, 0]
    mean, variance, last, expected = 0.0, 1.0, 0.0, []
    for time, value in zip(times, record.values[:, 0], strict=True):
        decay = np.exp(-(time - last))
        mean, variance, last = decay * mean, decay**2 * variance + (1 - decay**2) / 2, time
        expected.append(norm.cdf((value - mean) / np.sqrt(variance + 0.2)))
        gain = variance / (variance + 0.2)
        mean, variance = mean + gain * (value - mean), (1 - gain) * variance
    assert np.allclose(found, expected, atol=2e-5)


def test_coordinates_are_conditional_on_those_before_and_missing_ones_are_nan():
    model = _model(observation=["x", "2*x"], observation_noise=[["0.3", "0.1"], ["0.1", "0.5"]], parameters={})
    values = np.array([[0.4, -0.3], [np.nan, 1.0]])
    found = zakai.filter(model, zakai.Record([0.0, 1.0], values, "samples")).residuals()
    cov = np.outer([1, 2], [1, 2]) + [[0.3, 0.1], [0.1, 0.5]]
    slope = cov[0, 1] / cov[0, 0]
    conditional = (-0.3 - slope * 0.4) / np.sqrt(cov[1, 1] - slope * cov[0, 1])
    assert np.allclose(found[0], norm.cdf([0.4 / np.sqrt(cov[0, 0]), conditional]), atol=2e-5)
    assert np.isnan(found[1, 0]) and 0 < found[1, 1] < 1


@pytest.mark.parametrize("seed", range(3))
def test_the_true_model_is_accepted_and_a_halved_noise_detected(seed):
    model = _model()
    _, record = zakai.simulate(model, np.arange(1, 401) / 20, seed=seed)
    true = zakai.filter(model, record).residuals()
    assert kstest(true[:, 0], "uniform").pvalue > 0.01
    assert np.array_equal(true, zakai.filter(model, record).residuals(seed=7))
    halved = zakai.filter(model.with_parameters(s=0.5), record).residuals()
    assert kstest(halved[:, 0], "uniform").pvalue < 0.05


def test_residuals_of_increments_are_uniform():
    model = _model(0.5, observation_kind="increments")
    _, record = zakai.simulate(model, np.arange(1, 201) / 100, seed=2)
    assert kstest(zakai.filter(model, record).residuals()[:, 0], "uniform").pvalue > 0.01
