"""The survey's equations (31) and (59) for the exponent x'A x + b.x + c of a Gaussian, against the flow."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp

from zakai.numerics.families import gaussians, move
from zakai.numerics.flow import Coefficients, at, integrate

N = 2
LENGTH = 0.4


def system(t, constant):
    """L, l, G, Q, p, r; L does not commute with A, and nothing vanishes."""
    s = 0.0 if constant else t
    L = np.array([[0.3, -1.0 + s], [0.8, -0.4]])
    G = np.array([[1.0, 0.3], [0.3, 0.7 + 0.5 * s]])
    Q = -np.array([[0.9, 0.2], [0.2, 0.5 + s]])
    return L, np.array([0.4, -0.3 + s]), G, Q, np.array([0.2, 0.5]), 0.3 - s


def transition(constant):
    def coefficients(times, rows):
        parts = zip(*(system(t, constant) for t in times), strict=True)
        L, l, G, Q, p, r = (np.array(part) for part in parts)
        return Coefficients(L, l[:, :, None], G, Q, p[:, :, None], r[:, None])

    return at(integrate(coefficients, [0.0], [LENGTH], constant).transition, 0)


def exponents(constant, printed=False):
    """(A, b, c) after the interval from N(m, P), by an integrator of the ordinary differential equations alone."""
    m, P = np.array([0.5, -0.2]), np.array([[0.6, 0.15], [0.15, 0.4]])
    inverse = np.linalg.inv(P)
    c = -0.5 * m @ inverse @ m - 0.5 * np.linalg.slogdet(2 * np.pi * P)[1]

    def rate(t, y):
        A, b = y[: N * N].reshape(N, N), y[N * N : -1]
        L, l, G, Q, p, r = system(t, constant)
        product = 2 * A @ L if printed else A @ L + L.T @ A
        slope = 2 * A @ G @ A - product + Q
        return np.concatenate(
            [slope.ravel(), 2 * A @ G @ b - L.T @ b - 2 * A @ l + p, [np.trace(G @ A) + 0.5 * b @ G @ b - l @ b + r]]
        )

    first = np.concatenate([(-0.5 * inverse).ravel(), inverse @ m, [c]])
    y = solve_ivp(rate, (0.0, LENGTH), first, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    return (m, P), y[: N * N].reshape(N, N), y[N * N : -1], y[-1]


def difference(constant, printed=False):
    (m, P), A, b, c = exponents(constant, printed)
    moved = move(gaussians(np.zeros(1), m[None], P[None]), transition(constant), np.ones(1))
    mean, cov, log_mass = moved.mean[0], moved.cov[0], moved.log_mass[0]
    inverse = np.linalg.inv(cov)
    level = log_mass - 0.5 * mean @ inverse @ mean - 0.5 * np.linalg.slogdet(2 * np.pi * cov)[1]
    return max(np.abs(A + 0.5 * inverse).max(), np.abs(b - inverse @ mean).max(), abs(c - level))


def test_the_equations_31_are_the_flow_with_constant_coefficients():
    assert difference(constant=True) <= 1e-9


def test_the_equations_59_with_both_products_are_the_flow_and_as_printed_they_are_not():
    assert difference(constant=False) <= 1e-9
    assert difference(constant=False, printed=True) >= 0.05
