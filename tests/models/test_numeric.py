import math

import numpy as np
import pytest
import sympy

from zakai.errors import InputError
from zakai.models import Model
from zakai.models.checks import check_noise_at
from zakai.models.numeric import explain_nonfinite, numpy_function, program_of

EVERYTHING = [
    "sin(x) + cos(v)*tan(x/3) - asin(x/4) + acos(v/5) + atan(x*v)",
    "sinh(x) + cosh(v) + tanh(x - v) + exp(-x**2) + log(1 + x**2) + erf(a*x)",
    "sqrt(x**2 + 1)**3/(1 + v**2) - abs(x - v)**(1/3) + x**-3 - 2**-3*v**7",
    "t**2*x/(3*v) + pi*a/7 - 1e-20 + 123456789012345678901234567890e-25",
    "log(cosh(3*x)) + tan(x + pi/2) + sqrt(2)*x**2.5",
    "0",
]


@pytest.fixture(scope="module")
def everything():
    return Model(state=["x", "v"], drift=["0", "0"], observation=EVERYTHING, parameters={"a": 0.3})


POINTS = [(0.7, -1.2, 0.4), (1.3, 0.4, 2.0), (2.9, 1.5, 0.0)]


def by_sympy(expressions, model, x, t):
    values = dict(zip((*model.x, model.t, *model.parameter_symbols), (*x, t, *model.parameters.values()), strict=True))
    values = {symbol: sympy.Rational(str(value)) for symbol, value in values.items()}
    return [float(expr.subs(values).evalf(30)) for expr in expressions]


@pytest.mark.parametrize("point", POINTS)
def test_numpy_and_plain_floats_agree_with_sympy(everything, point):
    model, (x, v, t) = everything, point
    expected = by_sympy(model.observation, model, (x, v), t)
    theta = model.theta()
    state = np.array([x, v])
    np.testing.assert_allclose(numpy_function(model.observation, model)(state, t, theta), expected, rtol=1e-13)
    scalar = program_of(list(model.observation), model).scalar(theta.tolist())
    np.testing.assert_allclose(scalar([x, v], t), expected, rtol=1e-13)


def test_numpy_functions_broadcast_states_and_times(everything):
    function = numpy_function(everything.observation, everything)
    assert function(np.ones((4, 1, 2)), np.linspace(0, 1, 5), everything.theta()).shape == (4, 5, len(EVERYTHING))
    assert numpy_function(everything.x[0] ** 2, everything)(np.full(2, 3.0), 0.0, everything.theta()) == 9.0


def test_log_cosh_and_its_slope_do_not_overflow():
    model = Model(state=["x"], drift=["0"], observation=["log(cosh(x))"])
    f = numpy_function(list(model.observation), model, ())
    assert f(np.array([1000.0]), 0.0, model.theta()) == pytest.approx(1000 - math.log(2), rel=1e-15)
    assert f(np.array([-1000.0 + 1e-150j]), 0.0, model.theta()).imag == pytest.approx(-1e-150)


def test_the_derivatives_of_abs_can_be_computed():
    model = Model(state=["x"], drift=["0"], observation=["abs(x)"])
    slope = numpy_function([model.observation[0].diff(model.x[0])], model, ())
    assert slope(np.array([[-2.0], [3.0]]), 0.0, model.theta()).tolist() == [-1.0, 1.0]


def test_the_deepest_formula_that_can_be_read_can_be_computed():
    text = "1/(1+x*" * 24 + "sin(" * 20 + "x" + ")" * 44
    model = Model(state=["x"], drift=["0"], observation=[text])
    value = np.sin(0.3)
    for _ in range(19):
        value = np.sin(value)
    for _ in range(24):
        value = 1 / (1 + 0.3 * value)
    np.testing.assert_allclose(numpy_function(model.observation, model)(np.array([0.3]), 0.0, model.theta()), value, rtol=1e-13)


def test_a_model_with_undetermined_functions_cannot_be_computed_with():
    model = Model(state=["x"], drift=["gamma(x)"], observation=["x"], functions=["gamma"])
    with pytest.raises(InputError, match="undetermined function"):
        numpy_function(model.drift, model)


@pytest.mark.parametrize(
    ("formula", "x", "expected"),
    [
        ("log(x)", -0.3, "log of a negative number at x = -0.3, t = 0.2"),
        ("x + log(x)", 0.0, "log of zero in log(x) at x = 0, t = 0.2"),
        ("1/(x - 1)", 1.0, "division by zero at x = 1, t = 0.2"),
        ("x**-2", 0.0, "division by zero"),
        ("sin(sqrt(x))", -1.0, "square root of a negative number in sqrt(x)"),
        ("x**(1/3)", -8.0, "fractional power of a negative number"),
        ("exp(x**2)", 30.0, "larger than double precision can hold"),
        ("asin(x)", 2.0, "asin outside [-1, 1]"),
        ("x", math.nan, "the point itself is not finite"),
    ],
)
def test_what_is_not_finite_is_explained_by_its_innermost_cause(formula, x, expected):
    model = Model(state=["x"], drift=["0"], observation=["x", formula])
    words = explain_nonfinite(model, "observation", model.observation[1:, :], [x], 0.2)
    assert words.startswith(f"observation[0] = {model.observation[1]}: ") and expected in words
    assert explain_nonfinite(model, "observation", model.observation, [0.5], 0.2) == ""


def test_noise_that_stops_being_noise_is_refused_with_its_first_time():
    model = Model(state=["x"], drift=["0"], observation=["x"], observation_noise=[["1 - t"]], process_noise=[["4 - t"]])
    check_noise_at(model, [0.0, 0.9])
    with pytest.raises(InputError, match=r"model: observation_noise: is not positive definite at t = 1;"):
        check_noise_at(model, [0.5, 1.0, 2.0])
    model = Model(state=["x"], drift=["0"], observation=["x"], process_noise=[["4 - t"]], diffusion=[["1/(t - 2)"]])
    check_noise_at(model, [4.0])
    with pytest.raises(InputError, match=r"process_noise: is not positive semidefinite at t = 5;"):
        check_noise_at(model, [0.0, 5.0])
    with pytest.raises(InputError, match=r"diffusion: is not finite at t = 2$"):
        check_noise_at(model, [0.0, 2.0])
