"""From the Kolmogorov equation of a Yau system to a Schroedinger equation, in power series of time.

Chen, Luo, Yau 2017, Theorem 1.  For a drift f = L x + l + G grad phi and u = e^phi v,

    v_t = 1/2 G:Hess v - (L x + l).grad v - 1/2 (x'Q x + p.x + r) v.                            (19), (41)

With G = F F', B = F^-1, z = B x + b, b' = -B l and Omega = G^-1 (L - F' B) symmetric,
v = e^{x'Omega x/2} w(t, z) has

    w_t = 1/2 Lap w - 1/2 (x'Q~ x + p~.x + r~) w,    x = F (z - b),                                   (29)
    Q~ = Q + Omega' - Omega G Omega + L'Omega + Omega L,   p~ = p + 2 Omega l,   r~ = r - tr(G Omega).   (30)

The paper *assumes* that Omega is symmetric (Assumption 2).  It is so for every L if F is chosen for it:
F = Fc R with the Cholesky factor Fc and the rotation R' = W R, W the antisymmetric part of
Fc^-1 L Fc - Fc^-1 Fc'.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import sympy

from zakai.errors import ConditionError
from zakai.kolmogorov.taylor import (
    Values,
    apply,
    cauchy,
    cholesky,
    derivative,
    dot,
    expand,
    expand_matrix,
    integral,
    inverse,
    product,
    symmetric,
    transpose,
)


class TaylorData(NamedTuple):
    """Taylor coefficients about the start of an interval: first axis the power, then any batch.

    `covariance` G, `matrix` L (terms, ..., n, n), `offset` l (terms, ..., n) of the drift
    L x + l + G grad phi; `quadratic` Q, `linear` p, `constant` r (terms, ...) of q = x'Q x + p.x + r,
    which enters the equation as -q/2.
    """

    covariance: np.ndarray
    matrix: np.ndarray
    offset: np.ndarray
    quadratic: np.ndarray
    linear: np.ndarray
    constant: np.ndarray


def taylor_data(
    t: sympy.Symbol,
    covariance: sympy.MatrixBase,
    matrix: sympy.MatrixBase,
    offset: sympy.MatrixBase,
    quadratic: sympy.MatrixBase,
    linear: sympy.MatrixBase,
    constant: sympy.Expr,
    points: np.ndarray | float,
    terms: int,
    values: Values | None = None,
) -> TaylorData:
    """The `TaylorData` of SymPy functions of t about each of `points`; l and p are columns (n, 1).

    `values` are the numbers of the other symbols.  Raises `ConditionError` where a coefficient is not
    analytic.
    """

    def expanded(coefficient: sympy.MatrixBase) -> np.ndarray:
        return expand_matrix(coefficient, t, points, terms, values)

    return TaylorData(
        covariance=expanded(covariance),
        matrix=expanded(matrix),
        offset=expanded(offset)[..., 0],
        quadratic=expanded(quadratic),
        linear=expanded(linear)[..., 0],
        constant=expand(constant, t, points, terms, values),
    )


class Schroedinger(NamedTuple):
    """The series of B, b and Omega, and of the potential z'F'Q~F z + (F'p~ - 2 F'Q~F b).z + `constant` in z
    (43)."""

    B: np.ndarray
    b: np.ndarray
    Omega: np.ndarray
    FQF: np.ndarray
    FQFb: np.ndarray
    Fp: np.ndarray
    constant: np.ndarray


def schroedinger(data: TaylorData) -> Schroedinger:
    """Theorem 1 in series: from `data` with N terms, a potential with N - 2."""
    G, L, l = data.covariance, data.matrix, data.offset
    F, B = whitening(G, L)
    Omega = symmetric(product(transpose(B), product(B, L[:-1] - product(derivative(F), B))))
    b = integral(shift_rate(B, l)[:-1])

    L_Omega = product(transpose(L), Omega)
    change = L_Omega + transpose(L_Omega) - product(Omega, product(G, Omega))
    Q = data.quadratic[:-2] + derivative(Omega) + change[:-1]
    p = data.linear[:-1] + 2.0 * cauchy(Omega, l, apply)
    r = data.constant[:-1] - np.trace(product(G, Omega), axis1=-2, axis2=-1)

    FQF = symmetric(product(transpose(F), product(Q, F)))
    FQFb, Fp = cauchy(FQF, b, apply), cauchy(transpose(F), p, apply)
    constant = cauchy(b, FQFb, dot) + (r - cauchy(Fp, b, dot))[:-1]
    return Schroedinger(B, b, Omega, FQF, FQFb, Fp, constant)


def whitening(G: np.ndarray, L: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """F = Fc R with F F' = G for which G^-1 (L - F' F^-1) is symmetric, and F^-1."""
    try:
        Fc = cholesky(G)
    except np.linalg.LinAlgError:
        raise ConditionError(
            'kernel="power-series" needs a positive definite G (Assumption 1), and G is singular at the '
            'start of an interval; use kernel="flow"'
        ) from None
    Bc = inverse(Fc)
    M = product(Bc, product(L, Fc))[:-1] - product(Bc, derivative(Fc))
    W = 0.5 * (M - transpose(M))
    R = [np.broadcast_to(np.eye(G.shape[-1]), G[0].shape)]
    for v in range(len(W)):
        R.append(np.sum([W[i] @ R[v - i] for i in range(v + 1)], axis=0) / (v + 1))
    rotation = np.stack(R)
    return product(Fc, rotation), product(transpose(rotation), Bc)


def shift_rate(B: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """b' = -B l, which (38) asks for; (27) prints +B l."""
    return -cauchy(B, offset, apply)
