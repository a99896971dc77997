"""Warnings say by how much the means may be off and from when on, or that the density was lost; right results are silent."""

import re

import numpy as np
import pytest
from scipy import special

import zakai
from zakai import _progress
from zakai.notes.health import warnings_of_run, warnings_of_step


def linear(**more):
    keys = {"observation": ["x"], "prior": {"kind": "gaussian", "mean": [0], "cov": [[1]]}, **more}
    return zakai.Model(state=["x"], drift=["-x"], observation_kind="samples", **keys)


@pytest.mark.parametrize(
    ("errors", "words"),
    [
        ([0, 5e-4, 9e-4, 2e-4], None),
        ([0, 5e-4, 3e-3, 2e-4], "off by about 0.003 standard deviations, at t = 0.2 (tolerance_ratio: 7)"),
        ([0, 5e-4, 0.03, 0.2], "off by about 0.2 deviations, from t = 0.2 on"),
        ([0, 0.3, 2e-4, 2e-4], "off by about 0.3 deviations, at t = 0.1"),
        ([0, 0.3, 0.03, 2e-4], "off by about 0.3 deviations, from t = 0.1 to t = 0.2"),
        ([0, 4e3, 2.0, np.nan], "the density may be lost from t = 0.1 on"),
    ],
)
def test_an_estimate_says_how_far_and_since_when(errors, words):
    result = zakai.filter(linear(), zakai.Record([0.1, 0.2, 0.3], [0.1, 0.3, 0.2], "samples"), "yau-yau")
    assert result.warnings == []
    result.health["error_estimate"] = np.array(errors)
    result.health["tolerance_ratio"] = np.array([np.nan, 7.0, 3.0, 2.0])
    found = warnings_of_run(result)
    assert found == [] if words is None else len(found) == 1 and words in found[0] and re.search(r"up to 7|ratio: 7", found[0])
    # A result of a coarser tolerance that agrees bounds the error too.
    assert warnings_of_run(result, distances=lambda: np.array([0, 1e-4, 1e-4, 1e-4])) == []
    if words is not None:
        (closer,) = warnings_of_run(result, distances=lambda: np.array([0, 0.02, 0.01, 0.01]))
        assert "off by about 0.02 standard deviations" in closer or errors[1] < 1e-3


def test_a_slight_error_is_said_with_its_size_and_what_was_asked_without_advice():
    model = zakai.Model(
        state=["x", "v"], drift=["v", "2*(1 - x**2)*v - x"], diffusion=[["0"], ["0.3"]], observation=["x"],
        observation_noise=[["0.02"]], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [1.5, 0.0], "cov": [0.05, 0.05]},
    )  # fmt: skip
    forecast = zakai.filter(model, zakai.Record([0.3], [np.nan], "samples"), "yau-yau").forecast([2.8, 5.3])
    ratio, error = forecast.health["tolerance_ratio"][1:].max(), forecast.error_estimate[1:].max()
    assert ratio > 1 and 1e-3 < error < 0.05
    (said,) = forecast.warnings
    assert said.startswith(f"the means may be off by about {error:.1g} standard deviations, ") and "asked: 0.001 (" in said
    assert ";" not in said.replace("; asked", "")
    figures = {"tolerance_ratio": 3.0, "error_estimate": 3e-3}
    words = "the mean may be off by up to 0.003 standard deviations (tolerance_ratio is 3)"
    assert warnings_of_step(figures, forecast.bounds, {}) == [words]


def test_a_right_result_that_a_coarser_tolerance_reproduces_is_silent():
    # A sharp likelihood with a kink: the estimate of the method is 0.02 deviations.
    model = linear(observation=["abs(x - 0.3)"], observation_noise=[["0.0001"]])
    values = np.array([2.249, 2.040, 2.086, 1.415, 1.016, 0.797])
    record = zakai.Record(0.1 * np.arange(1, 7), values, "samples")
    result = zakai.filter(model, record, "yau-yau")
    assert result.health["tolerance_ratio"][1:].max() > 10 and result.error_estimate[1:].max() > 5e-3
    assert result.warnings == []
    mean, deviation = dense(record.times, values, lambda x: np.abs(x - 0.3), 1e-4, np.arange(-4, 4, 4e-4))
    assert (np.abs(result.mean[1:, 0] - mean) / deviation).max() < 5e-3


def test_observations_in_the_tails_are_silent_until_the_density_is_lost_there():
    # Nine and then twenty deviations from what is predicted; the exact filter knows the truth.
    record = zakai.Record(0.1 * np.arange(1, 8), [0.1, 0.2, 12.0, 0.1, 0.2, 0.0, -20.0], "samples")
    exact = zakai.filter(linear(), record, "kalman-bucy")
    found = zakai.filter(linear(), record, "yau-yau")
    off = np.abs(found.mean - exact.mean)[:, 0] / np.sqrt(exact.variance[:, 0])
    assert off[:7].max() < 1e-4 and off[7] > 0.2
    assert found.error_estimate[3] > 0.1  # a bound, far above the error
    (said,) = found.warnings
    assert said.startswith("the density was lost at t = 0.7: later rows mean nothing (tail_depth")
    online = zakai.online(linear(), "yau-yau")
    for time, value in zip(record.times, record.values, strict=True):
        estimate = online.update(time, value)
    assert len(estimate.warnings) == 1 and estimate.warnings[0].startswith("the density was lost (tail_depth")


@pytest.mark.parametrize("method", ["limited-direct", "yau-yau"])
def test_a_density_that_is_finer_than_every_grid_is_said_to_be_lost(method):
    # Peaks of 3e-4 at every zero of sin(3 x) - z: a coarser tolerance has the same grid and the same result.
    model = linear(observation=["sin(3*x)"], observation_noise=[["1e-6"]])
    values = np.array([0.42, -0.3])
    record = zakai.Record([0.1, 0.2], values, "samples")
    result = zakai.filter(model, record, method)
    mean, deviation = dense(record.times, values, lambda x: np.sin(3 * x), 1e-6, np.arange(-5, 5, 4e-5))
    assert (np.abs(result.mean[1:, 0] - mean) / deviation).max() > 0.1
    assert result.warnings[0].startswith("the density was lost at t = 0.2")


def test_four_states_on_a_grid_are_advised_to_take_particles():
    keys = {"state": list("abcd"), "drift": ["-a + b*c", "-b", "-c", "-d + a"], "observation": ["a"]}
    model = zakai.Model(**keys, observation_kind="samples", prior={"kind": "gaussian", "mean": [0] * 4, "cov": [1] * 4})
    method = zakai.online(model, "yau-yau").feeds[0].setting.method
    assert method.shorter == "take guided-particles"
    result = zakai.filter(linear(), zakai.Record([0.1, 0.2], [0.1, 0.3], "samples"), "yau-yau")
    result.health["error_estimate"] = np.array([0.0, 0.05, 0.5])
    result.health["tolerance_ratio"] = np.array([np.nan, 7.0, 3.0])
    assert warnings_of_run(result)[0].endswith("; compare with guided-particles")
    result.state = tuple("abcd")
    assert warnings_of_run(result)[0].endswith("; take guided-particles")
    result.health["error_estimate"] = np.array([0.0, 0.005, 0.02])  # particles leave an error of 0.03
    assert "guided-particles" not in warnings_of_run(result)[0]


def dense(times, values, h, noise, x):
    """Means and deviations of dx = -x dt + dv from N(0, 1), by sums over all points with any likelihood."""
    points, logs, before, moments = np.zeros(1), np.zeros(1), 0.0, []
    for time, value in zip(times, values, strict=True):
        decay, spread = np.exp(before - time), (1 - np.exp(2 * (before - time))) / 2
        spread = spread + decay**2 if before == 0 else spread  # the prior's variance
        likelihood = -0.5 * (value - h(x)) ** 2 / noise
        here = x[likelihood > -60]
        motion = -0.5 * (here[:, None] - decay * points) ** 2 / spread
        new = special.logsumexp(motion + logs, axis=1) + likelihood[likelihood > -60]
        kept = new > new.max() - 40
        points, logs, before = here[kept], new[kept] - new.max(), time
        weights = np.exp(logs) / np.exp(logs).sum()
        mean = weights @ points
        moments.append((mean, np.sqrt(weights @ (points - mean) ** 2)))
    return np.array(moments).T


@pytest.mark.parametrize("smooth", [False, True])
def test_a_comparison_that_takes_long_says_how_long(monkeypatch, caplog, smooth):
    monkeypatch.setattr(_progress, "FIRST", 0.001)
    model = linear(observation=["abs(x - 0.3)"], observation_noise=[["0.0001"]])
    values = np.tile([2.249, 2.040, 2.086, 1.415, 1.016, 0.797], 8)
    record = zakai.Record(0.1 * np.arange(1, 49), values, "samples")
    (zakai.smooth if smooth else zakai.filter)(model, record, "yau-yau")
    what = "comparing with a result of tolerance=0.01, to estimate the error, takes"
    assert re.search(what + r" (at most )?about \d+ s more", caplog.text)
