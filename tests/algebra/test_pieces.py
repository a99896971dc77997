"""What is affine or quadratic in each of several pieces is so nowhere else."""

import pytest
import sympy as sp

import zakai
from zakai.algebra.conditions import all_hold
from zakai.algebra.identities import is_quadratic, is_zero
from zakai.algebra.systems import affine_parts
from zakai.algebra.theorems import THEOREMS

IN_PIECES = [
    "2*atan(tan(x/2))",
    "asin(sin(x))",
    "acos(cos(x))",
    "x/10 + atan(x - 3) + atan(1/(x - 3))",
    "(x**3)**(1/3)",
    "sqrt((x - 1)**2)",
    "x + atan(x) + atan(1/x)",
]


def model(formula):
    prior = {"kind": "gaussian", "mean": [3.0], "cov": [[0.1]]}
    return zakai.Model(state=["x"], drift=["0"], observation=[formula], observation_kind="samples", prior=prior)


@pytest.mark.parametrize("formula", IN_PIECES)
def test_a_formula_that_is_affine_in_pieces_is_not_affine(formula):
    system = model(formula)
    assert affine_parts(system.observation, system.x) is None
    assert all_hold(THEOREMS["kalman-bucy"](system)) is False
    drift = zakai.Model(state=["x"], drift=[formula], observation=["x"])
    assert all_hold(THEOREMS["kalman-bucy"](drift)) is False


@pytest.mark.parametrize(
    "formula",
    ["2*x + abs(t)", "x*sqrt(t) + atan(1/t)", "x*(sin(x)**2 + cos(x)**2)", "(x**2 - 1)/(x - 1)", "log(exp(x)) + asin(t)*x"],
)
def test_what_depends_on_time_alone_may_have_pieces(formula):
    system = model(formula)
    assert affine_parts(system.observation, system.x) is not None


def test_no_square_of_a_formula_in_pieces_is_shown_to_be_quadratic():
    x = sp.Symbol("x", real=True)
    far = sp.atan(x - 300) + sp.atan(1 / (x - 300))  # constant but for a jump at 300
    assert is_quadratic((x + far) ** 2, [x]) is not True
    assert is_zero(far + sp.pi / 2) is not True
    assert is_quadratic(sp.expand((x + 1) ** 2) + sp.sin(x) ** 2 + sp.cos(x) ** 2, [x]) is True
