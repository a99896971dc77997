"""Estimation algebras in Dong, Chen and Yau (2021) and in Yau's report (1993): what is printed and what is right."""

from __future__ import annotations

import dataclasses

import pytest
import sympy as sp

import zakai
from references.wei_norman import residuals
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


def solves(model, found, robust) -> bool:
    """Whether the robust form with these right sides solves its equation."""
    changed = dataclasses.replace(found, robust=dict(zip(found.statistics, robust, strict=True)))
    return max(map(abs, residuals(model, changed, True))) < 1e-40


def test_53_has_4_plus_c_squared():
    model = zakai.load_model("gallery:dong-chen-yau-3-4")
    (c,), found = model.parameter_symbols, estimation_algebra(model).wei_norman
    (r2, r1, _), (y,) = found.statistics, found.path

    def of(a2):
        return [r1 + c * y, a2 * r2, r1**2 / 2 + a2 * r2**2 / 2 + c * y * r1 + c**2 * y**2 / 2]

    assert solves(model, found, of(4 + c**2))
    assert not solves(model, found, of(4))


def test_the_last_sum_of_47_and_of_table_2_is_that_of_34():
    model = system(["x1 + x2", "x1 - x2"], ["2*x1", "3*x1"])
    found, c = estimation_algebra(model).wei_norman, (2, 3)
    (r2, r1, _), y = found.statistics, found.path
    a2 = zakai.analyze(model).eta.coeff(model.x[0], 2)
    drive = c[0] * y[0] + c[1] * y[1]

    def of(last):
        return [r1 + drive, a2 * r2, r1**2 / 2 + drive * r1 + a2 * r2**2 / 2 + last / 2]

    # c_ij c_j1 y_i y_j, where c_ij is the coefficient of x_j in h_i: zero for j = 2.
    assert solves(model, found, of(drive**2))
    assert not solves(model, found, of((c[0] * y[0] + c[1] * y[1]) * c[0] * y[0]))


@pytest.mark.parametrize(
    "model",
    [
        system(["tanh(x1)"], ["2*x1"]),
        system(["x1 + 3*x2", "-x1 - 2*x2"], ["x1", "x1 + x2"]),
    ],
)
def test_r_of_theorem_6_has_no_factor_one_half(model):
    n, found = model.n, estimation_algebra(model).wei_norman
    s, right = sp.Matrix(found.statistics[:n]), list(found.robust.values())
    a = sp.hessian(zakai.analyze(model).eta, model.x) / 2  # eta = sum a_ij x_i x_j + ...
    assert solves(model, found, [*right[:n], *(a * s), right[-1]])
    assert not solves(model, found, [*right[:n], *(a * s / 2), right[-1]])


@pytest.mark.parametrize("hessian", [True, False])
def test_7_of_theorem_6_is_wrong_in_either_meaning_of_a(hessian):
    model = system(["x1 + 3*x2 + 1", "-x1 - 2*x2"], ["x1 + x2", "2*x2"])
    n, found = 2, estimation_algebra(model).wei_norman
    right, analysis = list(found.robust.values()), zakai.analyze(model)
    c, two = analysis.omega, range(n)
    a = sp.hessian(analysis.eta, model.x) / (1 if hessian else 2)
    b = [analysis.eta.diff(x).subs(dict.fromkeys(model.x, 0)) for x in model.x]
    s, r, h = found.statistics[:n], found.statistics[n : 2 * n], model.observation.jacobian(model.x)
    drive = h.T * sp.Matrix(found.path)
    ds = [r[i] + sum(s[j] * c[j, i] for j in two) + drive[i] for i in two]  # (5), which is right
    known = sum(s[i] * b[i] for i in two) / 2 + drive.dot(drive) / 2
    # eta = x'a x / 2 + ..., or x'a x + ...
    half = sp.Rational(1, 2) if hessian else 1
    common = -sum(s[i] ** 2 * (sum(c[i, j] ** 2 for j in two) - half * a[i, i]) for i in two) / 2
    common += s[0] * s[1] * (sum(c[0, j] * c[j, 1] for j in two) + half * a[0, 1])
    corrected = common + known - sum(r[i] ** 2 for i in two) / 2 + sum(r[i] * ds[i] for i in two)
    corrected += -sum(s[i] * r[j] * c[i, j] for i in two for j in two) - ds[0] * s[1] * c[0, 1]
    printed = -sum(s[i] ** 2 * (sum(c[i, j] ** 2 for j in two) - a[i, i] / 2) for i in two) / 2
    printed += s[0] * s[1] * (sum(c[0, j] * c[j, 1] for j in two) + a[0, 1] / 2)
    printed += known + sum(r[i] ** 2 for i in two) / 2 - sum(s[i] * s[j] * c[i, j] for i in two for j in two)
    printed += sum(r) - sum(s[1] * c[i, 1] for i in two)
    assert solves(model, found, [*ds, *right[n:-1], corrected])
    assert not solves(model, found, [*ds, *right[n:-1], printed])
