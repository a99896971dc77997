"""Tensor trains in a moving frame against the Kalman filter and against particles."""

from __future__ import annotations

import numpy as np

import zakai

NAMES = ["px", "py", "vx", "vy"]


def track(**more):
    """Return a target that moves on a line, seen by its position."""
    return zakai.Model(
        state=NAMES, drift=["vx", "vy", "0", "0"], diffusion=[[0, 0], [0, 0], ["sqrt(0.05)", 0], [0, "sqrt(0.05)"]],
        **{
            "observation": ["px", "py"], "observation_kind": "samples", "observation_noise": [[0.09, 0], [0, 0.04]],
            "prior": {"kind": "gaussian", "mean": [8, 4, -0.8, 0.3], "cov": np.diag([4, 4, 0.5, 0.5]).tolist()}, **more,
        },
    )  # fmt: skip


def test_a_linear_track_agrees_with_the_kalman_filter_through_gaps_and_missing_coordinates():
    model = track()
    times = np.cumsum(np.random.default_rng(3).uniform(0.1, 0.6, 10))
    times[6:] += 2.0
    _, record = zakai.simulate(model, times, seed=1)
    values = record.values.copy()
    values[2, 0] = values[4, 1] = np.nan
    values[5] = np.nan
    record = zakai.Record(times, values, "samples")
    exact = zakai.filter(model, record, "kalman-bucy")
    result = zakai.filter(model, record, "tensor-train")
    deviations = np.sqrt(np.einsum("kii->ki", exact.cov))
    assert not result.warnings
    assert np.abs((result.mean - exact.mean) / deviations).max() < 1e-2
    assert np.abs(np.sqrt(np.einsum("kii->ki", result.cov)) / deviations - 1).max() < 1e-2
    assert abs(result.log_likelihood - exact.log_likelihood) < 2e-2


def test_online_and_restarted_filters_equal_a_record_to_the_bit(tmp_path):
    model = track(observation=["sqrt(px**2 + py**2)", "atan2(py, px)"])
    times = np.array([0.2, 0.5, 0.6, 1.1])
    _, record = zakai.simulate(model, times, seed=2)
    result = zakai.filter(model, record, "tensor-train", tolerance=2e-2)
    online = zakai.online(model, "tensor-train", tolerance=2e-2)
    for t, z in zip(times[:2], record.values[:2], strict=True):
        online.update(t, z)
    online.save(tmp_path / "state")
    online = zakai.online(model, "tensor-train", tolerance=2e-2)
    online.restore(tmp_path / "state")
    for t, z in zip(times[2:], record.values[2:], strict=True):
        online.update(t, z)
    estimate = online.last
    assert np.array_equal(estimate.mean, result.mean[-1])
    assert np.array_equal(estimate.cov, result.cov[-1])
