"""What is compiled for a model serves every model with the same formulas."""

import numpy as np
import pytest

import zakai
from zakai.filters import _run

MODEL = zakai.Model(
    state=["x"], drift=["-a*x"], diffusion=[["s"]], observation=["x"], observation_noise=[["r**2"]],
    parameters={"a": 0.5, "s": 1.0, "r": 1.0}, prior={"kind": "density", "log_density": "-a*x**2"},
)  # fmt: skip
RECORD = zakai.simulate(MODEL, np.linspace(0.05, 1.0, 20), seed=1)[1]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["limited-direct", "extended-kalman-bucy"])
def test_other_values_of_the_parameters_compile_no_step_again(method):
    zakai.filter(MODEL, RECORD, method=method)
    compiled = len(_run.scan.compiled)
    other = zakai.filter(MODEL.with_parameters(a=0.51), RECORD, method=method)
    assert len(_run.scan.compiled) == compiled
    # And they count, in the prior too: the same model made from its text has nothing to share the values with.
    prior = {"kind": "density", "log_density": "-0.51*x**2"}
    alone = zakai.Model(state=["x"], drift=["-0.51*x"], observation=["x"], prior=prior)
    fresh = zakai.filter(alone, RECORD, method=method)
    np.testing.assert_allclose(other.mean, fresh.mean, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(other.log_likelihood, fresh.log_likelihood, rtol=1e-9)
