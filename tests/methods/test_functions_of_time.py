"""Tables, kinks and jumps of time and inputs alone are coefficients: every method that takes f(x, t) takes them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

import zakai

TIMES = np.cumsum([0.1, 0.35, 0.1, 0.5, 0.04, 0.5])
VALUES = np.array([0.3, -0.6, 0.02, 0.7, -0.4, 0.9])
POINTS, LEVELS = [0.0, 0.5, 1.2, 2.0], [0.0, 2.0, -1.0, 1.0]
FUNCTIONS = {
    "level(t)": lambda t: np.interp(t, POINTS, LEVELS),
    "2*sign(t - 0.7)": lambda t: 2 * np.sign(t - 0.7),
    "max(2*t - 1, 0)": lambda t: np.maximum(2 * t - 1, 0),
}
PRIOR = {"kind": "gaussian", "mean": [0.2], "cov": [[0.5]]}


def forced(function):
    """c(t) with c' = -c + s(t), c(0) = 0: what the forcing adds to every path."""
    breaks = [0.5, 0.7, 1.2]
    return np.array([quad(lambda s, t=t: np.exp(s - t) * function(s), 0, t, points=breaks, limit=200)[0] for t in TIMES])


@pytest.mark.parametrize("formula", FUNCTIONS)
@pytest.mark.parametrize(
    ("method", "close"),
    [("kalman-bucy", 1e-8), ("general-direct", 1e-8), ("limited-direct", 2e-5), ("yau-yau", 2e-5),
     ("extended-kalman-bucy", 0.2)],
)  # fmt: skip
def test_a_forcing_of_time_moves_the_mean_alone(method, close, formula):
    keys = {"observation_kind": "samples", "observation_noise": [["0.1"]], "tables": {"level": (POINTS, LEVELS)}, "prior": PRIOR}
    model = zakai.Model(state=["x"], drift=[f"-x + {formula}"], observation=["x"], **keys)
    result = zakai.filter(model, zakai.Record(TIMES, VALUES[:, None], "samples"), method)
    shift = forced(FUNCTIONS[formula])
    m, P, expected = 0.2, 0.5, []
    for length, z in zip(np.diff(TIMES, prepend=0.0), VALUES - shift, strict=True):
        decay = np.exp(-length)
        m, P = m * decay, P * decay**2 + 0.5 * (1 - decay**2)
        gain = P / (P + 0.1)
        m, P = m + gain * (z - m), P - gain * P
        expected.append(m)
    assert result.mean[1:, 0] == pytest.approx(np.array(expected) + shift, abs=close)


def test_an_input_beside_the_potential_moves_the_mean_alone():
    """f = (tanh x, -y + u): the input is in the affine part, and q does not contain it."""
    keys = {"state": ["x", "y"], "observation": ["x + y"], "observation_kind": "samples", "observation_noise": [["0.1"]]}
    prior = {"kind": "gaussian", "mean": [0.2, 0.0], "cov": [[0.5, 0.1], [0.1, 0.4]]}
    driven = zakai.Model(**keys, drift=["tanh(x)", "-y + u"], inputs=["u"], input_hold="linear", prior=prior)
    shift = forced(FUNCTIONS["level(t)"])
    record = zakai.Record(TIMES, (VALUES + shift)[:, None], "samples", zakai.Inputs(POINTS, LEVELS))
    free = zakai.Model(**keys, drift=["tanh(x)", "-y"], prior=prior)
    plain = zakai.filter(free, zakai.Record(TIMES, VALUES[:, None], "samples"), "benes")
    for method in ("benes", "hu-yau", "gaussian-sum"):
        result = zakai.filter(driven, record, method)
        assert result.mean[1:, 0] == pytest.approx(plain.mean[1:, 0], abs=1e-6)
        assert result.mean[1:, 1] == pytest.approx(plain.mean[1:, 1] + shift, abs=1e-6)
        assert result.log_likelihood == pytest.approx(plain.log_likelihood, abs=1e-6)


def test_a_table_of_time_that_ends_before_the_record_warns():
    table = {"level": ([0.0, 1.0], [0.0, 2.0])}
    model = zakai.Model(state=["x"], drift=["-x + level(t)"], observation=["x"], tables=table, prior=PRIOR)
    result = zakai.filter(model, zakai.Record([0.5, 1.5], [[0.1], [0.2]], "increments"))
    assert result.method == "kalman-bucy"
    assert result.warnings == [
        "level(t) is beyond the range of the table, where that is constant, at 1 of 3 times, first at t = 1.5; extend the table"
    ]
