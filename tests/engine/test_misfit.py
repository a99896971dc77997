"""Observations that no state of the model explains are reported, whatever the method, and ordinary outliers are not."""

from __future__ import annotations

import pytest

import zakai

PRIOR = {"kind": "gaussian", "mean": [0.3], "cov": [[0.4]]}


def warned(method, observation, value, kind="samples", **keys):
    model = zakai.Model(
        state=["x"], drift=["0"], observation=[observation], observation_kind=kind, observation_noise=[["0.1"]], prior=PRIOR,
        **keys,
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([0.1, 0.2, 0.3], [[0.1], [value], [0.2]], kind), method)
    return [warning for warning in result.warnings if "cannot be explained" in warning]


@pytest.mark.parametrize("method", ["yau-yau", "limited-direct", "general-direct"])
def test_a_sample_beyond_every_value_of_h_warns_on_a_circle(method):
    (warning,) = warned(method, "sin(x)", 45.0, periodic=["x"])
    assert "at t = 0.2 (1.4e+02 standard deviations)" in warning  # 44 / sqrt(0.1)
    assert not warned(method, "sin(x)", 2.5, periodic=["x"])


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_a_fill_value_of_a_linear_system_warns_and_ten_deviations_do_not(kind):
    assert warned("kalman-bucy", "x", 9.97e36, kind)
    assert not warned("kalman-bucy", "x", 7.0 if kind == "samples" else 1.0, kind)


def test_a_fill_value_that_a_grid_rejects_is_in_the_evidence():
    model = zakai.Model(
        state=["x", "y"], drift=["y - x", "-y - y**3"], observation=["x"], observation_kind="samples",
        observation_noise=[["1/10 + x**2"]], prior={"kind": "gaussian", "mean": [0.0, 0.0], "cov": [1.0, 1.0]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([0.2, 0.4, 0.6], [0.2, 1e8, 0.1], "samples"), "yau-yau")
    # No state within 60 deviations explains the value: |z - h| > 9e7, S < 4000.
    assert result.log_likelihood < -(9e7**2) / 2 / 4000 and result.warnings
