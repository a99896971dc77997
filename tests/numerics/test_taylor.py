"""Taylor coefficients of expressions, against repeated symbolic differentiation."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
import sympy

from zakai.errors import ConditionError
from zakai.methods.system.jets import Expansion
from zakai.models.functions import ComplementaryError, Floor, LogGamma, Minimum, Sinc
from zakai.numerics.series.power_series import cholesky, derivative, inverse, product, value

t, a = sympy.symbols("t a")
INNER = sympy.Rational(1, 3) + t / 2 + t**2 / 7

EXPRESSIONS = [
    INNER**5, INNER**-3, INNER ** sympy.Rational(2, 3), sympy.sqrt(INNER), INNER**t, 2**t, sympy.pi * t - 3,
    *(f(INNER) for f in (
        sympy.exp, sympy.log, sympy.sin, sympy.cos, sympy.tan, sympy.sec, sympy.csc, sympy.cot, sympy.sinh,
        sympy.cosh, sympy.tanh, sympy.sech, sympy.csch, sympy.coth, sympy.asin, sympy.acos, sympy.atan,
        sympy.erf,
    )),
    sympy.exp(sympy.sin(t)) / (1 + t**2) * sympy.log(2 + sympy.cos(3 * t)),
]  # fmt: skip


def expand(expression, points, terms, values=None):
    """The first `terms` Taylor coefficients of an expression about each of `points`."""
    values = values or {}
    return Expansion([expression], t, list(values)).taylor(points, terms, np.array(list(values.values())))[..., 0]


@pytest.mark.parametrize("expression", EXPRESSIONS, ids=str)
def test_coefficients_are_the_derivatives_over_the_factorials(expression):
    found = expand(expression, np.array([0.2, 0.6]), 6)
    for v in range(6):
        nth = expression.diff(t, v) / sympy.factorial(v)
        exact = [float(nth.subs(t, point).evalf(30)) for point in (0.2, 0.6)]
        np.testing.assert_allclose(found[v], exact, rtol=1e-11, atol=1e-12)


# Taylor coefficients of degree 0 to 5 at x = 1.3, by mpmath with 30 digits.
SPECIAL = {
    "lgamma": (LogGamma(t, 0), mpmath.loggamma), "digamma": (LogGamma(t, 1), mpmath.digamma), "sinc": (Sinc(t, 0), mpmath.sinc),
    "erfc": (ComplementaryError(t), mpmath.erfc),
    "inside": (LogGamma(2 + sympy.sin(t), 0), lambda x: mpmath.loggamma(2 + mpmath.sin(x))),
}  # fmt: skip


@pytest.mark.parametrize("name", SPECIAL)
def test_special_functions_have_the_series_of_an_independent_library(name):
    expression, function = SPECIAL[name]
    with mpmath.workdps(30):
        expected = [float(one) for one in mpmath.taylor(function, mpmath.mpf("1.3"), 5)]
    np.testing.assert_allclose(expand(expression, np.array([1.3]), 6)[:, 0], expected, rtol=1e-10, atol=1e-13)


def test_the_absolute_value_follows_the_side_on_which_the_point_lies():
    np.testing.assert_array_equal(
        expand(sympy.Abs(t), np.array([-2.0, 2.0]), 3), [[2, 2], [-1, 1], [0, 0]]
    )


def test_parameters_take_their_values():
    np.testing.assert_allclose(expand(sympy.exp(a * t), 0.0, 4, {a: 3.0}), [1.0, 3.0, 4.5, 4.5])


@pytest.mark.parametrize(
    ("expression", "words"),
    [(sympy.sqrt(t), "about t = 0"), (sympy.Abs(t), "about t = 0"), (1 / t, "about t = 0"),
     (sympy.gamma(t + 1), "not known"), (a * t, "not known"),
     (Floor(t), "the power series of floor is not known"), (Minimum(t, 1), "of min is not known")],
)  # fmt: skip
def test_what_has_no_series_is_said_with_the_expression_and_the_time(expression, words):
    with pytest.raises(ConditionError, match=words):
        expand(expression, np.array([0.5, 0.0]), 4)


def test_the_series_of_a_matrix_factor_and_of_an_inverse_multiply_back():
    generator = np.random.default_rng(0)
    g = generator.normal(size=(6, 3, 3, 3))
    g = g + np.swapaxes(g, -1, -2)
    g[0] = g[0] @ g[0] + np.eye(3)
    F = cholesky(g)
    assert np.all(np.triu(F, 1) == 0.0)
    np.testing.assert_allclose(product(F, np.swapaxes(F, -1, -2)), g, atol=1e-11)
    unit = np.zeros_like(g)
    unit[0] = np.eye(3)
    np.testing.assert_allclose(product(F, inverse(F)), unit, atol=1e-9)
    assert derivative(g).shape == (5, 3, 3, 3)
    np.testing.assert_allclose(value(g[:2], np.array([0.0, 1.0, 2.0]))[2], g[0, 2] + 2.0 * g[1, 2])
