"""Short formulas whose expansions, integrals or values are unbounded: an untrusted file may hold them."""

import pytest
import sympy as sp

import zakai
from zakai.algebra.identities import is_quadratic, is_zero

X = sp.Symbol("x", real=True)


@pytest.mark.parametrize(
    "drift",
    [
        "exp(exp(exp(exp(exp(9*x)))))",
        "sin(" * 16 + "x" + ")" * 16,
        "(x + 1)**64*(x + 2)**64*(x + 3)**64*(x + 4)**64",
    ],
)
def test_they_are_refuted_before_they_are_expanded(drift):
    analysis = zakai.analyze(zakai.Model(state=["x"], drift=[drift], observation=["x"]))
    assert False in [condition.holds for condition in analysis.methods["kalman-bucy"]]
    assert analysis.recommended == "yau-yau"


def test_a_linear_system_of_many_roots_is_linear():
    drift = " + ".join(f"sqrt({k})*x" for k in range(2, 60))
    assert zakai.analyze(zakai.Model(state=["x"], drift=[drift], observation=["x"])).recommended == "kalman-bucy"


def test_an_exponential_without_digits_decides_nothing():
    assert is_zero(sp.exp(sp.exp(sp.exp(sp.exp(9 * X))))) is not True
    assert is_zero(sp.exp(X) ** 2 - sp.exp(2 * X))


def test_a_pulse_is_not_zero_although_its_values_underflow():
    t, x = sp.symbols("t x")
    pulse = 400 * sp.exp(-((t - sp.Rational(337, 1000)) ** 2) / (2 * sp.Rational(5, 1000) ** 2))
    for formula in (pulse, sp.expand(pulse), pulse * (x - 1), pulse + sp.exp(-10000 * (t - 5) ** 2), sp.sech(1000 * (t - 3))):
        assert is_zero(formula) is False
    # Where a sum loses a pulse in its rounding, nothing is concluded.
    assert is_zero(1 - sp.tanh(1000 * t) ** 2) is not True
    assert is_quadratic(x**2 + sp.exp(-40000 * (x - sp.Rational(1, 3)) ** 2), [x]) is not True


def test_identities_are_found_within_factors_that_underflow():
    t, x, y = sp.symbols("t x y")
    circle, hyperbola = sp.sin(x) ** 2 + sp.cos(x) ** 2 - 1, sp.tanh(y) ** 2 + sp.sech(y) ** 2 - 1
    assert is_zero(circle * y + hyperbola * t) is True
    assert is_zero(circle * sp.exp(-20000 * (t - 4) ** 2)) is True
