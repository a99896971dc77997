"""Formulas that are printed wrongly: the corrected form leaves no residual, the printed form a clear one.

CLY is Chen, Luo, Yau, "Direct Method for Time-Varying Nonlinear Filtering Problems", IEEE TAES 2017; SV is
Chen and Dong, "A survey of direct methods for Yau filtering systems".  A statement about a differential
operator is proved on general functions, or on exponentials e^{kappa . z} with a symbolic kappa, which
determine an operator.
"""

from __future__ import annotations

import numpy as np
import pytest
import sympy
from sympy import Function, Matrix, Rational, Symbol, diff, exp, eye, symbols

from references.flow import flow_kernel
from references.power_series import data, single
from references.systems import planar
from zakai.methods.yau import power as power_series
from zakai.numerics.series.power_series import apply, cauchy

t = Symbol("t", real=True)
x1, x2 = symbols("x1 x2", real=True)
X = Matrix([x1, x2])


def of_t(name):
    return Function(name)(t)


def of_x(name):
    return Function(name)(t, x1, x2)


def gradient(u):
    return Matrix([diff(u, x) for x in X])


def double_dot(a, b):
    return (a * b).trace()


def dot(a, b):
    return (a.T * b)[0]


G = Matrix([[of_t("g11"), of_t("g12")], [of_t("g12"), of_t("g22")]])
L = Matrix(2, 2, lambda i, j: of_t(f"L{i}{j}"))
l = Matrix([of_t("l1"), of_t("l2")])
phi, noise = of_x("phi"), of_x("noise")  # noise stands for h' S^-1 h


def forward(u, f):
    """The right-hand side of the Kolmogorov equation (16)."""
    divergence = sum(diff(f[i], X[i]) for i in range(2))
    return double_dot(G, sympy.hessian(u, X)) / 2 - dot(f, gradient(u)) - (divergence + noise / 2) * u


# --- CLY (9), (11): the robust equation ------------------------------------------------------------


def robust_residual(coupling):
    """What u = e^{-K} sigma leaves of (11) plus coupling * (G grad K) . grad u, when sigma obeys (16)."""
    K, u, f = of_x("K"), of_x("u"), Matrix([of_x("f1"), of_x("f2")])
    sigma = exp(K) * u
    exact = sympy.expand(sympy.expand(exp(-K) * (forward(sigma, f) - diff(K, t) * sigma)))
    second = double_dot(G, sympy.hessian(K, X)) + dot(gradient(K), G * gradient(K))
    divergence = sum(diff(f[i], X[i]) for i in range(2))
    potential = -diff(K, t) + second / 2 - dot(f, gradient(K)) - divergence - noise / 2
    printed = double_dot(G, sympy.hessian(u, X)) / 2 - dot(f, gradient(u)) + potential * u
    return sympy.expand(exact - printed - coupling * dot(G * gradient(K), gradient(u)))


def test_the_robust_equation_9_and_11_needs_the_coupling_of_gradients():
    assert robust_residual(coupling=1) == 0
    assert robust_residual(coupling=0) != 0


# --- CLY (17)-(20): the gauge ----------------------------------------------------------------------


def gauge_residual(drift_gradient, time_term):
    """What u = e^phi v leaves of (19): q with time_term phi_t, f = L x + l + drift_gradient grad phi."""
    v = of_x("v")
    f = L * X + l + drift_gradient * gradient(phi)
    u = exp(phi) * v
    q = (
        time_term * diff(phi, t)
        + double_dot(G, sympy.hessian(phi, X))
        + dot(gradient(phi), G * gradient(phi))
        + 2 * dot(L * X + l, gradient(phi))
        + noise
        + 2 * L.trace()
    )
    kept = double_dot(G, sympy.hessian(v, X)) / 2 - dot(L * X + l, gradient(v)) - q * v / 2
    return sympy.expand(sympy.expand(exp(-phi) * (forward(u, f) - diff(phi, t) * u)) - kept)


def test_q_20_needs_twice_the_time_derivative_of_phi():
    assert gauge_residual(G, time_term=2) == 0
    assert sympy.expand(gauge_residual(G, time_term=0) + diff(phi, t) * of_x("v")) == 0


def test_the_drift_17_needs_the_covariance_before_the_gradient_unless_it_is_the_identity():
    printed = gauge_residual(eye(2), time_term=2)
    assert printed != 0
    assert sympy.expand(printed.subs({G[0, 0]: 1, G[1, 1]: 1, G[0, 1]: 0}).doit()) == 0
    # It is not a matter of another potential: the gradient of v stays in the equation.
    v = of_x("v")
    assert printed.coeff(diff(v, x1)) != 0


# --- CLY (25)-(30): the Schroedinger form ----------------------------------------------------------


def schroedinger_residual(shift_sign):
    """What v = e^{x'Omega x/2 + kappa.z}, z = B x + b, b' = shift_sign B l, leaves of (29)-(30)."""
    kappa = Matrix(symbols("kappa1 kappa2"))
    F = Matrix([[2 + t, 0], [t**2 - 1, 3 - t]])
    Omega = Matrix([[t, 1 + t**2], [1 + t**2, 2 - t]])
    offset = Matrix([1 + t, 2 * t - 3])
    B, covariance = F.inv(), F * F.T
    drift = covariance * Omega + F.diff(t) * B  # Assumption 2, (25)
    b = Matrix([of_t("b1"), of_t("b2")])
    exponent = dot(X, Omega * X) / 2 + dot(kappa, B * X + b)
    rate = (shift_sign * B * offset).T * kappa
    change = diff(exponent, t).subs({diff(b[0], t): 0, diff(b[1], t): 0}) + rate[0]
    slope = gradient(exponent)
    change -= (double_dot(covariance, Omega) + dot(slope, covariance * slope)) / 2 - dot(
        drift * X + offset, slope
    )
    # v_t - (1/2 G:Hess v - (L x + l).grad v - q v/2) over v, with q = 0, against the same of w and q~ in z.
    extra = (
        dot(X, (Omega.diff(t) - Omega * covariance * Omega + 2 * drift.T * Omega) * X)
        + 2 * dot(offset, Omega * X)
        - double_dot(covariance, Omega)
    )
    return sympy.simplify(change - (-dot(kappa, kappa) / 2 + extra / 2))


def test_the_shift_b_27_has_a_minus():
    assert schroedinger_residual(shift_sign=-1) == 0
    assert schroedinger_residual(shift_sign=1) != 0


def test_the_covariance_stands_in_the_cross_term_of_35():
    kappa, D = Matrix(symbols("kappa1 kappa2")), Matrix(2, 2, symbols("d11 d12 d21 d22"))
    B, g = Matrix(2, 2, symbols("b11 b12 b21 b22")), Matrix([[2, 1], [1, 3]])
    exponent = dot(X, D * X) + dot(kappa, B * X)
    slope = gradient(exponent)
    exact = double_dot(g, sympy.hessian(exponent, X)) + dot(slope, g * slope)
    s = (D + D.T) * X

    def right(middle):
        second = dot(B.T * kappa, g * B.T * kappa)
        return dot(s, g * s) + 2 * dot(s, middle * B.T * kappa) + double_dot(g, D + D.T) + second

    assert sympy.expand(exact - right(g)) == 0
    assert sympy.expand(exact - right(eye(2))) != 0


def test_the_hessian_33_of_the_gauge_is_symmetrised():
    D = Matrix(2, 2, symbols("d11 d12 d21 d22"))
    hessian = sympy.hessian(dot(X, D * X), X)
    assert hessian == D + D.T
    assert hessian != 2 * D


# --- CLY (53)-(58): the recursions, in the running code --------------------------------------------


def printed_D(v, A, D, Fp, FQFb):
    """(56), (72) as printed: -1/(2 (v + 2)) before the last sum."""
    return (2.0 * sum(apply(A[i], D[v - i]) for i in range(v + 2)) - 0.5 * Fp[v] - 0.5 * FQFb[v]) / (v + 2)


def printed_E(v, B, D):
    """(57), (75) as printed: a factor 2, and B in place of its transpose."""
    return 2.0 * sum(apply(B[i], D[v - i]) for i in range(-1, v + 2)) / (v + 1)


def printed_shift_rate(B, offset):
    """(27) as printed: b' = + B l."""
    return cauchy(B, offset, apply)


def error(names):
    """The largest error of the named coefficients of the kernel over a tenth, against the flow."""
    kernel = dict(zip("ABCDEs", single(data(planar(), 0.2, 16), 0.1)[0]))
    exact = dict(zip("ABCDEs", flow_kernel(planar(), 0.2, 0.3)))
    return max(np.max(np.abs(kernel[name] - exact[name])) for name in names)


@pytest.mark.parametrize(
    ("module", "name", "printed", "spoilt", "kept"),
    [
        (power_series, "_next_D", printed_D, "DEs", "ABC"),
        (power_series, "_next_E", printed_E, "E", "ABCDs"),
        (power_series, "shift_rate", printed_shift_rate, "DEs", "ABC"),
    ],
    ids=["D (56)", "E (57)", "b (27)"],
)
def test_the_kernel_is_right_as_corrected_and_wrong_as_printed(
    monkeypatch, module, name, printed, spoilt, kept
):
    assert error("ABCDEs") <= 1e-12
    monkeypatch.setattr(module, name, printed)
    assert error(kept) <= 1e-12
    for coefficient in spoilt:
        assert error(coefficient) >= 1e-4


def residuals():
    """The largest coefficient of t^v, v < 12, that the series leave of the equations (48) and (49)."""
    z = power_series.schroedinger(data(planar(), 0.2, 16))
    A, B, _, D, E, _ = power_series._recursion(z)
    left_D, left_E = [], []
    for v in range(12):
        rate_D = sum(2.0 * apply(A[i], D[v - i]) for i in range(-1, v + 2)) + z.FQFb[v] - 0.5 * z.Fp[v]
        rate_E = sum(apply(np.swapaxes(B[i], -1, -2), D[v - i]) for i in range(-1, v + 2))
        left_D.append(np.max(np.abs((v + 1) * D[v + 1] - rate_D)))
        left_E.append(np.max(np.abs((v + 1) * E[v + 1] - rate_E)))
    return max(left_D), max(left_E)


def test_the_series_of_D_and_E_solve_48_and_49_as_corrected_and_not_as_printed(monkeypatch):
    assert max(residuals()) <= 1e-11
    with monkeypatch.context() as patch:
        patch.setattr(power_series, "_next_D", printed_D)
        assert residuals()[0] >= 0.1
    with monkeypatch.context() as patch:
        patch.setattr(power_series, "_next_E", printed_E)
        assert residuals()[1] >= 0.1


# --- SV (59) ---------------------------------------------------------------------------------------


def test_the_matrix_riccati_equation_of_the_survey_59_keeps_its_solution_symmetric():
    A = Matrix([[-2, Rational(1, 2)], [Rational(1, 2), -3]])
    D, Q = Matrix([[1, 2], [-1, 3]]), Matrix([[-1, 0], [0, -2]])
    assert (2 * A**2 - (A * D + D.T * A) + Q).is_symmetric()
    assert not (2 * A**2 - 2 * A * D + Q).is_symmetric()
