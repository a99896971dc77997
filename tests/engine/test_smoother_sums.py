"""The smoother of Gaussian sums against exact smoothers and dense forward-backward sums in plain NumPy."""

from __future__ import annotations

import numpy as np
import pytest

import zakai


def gaussian(mean, variance):
    return {"kind": "gaussian", "mean": [mean], "cov": [[variance]]}


def irregular(count, seed, low=0.02, high=0.3):
    return np.cumsum(np.random.default_rng(seed).uniform(low, high, count))


def forward_backward(record, drift, h, noise, mean, variance):
    """Smoothed means and variances of dx = -`drift` x dt + dv with prior N(mean, variance) and samples of h, on a dense grid."""
    x = np.linspace(-5.0, 5.0, 1001)
    density = np.exp(-0.5 * (x - mean) ** 2 / variance)
    densities, moves, likelihoods = [density / density.sum()], [], []
    for length, value in zip(np.diff(np.append(0.0, record.times)), record.values[:, 0], strict=True):
        decay = np.exp(-drift * length)
        spread = (1.0 - decay**2) / (2.0 * drift) if drift else length
        move = np.exp(-0.5 * (x[:, None] - decay * x) ** 2 / spread)
        likelihood = np.exp(-0.5 * (value - h(x)) ** 2 / noise)
        density = likelihood * (move @ densities[-1])
        densities.append(density / density.sum())
        moves.append(move)
        likelihoods.append(likelihood)
    message, means, variances = np.ones_like(x), [], []
    for k in reversed(range(len(densities))):
        smoothed = densities[k] * message / np.sum(densities[k] * message)
        means.append(smoothed @ x)
        variances.append(smoothed @ (x - means[-1]) ** 2)
        if k:
            message = moves[k - 1].T @ (likelihoods[k - 1] * message)
            message /= message.max()
    return np.array(means[::-1]), np.array(variances[::-1])


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_sums_smooth_a_linear_system_of_five_states_exactly_and_draw_its_paths(kind):
    # No grid takes five states that are coupled.
    names = list("abcde")
    drift = ["-a + b/2", "-b + c/2", "-c + d/2", "-d + e/2", "sin(3*t) - e + a/2"]
    cov = 0.3 * np.eye(5) + 0.1
    model = zakai.Model(
        state=names, drift=drift, observation=["a - d", "c + 1"], observation_kind=kind, process_noise=(0.5 * np.eye(5)).tolist(),
        observation_noise=[[0.1, 0.02], [0.02, 0.2]], prior={"kind": "gaussian", "mean": [1.0, 0, 0, 0, -1], "cov": cov.tolist()},
    )  # fmt: skip
    _, record = zakai.simulate(model, irregular(12, 0), seed=1)
    values = record.values.copy()
    values[3, 0] = values[7] = np.nan
    record = zakai.Record(record.times, values, kind)
    exact, sums = (zakai.smooth(model, record, method) for method in ("kalman-bucy", "general-direct"))
    np.testing.assert_allclose(sums.mean, exact.mean, atol=1e-8)
    np.testing.assert_allclose(sums.cov, exact.cov, atol=1e-8)
    np.testing.assert_allclose(sums.density(4).cov(), exact.cov[4], atol=1e-8)
    assert sums.warnings == []
    first, second = (result.sample_paths(4000, seed=seed) for seed, result in enumerate((exact, sums)))
    for k in range(len(first[0]) - 1):
        lagged = [np.cov(paths[:, k : k + 2].reshape(len(paths), 10).T) for paths in (first, second)]
        np.testing.assert_allclose(lagged[1], lagged[0], atol=0.06)
    np.testing.assert_allclose(second.mean(axis=0), exact.mean, atol=0.05)


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_sums_in_the_gauge_of_log_cosh_agree_with_the_exact_smoother(kind):
    model = zakai.Model(
        state=["x"], drift=["tanh(x)"], observation=["x"], observation_kind=kind, observation_noise=[[0.5]],
        prior=gaussian(0.2, 0.8),
    )  # fmt: skip
    _, record = zakai.simulate(model, irregular(20, 1), seed=2)
    exact, sums = (zakai.smooth(model, record, method) for method in ("benes", "gaussian-sum"))
    np.testing.assert_allclose(sums.mean, exact.mean, atol=1e-5)
    np.testing.assert_allclose(sums.variance, exact.variance, atol=1e-5)
    assert sums.warnings == [] and np.nanmax(sums.health["evidence_error"]) < 1e-9


@pytest.mark.parametrize(
    ("drift", "observation", "h", "noise"),
    [(1.0, "x + x**3/6", lambda x: x + x**3 / 6, 0.2), (0.0, "x**2", lambda x: x**2, 0.5)],
)
def test_a_curved_observation_agrees_with_sums_over_a_dense_grid(drift, observation, h, noise):
    model = zakai.Model(
        state=["x"], drift=[f"-{drift}*x"], observation=[observation], observation_kind="samples", observation_noise=[[noise]],
        prior=gaussian(0.3, 0.5),
    )  # fmt: skip
    _, record = zakai.simulate(model, irregular(30, 3), seed=4)
    result = zakai.smooth(model, record, "general-direct")
    mean, variance = forward_backward(record, drift, h, noise, 0.3, 0.5)
    deviation = np.sqrt(variance)
    np.testing.assert_allclose(result.mean[:, 0] / deviation, mean / deviation, atol=0.03)
    np.testing.assert_allclose(result.variance[:, 0] / variance, 1.0, atol=0.06)
    assert np.nanmax(result.health["evidence_error"]) < 0.03
    paths = result.sample_paths(4000, seed=5)[:, :, 0]
    np.testing.assert_allclose(paths.mean(axis=0) / deviation, mean / deviation, atol=0.12)
    np.testing.assert_allclose(paths.var(axis=0) / variance, 1.0, atol=0.2)


def test_a_smoother_that_a_lost_skewness_misleads_warns():
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=["x**3"], observation_kind="samples", observation_noise=[[0.1]],
        prior=gaussian(0.0, 0.5),
    )  # fmt: skip
    _, record = zakai.simulate(model, irregular(60, 0), seed=1)
    result = zakai.smooth(model, record, "general-direct", components=6)
    mean, variance = forward_backward(record, 1.0, lambda x: x**3, 0.1, 0.0, 0.5)
    assert np.abs(result.variance[:, 0] / variance - 1.0).max() > 0.2
    assert any(warning.startswith(("mean_error", "deviation_error", "evidence_error")) for warning in result.warnings)


def test_increments_of_a_curved_sensor_on_a_circle_agree_with_a_grid():
    model = zakai.Model(
        state=["x"], periodic=["x"], drift=["1"], process_noise=[[0.5]], observation=["sin(x)", "cos(x)"],
        observation_noise=[[0.2, 0], [0, 0.2]], prior=gaussian(3.0, 0.3),
    )  # fmt: skip
    _, record = zakai.simulate(model, irregular(60, 0, 0.01, 0.05), seed=1)
    sums, grid = (zakai.smooth(model, record, method) for method in ("general-direct", "yau-yau"))
    apart = sums.mean - grid.mean
    apart = apart - 2 * np.pi * np.round(apart / (2 * np.pi))
    np.testing.assert_allclose(apart / np.sqrt(grid.variance), 0.0, atol=0.03)
    np.testing.assert_allclose(sums.variance / grid.variance, 1.0, atol=0.05)
    assert np.abs(sums.sample_paths(10)).max() <= np.pi


def test_sums_that_are_narrow_in_three_directions_smooth_a_system_that_is_nearly_linear():
    def model(observation):
        return zakai.Model(
            state=["x", "y", "z"], drift=["-x", "x - y", "y - z"], observation=observation, observation_kind="samples",
            observation_noise=(0.2 * np.eye(3)).tolist(),
            prior={"kind": "gaussian", "mean": [0.3, 0.0, 0.0], "cov": (0.3 * np.eye(3)).tolist()},
        )  # fmt: skip

    linear, curved = model(["x", "y", "z"]), model(["x + x**3/1000", "y + y**3/1000", "z + z**3/1000"])
    _, record = zakai.simulate(linear, irregular(4, 0), seed=1)
    exact, sums = zakai.smooth(linear, record, "kalman-bucy"), zakai.smooth(curved, record, "general-direct")
    # The filter's own start is coarse in three directions: its mean is 0.06 deviations off after the first sample.
    np.testing.assert_allclose((sums.mean - exact.mean) / np.sqrt(exact.variance), 0.0, atol=0.1)
    np.testing.assert_allclose(sums.variance / exact.variance, 1.0, atol=0.08)
    assert sums.health["evidence_error"].max() < 0.01
