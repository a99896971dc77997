"""Two and three states whose noise is proportional to them: populations, prices."""

import numpy as np
import pytest

import zakai
from zakai.densities import LogarithmicDensity

LOG_PRIOR = "-log(x)**2/(2*0.04) - log(x) - (log(y) - 0.3)**2/(2*0.09) - log(y)"
TRANSITION = np.array([[0.09, 0.03], [0.03, 0.05]])  # of the logarithms, per unit time


def growth(**keys):
    """Geometric Brownian motions with correlated noise, seen with log-normal noise: the logarithms are linear and Gaussian."""
    parts = {
        "state": ["x", "y"], "drift": ["0.2*x", "-0.1*y"], "diffusion": [["0.3*x", "0"], ["0.1*y", "0.2*y"]],
        "observation": ["log(x)", "log(x*y)"], "observation_family": "log-normal", "observation_kind": "samples",
        "observation_noise": [["0.02", "0"], ["0", "0.05"]], "prior": {"kind": "density", "log_density": LOG_PRIOR},
        "domain": {"x": {"lower": 0.0}, "y": {"lower": 0.0}},
    }  # fmt: skip
    return zakai.Model(**{**parts, **keys})


def kalman(times, values):
    """The means and covariances of the logarithms after each observation, and the log-likelihood."""
    mean, cov = np.array([0.0, 0.3]), np.diag([0.04, 0.09])
    H, S, drift = np.array([[1.0, 0.0], [1.0, 1.0]]), np.diag([0.02, 0.05]), np.array([0.2, -0.1]) - 0.5 * np.diag(TRANSITION)
    last, found, total = 0.0, [], 0.0
    noise = np.array([[0.3, 0.0], [0.1, 0.2]])
    for t, z in zip(times, values, strict=True):
        mean, cov, last = mean + (t - last) * drift, cov + (t - last) * noise @ noise.T, t
        if np.isfinite(z).all():
            V = H @ cov @ H.T + S
            apart = np.log(z) - H @ mean
            total += -0.5 * (apart @ np.linalg.solve(V, apart) + np.linalg.slogdet(2 * np.pi * V)[1]) - np.log(z).sum()
            gain = cov @ H.T @ np.linalg.inv(V)
            mean, cov = mean + gain @ apart, cov - gain @ H @ cov
        found.append((mean, cov))
    return found, total


def exponentials(mean, cov):
    """Mean and covariance of e^w, w ~ N(mean, cov)."""
    first = np.exp(mean + 0.5 * np.diag(cov))
    return first, np.outer(first, first) * np.expm1(cov)


def test_growth_equals_a_kalman_filter_of_the_logarithms():
    times = np.array([0.3, 0.5, 3.5, 3.6, 8.0])  # with a gap, and a forecast of many intervals' length
    values = np.array([[1.2, 1.5], [1.1, 1.9], [2.5, 2.0], [2.4, 2.2], [np.nan, np.nan]])
    result = zakai.filter(growth(), zakai.Record(times, values, "samples"), "yau-yau")
    found, total = kalman(times, values)
    assert result.log_likelihood == pytest.approx(total, abs=1e-4) and result.warnings == []
    for k, (mean, cov) in enumerate(found, start=1):
        first, second = exponentials(mean, cov)
        deviations = np.sqrt(np.diag(second))
        assert np.abs((result.mean[k] - first) / deviations).max() < 1e-3
        assert np.abs(result.cov[k] / np.outer(deviations, deviations) - second / np.outer(deviations, deviations)).max() < 3e-3
        density, w = result.density(k), mean + np.array([[0.3, -0.2], [-0.5, 0.4]])
        normal = -0.5 * np.einsum("pi,ij,pj->p", w - mean, np.linalg.inv(cov), w - mean)
        exact = normal - 0.5 * np.linalg.slogdet(2 * np.pi * cov)[1] - w.sum(axis=1)
        assert np.allclose(density.log_density(np.exp(w)), exact, atol=3e-3)
        assert density.log_density(np.array([-0.1, 1.0])) == -np.inf
        assert np.allclose(density.quantile([0.5])[0], np.exp(mean), rtol=3e-3)
        assert np.abs((density.mode() - np.exp(mean - cov.sum(axis=1))) / deviations).max() < 0.1
        assert np.allclose(density.mean(), result.mean[k], rtol=1e-6)
        assert np.allclose(density.marginal("y").mean(), first[1], rtol=1e-3)
        assert np.allclose(density.marginal(["y", "x"]).cov(), density.cov()[::-1, ::-1])


def test_smoothing_and_paths_equal_those_of_the_logarithms():
    times, values = np.array([0.5, 1.5, 2.0]), np.array([[1.2, 1.5], [np.nan, np.nan], [2.5, 2.0]])
    record = zakai.Record(times, values, "samples")
    smoothed = zakai.smooth(growth(), record, "yau-yau")
    ((mean, cov), (predicted, between), (last, after)), _ = kalman(times, values)
    predicted, between = mean + 1.5 * (predicted - mean), cov + 1.5 * (between - cov)  # at 2.0, before the observation
    gain = cov @ np.linalg.inv(between)
    first, second = exponentials(mean + gain @ (last - predicted), cov + gain @ (after - between) @ gain.T)
    deviations = np.sqrt(np.diag(second))
    assert np.abs((smoothed.mean[1] - first) / deviations).max() < 2e-3
    assert np.allclose(smoothed.cov[1] / np.outer(deviations, deviations), second / np.outer(deviations, deviations), atol=4e-3)
    assert np.allclose(smoothed.density(1).mean(), smoothed.mean[1], rtol=1e-3)
    paths = smoothed.sample_paths(4000, 0)[:, 1]
    assert np.abs((paths.mean(axis=0) - first) / deviations).max() < 0.06
    assert np.allclose(np.cov(paths.T) / np.outer(deviations, deviations), second / np.outer(deviations, deviations), atol=0.1)


def predator_prey(**keys):
    parts = {
        "state": ["x", "y"], "drift": ["1.1*x - 0.4*x*y", "0.1*x*y - 0.4*y"], "diffusion": [["0.1*x", "0"], ["0", "0.1*y"]],
        "observation": ["x", "y"], "observation_noise": [["0.04", "0"], ["0", "0.04"]], "observation_kind": "samples",
        "prior": {"kind": "gaussian", "mean": [10.0, 5.0], "cov": [0.25, 0.25]},
    }  # fmt: skip
    return zakai.Model(**{**parts, **keys})


def test_a_long_forecast_equals_one_in_small_steps():
    result = zakai.filter(predator_prey(), zakai.Record([0.5], [[7.0, 6.0]], "samples"), "yau-yau")
    once, often = result.forecast([3.0, 5.5, 8.0]), result.forecast(np.linspace(0.6, 8.0, 75))
    for k, when in enumerate([3.0, 5.5, 8.0], start=1):
        j = int(np.argmin(np.abs(often.times - when)))
        assert np.abs((once.mean[k] - often.mean[j]) / np.sqrt(often.variance[j])).max() < 1e-3
        assert np.allclose(once.variance[k], often.variance[j], rtol=2e-3)
    assert not once.warnings and not often.warnings


def test_records_online_filters_and_restarts_agree_to_the_bit(tmp_path):
    model, record = predator_prey(), zakai.Record([0.5, 1.0, 3.0], [[7.0, 6.0], [5.0, 7.0], [1.0, 3.0]], "samples")
    result, online = zakai.filter(model, record, "yau-yau"), zakai.online(model, "yau-yau")
    for k, (time, value) in enumerate(zip(record.times, record.values, strict=True), start=1):
        estimate = online.update(time, value)
        assert np.array_equal(estimate.mean, result.mean[k]) and np.array_equal(estimate.cov, result.cov[k])
        online.save(tmp_path / "state")
        online = zakai.online(model, "yau-yau")
        online.restore(tmp_path / "state")
    assert isinstance(estimate.density, LogarithmicDensity)


def test_a_density_is_saved_and_the_prior_of_a_next_record(tmp_path):
    model = predator_prey()
    result = zakai.filter(model, zakai.Record([0.5], [[7.0, 6.0]], "samples"), "yau-yau")
    result.density(1).save(tmp_path / "density")
    loaded = zakai.load_density(tmp_path / "density")
    assert np.array_equal(loaded.points, result.density(1).points)
    later = model.with_prior(loaded, start=0.5)
    (tmp_path / "later.toml").write_text(later.text)
    later = zakai.load_model(tmp_path / "later.toml")
    again = zakai.filter(later, zakai.Record([1.0], [[5.0, 7.0]], "samples"), "yau-yau")
    whole = zakai.filter(model, zakai.Record([0.5, 1.0], [[7.0, 6.0], [5.0, 7.0]], "samples"), "yau-yau")
    assert np.abs((again.mean[1] - whole.mean[2]) / np.sqrt(whole.variance[2])).max() < 1e-3


def test_a_prior_on_both_sides_of_zero_keeps_its_mass():
    # The mean and the second moment of geometric Brownian motion are known for any prior.
    model = growth(
        observation=["x"], observation_family="gaussian", observation_noise=[["1"]],
        prior={"kind": "gaussian", "mean": [0.2, 1.0], "cov": [0.09, 0.04]}, domain={},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([1.0], [np.nan], "samples"), "yau-yau")
    assert result.mean[1] == pytest.approx([0.2 * np.exp(0.2), np.exp(-0.1)], abs=1e-3)
    second = np.array([0.13 * np.exp(0.4 + 0.09), 1.04 * np.exp(-0.2 + 0.05)])
    assert result.variance[1] + result.mean[1] ** 2 == pytest.approx(second, rel=2e-3)
    assert result.density(1).marginal("x").quantile([0.2])[0, 0] < -0.01
