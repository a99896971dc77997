"""The gradient of the log-likelihood against central differences of ordinary filters, each with its own grids."""

from __future__ import annotations

import numpy as np
import pytest

import zakai
from zakai.engine.likelihood import log_likelihood

SYSTEMS = {
    "spiral sensor": {
        "state": ["x"],
        "drift": ["a*t*x"],
        "observation": ["b*x*sin(x)", "b*x*cos(x)"],
        "diffusion": [["c"]],
        "observation_noise": [["s", "0"], ["0", "s"]],
        "observation_kind": "increments",
        "parameters": {"a": 0.025, "b": 1.0, "c": 1.0, "s": 1.0},
        "prior": {"kind": "gaussian", "mean": [0.1], "cov": [[3.0]]},
    },
    "a density prior and a sample at the start": {
        "state": ["x"],
        "drift": ["a*tanh(a*x)"],
        "observation": ["b*x + sin(x)"],
        "observation_noise": [["s"]],
        "observation_kind": "samples",
        "parameters": {"a": 0.9, "b": 1.0, "s": 0.5},
        "prior": {"kind": "density", "log_density": "-(x - b)**4/4 - x**2/8"},
    },
    "wind vane": {
        "state": ["x"],
        "drift": ["a"],
        "observation": ["b*cos(x)", "b*sin(x)"],
        "diffusion": [["c"]],
        "observation_noise": [["s", "0"], ["0", "s"]],
        "observation_kind": "samples",
        "periodic": ["x"],
        "parameters": {"a": 0.2, "b": 1.0, "c": 0.7, "s": 0.3},
        "prior": {"kind": "density", "log_density": "b*cos(x)"},
    },
    "two states, increments": {
        "state": ["x", "y"],
        "drift": ["-a*x - y", "x - y/2"],
        "observation": ["b*x + y"],
        "diffusion": [["c", "0"], ["1/5", "1"]],
        "observation_noise": [["s"]],
        "observation_kind": "increments",
        "parameters": {"a": 0.4, "b": 1.0, "c": 1.1, "s": 0.5},
        "prior": {"kind": "gaussian", "mean": [0.1, 0.2], "cov": [[1.0, 0.2], [0.2, 0.8]]},
    },
    "two states, samples": {
        "state": ["x", "y"],
        "drift": ["-a*x - y", "x - y/2"],
        "observation": ["b*x + sin(y)"],
        "diffusion": [["c", "0"], ["1/5", "1"]],
        "observation_noise": [["s"]],
        "observation_kind": "samples",
        "parameters": {"a": 0.4, "b": 1.0, "c": 1.1, "s": 0.5},
        "prior": {"kind": "gaussian", "mean": [0.1, 0.2], "cov": [[1.0, 0.2], [0.2, 0.8]]},
    },
}


@pytest.mark.parametrize(
    "name",
    SYSTEMS,
)
def test_the_gradient_agrees_with_central_differences(name):
    keys = SYSTEMS[name]
    model = zakai.Model(**keys)
    first = 0 if keys["observation_kind"] == "samples" else 1
    _, record = zakai.simulate(model, 0.05 * np.arange(first, 7), seed=3)
    value, gradient = log_likelihood(model, record, "limited-direct").value_and_gradient(model.theta())

    def at(parameter, shift):
        parameters = {**keys["parameters"], parameter: keys["parameters"][parameter] + shift}
        moved = zakai.filter(zakai.Model(**{**keys, "parameters": parameters}), record, "limited-direct", keep="moments")
        assert not moved.warnings
        return moved.log_likelihood

    assert value == pytest.approx(at("a", 0.0), abs=1e-10)
    for derivative, parameter in zip(gradient, keys["parameters"], strict=True):
        wide, narrow = ((at(parameter, h) - at(parameter, -h)) / (2 * h) for h in (2e-3, 1e-3))
        assert derivative == pytest.approx((4 * narrow - wide) / 3, abs=1e-6, rel=1e-7)


def test_a_window_follows_the_mass_of_other_parameters():
    def filtered(a, record):
        model = zakai.Model(
            state=["x"], drift=["a"], observation=["x*sin(x)", "x*cos(x)"], observation_kind="increments",
            parameters={"a": a}, prior={"kind": "gaussian", "mean": [0.1], "cov": [[3.0]]},
        )  # fmt: skip
        return model, (record and zakai.filter(model, record, "limited-direct", keep="moments"))

    model, _ = filtered(3.0, None)
    _, record = zakai.simulate(model, 0.01 * np.arange(1, 701), seed=1)
    value, gradient = log_likelihood(model, record, "limited-direct", parameters=["a"]).value_and_gradient([3.0])
    (_, low), (_, own), (_, high) = (filtered(a, record) for a in (3.0 - 1e-3, 3.0, 3.0 + 1e-3))
    # Far beyond what one window holds.
    assert np.ptp(own.mean) > 15
    assert value == pytest.approx(own.log_likelihood, abs=1e-9)
    assert gradient[0] == pytest.approx((high.log_likelihood - low.log_likelihood) / 2e-3, rel=1e-4)
