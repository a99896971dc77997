"""Estimation algebras in Dong, Chen and Yau (2021) and in Yau's report (1993): what is printed and what is right."""

from __future__ import annotations

import pytest
import sympy as sp

import zakai
from zakai.algebra.estimation_algebra import estimation_algebra
from zakai.algebra.verification import verify

X = sp.symbols("x1:5", real=True)
_, x2, x3, x4 = X


def system(drift, observation, **keys) -> zakai.Model:
    return zakai.Model(state=[f"x{i + 1}" for i in range(len(drift))], drift=drift, observation=observation, **keys)


def is_infinite(model) -> bool:
    algebra = estimation_algebra(model)
    return algebra.verdict == "infinite" and verify(algebra.certificate)


def test_the_third_drift_of_wong_is_that_of_12_and_not_of_the_introduction():
    def drift(third):
        return system(["x1 + x2 + x3 + gamma(x1 + x2 + x3)", "x1 + x3", third], ["x2 - x3"], functions=["gamma"])

    assert is_infinite(drift("x2 - x3"))
    assert estimation_algebra(drift("x1 + x2")).dimension == 4


def test_wongs_gamma_is_a_function_of_the_sum_and_not_of_three_arguments():
    drift = ["x1 + x2 + x3 + gamma(x1, x2, x3)", "x1 + x3", "x1 + x2"]
    assert is_infinite(system(drift, ["x2 - x3"], functions=["gamma"]))


def test_phi_3_of_example_3_4_is_that_of_26_and_not_of_the_text():
    model = zakai.load_model("gallery:dong-chen-yau-3-4")
    assert estimation_algebra(model).dimension == 4
    printed = [*model.drift[:2], model.drift[2] + x2**3 - x3**3, model.drift[3]]
    assert is_infinite(system(printed, list(model.observation), parameters={"c": 1}))
    # (C.4): 2 (phi_1 + ... + phi_4) is constant for the drift of (26) alone, phi_i being the part without x1.
    of_26 = sum(entry.subs(X[0], 0) for entry in model.drift)
    assert sp.expand(of_26) == 0 and sp.expand(of_26 + x2**3 - x3**3) != 0


@pytest.mark.parametrize("example", ["3-4", "3-5", "3-6"])
def test_the_square_of_x1_in_eta_has_the_coefficient_4_plus_c_squared(example):
    model = zakai.load_model(f"gallery:dong-chen-yau-{example}")
    (c,) = model.parameter_symbols
    eta = sp.Poly(sp.expand(zakai.analyze(model).eta), X[0])
    assert sp.expand(eta.coeff_monomial(X[0] ** 2)) == 4 + c**2
    assert eta.coeff_monomial(X[0]) == 0


OMEGA = {
    "3-4": {
        (2, 3): -3 * x2**2 + 3 * x3**2 - x2 - x3 + 6,
        (2, 4): 3 * x2**2 - 3 * x4**2 - 3,
        (3, 4): 3 * x3**2 + 3 * x4**2 - x3 - x4 + 9,
    },
    "3-5": {
        (2, 3): -5 * x2**8 * x3**4 - 8 * x2**7 * x3**5 - 8 * x2**7 + 7 * x3**6,
        (2, 4): 8 * x2**7 - 7 * x4**6,
        (3, 4): -6 * x3**5 * x4**3 - 3 * x3**6 * x4**2 + 7 * x3**6 + 7 * x4**6,
    },
}


@pytest.mark.parametrize("example", OMEGA)
def test_omega_of_25_is_right_and_of_27_is_this(example):
    omega = zakai.analyze(zakai.load_model(f"gallery:dong-chen-yau-{example}")).omega
    for i in range(4):
        for j in range(i + 1, 4):
            assert sp.expand(omega[i, j] - OMEGA[example].get((i + 1, j + 1), 0)) == 0


@pytest.mark.parametrize("k", range(1, 7))
def test_omega_of_30_is_right_for_every_k(k):
    drift = [
        "x1 + x2 + x3 + x4",
        f"x1 - x2 - x3**{k} + x4**{k} + x2**{k + 1}*x3**{k + 3}",
        f"x1 - x3 - x2**{k + 2} - x4**{k} + x3**{k + 5}*x4**{k} - x2**{k + 1}*x3**{k + 3}",
        f"x1 - x4 + x2**{k + 2} + x3**{k} - x3**{k + 5}*x4**{k}",
    ]
    omega = zakai.analyze(system(drift, ["x1"])).omega
    of_23 = -(k + 3) * x2 ** (k + 1) * x3 ** (k + 2) - (k + 1) * x2**k * x3 ** (k + 3)
    expected = {
        (1, 2): of_23 - (k + 2) * x2 ** (k + 1) + k * x3 ** (k - 1),
        (1, 3): (k + 2) * x2 ** (k + 1) - k * x4 ** (k - 1),
        (2, 3): -k * x3 ** (k + 5) * x4 ** (k - 1) - (k + 5) * x3 ** (k + 4) * x4**k + k * x3 ** (k - 1) + k * x4 ** (k - 1),
    }
    for pair, entry in expected.items():
        assert sp.expand(omega[pair] - entry) == 0
    assert all(omega[0, j] == 0 for j in range(1, 4))


def test_a_finite_algebra_without_maximal_rank_may_have_an_eta_that_is_not_quadratic():
    model = system(["x1", "x2 - x2**3"], ["x1"])
    assert estimation_algebra(model).dimension == 4
    assert sp.Poly(zakai.analyze(model).eta, *model.x).total_degree() == 6
