"""`limited-direct` with laws of samples, inputs and tables in h: the transition is exact, a sample is a factor at its time."""

from __future__ import annotations

from math import factorial

import numpy as np
import pytest

import zakai
from methods.test_line_features import LAWS, TIMES, dense, error, model_of, normal, samples
from zakai.algebra.theorems import conditions_of


@pytest.mark.parametrize("name", LAWS)
def test_laws_of_samples_are_those_of_dense_bayes(name):
    keys, values, law = LAWS[name]
    result = zakai.filter(model_of("-0.8*x", **keys), samples(TIMES, values), method="limited-direct")
    x = np.linspace(-5, 5, 601) if name.startswith("noise") else np.linspace(-6, 6, 241)
    lengths = np.diff(np.concatenate([[0.0], TIMES]))
    expected = dense(x, -0.8 * x, np.ones(len(x)), [law(z) for z in values], lengths, normal(0.2, 0.5))
    assert error(result, expected) < 1e-6
    assert not result.warnings


def test_inputs_of_the_observation():
    """z = x^3 + u: the input moves each sample."""
    values, u = np.array([0.3, -0.6, 0.02, 0.7, -0.4, 0.9, 0.0]), np.array([1.0, -2.0, 3.0, 0.0, 2.0, -1.0, 0.5])
    keys = {"observation_noise": [["0.1"]]}
    moved = zakai.filter(
        model_of("-x", "x**3 + u", inputs=["u"], **keys), samples(TIMES, values + u, zakai.Inputs([0.0, *TIMES], [0.0, *u])),
        "limited-direct",
    )  # fmt: skip
    plain = zakai.filter(model_of("-x", "x**3", **keys), samples(TIMES, values), "limited-direct")
    assert moved.mean == pytest.approx(plain.mean, abs=1e-9)
    assert moved.log_likelihood == pytest.approx(plain.log_likelihood, abs=1e-8)


@pytest.mark.parametrize("method", ["limited-direct", "yau-yau"])
def test_counts_whose_mean_is_no_product_of_input_and_state(method):
    u, counts = np.array([1.0, -2.0, 3.0, 0.0, 2.0, -1.0, 0.5]), [0, 1, 0, 2, 1, 3, 0]
    model = model_of("-x", "exp(tanh(x) + u*x/4)", observation_family="poisson", inputs=["u"])
    result = zakai.filter(model, samples(TIMES, counts, zakai.Inputs([0.0, *TIMES], [0.0, *u])), method)
    x = np.linspace(-5, 5, 401)
    logs = [np.tanh(x) + v * x / 4 for v in u]
    likelihoods = [lambda _, n=n, a=a: np.exp(n * a - np.exp(a)) / factorial(n) for n, a in zip(counts, logs, strict=True)]
    lengths = np.diff(np.concatenate([[0.0], TIMES]))
    assert error(result, dense(x, -x, np.ones(len(x)), likelihoods, lengths, normal(0.2, 0.5))) < 1e-6


def test_tables_and_kinks_of_the_observation():
    points = np.linspace(-6, 6, 13)
    table = {"sensor": {"x": points.tolist(), "values": (points + 0.5 * np.abs(points)).tolist(), "kind": "linear"}}
    values, keys = [0.3, -0.6, 0.02, 0.7, -0.4, 0.9, 0.0], {"observation_noise": [["0.1"]]}
    tabulated = zakai.filter(model_of("-x", "sensor(x)", tables=table, **keys), samples(TIMES, values), "limited-direct")
    kinked = zakai.filter(model_of("-x", "max(1.5*x, 0.5*x)", **keys), samples(TIMES, values), "limited-direct")
    assert tabulated.mean == pytest.approx(kinked.mean, abs=1e-9)
    x = np.linspace(-5, 5, 401)
    likelihoods = [lambda x, z=z: normal(x + 0.5 * np.abs(x), 0.1)(z) for z in values]
    lengths = np.diff(np.concatenate([[0.0], TIMES]))
    assert error(kinked, dense(x, -x, np.ones(len(x)), likelihoods, lengths, normal(0.2, 0.5))) < 1e-3


REFUSED = {
    "an input in f": {"drift": "-x + u", "inputs": ["u"]},
    "a table in f": {"drift": "-x + bump(x)", "tables": {"bump": {"x": [-1.0, 0.0, 1.0], "values": [0.0, 1.0, 0.0]}}},
    "increments": {"observation": "min(x, 1)", "observation_kind": "increments"},
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_hold_is_refused(name):
    failed = [condition for condition in conditions_of("limited-direct", model_of(**REFUSED[name])) if condition.holds is False]
    assert len(failed) == 1


def test_rounding_that_a_gauge_lifts_far_out_is_not_followed_there():
    """The transition is cosh(x + y) N(x1 - x0, tau I) / cosh(x0 + y0), apart from a constant."""
    model = zakai.Model(
        state=["x", "y"], drift=["tanh(x + y)", "tanh(x + y)"], observation=["x", "y + sin(3*x)/10"],
        observation_kind="samples", prior={"kind": "gaussian", "mean": [0, 0], "cov": [0.5, 0.5]},
    )  # fmt: skip
    times = np.cumsum(np.random.default_rng(0).uniform(0.02, 0.2, 32))
    _, record = zakai.simulate(model, times, seed=1)
    result = zakai.filter(model, record, "limited-direct")
    x, start = np.linspace(-7.0, 11.0, 181), 0.0
    grid = np.stack(np.meshgrid(x, x, indexing="ij"))
    u, sensor = np.exp(-(grid**2).sum(axis=0)), np.stack([grid[0], grid[1] + np.sin(3 * grid[0]) / 10])
    for t, z, found in zip(times, record.values, result.mean[1:], strict=True):
        kernel = np.exp(-0.5 * (x[:, None] - x) ** 2 / (t - start))
        u = (kernel @ (u / np.cosh(grid.sum(axis=0))) @ kernel) * np.cosh(grid.sum(axis=0))
        u, start = u * np.exp(-0.5 * ((z[:, None, None] - sensor) ** 2).sum(axis=0)), t
        u /= u.sum()
        np.testing.assert_allclose(found, (grid * u).sum(axis=(1, 2)), atol=1e-7)
    assert result.warnings == []


@pytest.mark.parametrize("family", ["gaussian", "bernoulli", "poisson"])
@pytest.mark.parametrize("method", ["limited-direct", "general-direct", "gaussian-sum", "yau-yau"])
def test_an_observation_of_an_input_alone_leaves_the_density_to_its_motion(family, method):
    model = zakai.Model(
        state=["x"], drift=["-x"], inputs=["u"], observation=["u"], observation_kind="samples", observation_family=family,
        prior={"kind": "gaussian", "mean": [0.5], "cov": [[0.1]]},
    )  # fmt: skip
    inputs = zakai.Inputs([0, 0.15], [[0.1], [0.2]])
    result = zakai.filter(model, zakai.Record([0.1, 0.2], [1, 0], "samples", inputs=inputs), method)
    decay = np.exp(-0.2)
    assert result.mean[-1, 0] == pytest.approx(0.5 * decay, abs=1e-5)
    assert result.variance[-1, 0] == pytest.approx(0.1 * decay**2 + (1 - decay**2) / 2, abs=1e-5)
    laws = {
        "gaussian": -0.5 * (0.9**2 + 0.2**2) - np.log(2 * np.pi), "bernoulli": np.log(0.1) + np.log(0.8),
        "poisson": np.log(0.1) - 0.1 - 0.2,
    }  # fmt: skip
    assert result.log_likelihood == pytest.approx(laws[family], abs=1e-5)
