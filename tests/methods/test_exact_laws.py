"""The direct method where the answer is known: Kalman and Bucy's equations, integrated here without any of the package's code."""

from __future__ import annotations

import numpy as np
import pytest

import zakai
from references.kalman_bucy import assert_agrees, kalman_bucy


def test_one_state_with_two_sensors_gaps_and_irregular_times_is_kalman_and_bucy():
    model = zakai.Model(
        state=["x"],
        drift=["(-1/2 + sin(t)/3)*x + cos(t)"],
        process_noise=[["1 + t/4"]],
        observation=["x", "2*x"],
        observation_noise=[["1/2", "1/10"], ["1/10", "1"]],
        prior={"kind": "gaussian", "mean": [0.4], "cov": [[0.7]]},
    )
    times = np.array([0.05, 0.11, 0.2, 0.22, 0.4, 0.47])
    dy = np.array([[0.3, -0.1], [np.nan, 0.2], [0.1, 0.4], [np.nan, np.nan], [0.2, np.nan], [-0.3, 0.1]])
    result = zakai.filter(model, zakai.Record(times, dy, "increments"), "limited-direct")
    expected = kalman_bucy(
        times,
        dy,
        np.array([0.4]),
        np.array([[0.7]]),
        lambda t: np.array([[-0.5 + np.sin(t) / 3]]),
        lambda t: np.array([np.cos(t)]),
        lambda t: np.array([[1 + t / 4]]),
        np.array([[1.0], [2.0]]),
        np.array([[0.5, 0.1], [0.1, 1.0]]),
    )
    assert not result.warnings
    assert_agrees(result, expected, 1e-9)


def test_two_states_are_kalman_and_bucy():
    model = zakai.load_model("gallery:kalman-bucy-2d")
    times = 0.05 * np.arange(1, 9)
    dy = 0.1 * np.cos(np.arange(8))[:, None]
    result = zakai.filter(model, zakai.Record(times, dy, "increments"), "limited-direct")
    omega, zeta = 1.5, 0.1
    expected = kalman_bucy(
        times,
        dy,
        np.array([1.0, 0.0]),
        np.array([[0.5, 0.1], [0.1, 0.5]]),
        lambda t: np.array([[0.0, 1.0], [-(omega**2), -2 * zeta * omega]]),
        lambda t: np.zeros(2),
        lambda t: np.array([[0.1, 0.05], [0.05, 0.5]]),
        np.array([[1.0, 0.0]]),
        np.array([[0.2]]),
    )
    assert not result.warnings
    assert_agrees(result, expected, 1e-8)


def test_an_observation_far_beyond_the_prediction_is_said():
    model = zakai.load_model("gallery:kalman-bucy-1d")
    result = zakai.filter(model, zakai.Record([0.01, 0.02], [[1e4], [0.0]], "increments"), "limited-direct")
    assert any("the density was lost at t = 0.01" in warning for warning in result.warnings)


def test_a_long_interval_is_taken_in_parts_and_agrees_with_many_short_ones():
    model = zakai.load_model("gallery:kalman-bucy-1d")
    long = zakai.filter(model, zakai.Record([40.0], [[0.0]], "increments"), "limited-direct")
    short = zakai.filter(model, zakai.Record(np.arange(1.0, 41.0), np.zeros((40, 1)), "increments"), "limited-direct")
    assert long.mean[-1] == pytest.approx(short.mean[-1], abs=1e-10)
    assert long.cov[-1] == pytest.approx(short.cov[-1], abs=1e-10)
    assert long.log_likelihood == pytest.approx(short.log_likelihood, abs=1e-8)


def test_a_path_that_is_read_after_a_gap_is_said_to_be_an_approximation():
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=["x", "x/2"], observation_kind="path",
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
    )  # fmt: skip
    times, values = [0.1, 0.2, 0.4], np.array([[0.1, 0.2], [0.2, np.nan], [0.3, 0.1]])
    for method in ("kalman-bucy", "limited-direct"):
        assert "1 of 3 times" in zakai.filter(model, zakai.Record(times, values, "path"), method).warnings[0]
    # A coordinate that is never read leaves no gap behind.
    values[:, 1] = np.nan
    assert zakai.filter(model, zakai.Record(times, values, "path"), "kalman-bucy").warnings == []
