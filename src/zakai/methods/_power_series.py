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
to about pi/omega, omega^2 the largest eigenvalue of F'Q~F; `_series_kernel` divides a longer interval.

Chen, Luo, Yau 2017, Theorems 1 to 3.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import sympy
from numpy.typing import NDArray

from zakai.errors import ConditionError
from zakai.methods._taylor import (
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
    total,
    transpose,
    value,
)
from zakai.numerics.complex_step import log_determinant

Array = NDArray[Any]
TOLERANCE = 1e-13
Indexed = dict[int, Array]  # the coefficients of one series, by their index, which begins at -1


class KernelCoefficients(NamedTuple):
    """log K(x, y) = x'A x + x'B y + y'C y + D.x + E.y + s, where v(stop, x) = int K(x, y) v(start, y) dy.

    A and C are symmetric (..., n, n), B is (..., n, n), D and E are (..., n), s is (...); `order` and `remainder` (...) are
    those of the `Series`.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    E: Array
    s: Array
    order: Array
    remainder: Array


class TaylorData(NamedTuple):
    """Taylor coefficients about the start of an interval: first axis the power, then any batch.

    `covariance` G, `matrix` L (terms, ..., n, n), `offset` l (terms, ..., n) of the drift
    L x + l + G grad phi; `quadratic` Q, `linear` p, `constant` r (terms, ...) of q = x'Q x + p.x + r,
    which enters the equation as -q/2.
    """

    covariance: Array
    matrix: Array
    offset: Array
    quadratic: Array
    linear: Array
    constant: Array


def taylor_data(
    t: sympy.Symbol,
    covariance: sympy.MatrixBase,
    matrix: sympy.MatrixBase,
    offset: sympy.MatrixBase,
    quadratic: sympy.MatrixBase,
    linear: sympy.MatrixBase,
    constant: sympy.Expr,
    points: Array | float,
    terms: int,
    values: Values | None = None,
) -> TaylorData:
    """Return the `TaylorData` of SymPy functions of t about each of `points`; l and p are columns (n, 1).

    `values` are the numbers of the other symbols.  Raises `ConditionError` where a coefficient is not analytic.
    """

    def expanded(coefficient: sympy.MatrixBase) -> Array:
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
    M = product(Bc, product(L, Fc))[:-1] - product(Bc, derivative(Fc))
    W = 0.5 * (M - transpose(M))
    R = [np.broadcast_to(np.eye(G.shape[-1]), G[0].shape)]
    for v in range(len(W)):
        R.append(total(W[i] @ R[v - i] for i in range(v + 1)) / (v + 1))
    rotation = np.stack(R)
    return product(Fc, rotation), product(transpose(rotation), Bc)


def shift_rate(B: Array, offset: Array) -> Array:
    """Return b' = -B l, which (38) asks for; (27) prints +B l."""
    return -cauchy(B, offset, apply)


def _next_A(v: int, A: Indexed, FQF: Array) -> Array:
    """Return A~_{v+1} of (53)."""
    return np.asarray((2.0 * total(A[i] @ A[v - i] for i in range(v + 1)) - 0.5 * FQF[v]) / (v + 3))


def _next_B(v: int, A: Indexed, B: Indexed) -> Array:
    """Return B~_{v+1} of (54)."""
    return 2.0 * total(A[i] @ B[v - i] for i in range(v + 2)) / (v + 2)


def _next_C(v: int, B: Indexed) -> Array:
    """Return C~_{v+1} of (55)."""
    return total(transpose(B[i]) @ B[v - i] for i in range(-1, v + 2)) / (2 * (v + 1))


def _next_D(v: int, A: Indexed, D: Indexed, Fp: Array, FQFb: Array) -> Array:
    """Return D~_{v+1} of (56), whose last term is printed with the factor -1/2 in place of 1."""
    return np.asarray((2.0 * total(apply(A[i], D[v - i]) for i in range(v + 2)) - 0.5 * Fp[v] + FQFb[v]) / (v + 2))


def _next_E(v: int, B: Indexed, D: Indexed) -> Array:
    """Return E~_{v+1} of (57), printed with a factor 2 and without the transpose."""
    return total(apply(transpose(B[i]), D[v - i]) for i in range(-1, v + 2)) / (v + 1)


def _next_s(v: int, A: Indexed, D: Indexed, constant: Array) -> Array:
    """Return s_{v+1} of (58)."""
    squares = total(dot(D[i], D[v - i]) for i in range(-1, v + 2))
    return np.asarray((0.5 * squares + np.trace(A[v], axis1=-2, axis2=-1) - 0.5 * constant[v]) / (v + 1))


def _recursion(z: Schroedinger) -> tuple[Indexed, ...]:
    """Return Theorem 3: A~, B~, C~, D~, E~, s up to the power N, from a potential with N terms."""
    zero = np.zeros_like(z.FQF[0])
    one = zero + np.eye(zero.shape[-1])
    A, B, C = {-1: -0.5 * one, 0: zero}, {-1: one, 0: zero}, {-1: -0.5 * one, 0: zero}
    D, E = {-1: zero[..., 0], 0: zero[..., 0]}, {-1: zero[..., 0], 0: zero[..., 0]}
    s = {-1: zero[..., 0, 0], 0: zero[..., 0, 0]}
    for v in range(len(z.FQF)):
        A[v + 1] = _next_A(v, A, z.FQF)
        B[v + 1] = _next_B(v, A, B)
        C[v + 1] = _next_C(v, B)
        D[v + 1] = _next_D(v, A, D, z.Fp, z.FQFb)
        E[v + 1] = _next_E(v, B, D)
        s[v + 1] = _next_s(v, A, D, z.constant)
    return A, B, C, D, E, s


class Series(NamedTuple):
    """The kernel (44) at t = delta without its singular part: A~ + I/(2 t), B~ - I/t, C~ + I/(2 t), D~, E~, s.

    `order` (...) is the power at which each series was cut; `remainder` (...) estimates the sum of the terms left out: in A, B, C
    and in D, E relative to the largest term, in s absolute where it is less than 1.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    E: Array
    s: Array
    order: Array
    remainder: Array


def power_series(z: Schroedinger, delta: Array, order: int | None = None, tolerance: float = TOLERANCE, parts: int = 1) -> Series:
    """Return Theorem 3 over intervals of the lengths `delta` (...), each cut after the power `order`.

    Without an `order`, after the smallest that leaves a remainder of at most `tolerance`, or after all terms.
    `parts` consecutive lengths belong to one interval, whose largest terms the remainder is relative to.
    """
    coefficients = _recursion(z)
    sizes = _term_sizes(z, coefficients, delta, parts)
    # Terms that were not computed count as much as the last two.
    tails = np.stack([total(sizes[v + 1 :]) if v + 1 < len(sizes) else 0.0 * sizes[v] for v in range(len(sizes))])
    tails = tails + sizes[-1] + sizes[-2]
    if order is None:
        enough = tails[1:] <= tolerance
        orders = 1 + np.where(enough.any(axis=0), np.argmax(enough, axis=0), len(enough) - 1)
    else:
        orders = np.full(delta.shape, order)
    values = []
    for series in coefficients:
        terms = np.stack([series[v] for v in range(len(sizes))])
        kept = np.arange(len(sizes)).reshape(-1, *[1] * delta.ndim) <= orders
        values.append(value(np.where(kept.reshape(*kept.shape, *[1] * (terms.ndim - kept.ndim)), terms, 0.0), delta))
    A, B, C, D, E, s = values
    return Series(A, B, C, D, E, s, orders, np.take_along_axis(tails, orders[None], axis=0)[0])


def _term_sizes(z: Schroedinger, coefficients: tuple[Indexed, ...], delta: Array, parts: int) -> Array:
    """Return the size of the terms at each power of delta, (powers, ...), which does not depend on the unit of time.

    The kernel multiplies z = B x + b by 1/delta.
    """

    def size(term: Array) -> Array:
        return np.asarray(np.max(np.abs(term.reshape(*delta.shape, -1)), axis=-1))

    A, B, C, D, E, s = coefficients
    F = np.linalg.inv(z.B[0])
    powers = range(len(z.FQF) + 1)
    gauge = [size(transpose(F) @ omega @ F) for omega in z.Omega] + [0.0 * delta]
    moved = [np.maximum(size(z.B[v] @ F) / delta, gauge[v]) if v else gauge[0] for v in powers]
    quadratic = np.stack([np.max([size(A[v]), size(B[v]), size(C[v]), moved[v]], axis=0) * delta**v for v in powers])
    linear = np.stack([np.max([size(D[v]), size(E[v]), size(z.b[v]) / delta], axis=0) * delta**v for v in powers])
    constant = np.stack([size(s[v]) * delta**v for v in powers])

    def largest(sizes: Array) -> Array:
        most = sizes.max(axis=0)
        return most if parts == 1 else np.repeat(most.reshape(-1, parts).max(axis=1), parts)

    relative = [sizes / np.where(scale > 0, scale, 1.0) for sizes in (quadratic, linear) for scale in [largest(sizes)]]
    return np.asarray(np.max([*relative, constant / np.maximum(largest(constant), 1.0)], axis=0))


def power_series_kernel(
    taylor: TaylorData, delta: Array | float, order: int | None = None, tolerance: float = TOLERANCE
) -> KernelCoefficients:
    """Return the kernel over an interval of length `delta` (or a batch), by series cut after the power `order`.

    Without an `order`, the smallest that leaves a remainder of at most `tolerance`.  `taylor` must hold at least order + 2 terms
    about the start of the interval.  Raises `ConditionError` if its terms do not suffice for `tolerance`: the interval is then
    too long for one series.

    Source: Chen, Luo, Yau 2017, Theorem 3, with (56) and (57) corrected.

        >>> import numpy as np
        >>> zero, one = np.zeros((16, 1)), np.zeros((16, 1, 1))
        >>> one[0] = 1.0                                     # v_t = v_xx / 2 - x^2 v / 2, Mehler's kernel
        >>> kernel = power_series_kernel(TaylorData(one, 0 * one, zero, one, zero, zero[:, 0]), 0.1)
        >>> bool(abs(kernel.B[0, 0] - 1 / np.sinh(0.1)) < 1e-13)
        True
    """
    if len(taylor.constant) < (order or 1) + 2:
        raise ValueError(f"order {order or 1} needs {(order or 1) + 2} Taylor terms, not {len(taylor.constant)}")
    delta, z = np.asarray(delta, float), schroedinger(taylor)
    A, B, C, D, E, s, orders, remainder = power_series(z, delta, order, tolerance)
    worst = float(np.max(remainder))
    if order is None and not worst <= tolerance:
        raise ConditionError(
            f"{len(taylor.constant)} terms of the power series leave a remainder of {worst:.1e} on an "
            f"interval of length {np.max(delta):g}, more than {tolerance:.1e}; divide it or take more terms"
        )
    n = D.shape[-1]
    leading = 0.5 * np.eye(n) / delta[..., None, None]
    A, B, C = A - leading, B + 2.0 * leading, C - leading

    # Back to x: z = B(delta) x + b(delta) at the end, z = B(0) y at the start; at both e^{x'Omega x/2}.
    start, end, b = z.B[0], value(z.B, delta), value(z.b, delta)
    Ab = apply(A, b)
    volume = log_determinant(start) - 0.5 * n * np.log(2.0 * np.pi * delta)
    return KernelCoefficients(
        A=symmetric(transpose(end) @ A @ end + 0.5 * value(z.Omega, delta)),
        B=transpose(end) @ B @ start,
        C=symmetric(transpose(start) @ C @ start - 0.5 * z.Omega[0]),
        D=apply(transpose(end), D + 2.0 * Ab),
        E=apply(transpose(start), E + apply(transpose(B), b)),
        s=s + dot(Ab + D, b) + volume,
        order=orders,
        remainder=remainder,
    )
