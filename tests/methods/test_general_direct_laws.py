"""Gaussian sums of samples with a law of their own, in more states than a grid has, against the exact filter of one state."""

from __future__ import annotations

import numpy as np
import pytest

import zakai

TIMES = np.array([0.2, 0.4, 0.9, 1.0, 1.6])
# One state that is observed drives four that are not: its posterior is that of the state alone.
STATES = ["x", "a", "b", "c", "d"]
CHAIN = {"state": STATES, "drift": ["-x", "x - a", "a - b", "b - c", "c - d"]}
LAWS = {
    "poisson": ({"observation": ["2*exp(x)"], "observation_family": "poisson"}, [1, 0, 3, 2, 4]),
    "bernoulli": ({"observation": ["1/(1 + exp(-2*x))"], "observation_family": "bernoulli"}, [1, 0, 0, 1, 1]),
    "student-t": (
        {"observation": ["x"], "observation_family": "student-t", "degrees_of_freedom": "5", "observation_noise": [["0.1"]]},
        [0.5, 0.2, 4.0, -0.4, 0.1],
    ),
    "von-mises": ({"observation": ["x"], "observation_family": "von-mises", "concentration": "5"}, [0.5, -0.2, 0.9, 1.5, 0.2]),
    "noise that depends on the state": ({"observation": ["0"], "observation_noise": [["exp(x)"]]}, [0.5, -0.4, 2.9, 0.2, 1.0]),
    "log density": ({"observation_log_density": "-log(pi*(1 + (z - x)**2))", "observed": ["z"]}, [0.5, 0.2, 9.0, -0.4, 0.1]),
    "table": (
        {"observation": ["depth(x)"], "observation_noise": [["0.1"]],
         "tables": {"depth": {"x": [-4, -1, 0, 2, 4], "values": [-1, -0.8, 0, 0.5, 2], "kind": "cubic"}}},
        [0.5, 0.2, 0.4, -0.4, 0.1],
    ),
    "kink": ({"observation": ["max(x, 0.2)"], "observation_noise": [["0.1"]]}, [0.5, 0.2, 0.4, 0.1, 0.6]),
    "bearing": (
        {"observation": ["atan2(x - 2, 1)"], "observation_family": "von-mises", "concentration": "20"},
        [-1.0, -0.9, -1.2, -0.8, -1.1],
    ),
    "sinc": ({"observation": ["sinc(x)"], "observation_noise": [["0.1"]]}, [0.5, 0.8, 0.9, 0.1, 0.2]),
}  # fmt: skip


def model_of(keys, chain=True):
    states = CHAIN if chain else {"state": ["x"], "drift": ["-x"]}
    n = len(states["state"])
    return zakai.Model(
        **states, **keys, observation_kind="samples", prior={"kind": "gaussian", "mean": [0.2] * n, "cov": [0.5] * n}
    )


@pytest.mark.parametrize("name", LAWS)
def test_five_states_agree_with_the_one_that_is_observed(name):
    keys, values = LAWS[name]
    record = zakai.Record(TIMES, np.array(values, float)[:, None], "samples")
    exact = zakai.filter(model_of(keys, False), record, "limited-direct")
    found = zakai.filter(model_of(keys), record)
    assert found.method == "general-direct"
    assert np.abs((found.mean[:, 0] - exact.mean[:, 0]) / np.sqrt(exact.variance[:, 0])).max() < 0.04
    assert np.abs(found.variance[:, 0] / exact.variance[:, 0] - 1).max() < 0.08
    assert np.abs(found.log_likelihood_increments - exact.log_likelihood_increments)[1:].max() < 0.02


def test_missing_samples_and_the_derivative():
    keys = {"observation": ["k*exp(x)"], "observation_family": "poisson", "parameters": {"k": 2}}
    record = zakai.Record(TIMES, [[1.0], [np.nan], [3.0], [np.nan], [4.0]], "samples")
    model = model_of(keys)
    evidence = zakai.log_likelihood(model, record, "general-direct")
    value, slope = evidence.value_and_gradient([2.0])
    # So near that the same components are split and merged.
    assert slope[0] == pytest.approx((evidence([2.00001]) - evidence([1.99999])) / 0.00002, rel=1e-6)
    assert value == pytest.approx(zakai.log_likelihood(model_of(keys, False), record, "limited-direct")([2.0]), abs=0.03)


def test_mass_without_a_law_warns():
    model = model_of({"observation": ["x + 1"], "observation_family": "poisson"})
    result = zakai.filter(model, zakai.Record([0.2], [[1.0]], "samples"), "general-direct")
    assert any("without_law" in warning for warning in result.warnings)


def test_few_states_keep_the_grid_and_increments_are_refused():
    keys, values = LAWS["poisson"]
    model = zakai.Model(
        state=["x", "a"], drift=["-x", "x - a"], **keys, observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0, 0], "cov": [1, 1]},
    )  # fmt: skip
    assert zakai.filter(model, zakai.Record(TIMES, np.array(values, float)[:, None], "samples")).method == "yau-yau"
    kinked = zakai.Model(state=["x"], drift=["-x"], observation=["sinc(x)"], prior={"kind": "gaussian", "mean": [0], "cov": [1]})
    with pytest.raises(zakai.ConditionError, match="what a sample depends on"):
        zakai.filter(kinked, zakai.Record([0.1], [[0.1]], "increments"), "general-direct")
