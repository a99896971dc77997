"""Laws of samples against SciPy, and their draws."""

import numpy as np
import pytest
from scipy import stats

import zakai
from zakai.errors import InputError
from zakai.methods.system.observation import log_likelihood

KEYS = {"state": ["x"], "drift": ["0"], "observation_kind": "samples", "prior": {"kind": "gaussian", "mean": [0], "cov": [[1]]}}
X = np.array([[-1.2], [0.1], [0.8], [2.0]])
H = np.exp(X[:, 0] / 2)
LAWS = {
    "gaussian": ({"observation_noise": [["0.3 + x**2"]]}, 0.7, lambda h, x: stats.norm(h, np.sqrt(0.3 + x**2))),
    "student-t": ({"observation_noise": [["0.3 + x**2"]], "degrees_of_freedom": "c + 1"}, 0.7,
                  lambda h, x: stats.t(4.0, h, np.sqrt(0.3 + x**2))),
    "poisson": ({}, 3.0, lambda h, x: stats.poisson(h)),
    "bernoulli": ({"observation": ["1/(1 + exp(-x))"]}, 1.0, lambda h, x: stats.bernoulli(1 / (1 + np.exp(-x)))),
    "von-mises": ({"concentration": "c"}, 2.5, lambda h, x: stats.vonmises(3.0, h)),
    "binomial": ({"observation": ["1/(1 + exp(-x))"], "trials": 5}, 2.0, lambda h, x: stats.binom(5, 1 / (1 + np.exp(-x)))),
    "negative-binomial": ({"dispersion": "c/6"}, 3.0, lambda h, x: stats.nbinom(2.0, 1 / (1 + h / 2))),
    "log-normal": ({"observation_noise": [["0.3 + x**2"]]}, 0.7, lambda h, x: stats.lognorm(np.sqrt(0.3 + x**2), 0, np.exp(h))),
    "exponential": ({}, 0.7, lambda h, x: stats.expon(0, h)),
}  # fmt: skip


def of_family(name):
    keys, z, law = LAWS[name]
    model = zakai.Model(**{**KEYS, "observation": ["exp(x/2)"], "observation_family": name, "parameters": {"c": 3}, **keys})
    return model, z, law(H, X[:, 0])


@pytest.mark.parametrize("name", LAWS)
def test_the_log_density_of_a_family_is_that_of_scipy(name):
    model, z, law = of_family(name)
    counts = ("poisson", "bernoulli", "binomial", "negative-binomial")
    expected = law.logpmf(z) if hasattr(law, "pmf") and name in counts else law.logpdf(z)
    found = log_likelihood(model, np.array([z]), np.array([True]), X, 0.0, model.theta())
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    unseen = log_likelihood(model, np.array([z]), np.array([False]), X, 0.0, model.theta())
    np.testing.assert_array_equal(unseen, np.zeros(4))
    total = model.observation_law.terms([z], X, 0.0, model.theta()).sum(axis=-1)
    np.testing.assert_array_equal(total, found)
    # The derivative with respect to the parameter, by the complex step and by differences.
    moved = [log_likelihood(model, np.array([z]), np.array([True]), X, 0.0, model.theta() + d) for d in (1e-6, -1e-6, 1e-150j)]
    np.testing.assert_allclose(moved[2].imag / 1e-150, (moved[0] - moved[1]) / 2e-6, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("name", LAWS)
def test_draws_have_the_distribution_function_of_the_law(name):
    model, _, _ = of_family(name)
    rng, law = np.random.default_rng(0), model.observation_law
    x = np.full((20_000, 1), 0.8)
    draws = law.sample(rng, x, 0.0, model.theta())
    low, high = law.cdf(draws, x, 0.0, model.theta())
    uniform = low + rng.uniform(size=low.shape) * (high - low)
    assert stats.kstest(uniform[:, 0], "uniform").pvalue > 1e-3


def test_the_distribution_function_of_an_angle_counts_from_minus_pi():
    model, _, _ = of_family("von-mises")
    low, high = model.observation_law.cdf([np.pi - 1e-9], X, 0.0, model.theta())
    np.testing.assert_allclose(high, 1.0, atol=1e-8)
    turned = [model.observation_law.cdf([z], X, 0.0, model.theta())[1] for z in (1.0, 1.0 + 2 * np.pi)]
    np.testing.assert_allclose(turned[0], turned[1], atol=1e-12)


def test_correlated_gaussians_leave_out_what_is_not_observed():
    S = np.array([[1.0, 0.4, 0.1], [0.4, 2.0, -0.3], [0.1, -0.3, 0.5]])
    model = zakai.Model(**{**KEYS, "observation": ["x", "2*x", "-x"], "observation_noise": S.tolist()})
    z = np.array([0.3, -0.4, 1.1])
    for seen in ([0, 1, 2], [0, 2], [1], [1, 2]):
        mask = np.isin(range(3), seen)
        found = log_likelihood(model, z, mask, X, 0.0, model.theta())
        expected = [stats.multivariate_normal((x * np.array([1, 2, -1]))[seen], S[np.ix_(seen, seen)]).logpdf(z[seen])
                    for x in X[:, 0]]  # fmt: skip
        np.testing.assert_allclose(found, expected, rtol=1e-12)
    # The distribution function of each coordinate is given those before it.
    low, _ = model.observation_law.cdf(z, np.array([[0.5]]), 0.0, model.theta())
    mean, gain = np.array([0.5, 1.0, -0.5]), S[2, :2] @ np.linalg.inv(S[:2, :2])
    conditional = stats.norm(mean[2] + gain @ (z - mean)[:2], np.sqrt(S[2, 2] - gain @ S[:2, 2]))
    assert low[0, 2] == pytest.approx(conditional.cdf(z[2]), rel=1e-12)


def test_a_coordinate_may_have_a_family_of_its_own():
    model = zakai.Model(**{**KEYS, "observation": ["x", "exp(x)"], "observation_family": ["gaussian", "poisson"],
                           "observation_noise": [["4", "0"], ["0", "1"]]})  # fmt: skip
    found = log_likelihood(model, np.array([0.2, 3.0]), np.array([True, True]), X, 0.0, model.theta())
    expected = stats.norm(X[:, 0], 2).logpdf(0.2) + stats.poisson(np.exp(X[:, 0])).logpmf(3)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_a_log_density_is_drawn_from_and_evaluated():
    text = "-abs(z - x) - log(2)"
    model = zakai.Model(**KEYS, observation_log_density=text, observed=["z"])
    draws = model.observation_law.sample(np.random.default_rng(0), np.full((2000, 1), 30.0), 0.0, model.theta())
    assert stats.kstest(draws[:, 0], stats.laplace(30.0).cdf).pvalue > 1e-3
    np.testing.assert_allclose(
        log_likelihood(model, np.array([0.3]), np.array([True]), X, 0.0, model.theta()), stats.laplace(X[:, 0]).logpdf(0.3)
    )
    with pytest.raises(InputError, match="no distribution function"):
        model.observation_law.cdf([0.3], X, 0.0, model.theta())
    improper = zakai.Model(**KEYS, observation_log_density="z*exp(x) - 5*x", observed=["z"])
    with pytest.raises(InputError, match="no finite mass over 'z'"):
        zakai.simulate(improper, [0.5, 1.0])


@pytest.mark.parametrize(
    ("name", "z", "words"),
    [("poisson", -1.0, "whole numbers"), ("poisson", 1.5, "whole numbers"), ("bernoulli", 2.0, "0 or 1")],
)
def test_values_that_a_family_cannot_have_are_refused_with_their_row(name, z, words):
    model, _, _ = of_family(name)
    record = zakai.Record([0.1, 0.2], [1.0, z], "samples")
    with pytest.raises(InputError, match=f"row 1, counted from 0: observation 1 is {z}; the family {name} has {words}"):
        record.check(model)
    with pytest.raises(InputError, match=f"the family {name} has {words}"):
        zakai.filter(model, record)


def test_where_there_is_no_law_the_log_density_is_nan_and_a_draw_is_refused():
    model = zakai.Model(**KEYS, observation=["x"], observation_family="poisson")
    found = log_likelihood(model, np.array([2.0]), np.array([True]), X, 0.0, model.theta())
    assert np.isnan(found[0]) and np.isfinite(found[1:]).all()
    with pytest.raises(InputError, match=r"observation\[0\] = x: the family poisson has no such law at x = -1.2"):
        model.observation_law.sample(np.random.default_rng(0), X, 0.0, model.theta())


@pytest.mark.parametrize("name", [name for name in LAWS if name != "von-mises"])
def test_the_mean_and_the_mode_of_a_family_are_those_of_scipy(name):
    model, _, law = of_family(name)
    own = model.observation_law
    np.testing.assert_allclose(own.mean(X, 0.0, model.theta())[:, 0], law.mean() * np.ones(4), rtol=1e-12)
    z = np.arange(0.0, 60.0) if law.dist.name in ("poisson", "bernoulli", "binom", "nbinom") else np.linspace(1e-9, 20, 400001)
    for k, x in enumerate(X[:, 0]):
        if name in ("poisson", "bernoulli", "binomial", "negative-binomial", "log-normal", "exponential"):
            found = own.largest(np.array([True]), X[k], 0.0, model.theta())
            one = LAWS[name][2](H[k], x)
            logs = one.logpmf(z) if hasattr(one.dist, "pmf") and one.dist.name not in ("lognorm", "expon") else one.logpdf(z)
            np.testing.assert_allclose(found, logs.max(), atol=1e-7)


def test_what_a_family_cannot_have_is_refused():
    binomial = zakai.Model(**{**KEYS, "observation": ["1/(1 + exp(-x))"], "observation_family": "binomial", "trials": 5})
    with pytest.raises(InputError, match="row 1, counted from 0: observation 1 is 6.0, more than the 5 trials"):
        zakai.filter(binomial, zakai.Record([1, 2], [3, 6], "samples"))
    positive = zakai.Model(**{**KEYS, "observation": ["x"], "observation_family": "log-normal"})
    with pytest.raises(InputError, match="observation 1 is 0.0; the family log-normal has positive numbers"):
        zakai.filter(positive, zakai.Record([1], [0], "samples"))
    for keys, words in (({"trials": 2.5}, "expected a whole number"), ({}, "missing; the family binomial needs it")):
        with pytest.raises(InputError, match=f"trials: {words}"):
            zakai.Model(**{**KEYS, "observation": ["x"], "observation_family": "binomial", **keys})


@pytest.mark.parametrize("name", ["binomial", "negative-binomial", "log-normal", "exponential"])
@pytest.mark.parametrize("method", ["yau-yau", "gaussian-sum"])
def test_filters_of_a_family_agree_with_a_sum_over_a_grid(name, method):
    keys, z, _ = LAWS[name]
    keys = {**keys, "observation_noise": [[0.4]]} if name == "log-normal" else keys
    model = zakai.Model(**{**KEYS, "observation": ["exp(x/2)"], "observation_family": name, "parameters": {"c": 3}, **keys})
    x = np.linspace(-11, 8, 6001)
    h = np.exp(x / 2)
    law = LAWS[name][2](h, x) if name != "log-normal" else stats.norm(h, np.sqrt(0.4))
    likely = law.pmf(z) if "binomial" in name else law.pdf(np.log(z)) / z if name == "log-normal" else law.pdf(z)
    weights = np.exp(-0.5 * x**2 / 2.0) * likely  # a random walk with the variance 1 + 1 at t = 1
    mean = np.sum(x * weights) / np.sum(weights)
    evidence = np.log(np.sum(weights) * (x[1] - x[0]) / np.sqrt(2 * np.pi * 2.0))
    result = zakai.filter(model, zakai.Record([1.0], [z], "samples"), method)
    tolerance = 1e-6 if method == "yau-yau" else 1e-2
    assert abs(result.mean[-1, 0] - mean) < tolerance and abs(result.log_likelihood - evidence) < tolerance
    assert np.isfinite(zakai.filter(model, zakai.Record([1.0], [z], "samples"), method).residuals()).all()
