"""Density grids where they cannot keep the tolerance: the filter ends, warns, and goes on."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import norm

import zakai

CUBIC = {
    "state": ["x", "y"], "drift": ["-x + y/2", "-y**3"], "observation": ["x", "y"], "observation_kind": "samples",
    "observation_noise": [["1/10", "0"], ["0", "1/10"]], "prior": {"kind": "gaussian", "mean": [0, 0], "cov": [1, 1]},
}  # fmt: skip
# Means and variances of logarithms of predator and prey, by sinc collocation (benchmarks/random_plane.py).
MEANS = np.array([[1.80717, -0.0587074], [1.63471675, 1.2161048], [1.69597772, 0.4100613], [1.26298092, 1.3801308]])
VARIANCES = np.array([[0.0010554309, 0.5180715], [0.0013268878, 0.3215228], [0.0012880636, 0.2083324], [0.0030592151, 0.0359201]])


def test_a_fill_value_in_two_states_warns_with_its_time_and_does_not_end_the_filter():
    model, times = zakai.Model(**CUBIC), 0.1 * np.arange(1, 13)
    _, record = zakai.simulate(model, times, seed=1)
    values = np.asarray(record.values).copy()
    values[3] = 1e8
    result = zakai.filter(model, zakai.Record(times, values, "samples"), "yau-yau")
    assert any("most at t = 0.4" in text for text in result.warnings)
    without = values.copy()
    without[3] = np.nan
    expected = zakai.filter(model, zakai.Record(times, without, "samples"), "yau-yau")
    assert not expected.warnings
    assert np.abs(result.mean[-1] - expected.mean[-1]).max() < 1e-2 * np.sqrt(expected.variance[-1]).min()


def test_a_density_that_no_grid_of_three_states_holds_ends_with_a_warning():
    # The density of Lorenz' attractor is a sheet that is far thinner than the spacing of the largest grid.
    model = zakai.Model(
        state=["x", "y", "z"], drift=["10*(y - x)", "x*(28 - z) - y", "x*y - 8/3*z"], observation=["x"],
        observation_kind="samples", observation_noise=[["4"]], process_noise=np.eye(3).tolist(),
        prior={"kind": "gaussian", "mean": [0, 0, 25], "cov": [60, 80, 70]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([0.2], [[6.0]], "samples"), "yau-yau")
    assert any("the density was lost at t = 0.2" in text for text in result.warnings)
    assert result.density(1).log_values.size < 500_000 and np.isfinite(result.mean).all()


@pytest.mark.parametrize("surprise", [0.0, 0.05, 0.1])
def test_an_observation_in_the_tails_of_a_prediction_has_the_error_that_is_estimated(surprise):
    # Two independent linear states; the second observation of y is 2, 5 and 7 standard deviations from its prediction.
    model = zakai.Model(
        state=["x", "y"], drift=["-x", "-y"], observation=["x", "y"], observation_kind="samples",
        observation_noise=[[1e-4, 0], [0, 1e-4]], process_noise=[[1e-3, 0], [0, 1e-3]],
        prior={"kind": "gaussian", "mean": [0, 0], "cov": [1, 1]},
    )  # fmt: skip
    times, values = [0.01, 2.0], np.array([[0.7, -0.4], [0.1, surprise]])
    mean, variance, evidence = np.zeros(2), np.ones(2), 0.0
    for length, value in zip(np.diff(times, prepend=0.0), values, strict=True):
        kept = np.exp(-length)
        mean, variance = kept * mean, kept**2 * variance + 1e-3 * (1 - kept**2) / 2
        evidence += norm.logpdf(value, mean, np.sqrt(variance + 1e-4)).sum()
        gain = variance / (variance + 1e-4)
        mean, variance = mean + gain * (value - mean), variance * (1 - gain)
    result = zakai.filter(model, zakai.Record(times, values, "samples"), "yau-yau")
    errors = [
        result.log_likelihood - evidence,
        *((result.mean[-1] - mean) / np.sqrt(variance)),
        *(np.sqrt(result.variance[-1] / variance) - 1),
    ]
    assert np.abs(errors).max() < result.health["error_estimate"][-1] < 5e-4
    assert result.warnings == []


def test_logarithms_of_predator_and_prey_keep_the_error_that_is_estimated():
    # The drift grows as exp: grids for the tails of a density may have to be far wider than the density.
    model = zakai.Model(
        state=["u", "v"], drift=["1 - exp(v)", "exp(u) - 1"], process_noise=[["1/20", "0"], ["0", "1/20"]],
        observation=["exp(u)"], observation_kind="samples", observation_noise=[["1/25"]],
        prior={"kind": "gaussian", "mean": [0.3, 0.0], "cov": [0.1, 0.1]},
    )  # fmt: skip
    gaps = np.random.default_rng(1).exponential(0.2, 200)
    _, record = zakai.simulate(model, np.cumsum(np.maximum(gaps, 0.004)), seed=2)
    result = zakai.filter(model, zakai.Record(record.times[:71], record.values[:71], "samples"), "yau-yau")
    errors = np.abs(np.hstack([(result.mean[68:] - MEANS) / np.sqrt(VARIANCES), np.sqrt(result.variance[68:] / VARIANCES) - 1]))
    assert np.isfinite(result.mean).all() and result.warnings == []
    assert (errors.max(axis=1) < 10 * result.health["error_estimate"][68:]).all()


@pytest.mark.parametrize("outlier", [0.4, 3.0])
def test_an_outlying_increment_has_the_error_that_is_estimated_where_noise_does_not_reach_the_state(outlier):
    # A linear oscillator whose velocity alone is driven; the last increment of the position is ordinary or outlying.
    model = zakai.Model(
        state=["x", "y"], drift=["y", "-x - 3/10*y"], diffusion=[["0"], ["1/2"]], observation=["x"],
        observation_kind="increments", observation_noise=[["1/5"]], prior={"kind": "gaussian", "mean": [0, 0], "cov": [0.1, 0.1]},
    )  # fmt: skip
    times, values = [0.1, 0.4, 0.5, 0.8], [0.02, -0.05, 0.01, outlier]
    result = zakai.filter(model, zakai.Record(times, np.array(values)[:, None], "increments"), "yau-yau")
    A, noise, mean, cov = np.array([[0, 1], [-1, -0.3]]), np.diag([0, 0.25]), np.zeros(2), 0.1 * np.eye(2)
    for k, (length, value) in enumerate(zip(np.diff(times, prepend=0.0), values, strict=True)):

        def kalman_bucy(_, z, rate=value / length):
            m, P = z[:2], z[2:].reshape(2, 2)
            gain = P[:, 0] / 0.2
            return np.concatenate([A @ m + gain * (rate - m[0]), (A @ P + P @ A.T + noise - np.outer(gain, P[0])).ravel()])

        end = solve_ivp(kalman_bucy, (0, length), [*mean, *cov.ravel()], rtol=1e-10, atol=1e-12).y[:, -1]
        mean, cov = end[:2], end[2:].reshape(2, 2)
        variance = np.diagonal(cov)
        errors = np.abs(result.mean[k + 1] - mean) / np.sqrt(variance), np.abs(np.sqrt(result.variance[k + 1] / variance) - 1)
        assert np.max(errors) < 10 * result.health["error_estimate"][k + 1]
    assert bool(result.warnings) == (outlier > 2)


def test_a_distant_mode_with_a_small_weight_keeps_it_over_an_interval():
    # Two independent linear states; the noise of the interval is far wider than the modes, and the sample allows both of them.
    weights, means, noise = np.array([1 - 2e-4, 2e-4]), np.array([0.4, 1.9]), 0.3
    model = zakai.Model(
        state=["x", "y"], drift=["-x", "-y"], process_noise=[[noise, 0], [0, noise]], observation=["(x - 0.4)*(x - 1.5)"],
        observation_kind="samples", observation_noise=[["0.002"]],
        prior={
            "kind": "mixture", "weights": weights.tolist(), "means": [[m, 0] for m in means],
            "covs": [[[0.004, 0], [0, 0.05]]] * 2,
        },
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([0.2], [[0.0]], "samples"), "yau-yau")
    kept = np.exp(-0.2)
    x = np.linspace(-1, 4, 20001)
    modes = norm.pdf(x[:, None], kept * means, np.sqrt(0.004 * kept**2 + noise * (1 - kept**2) / 2))
    density = (modes @ weights) * norm.pdf((x - 0.4) * (x - 1.5), 0, np.sqrt(0.002))
    mean = density @ x / density.sum()
    deviation = np.sqrt(density @ (x - mean) ** 2 / density.sum())
    error = max(abs(result.mean[1, 0] - mean) / deviation, abs(np.sqrt(result.variance[1, 0]) / deviation - 1))
    assert error < 10 * result.health["error_estimate"][1]
    assert error < 3e-4


@pytest.mark.parametrize("noise", [0.002, 0.01])
def test_a_sample_that_lifts_a_mode_from_the_end_of_the_tails_is_warned_of(noise):
    # Two independent linear states; the sample makes a mode count that is 13 nats below the other one.
    weights, means = np.array([1 - 1.5e-6, 1.5e-6]), np.array([0.4, 1.9])
    model = zakai.Model(
        state=["x", "y"], drift=["-x", "-y"], process_noise=[[noise, 0], [0, noise]], observation=["x"],
        observation_kind="samples", observation_noise=[["0.05"]],
        prior={
            "kind": "mixture", "weights": weights.tolist(), "means": [[m, 0] for m in means],
            "covs": [[[0.004, 0], [0, 0.05]]] * 2,
        },
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([0.1], [[1.43]], "samples"), "yau-yau")
    kept = np.exp(-0.1)
    x = np.linspace(-1, 4, 20001)
    density = (norm.pdf(x[:, None], kept * means, np.sqrt(0.004 * kept**2 + noise * (1 - kept**2) / 2)) @ weights) * norm.pdf(
        x, 1.43, np.sqrt(0.05)
    )
    mean = density @ x / density.sum()
    deviation = np.sqrt(density @ (x - mean) ** 2 / density.sum())
    error = max(abs(result.mean[1, 0] - mean) / deviation, abs(np.sqrt(result.variance[1, 0]) / deviation - 1))
    assert error < 10 * result.health["error_estimate"][1]
    assert result.warnings


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_what_is_not_observed_has_no_evidence(kind):
    keys = {**CUBIC, "drift": ["y", "-x - y*(x**2 - 1)"], "observation_kind": kind}
    values = np.full((8, 2), np.nan)
    values[4] = [0.3, 0.2]
    result = zakai.filter(zakai.Model(**keys), zakai.Record(0.2 * np.arange(1, 9), values, kind), "yau-yau")
    unobserved = np.delete(result.log_likelihood_increments, 5)
    assert np.abs(unobserved).max() < 1e-13
    assert result.log_likelihood_increments[5] != 0


def test_modes_far_away_that_are_lost_are_said():
    # sin x has the same value at many x: a share of 1e-6 of the mass, thirty deviations away, counts in the variance.
    model = zakai.Model(
        state=["x", "v"], drift=["v", "-sin(x) - 0.3*v"], process_noise=[["0", "0"], ["0", "1/4"]], observation=["sin(x)"],
        observation_kind="samples", observation_noise=[["1/25"]],
        prior={"kind": "gaussian", "mean": [0.5, 0.0], "cov": [0.3, 0.3]},
    )  # fmt: skip
    _, record = zakai.simulate(model, np.cumsum(np.random.default_rng(5).exponential(0.2, 60)), seed=2)
    result = zakai.filter(model, zakai.Record(record.times[:42], record.values[:42], "samples"), "yau-yau")
    # Tolerances from 3e-5 to 1e-5 agree in these deviations of x.
    errors = np.abs(np.sqrt(result.variance[39:, 0]) / [0.15632, 0.15088, 0.15024, 0.15000] - 1)
    assert errors.max() < 1e-2
    assert errors.max() < 1e-3 or any("tolerance_ratio" in warning for warning in result.warnings)
