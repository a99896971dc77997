"""One-state grids keep modes that are far apart and unlikely, and steep drifts do not spread rounding over the grid."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

import zakai


@pytest.mark.parametrize(
    ("noise", "deviation", "value", "frequency"), [(0.004, 0.8, 0.5, 1.663), (0.01, 1.0, 0.8, 2.5), (0.01, 0.5, 0.5, 1.663)]
)
def test_unlikely_modes_far_away_stay_in_the_posterior(noise, deviation, value, frequency):
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=[f"sin({frequency}*x)"], observation_kind="samples",
        observation_noise=[[str(noise)]], prior={"kind": "gaussian", "mean": [0.4], "cov": [[deviation**2]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([0.0], [value], "samples"), "yau-yau")

    x = np.linspace(-9, 9, 60001)
    p = np.exp(-0.5 * ((x - 0.4) / deviation) ** 2 - 0.5 * (value - np.sin(frequency * x)) ** 2 / noise)
    p /= p.sum()
    mean = p @ x
    std = np.sqrt(p @ (x - mean) ** 2)
    assert result.mean[1, 0] == pytest.approx(mean, abs=2e-6 * std)
    assert np.sqrt(result.variance[1, 0]) == pytest.approx(std, rel=2e-6)


@pytest.mark.parametrize("seed", [5, 7, 13])
def test_increments_of_a_steep_drift_against_matrix_exponentials(seed):
    model = zakai.Model(
        state=["x"], drift=["-927*x**3/1000 - 39*x/200 + 953/1000"], diffusion=[["0.904"]], observation=["x**2 + 119*x/1000"],
        observation_noise=[["0.7001"]], prior={"kind": "gaussian", "mean": [-0.5], "cov": [[0.32]]},
    )  # fmt: skip
    lengths = np.tile([0.06, 0.16, 0.09, 0.2], 3)
    record = zakai.simulate(model, np.cumsum(lengths), seed=seed)[1]
    result = zakai.filter(model, record, "yau-yau")

    size, half = 260, 5.5
    x = half * (2 * np.arange(size) / size - 1)
    k = np.fft.fftfreq(size, 2 * half / size) * 2 * np.pi
    waves = np.fft.fft(np.eye(size), axis=0)
    first = np.fft.ifft(1j * np.where(np.arange(size) == size // 2, 0, k)[:, None] * waves, axis=0).real
    second = np.fft.ifft(-(k**2)[:, None] * waves, axis=0).real
    drift, h = -0.927 * x**3 - 0.195 * x + 0.953, x**2 + 0.119 * x
    operator = 0.5 * 0.904**2 * second - first * drift
    u = np.exp(-0.5 * (x + 0.5) ** 2 / 0.32)
    for row, (length, increment) in enumerate(zip(np.diff(record.times, prepend=0.0), record.values[:, 0], strict=True), 1):
        potential = np.maximum(h * (increment / length - h / 2) / 0.7001, -5e3)
        u = expm(length * (operator + np.diag(potential))) @ u
        u /= u.sum()
        mean = u @ x
        std = np.sqrt(u @ (x - mean) ** 2)
        error = max(abs(result.mean[row, 0] - mean), abs(np.sqrt(result.variance[row, 0]) - std)) / std
        assert error < 10 * result.health["error_estimate"][row] + 1e-9


def test_a_mode_beyond_values_that_are_rounding_is_kept():
    model = zakai.load_model("gallery:spiral-sensor")
    record = zakai.simulate(model, 0.01 * np.arange(1, 401), seed=3)[1]
    coarse, fine = (zakai.filter(model, record, "limited-direct", tolerance=tolerance) for tolerance in (1e-6, 1e-9))
    assert np.max(np.abs(coarse.mean - fine.mean) / np.sqrt(fine.variance)) < 1e-6
