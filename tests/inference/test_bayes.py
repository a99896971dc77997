"""Posteriors of parameters by the no-U-turn sampler."""

import io
import sys

import numpy as np
import pytest
from scipy import stats

import zakai
from zakai._progress import bar
from zakai.inference.priors import Prior


class Terminal(io.StringIO):
    def isatty(self):
        return True


def _model():
    return zakai.Model(
        state=["x"], drift=["-a*x"], observation=["x"], observation_noise=[["0.2"]], observation_kind="samples",
        parameters={"a": 0.5}, prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
    )  # fmt: skip


RECORD = zakai.simulate(_model(), np.arange(1, 16) / 2, seed=3)[1]


@pytest.mark.parametrize("text, law", [
    ("normal(1, 2)", stats.norm(1, 2)), ("lognormal(0.5, 0.3)", stats.lognorm(0.3, scale=np.exp(0.5))),
    ("gamma(2, 3)", stats.gamma(2, scale=1 / 3)), ("beta(2, 5)", stats.beta(2, 5)), ("uniform(-1, 3)", stats.uniform(-1, 4)),
    ("half-normal(2)", stats.halfnorm(scale=2)),
])  # fmt: skip
def test_a_prior_is_that_of_scipy_with_the_jacobian(text, law):
    prior = Prior("a", text)
    for u in (-0.7, 0.2):
        slope = (prior.value(u + 1e-6) - prior.value(u - 1e-6)) / 2e-6
        assert np.isclose(prior.log_density(u), law.logpdf(prior.value(u)) + np.log(slope), atol=1e-7)
        assert np.isclose(prior.place(prior.value(u)), u)
        assert np.allclose(
            prior.slopes(u), [slope, (prior.log_density(u + 1e-4) - prior.log_density(u - 1e-4)) / 2e-4], rtol=1e-5
        )


@pytest.mark.parametrize("priors, message", [
    ({}, "expected a dictionary"), ({"b": "normal(0, 1)"}, 'there is no "b"'), ({"a": "norm(0, 1)"}, 'no prior "norm"'),
    ({"a": "normal(0)"}, "expected normal"), ({"a": "normal(0, -1)"}, "must be positive"), ({"a": "uniform(2, 1)"}, "not below"),
    ({"a": "__import__('os')"}, "is not a prior"),
])  # fmt: skip
def test_wrong_priors_are_refused(priors, message):
    with pytest.raises(zakai.InputError, match=message):
        zakai.sample(_model(), RECORD, priors)


@pytest.mark.filterwarnings("ignore:sample. R-hat")
def test_the_posterior_is_that_of_a_quadrature_and_its_draws_have_a_bar(monkeypatch):
    pytest.importorskip("blackjax")
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setattr(bar.__wrapped__, "__defaults__", (0.0,))
    found = zakai.sample(_model(), RECORD, {"a": "lognormal(0, 0.5)"}, draws=100, warmup=50)
    assert "sampling parameters" in terminal.getvalue()
    grid = np.linspace(0.02, 6, 60)
    likelihood = zakai.log_likelihood(_model(), RECORD)
    logs = np.array([likelihood([a]) for a in grid]) + stats.lognorm(0.5).logpdf(grid)
    weights = np.exp(logs - logs.max())
    mean = weights @ grid / weights.sum()
    deviation = np.sqrt(weights @ (grid - mean) ** 2 / weights.sum())
    assert found["a"].shape == (2, 100)
    assert abs(float(found["a"].mean()) - mean) < 5 * deviation / np.sqrt(found.attrs["ess"])
    assert 0.6 < float(found["a"].std()) / deviation < 1.5
    assert {"divergences", "r_hat", "ess"} <= set(found.attrs)
    assert found.attrs["ess"] > 20  # much less where the force is not the gradient
