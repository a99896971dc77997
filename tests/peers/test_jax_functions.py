"""The formulas of a model in JAX against NumPy and SymPy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zakai
from zakai.models.numeric import numpy_function
from zakai.peers._jax_functions import jax_function

# Every function of the grammar, with an argument in its domain for all x.
GRAMMAR = [
    "sin(3*x)", "cos(3*x)", "tan(x)", "asin(tanh(x))", "acos(tanh(x))", "atan(x)", "atan(5*x + y)", "sinh(x)", "cosh(x)",
    "tanh(x)", "exp(x)", "log(1 + x**2)", "sqrt(1 + x**2)", "abs(x - y)", "erf(x)", "x**3", "1/(1 + x**2)", "(1 + x**2)**(1/3)",
    "erfc(2*x)", "lgamma(3 + x**2)", "log(cosh(50*x))", "1/tan(2 + tanh(x)/2)",
]  # fmt: skip
MODEL = zakai.Model(state=["x", "y"], drift=["0", "0"], observation=GRAMMAR)
GALLERY = [
    name for name in zakai.gallery.names() if not (zakai.gallery.load(name).functions or zakai.gallery.load(name).features)
]


@pytest.mark.parametrize("count", [3, 257, 1000])
def test_every_function_of_the_grammar_is_right_on_arrays_of_any_length(count):
    # Vectorised code for long arrays differs from that for short ones.
    x = np.random.default_rng(0).normal(0.3, 1.2, (count, 2))
    compiled = jax.jit(jax.vmap(jax_function(MODEL.observation, MODEL), (0, None, None)))
    expected = numpy_function(MODEL.observation, MODEL)(x, 0.0, MODEL.theta())
    np.testing.assert_allclose(compiled(x, 0.0, MODEL.theta()), expected, rtol=1e-12, atol=1e-13)


def test_atan_of_many_particles_gives_the_posterior_of_bayes_rule():
    model = zakai.Model(
        state=["x"], drift=["0"], process_noise=[["0"]], observation=["atan(x)"], observation_kind="samples",
        observation_noise=[["1/100"]], prior={"kind": "gaussian", "mean": [1.0], "cov": [[0.2]]},
    )  # fmt: skip
    record = zakai.Record([0.1], [[0.6]], "samples")
    x = np.linspace(-3, 5, 20001)
    weights = np.exp(-((x - 1) ** 2) / 0.4 - (np.arctan(x) - 0.6) ** 2 / 0.02)
    mean = weights @ x / weights.sum()
    assert zakai.filter(model, record, "particle", particles=20_000).mean[-1, 0] == pytest.approx(mean, abs=0.01)
    assert zakai.filter(model, record, "ukf").mean[-1, 0] == pytest.approx(mean, abs=0.1)


@pytest.mark.parametrize("name", GALLERY)
def test_the_formulas_of_gallery_models_are_the_same_in_numpy(name):
    model = zakai.gallery.load(name)
    x = np.linspace(0.3, 0.9, model.n)
    for key in ("drift", "observation", "diffusion", "process_noise", "covariance", "observation_noise"):
        matrix = getattr(model, key)
        shape = (len(matrix),) if matrix.shape[1] == 1 and key in ("drift", "observation") else matrix.shape
        value = jax_function(matrix, model, shape)(x, 0.4, model.theta())
        assert value.shape == shape and value.dtype == np.float64
        np.testing.assert_allclose(value, numpy_function(matrix, model, shape)(x, 0.4, model.theta()), rtol=1e-14)


def test_the_deepest_formula_that_can_be_read_is_compiled():
    model = zakai.Model(state=["x"], drift=["0"], observation=["1/(1+x*" * 24 + "sin(" * 20 + "x" + ")" * 44])
    value = jax.jit(jax_function(model.observation, model))(np.array([0.3]), 0.0, model.theta())
    np.testing.assert_allclose(value, numpy_function(model.observation, model)(np.array([0.3]), 0.0, model.theta()))


def test_functions_work_under_grad():
    model = zakai.Model(state=["x"], drift=["0"], observation=["log(cosh(x)) + erf(x)*x**2"])
    f = jax_function(list(model.observation), model, ())
    assert jax.grad(f)(jnp.array([-1000.0]), 0.0, model.theta())[0] == pytest.approx(-1.0 + 2000.0)


def test_an_undetermined_function_is_refused():
    model = zakai.Model(state=["x"], drift=["F(x)"], observation=["x"], functions=["F"])
    with pytest.raises(zakai.InputError, match="undetermined"):
        jax_function(model.drift, model)
