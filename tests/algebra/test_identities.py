"""Whether formulas are identically zero, against values in 60 digits by mpmath, which shares no code with the decisions."""

import random

import pytest
import sympy as sp

from algebra.random_formulas import A, T, X, Y, formula, values, zero
from zakai.algebra.balls import concrete, differences, sampled
from zakai.algebra.identities import is_quadratic, is_zero
from zakai.models.functions import Maximum, Minimum, Sinc

HALF = sp.Rational(1, 2)
PROVED = [
    sp.sin(X + 1) - sp.sin(X) * sp.cos(1) - sp.cos(X) * sp.sin(1),
    sp.sin(1) ** 2 + sp.cos(1) ** 2 - 1,
    sp.sin(1) - 2 * sp.sin(HALF) * sp.cos(HALF),
    sp.exp(HALF) * sp.exp(sp.Rational(3, 2)) - sp.exp(2),
    sp.sinh(sp.log(2)) - sp.Rational(3, 4),
    sp.exp(2 * sp.log(X) + Y, evaluate=False) - X**2 * sp.exp(Y),
    sp.log(sp.exp(X) * Y) - X - sp.log(Y),
    sp.log(X * Y) - sp.log(sp.Abs(X)) - sp.log(sp.Abs(Y)),
    sp.log(12 * X**2) - 2 * sp.log(2) - sp.log(3) - 2 * sp.log(sp.Abs(X)),
    sp.sqrt(X**2 * (1 + Y**2)) - sp.Abs(X) * sp.sqrt(1 + Y**2),
    sp.sqrt(8 * X) - 2 * sp.sqrt(2) * sp.sqrt(X),
    sp.sqrt((X * Y) ** 2) - sp.Abs(X) * sp.Abs(Y),
    sp.Abs(X**2 + Y**4 + 1) - X**2 - Y**4 - 1,
    sp.Abs(X) * sp.sign(X) - X,
    sp.sin(3 * sp.asin(X)) - 3 * X + 4 * X**3,
    sp.cos(sp.atan2(Y, X)) * sp.sqrt(X**2 + Y**2) - X,
    X**A * X - X ** (A + 1),
    Minimum(X, Y) * Maximum(X, Y) - X * Y,
    sp.erf(X) + sp.erfc(X) - 1,
    Sinc(X, 0) * X - sp.sin(X),
    sp.tanh(X + Y) * (1 + sp.tanh(X) * sp.tanh(Y)) - sp.tanh(X) - sp.tanh(Y),
]


@pytest.mark.parametrize("e", PROVED, ids=str)
def test_identities_of_the_grammar_are_found(e):
    assert is_zero(e) is True
    assert is_zero(e + sp.Rational(1, 10**30)) is False
    assert is_zero(e + sp.Rational(1, 1000) * sp.sin(X)) is False


@pytest.mark.parametrize("seed", range(120))
def test_no_random_formula_is_refuted_or_proved_falsely(seed):
    rng = random.Random(seed)
    true, other = zero(rng), formula(rng)
    assert is_zero(true) is not False, true
    answer, found = is_zero(other), values(other)
    if answer is True:
        assert all(value < 1e-40 for value in found), other
    elif answer is False:
        assert any(value > 1e-50 for value in found), other


def test_no_ball_of_an_identity_excludes_zero():
    rng = random.Random(11)
    for _ in range(60):
        e = zero(rng)
        assert sampled(differences([concrete(e)], 0), [A, T, X, Y], [], 12).holds is not False, e


def test_terms_of_several_formulas_do_not_cancel():
    # The one is minus twice the other: a sum with weights 2 and 1 would vanish.
    field = sp.Matrix([4 * sp.tanh(X) / 3, -2 * sp.tanh(X) / 3])
    assert sampled(differences(list(field), 2), [X], [X], 2).holds is False


def test_a_tiny_coefficient_is_seen():
    assert is_quadratic(X**2 + sp.Rational(1, 10**40) * X**3, [X]) is False
    assert is_quadratic(X**2 + X * sp.tanh(T) + sp.exp(T * Y), [X]) is True
    assert is_quadratic((X**4 - 1) / (X**2 + 1), [X]) is True
