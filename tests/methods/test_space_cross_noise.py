"""Correlated noise on grids of two states, against `kalman-bucy` in the same and in other coordinates."""

from __future__ import annotations

import numpy as np
import pytest

import zakai

TIMES = np.cumsum([0.1, 0.02, 0.15, 0.05, 0.3, 0.1])
VALUES = np.array([[0.2, 0.1], [-0.1, np.nan], [0.3, -0.1], [np.nan, np.nan], [-0.4, 0.2], [0.15, np.nan]])
MEAN, COV = [0.3, -0.1], [[0.5, 0.1], [0.1, 0.4]]
PRIOR = {"kind": "gaussian", "mean": MEAN, "cov": COV}
NOISE = {
    "observation": ["x", "x + y"], "observation_noise": [["0.2", "0.05"], ["0.05", "0.3"]],
    "cross_noise": [["0.2", "0.1"], ["-0.1", "0.2"]],
}  # fmt: skip


def compare(model, exact, bound, states, inputs=None):
    """Compare the increments of the log-likelihood, and the moments of some states."""
    record = zakai.Record(TIMES, VALUES, "rates" if model.observation_kind == "rates" else "increments", inputs)
    found, expected = zakai.filter(model, record, "yau-yau"), zakai.filter(exact, record, "kalman-bucy")
    increments = found.log_likelihood_increments[1:] - expected.log_likelihood_increments[1:]
    away = (found.mean - expected.mean)[:, states] / np.sqrt(expected.variance[:, states])
    ratio = found.variance[:, states] / expected.variance[:, states] - 1
    error = max(np.abs(increments).max(), np.abs(away).max(), np.abs(ratio).max())
    assert error < bound
    assert error < 10 * np.nanmax(found.health["error_estimate"])
    return found


@pytest.mark.parametrize("kind", ["increments", "rates"])
def test_a_linear_system_is_that_of_kalman_and_bucy(kind):
    keys = {"state": ["x", "y"], "drift": ["-x + y", "-y"], **NOISE, "prior": PRIOR, "observation_kind": kind}
    model = zakai.Model(**keys)
    compare(model, model, 1e-4, [0, 1])


def test_noise_that_varies_in_time_with_known_inputs():
    keys = {
        "state": ["x", "y"], "drift": ["-x + y + u", "-y"], **NOISE, "prior": PRIOR, "inputs": ["u"],
        "observation_noise": [["0.2*(1 + 0.3*sin(10*t))", "0.05"], ["0.05", "0.3"]],
        "cross_noise": [["0.15*cos(5*t)", "0.1"], ["-0.1", "0.2"]],
    }  # fmt: skip
    model = zakai.Model(**keys)
    compare(model, model, 1e-4, [0, 1], zakai.Inputs([0.0, 0.15, 0.5], [1.0, -2.0, 0.5]))


def test_noise_that_determines_the_state():
    """One dv that is known once dw is: G - a K a' is zero."""
    model = zakai.Model(
        state=["x", "v"], drift=["v", "-x - v"], diffusion=[["0"], ["1"]], observation=["x"], observation_noise=[["0.25"]],
        cross_noise=[["0.5"]], prior=PRIOR,
    )  # fmt: skip
    record = zakai.Record(TIMES, VALUES[:, :1], "increments")
    found, expected = zakai.filter(model, record, "yau-yau"), zakai.filter(model, record, "kalman-bucy")
    assert np.abs((found.mean - expected.mean) / np.sqrt(expected.variance)).max() < 1e-4
    assert abs(found.log_likelihood - expected.log_likelihood) < 1e-4


def test_noise_that_depends_on_the_state_in_other_coordinates():
    """z = asinh x: by Ito's formula dz = ((y - x) / cosh z - G_xx sinh z / (2 cosh^3 z)) dt + ... / cosh z."""
    exact = zakai.Model(state=["x", "y"], drift=["-x + y", "-y"], **NOISE, prior=PRIOR)
    precision = np.linalg.inv(COV)
    x, y = f"(sinh(z) - {MEAN[0]})", f"(y - ({MEAN[1]}))"
    square = f"({precision[0, 0]}*{x}**2 + 2*({precision[0, 1]})*{x}*{y} + {precision[1, 1]}*{y}**2)"
    model = zakai.Model(
        state=["z", "y"],
        drift=["(y - sinh(z))/cosh(z) - sinh(z)/(2*cosh(z)**3)", "-y"],
        diffusion=[["1/cosh(z)", "0"], ["0", "1"]],
        **{**NOISE, "observation": ["sinh(z)", "sinh(z) + y"]},
        prior={"kind": "density", "log_density": f"log(cosh(z)) - {square}/2"},
    )
    compare(model, exact, 1e-4, [1])


def test_an_increment_over_a_gap_is_noted():
    model = zakai.Model(state=["x", "y"], drift=["-x + y**3/10", "-y"], **NOISE, prior=PRIOR, observation_kind="path")
    values = np.cumsum(np.nan_to_num(VALUES), axis=0)
    values[2] = np.nan
    result = zakai.filter(model, zakai.Record(TIMES, values, "path"))
    assert any("cross_noise is omitted" in warning for warning in result.warnings)
