"""The programs of `guided-particles` against the NumPy functions of the same formulas."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import zakai
from zakai.methods.particles.interval import Motion
from zakai.methods.particles.system import system_of
from zakai.models.numeric import numpy_function

X = np.random.default_rng(0).normal(0.4, 0.8, (2, 600))


def model_of(**keys):
    given = {"state": ["x", "y"], "drift": ["-x", "-y"], "observation": ["x"], "observation_kind": "samples"}
    return zakai.Model(**{**given, "prior": {"kind": "gaussian", "mean": [0.0, 0.0], "cov": [1.0, 1.0]}, **keys})


def test_every_function_of_the_grammar_is_computed():
    axis = np.linspace(-1.0, 2.0, 7)
    plane = np.outer(np.sin(axis), np.cos(axis[:5]))
    tables = {
        "one": {"x": axis, "values": axis**2, "kind": "linear"},
        "two": {"x": axis, "values": np.sin(axis), "kind": "cubic"},
        "both": {"x": axis, "y": axis[:5], "values": plane, "kind": "cubic"},
        "again": {"x": axis, "values": [0.1, 0.5, -0.3, 0.2, 0.6, 0.4, 0.1], "kind": "cubic", "periodic": True},
    }
    formulas = [
        "sin(x)*cos(y) + tan(x/5) - a*t", "asin(x/9) + acos(y/9) + atan(x)", "sinh(x) + cosh(y) + tanh(x)",
        "exp(-x**2) + log(1 + y**2)", "sqrt(1 + x**2) + erf(y) + abs(x)", "atan2(y, x) + sign(x) + floor(3*y)",
        "min(x, y) + max(x, 2*y) + heaviside(x - y)", "log1p(x**2) + expm1(y/3) + sinc(5*x)", "x**3 - y**-2 + (1 + x**2)**0.3",
        "one(x) + two(y)", "both(x, y)", "again(3*x)", "log(cosh(x))", "lgamma(1 + x**2)", "erfc(y)",
    ]  # fmt: skip
    for pair in itertools.batched(formulas, 2) if hasattr(itertools, "batched") else zip(formulas[::2], formulas[1::2]):
        drift = [*pair, "0"][:2]
        model = model_of(drift=drift, tables=tables, parameters={"a": 0.7})
        motion = Motion(system_of(model), model.theta())
        ours = motion.values(motion.arrays[0], X, 0.3, np.zeros(0))
        expected = numpy_function(model.drift, model)(X.T, 0.3, model.theta()).T
        assert np.allclose(ours, expected, rtol=1e-10, atol=1e-12, equal_nan=True), drift


LAWS = {
    "gaussian": ({"observation": ["x*y", "x"], "observation_noise": [["0.3", "0.1"], ["0.1", "0.2*(1 + t)"]]}, [0.4, -0.3]),
    "noise with the state": (
        {"observation": ["x*y", "x"], "observation_noise": [["0.3 + x**2", "0.1*x"], ["0.1*x", "0.2 + y**2"]]}, [0.4, -0.3],
    ),
    "student-t": (
        {"observation": ["x", "y"], "observation_noise": [["0.3", "0"], ["0", "1 + x**2"]], "observation_family": "student-t",
         "degrees_of_freedom": ["3", "4 + y**2"]}, [2.4, -1.3],
    ),
    "counts": ({"observation": ["exp(x)", "1/(1 + exp(-y))"], "observation_family": ["poisson", "bernoulli"]}, [3.0, 1.0]),
    "trials": (
        {"observation": ["1/(1 + exp(-x))", "exp(y)"], "observation_family": ["binomial", "negative-binomial"], "trials": "7",
         "dispersion": "0.3"}, [3.0, 2.0],
    ),
    "dispersion with the state": (
        {"observation": ["exp(x)", "exp(y)"], "observation_family": "negative-binomial", "dispersion": ["1 + x**2", "0.5"]},
        [3.0, 0.0],
    ),
    "positive": (
        {"observation": ["x", "exp(y)"], "observation_family": ["log-normal", "exponential"],
         "observation_noise": [["0.2", "0"], ["0", "1"]]}, [3.0, 0.4],
    ),
    "angles": (
        {"observation": ["atan2(y, x)", "atan2(x, y)"], "observation_family": ["gaussian", "student-t"],
         "observation_noise": [["3", "0"], ["0", "0.01"]], "degrees_of_freedom": "6"}, [3.0, 0.4],
    ),
    "directions": (
        {"observation": ["x", "y"], "observation_family": "von-mises", "concentration": ["2", "1 + exp(4*x)"]}, [1.0, -2.0],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("missing", [(), (0,), (1,), (0, 1)])
def test_a_law_is_that_of_the_model_whatever_is_missing(name, missing):
    keys, values = LAWS[name]
    model = model_of(**keys)
    seen = np.array([j not in missing for j in range(2)])
    given = np.where(seen, values, np.nan)
    motion = Motion(system_of(model), model.theta())
    row, counted = motion.system.law.given(np.where(seen, values, 0.0), seen, motion.law_parameters(0.7, None), None)
    terms = motion.values(motion.law, X, 0.7, row)
    ours = np.where(counted[:, None] > 0, terms, 0.0).sum(axis=0)
    assert np.allclose(ours, model.observation_law.log_density(given, X.T, 0.7, model.theta()), rtol=1e-9, atol=1e-9)


def test_a_log_density_is_a_law():
    model = model_of(observation=None, observation_log_density="-abs(z - x*y)/2 - log(4)", observed=["z"])
    motion = Motion(system_of(model), model.theta())
    row, counted = motion.system.law.given(np.array([0.4]), np.array([True]), motion.law_parameters(0.7, None), None)
    expected = model.observation_law.log_density([0.4], X.T, 0.7, model.theta())
    assert counted[0] == 1 and np.allclose(motion.values(motion.law, X, 0.7, row)[0], expected)


def test_an_angle_with_wide_noise_has_a_density_on_the_circle():
    model = model_of(observation=["atan2(y, x)"], observation_noise=[["2.0"]])
    motion = Motion(system_of(model), model.theta())
    z = np.linspace(-np.pi, np.pi, 400, endpoint=False)
    logs = []
    for value in z:
        row, _ = motion.system.law.given(np.array([value]), np.array([True]), motion.law_parameters(0.0, None), None)
        logs.append(motion.values(motion.law, X[:, :5].copy(), 0.0, row)[0])
    assert np.allclose(np.exp(logs).sum(axis=0) * 2 * np.pi / 400, 1.0, atol=1e-6)


def test_normal_numbers_have_the_normal_distribution():
    from scipy.stats import kstest

    from zakai.numerics.particles.random import key_of, normals

    numbers = np.empty((3, 30_000))
    normals(key_of(7, 1), 0, 30_000, numbers)
    assert kstest(numbers.ravel(), "norm").pvalue > 1e-3
    assert np.abs(np.corrcoef(numbers)[np.triu_indices(3, 1)]).max() < 0.03
    other = np.empty_like(numbers)
    normals(key_of(7, 2), 0, 30_000, other)
    assert np.abs(np.corrcoef(numbers[0], other[0])[0, 1]) < 0.03


def test_a_reflecting_end_of_one_of_two_states_is_kept():
    model = zakai.Model(
        state=["l", "q"], drift=["q - 0.3", "-q"], diffusion=[[0.4, 0], [0, 0.3]], observation=["l"], observation_kind="samples",
        observation_noise=[[100.0]], domain={"l": {"lower": 0, "upper": 1, "boundary": "reflecting"}},
        prior={"kind": "gaussian", "mean": [0.5, 0], "cov": [0.01, 0.1]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([2.0], [0.3], "samples"), "guided-particles")
    points = result.density(-1).points[:, 0]
    assert result.warnings == [] and points.min() >= 0.0 and points.max() <= 1.0
