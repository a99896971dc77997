"""Hu and Yau (2002), Theorem 3, and the survey's Theorem 1: what is printed and what is right.

With (12) to (14) as corrected, u~(t, x) = exp(c + a.x + S(x) - F(x + b)) u(t, x + b) carries the robust equation of u to an
equation without data; as printed a term that depends on t alone is left, which no normalised density shows, but the evidence.
"""

from __future__ import annotations

import numpy as np
import pytest
import sympy
from sympy import Function, Matrix, Symbol, symbols

import zakai
from zakai.methods.gaussian import one_shot

t = Symbol("t", real=True)
X = Matrix(symbols("x1 x2", real=True))


def of_t(name, count=2):
    return Matrix([Function(f"{name}{i}")(t) for i in range(count)])


def dot(a, b):
    return (a.T * b)[0]


def residual(c_term, transposed=False):
    """What Theorem 4 (S = 0) leaves of the equation for u~, G = I, h = C x, f = grad F + D x + d, divided by u.

    eta quadratic means (grad F)^2 + Lap F + 2 l.grad F = x'K x + k.x + k0; that is used for Lap F. `c_term` is the third term of
    (14) from (D, d, b'); `transposed` takes the index of D in (13) as (24) and the survey's (21) print it.
    """
    D = Matrix(2, 2, symbols("d11 d12 d21 d22"))
    d, C = Matrix(symbols("d1 d2")), Matrix(1, 2, symbols("c1 c2"))
    K = Matrix([[Symbol("k11"), Symbol("k12")], [Symbol("k12"), Symbol("k22")]])
    k, k0 = Matrix(symbols("p1 p2")), Symbol("p0")
    y = Function("y")(t)
    # eta = f'f + div f + h'h with (grad F)^2 + Lap F + 2 l.grad F = x'K x + k.x + k0 gives N and e.
    N, e = K + D.T * D + C.T * C, k + 2 * D.T * d
    a, b = of_t("a"), of_t("b")
    b_rate = a + D * b - C.T * y
    a_rate = N * b - (D if transposed else D.T) * b_rate
    c_rate = -dot(b_rate, b_rate) / 2 + dot(a, b_rate) - c_term(D, d, b_rate) + dot(b, N * b) / 2 + dot(e, b) / 2
    # Work with v = e^-F u, which obeys v_t = Lap v/2 - (Dx + d - y C').grad v + W v for the robust u = e^{-hy} sigma.
    kappa = Matrix(symbols("kappa1 kappa2"))
    # u~(t, x) = exp(c + a.x) v(t, x + b); try v = e^{kappa.x}, a general exponential, at one time.
    z = X + b

    def potential(x):
        return -(dot(x, K * x) + dot(k, x) + k0 + 2 * D.trace() + dot(C.T, x) ** 2) / 2

    l_at = D * z + d
    # Robust: e^{-hy} L e^{hy}: Lap/2 + y C.grad + y^2 C C'/2 - l.grad - y l.C + potential.
    v_t = dot(kappa, kappa) / 2 + y * dot(C.T, kappa) + y**2 * dot(C.T, C.T) / 2
    v_t += -dot(l_at, kappa) - y * dot(l_at, C.T) + potential(z)
    rate = c_rate + dot(a_rate, X) + dot(b_rate, kappa) + v_t
    slope = a + kappa
    wanted = dot(slope, slope) / 2 - dot(D * X + d, slope) + potential(X)
    return sympy.expand(rate - wanted)


def corrected(D, d, b_rate):
    return dot(d, b_rate)


def printed(D, d, b_rate):
    return sum(D[j, i] * b_rate[j] for i in range(2) for j in range(2))


def test_theorem_3_holds_as_corrected():
    assert residual(corrected) == 0


def test_equation_14_as_printed_leaves_a_term_that_depends_on_time_alone():
    left = residual(printed)
    assert left != 0 and not left.has(*X)


def test_the_index_of_the_matrix_in_24_and_in_the_survey_21_matters():
    assert residual(corrected, transposed=True).has(*X)


def test_the_bilinear_term_of_25_is_that_of_the_drift_at_the_moved_point():
    """(25) is what l(x + b)'G^-1 b' has of b: sum G^ij d_jl b_l b_i', and not d_ji b_i b_i' as printed."""
    D, d, inverse = Matrix(2, 2, symbols("d11 d12 d21 d22")), Matrix(symbols("d1 d2")), Matrix([[3, 1], [1, 2]])
    b, b_rate = of_t("b"), of_t("b").diff(t)
    both = range(2)
    right = sum(inverse[i, j] * D[j, l] * b[l] * b_rate[i] for i in both for j in both for l in both)
    printed_25 = sum(inverse[i, j] * D[j, i] * b[i] * b_rate[i] for i in both for j in both)
    wanted = dot(D * (X + b) + d, inverse * b_rate) - dot(D * X + d, inverse * b_rate)
    assert sympy.expand(wanted - right) == 0
    assert sympy.expand(wanted - printed_25) != 0


def test_the_double_bracket_of_lemma_1_is_a_function_and_has_no_operator_in_it():
    G = Matrix([[2, 1], [1, 3]])
    f, h = ([Function(f"{name}{i}")(*X) for i in (1, 2)] for name in "fh")
    u = Function("u")(*X)

    def generator(v):
        second = sum(G[k, l] * v.diff(X[k], X[l]) for k in range(2) for l in range(2)) / 2
        return second - sum((f[k] * v).diff(X[k]) for k in range(2)) - (h[0] ** 2 + h[1] ** 2) * v / 2

    def bracket(operator, function):
        return lambda v: operator(function * v) - function * operator(v)

    double = bracket(bracket(generator, h[0]), h[1])(u).doit()
    right = sum(G[k, l] * h[0].diff(X[k]) * h[1].diff(X[l]) for k in range(2) for l in range(2))
    assert sympy.expand(double - right * u) == 0
    # The line that is printed runs on into the next sentence, "L0 + sum y_i [L0, L_i]".
    assert sympy.expand(double - right * generator(u).doit()) != 0


def test_the_running_code_has_the_wrong_evidence_with_14_as_printed(monkeypatch):
    model = zakai.Model(
        state=["x"],
        drift=["1/2 - x"],
        observation=["x"],
        prior={"kind": "gaussian", "mean": [0.3], "cov": [[0.5]]},
    )
    record = zakai.Record([0.1, 0.25, 0.4], [[0.3], [-0.1], [0.2]], "increments")
    exact = zakai.filter(model, record, "kalman-bucy")
    good = zakai.filter(model, record, "hu-yau", form="one-shot")
    assert good.log_likelihood == pytest.approx(exact.log_likelihood, abs=1e-12)

    def printed_rate(k, b, a, b_rate):
        inner, matrix = k.inverse @ b_rate, k.hamiltonian[: len(b), : len(b)]
        return -0.5 * b_rate @ inner + a @ b_rate - (matrix.T @ inner).sum() + 0.5 * b @ k.N @ b + 0.5 * k.e @ b

    monkeypatch.setattr(one_shot, "c_rate", printed_rate)
    wrong = zakai.filter(model, record, "hu-yau", form="one-shot")
    assert np.abs(wrong.mean - exact.mean).max() <= 1e-12
    assert abs(wrong.log_likelihood - exact.log_likelihood) >= 1e-3
