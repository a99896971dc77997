"""Laws of a sample that are impossible at the mean of the prior."""

import numpy as np
import pytest

import zakai

PRIOR = {"kind": "gaussian", "mean": [0.5], "cov": [[0.25]]}


def model_of(observation, prior=PRIOR, **keys):
    return zakai.Model(state=["x"], drift=["-x"], observation=[observation], observation_kind="samples", prior=prior, **keys)


def filtered(model, value=1.0):
    return zakai.filter(model, zakai.Record([0.1, 0.2], [[value], [value]], "samples"))


@pytest.mark.parametrize(
    "observation, keys, words",
    [
        (
            "-0.3",
            {"observation_family": "bernoulli"},
            r"observation\[0\] = -3/10: is -0.3 .*the family bernoulli has no such law",
        ),
        ("1 + x", {"observation_family": "bernoulli"}, r"observation\[0\] = x \+ 1: is 1.5 at the mean of the prior \(x = 0.5\)"),
        ("-2", {"observation_family": "poisson"}, r"observation\[0\] = -2: is -2 .*the family poisson has no such law"),
        ("x - p", {"observation_family": "poisson", "parameters": {"p": 2.0}}, r"observation\[0\] = -p \+ x: is -1.5"),
        ("x", {"observation_noise": [["-exp(x)"]]}, r"observation_noise\[0\]\[0\] = -exp\(x\): has the negative variance -1.6"),
        ("x", {"observation_family": "student-t", "degrees_of_freedom": "-x"}, r"degrees_of_freedom = -x: is -0.5"),
    ],
)
def test_a_law_that_is_impossible_at_the_mean_of_the_prior_is_refused_by_its_key(observation, keys, words):
    model = model_of(observation, **keys)
    with pytest.raises(zakai.InputError, match=words):
        filtered(model)
    with pytest.raises(zakai.InputError, match=words):
        zakai.online(model)


def test_a_formula_of_the_density_prior_is_checked_where_it_does_not_depend_on_the_state():
    prior = {"kind": "density", "log_density": "-x**2"}
    with pytest.raises(zakai.InputError, match=r"observation\[0\] = -2: is -2, and the family poisson"):
        filtered(model_of("-2", prior, observation_family="poisson"))
    assert np.isfinite(filtered(model_of("x", prior, observation_family="poisson")).mean).all()


@pytest.mark.parametrize(
    "observation, keys",
    [
        ("x - 1/2", {"observation_family": "poisson"}),  # zero
        ("x - 1/2", {"observation_family": "bernoulli"}),
        ("x", {"observation_noise": [["(x - 1/2)**2"]]}),  # none at the mean, some elsewhere
        ("log(x - 1)", {}),  # without a value, but possible elsewhere
    ],
)
def test_what_is_possible_next_to_the_mean_is_filtered(observation, keys):
    assert filtered(model_of(observation, **keys)).method


def test_one_component_of_a_mixture_is_enough():
    prior = {"kind": "mixture", "weights": [0.5, 0.5], "means": [[-3.0], [2.0]], "covs": [[[0.1]], [[0.1]]]}
    assert np.isfinite(filtered(model_of("x", prior, observation_family="poisson")).log_likelihood)


def test_the_law_is_checked_at_the_time_and_the_inputs_of_the_first_observation():
    model = model_of("u*exp(-x**2)", observation_family="bernoulli", inputs=["u"])
    record = zakai.Record([0.1, 0.2], [[1.0], [1.0]], "samples", zakai.Inputs([0.0, 0.1], [[-1.0], [0.5]]))
    assert np.isfinite(zakai.filter(model, record).log_likelihood)
    with pytest.raises(zakai.InputError, match=r"observation\[0\] = u\*exp\(-x\*\*2\): is -0.7.*bernoulli"):
        zakai.filter(model, zakai.Record([0.1, 0.2], [[1.0], [1.0]], "samples", zakai.Inputs([0.0], [[-1.0]])))


@pytest.mark.parametrize("key", ["drift", "observation", "diffusion"])
@pytest.mark.parametrize("method", ["auto", "ekf"])
@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_a_formula_without_a_value_at_every_state_of_the_prior_is_refused_by_its_key(key, method, kind):
    keys = {"drift": ["-x"], "observation": ["x"], key: ["sqrt(x - 100)"]}
    model = zakai.Model(state=["x"], observation_kind=kind, prior=PRIOR, **keys)
    with pytest.raises(zakai.InputError, match=rf"{key}.*sqrt\(x - 100\): square root of a negative .*no state of the prior"):
        zakai.filter(model, zakai.Record([0.1], [0.2], kind), method)


def test_a_formula_with_a_value_at_one_end_of_the_prior_is_filtered_with_a_warning():
    model = model_of("sqrt(x + 1)")
    assert any("square root of a negative number" in text for text in filtered(model).warnings)
