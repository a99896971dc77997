"""Gradients of the log-likelihood of one state on a grid are the slopes of what the filter returns, for every transition."""

from __future__ import annotations

import numpy as np
import pytest

import zakai

RIGHT = {"kind": "gaussian", "mean": [0.1], "cov": [[0.5]]}
WIDE = {"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]}
WELL = {"drift": ["k*(x - x**3)"], "diffusion": [["g"]], "observation": ["x"], "observation_noise": [["s"]]}
COUNTS = {"drift": ["-k*tanh(x) + 0.1"], "diffusion": [["g"]], "observation": ["exp(s + x)"], "observation_family": "poisson"}
ANGLE = {"state": ["x"], "periodic": ["x"], "diffusion": [["g"]], "observation_noise": [["s", "0"], ["0", "s"]]}
SYSTEMS = {
    "modes, from a prior that the drift contracts": dict(WELL, observation_kind="samples", prior=WIDE),
    "modes, of noise that depends on the state": dict(
        WELL, drift=["-k*x"], diffusion=[["g*sqrt(1 + x**2)"]], observation_kind="samples", prior=RIGHT
    ),
    "modes, after precise samples": dict(WELL, observation_kind="samples", prior=RIGHT, noise=1e-4),
    "modes, with counts": dict(COUNTS, observation_kind="samples", prior=RIGHT),
    "modes, of an angle": dict(
        ANGLE, drift=["k*sin(x)"], observation=["cos(x)", "sin(x)"], observation_kind="samples", prior=RIGHT
    ),
    "a prior with a parameter": dict(
        WELL, observation_kind="samples", prior={"kind": "density", "log_density": "-(x - s)**2 - k*x**4/10"}
    ),
    "splitting, with increments": dict(WELL, observation=["s*x**3"], observation_noise=[["1"]], prior=RIGHT),
    "splitting, with time": dict(WELL, drift=["k*(x - x**3) + cos(9*t)"], observation_kind="samples", prior=RIGHT),
    "splitting, of an angle with time": dict(
        ANGLE, drift=["k*sin(x) + cos(3*t)"], observation=["cos(x)", "sin(x)"], observation_kind="samples", prior=RIGHT
    ),
    "increments of an angle": dict(ANGLE, drift=["k*sin(x)"], observation=["cos(x)", "sin(x)"], prior=RIGHT),
}


def of_system(name):
    keys = {"state": ["x"], **SYSTEMS[name]}
    noise = keys.pop("noise", 0.2)
    model = zakai.Model(**keys, parameters={"k": 1.0, "g": 0.7, "s": noise})
    times = np.cumsum([0.1, 0.02, 0.3, 0.05, 0.05, 0.6, 0.04])
    _, record = zakai.simulate(model, times, seed=3)
    values = record.values.copy()
    values[4] = np.nan  # an interval without an observation
    record = zakai.Record(times, values, record.kind)
    return model, record, zakai.log_likelihood(model, record, "yau-yau")


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_gradient_is_the_slope_of_the_evidence_and_the_value_is_the_evidence(name):
    model, record, likelihood = of_system(name)
    value, gradient = likelihood.value_and_gradient(model.theta())

    def at(parameter, shift):
        moved = model.with_parameters(**{parameter: model.parameters[parameter] * (1.0 + shift)})
        return zakai.filter(moved, record, "yau-yau", keep="moments").log_likelihood

    assert value == at("k", 0.0)
    for slope, parameter in zip(gradient, model.parameters, strict=True):
        wide, narrow = ((at(parameter, h) - at(parameter, -h)) / (2 * h * model.parameters[parameter]) for h in (2e-3, 1e-3))
        assert slope == pytest.approx((4 * narrow - wide) / 3, abs=1e-6, rel=1e-6)


def test_several_samples_that_barely_overlap_keep_the_gradient():
    """Each sample stands seven deviations of the prediction away from its mean, so that the tails of the derivatives count."""
    keys = {"state": ["x"], **WELL, "observation_kind": "samples", "prior": RIGHT}
    model = zakai.Model(**keys, parameters={"k": 1.0, "g": 0.3, "s": 0.01})
    record = zakai.Record(0.05 * np.arange(1, 5), np.array([[0.1], [0.9], [0.2], [1.1]]), "samples")
    likelihood = zakai.log_likelihood(model, record, "yau-yau")
    _, gradient = likelihood.value_and_gradient(model.theta())
    for i, at in enumerate(model.theta()):
        step = 1e-3 * at * np.eye(3)[i]
        wide, narrow = ((likelihood(model.theta() + h * step) - likelihood(model.theta() - h * step)) / (2 * h) for h in (2, 1))
        assert gradient[i] * step[i] == pytest.approx((4 * narrow - wide) / 3, abs=1e-7, rel=1e-5)


def test_the_gradient_of_an_accurate_sensor_with_gaps_is_that_of_differences():
    model = zakai.Model(
        state=["x"], drift=["b*(x - x**3)"], diffusion=[["s"]], observation=["x"], observation_kind="samples",
        observation_noise=[[0.0004]], parameters={"b": 2.0, "s": 0.7}, prior={"kind": "gaussian", "mean": [1.0], "cov": [[0.1]]},
    )  # fmt: skip
    times = np.unique(np.round(np.sort(np.random.default_rng(7).uniform(0, 40, 120)), 4))
    _, record = zakai.simulate(model, times, seed=8)
    values = record.values.copy()
    values[50:70], values[90:92] = np.nan, np.nan
    value = zakai.log_likelihood(model, zakai.Record(times[:90], values[:90], "samples"))
    theta = np.array([3.4311860446525273, 0.9])
    _, gradient = value.value_and_gradient(theta)
    for i, step in enumerate(1e-4 * np.eye(2)):
        assert gradient[i] == pytest.approx((value(theta + step) - value(theta - step)) / 2e-4, rel=1e-4)


ROOT = dict(
    state=["x"], domain={"x": {"lower": 0}}, observation=["x"], observation_kind="samples",
    prior={"kind": "density", "log_density": "3*log(x) - 3*x"},
)  # fmt: skip
GENE = {"drift": ["a + b*x**3/(1 + x**3) - x"], "diffusion": [["s*sqrt(x)"]], "observation_noise": [[0.09]]}
REVERTING = {"drift": ["a*(b - x)"], "diffusion": [["s*sqrt(x)"]], "observation_noise": [[1e-5]]}
SMALL = {
    "small values, after exponentials": (GENE, [0.3, 0.7, 1.1, 1.5], [1.9, 1.5, 1.2, 0.7], [0.079, 1.843, 0.189]),
    "small values, that are interpolated": (GENE, [0.3, 0.7, 1.1, 1.5], [1.9, 1.5, 1.2, 0.7], [0.032, 2.547, 0.135]),
    "ends of coarse grids": (REVERTING, [0.1, 0.2, 0.3, 0.35, 0.45], [0.9, 0.95, 1.1, 1.3, 1.35], [0.586, 0.503, 0.187]),
}


@pytest.mark.parametrize("name", SMALL)
def test_small_values_of_the_density_do_not_amplify_the_rounding_of_derivatives(name):
    """The density falls by hundreds of nats within a grid on which its derivatives are known relative to their maximum."""
    keys, times, values, theta = SMALL[name]
    model, theta = zakai.Model(**ROOT, **keys, parameters=dict(zip("abs", theta, strict=True))), np.array(theta)
    likelihood = zakai.log_likelihood(model, zakai.Record(times, np.array(values)[:, None], "samples"))
    _, gradient = likelihood.value_and_gradient(theta)
    scale = np.max(np.abs(gradient))
    for size in (1e-3, 3e-4, 1e-4):
        steps = size * np.diag(theta)
        slopes = [(likelihood(theta + step) - likelihood(theta - step)) / (2.0 * np.sum(step)) for step in steps]
        assert gradient == pytest.approx(slopes, abs=5e-5 * scale)
