"""The kernel between two observations as a power series in the length of the interval.

For a drift f = L x + l + G grad phi and u = e^phi v,

    v_t = 1/2 G:Hess v - (L x + l).grad v - 1/2 (x'Q x + p.x + r) v.                            (19), (41)

With G = F F', B = F^-1, z = B x + b, b' = -B l and Omega = G^-1 (L - F' B) symmetric, v = e^{x'Omega x/2} w(t, z) has

    w_t = 1/2 Lap w - 1/2 (x'Q~ x + p~.x + r~) w,    x = F (z - b),                                   (29)
    Q~ = Q + Omega' - Omega G Omega + L'Omega + Omega L,   p~ = p + 2 Omega l,   r~ = r - tr(G Omega).   (30)

The paper *assumes* that Omega is symmetric (Assumption 2).  It is so for every L if F is chosen for it: F = Fc R with the
Cholesky factor Fc and the rotation R' = W R, W the antisymmetric part of Fc^-1 L Fc - Fc^-1 Fc'.  In z-coordinates

    K(t, z, y) = (2 pi t)^(-n/2) exp(z'A~ z + z'B~ y + y'C~ y + D~.z + E~.y + s),                     (44)
    A~' = 2 A~^2 - F'Q~F/2,  B~' = 2 A~ B~,  C~' = B~'B~/2,  D~' = 2 A~ D~ + F'Q~F b - F'p~/2,  E~' = B~'D~,
    s' = D~.D~/2 + tr A~ - constant/2 + n/(2t),                                                  (45)-(50)

and each is a power series in t that begins at t^-1.  The recursions of D~ (56) and E~ (57) are corrected.  A series converges up
to about pi/omega, omega^2 the largest eigenvalue of F'Q~F; `series/kernel.py` divides a longer interval.

Chen, Luo, Yau 2017, Theorems 1 to 3.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.errors import ConditionError
from zakai.numerics.series.power_series import apply, cauchy, cholesky, derivative, dot, integral, inverse, product, value
from zakai.numerics.transition import symmetric, transposed

Array = NDArray[Any]
Indexed = dict[int, Array]  # the coefficients of one series, by their index, which begins at -1


class TaylorData(NamedTuple):
    """Taylor coefficients about the start of an interval: first axis the power, then any batch.

    `covariance` G, `matrix` L (terms, ..., n, n), `offset` l (terms, ..., n) of the drift L x + l + G grad phi; `quadratic` Q,
    `linear` p, `constant` r (terms, ...) of q = x'Q x + p.x + r, which enters the equation as -q/2.
    """

    covariance: Array
    matrix: Array
    offset: Array
    quadratic: Array
    linear: Array
    constant: Array


def taylor_data(entries: Array, origin: Array) -> TaylorData:
    """Return the data for x relative to the origin (n,), from the entries (..., 3 n^2 + 2 n + 1) of L, l, G, Q, p and r.

    Those of Q, p and r are of the potential x'Q x + p.x + r of `PowerSeries`, which is -q/2.
    """
    n = len(origin)
    L, l, G, Q, p, r = np.split(entries, np.cumsum([n * n, n, n * n, n * n, n]), axis=-1)
    L, G, Q = (matrix.reshape(*entries.shape[:-1], n, n) for matrix in (L, G, Q))
    place = np.broadcast_to(origin, p.shape)
    pushed = apply(Q, place)
    constant = r[..., 0] + dot(p + pushed, place)
    return TaylorData(G, L, l + apply(L, place), -2.0 * symmetric(Q), -2.0 * (p + 2.0 * pushed), -2.0 * constant)


class Schroedinger(NamedTuple):
    """The series of B, b, Omega, and of the potential z'F'Q~F z + (F'p~ - 2 F'Q~F b).z + `constant` in z (43)."""

    B: Array
    b: Array
    Omega: Array
    FQF: Array
    FQFb: Array
    Fp: Array
    constant: Array


def schroedinger(data: TaylorData) -> Schroedinger:
    """Return Theorem 1 in series: from `data` with N terms, a potential with N - 2."""
    G, L, l = data.covariance, data.matrix, data.offset
    F, B = whitening(G, L)
    Omega = symmetric(product(transposed(B), B, L[:-1] - product(derivative(F), B)))
    b = integral(shift_rate(B, l)[:-1])

    L_Omega = product(transposed(L), Omega)
    Q = data.quadratic[:-2] + derivative(Omega) + (L_Omega + transposed(L_Omega) - product(Omega, G, Omega))[:-1]
    p = data.linear[:-1] + 2.0 * cauchy(Omega, l, apply)
    r = data.constant[:-1] - np.trace(product(G, Omega), axis1=-2, axis2=-1)

    FQF = symmetric(product(transposed(F), Q, F))
    FQFb, Fp = cauchy(FQF, b, apply), cauchy(transposed(F), p, apply)
    constant = cauchy(b, FQFb, dot) + (r - cauchy(Fp, b, dot))[:-1]
    return Schroedinger(B, b, Omega, FQF, FQFb, Fp, constant)


def whitening(G: Array, L: Array) -> tuple[Array, Array]:
    """Return F = Fc R with F F' = G for which G^-1 (L - F' F^-1) is symmetric, and F^-1."""
    try:
        Fc = cholesky(G)
    except np.linalg.LinAlgError:
        raise ConditionError(
            'kernel="power-series" needs a positive definite G (Assumption 1), and G is singular at the '
            'start of an interval; use kernel="flow"'
        ) from None
    Bc = inverse(Fc)
    M = product(Bc, L, Fc)[:-1] - product(Bc, derivative(Fc))
    W = 0.5 * (M - transposed(M))
    R = [np.broadcast_to(np.eye(G.shape[-1]), G[0].shape)]
    for v in range(len(W)):
        R.append(_sum(W[i] @ R[v - i] for i in range(v + 1)) / (v + 1))
    rotation = np.stack(R)
    return product(Fc, rotation), product(transposed(rotation), Bc)


def shift_rate(B: Array, offset: Array) -> Array:
    """Return b' = -B l, which (38) asks for; (27) prints +B l."""
    return -cauchy(B, offset, apply)


def _sum(terms: Iterable[Array]) -> Array:
    return np.asarray(reduce(operator.add, terms))


def _next_D(v: int, A: Indexed, D: Indexed, Fp: Array, FQFb: Array) -> Array:
    """Return D~_{v+1} of (56), whose last term is printed with the factor -1/2 in place of 1."""
    return np.asarray((2.0 * _sum(apply(A[i], D[v - i]) for i in range(v + 2)) - 0.5 * Fp[v] + FQFb[v]) / (v + 2))


def _next_E(v: int, B: Indexed, D: Indexed) -> Array:
    """Return E~_{v+1} of (57), printed with a factor 2 and without the transpose."""
    return _sum(apply(transposed(B[i]), D[v - i]) for i in range(-1, v + 2)) / (v + 1)


def _recursion(z: Schroedinger) -> tuple[Indexed, ...]:
    """Return Theorem 3: A~, B~, C~, D~, E~, s up to the power N, from a potential with N terms."""
    zero = np.zeros_like(z.FQF[0])
    one = zero + np.eye(zero.shape[-1])
    A, B, C = {-1: -0.5 * one, 0: zero}, {-1: one, 0: zero}, {-1: -0.5 * one, 0: zero}
    D, E = {-1: zero[..., 0], 0: zero[..., 0]}, {-1: zero[..., 0], 0: zero[..., 0]}
    s = {-1: zero[..., 0, 0], 0: zero[..., 0, 0]}
    for v in range(len(z.FQF)):
        from_zero, from_minus = range(v + 1), range(-1, v + 2)
        A[v + 1] = np.asarray((2.0 * _sum(A[i] @ A[v - i] for i in from_zero) - 0.5 * z.FQF[v]) / (v + 3))
        B[v + 1] = 2.0 * _sum(A[i] @ B[v - i] for i in range(v + 2)) / (v + 2)
        C[v + 1] = _sum(transposed(B[i]) @ B[v - i] for i in from_minus) / (2 * (v + 1))
        D[v + 1] = _next_D(v, A, D, z.Fp, z.FQFb)
        E[v + 1] = _next_E(v, B, D)
        squares = _sum(dot(D[i], D[v - i]) for i in from_minus)
        s[v + 1] = np.asarray((0.5 * squares + np.trace(A[v], axis1=-2, axis2=-1) - 0.5 * z.constant[v]) / (v + 1))
    return A, B, C, D, E, s


class Series(NamedTuple):
    """The kernel (44) at t = delta without its singular part: A~ + I/(2 t), B~ - I/t, C~ + I/(2 t), D~, E~, s.

    `remainder` (...) estimates the sum of the terms left out: in A, B, C and in D, E relative to the largest term, in s absolute
    where it is less than 1.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    E: Array
    s: Array
    remainder: Array


def power_series(z: Schroedinger, delta: Array, parts: int = 1) -> Series:
    """Return Theorem 3 over intervals of the lengths `delta` (K,).

    `parts` consecutive lengths belong to one interval, whose largest terms the remainder is relative to.
    """
    coefficients = _recursion(z)
    sizes = _term_sizes(z, coefficients, delta, parts)
    A, B, C, D, E, s = (value(np.stack([series[v] for v in range(len(sizes))]), delta) for series in coefficients)
    # Terms that were not computed count as much as the last two.
    return Series(A, B, C, D, E, s, sizes[-1] + sizes[-2])


def _term_sizes(z: Schroedinger, coefficients: tuple[Indexed, ...], delta: Array, parts: int) -> Array:
    """Return the size (powers, K) of the terms at each power of delta, which does not depend on the unit of time.

    The kernel multiplies z = B x + b by 1/delta.
    """

    def size(term: Array) -> Array:
        return np.asarray(np.max(np.abs(term.reshape(*delta.shape, -1)), axis=-1))

    def relative(sizes: list[Array], least: float = 0.0) -> Array:
        terms = np.stack([term * delta**v for v, term in enumerate(sizes)])
        largest = terms.max(axis=0).reshape(-1, parts).max(axis=1).repeat(parts)
        return terms / np.where(largest > least, largest, 1.0)

    A, B, C, D, E, s = coefficients
    F = np.linalg.inv(z.B[0])
    powers = range(len(z.FQF) + 1)
    gauge = [size(transposed(F) @ omega @ F) for omega in z.Omega] + [0.0 * delta]
    moved = [np.maximum(size(z.B[v] @ F) / delta, gauge[v]) if v else gauge[0] for v in powers]
    quadratic = relative([np.max([size(A[v]), size(B[v]), size(C[v]), moved[v]], axis=0) for v in powers])
    linear = relative([np.max([size(D[v]), size(E[v]), size(z.b[v]) / delta], axis=0) for v in powers])
    return np.asarray(np.max([quadratic, linear, relative([size(s[v]) for v in powers], 1.0)], axis=0))
