"""The kernel between two observations as a power series in the length of the interval.

Chen, Luo, Yau 2017, Theorems 2 and 3, after the transformation of `schroedinger`: in z-coordinates

    K(t, z, y) = (2 pi t)^(-n/2) exp(z'A~ z + z'B~ y + y'C~ y + D~.z + E~.y + s),                     (44)
    A~' = 2 A~^2 - F'Q~F/2,  B~' = 2 A~ B~,  C~' = B~'B~/2,  D~' = 2 A~ D~ + F'Q~F b - F'p~/2,  E~' = B~'D~,
    s' = D~.D~/2 + tr A~ - constant/2 + n/(2t),                                                  (45)-(50)

and each is a power series in t that begins at t^-1.  The recursions of D~ (56) and E~ (57) are corrected.  A
series converges up to about pi/omega, omega^2 the largest eigenvalue of F'Q~F; a longer interval is divided
and the kernels of its parts are composed.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from zakai.errors import ConditionError
from zakai.kolmogorov.quadratic_kernel import KernelCoefficients, compose, log_kernel
from zakai.kolmogorov.schroedinger import Schroedinger, TaylorData, schroedinger, taylor_data
from zakai.kolmogorov.taylor import apply, dot, symmetric, transpose, value

__all__ = [
    "KernelCoefficients",
    "TaylorData",
    "compose",
    "log_kernel",
    "power_series_kernel",
    "power_series_kernels",
    "taylor_data",
]

TOLERANCE = 1e-13
MOST_TERMS = 20
MOST_PARTS = 1024

# The coefficients of one series, by their index, which begins at -1.
Indexed = dict[int, np.ndarray]


def power_series_kernel(
    taylor: TaylorData, delta: np.ndarray | float, order: int | None = None, tolerance: float = TOLERANCE
) -> KernelCoefficients:
    """The kernel over an interval of length `delta` (or a batch), by series cut after the power `order`.

    Without an `order`, the smallest that leaves a remainder of at most `tolerance`.  `taylor` must hold at
    least order + 2 terms about the start of the interval.  Raises `ConditionError` if its terms do not
    suffice for `tolerance`: the interval is then too long for one series, and `power_series_kernels` divides
    it.

    Source: Chen, Luo, Yau 2017, Theorem 3, with (56) and (57) corrected.

        >>> import numpy as np
        >>> zero, one = np.zeros((12, 1)), np.zeros((12, 1, 1))
        >>> one[0] = 1.0                                     # v_t = v_xx / 2 - x^2 v / 2, Mehler's kernel
        >>> kernel = power_series_kernel(TaylorData(one, 0 * one, zero, one, zero, zero[:, 0]), 0.1)
        >>> bool(abs(kernel.B[0, 0] - 1 / np.sinh(0.1)) < 1e-13)
        True
    """
    kernel = _kernel(taylor, np.asarray(delta, float), order, tolerance)
    worst = float(np.max(kernel.remainder))
    if order is None and not worst <= tolerance:
        raise ConditionError(
            f"{len(taylor.constant)} terms of the power series leave a remainder of {worst:.1e} on an "
            f"interval of length {np.max(delta):g}, more than {tolerance:.1e}; divide it or take more terms"
        )
    return kernel


def power_series_kernels(
    expand: Callable[[np.ndarray, int], TaylorData],
    starts: np.ndarray,
    stops: np.ndarray,
    order: int | None = None,
    tolerance: float = TOLERANCE,
) -> KernelCoefficients:
    """The kernels over all intervals [starts_i, stops_i]; where one series is too short, equal parts are
    composed.

    `expand(points, terms)` gives the `TaylorData` about each of `points`, as `taylor_data` does.  `tolerance`
    is for each part.  With an `order` given nothing is divided, as in the paper.  Raises `ConditionError` if
    the finest division still leaves too large a remainder.
    """
    starts, stops = np.asarray(starts, float), np.asarray(stops, float)
    if order is not None:
        return power_series_kernel(expand(starts, order + 4), stops - starts, order)
    parts = 1
    while True:
        nodes = np.linspace(starts, stops, parts + 1)
        kernels = _kernel(expand(nodes[:-1], MOST_TERMS), np.diff(nodes, axis=0), None, tolerance)
        worst = float(np.max(kernels.remainder))
        if worst <= tolerance:
            break
        if parts >= MOST_PARTS:
            raise ConditionError(
                f"the power series leaves a remainder of {worst:.1e}, more than {tolerance:.1e}, even on "
                f'{parts} parts of an interval; use kernel="flow"'
            )
        parts *= 2
    while parts > 1:
        kernels = compose(kernels.part(slice(1, None, 2)), kernels.part(slice(0, None, 2)))
        parts //= 2
    return kernels.part(0)


def _next_A(v: int, A: Indexed, FQF: np.ndarray) -> np.ndarray:
    """A~_{v+1} of (53)."""
    return (2.0 * _sum(A[i] @ A[v - i] for i in range(v + 1)) - 0.5 * FQF[v]) / (v + 3)


def _next_B(v: int, A: Indexed, B: Indexed) -> np.ndarray:
    """B~_{v+1} of (54)."""
    return 2.0 * _sum(A[i] @ B[v - i] for i in range(v + 2)) / (v + 2)


def _next_C(v: int, B: Indexed) -> np.ndarray:
    """C~_{v+1} of (55)."""
    return _sum(transpose(B[i]) @ B[v - i] for i in range(-1, v + 2)) / (2 * (v + 1))


def _next_D(v: int, A: Indexed, D: Indexed, Fp: np.ndarray, FQFb: np.ndarray) -> np.ndarray:
    """D~_{v+1} of (56), whose last term is printed with the factor -1/2 in place of 1."""
    return (2.0 * _sum(apply(A[i], D[v - i]) for i in range(v + 2)) - 0.5 * Fp[v] + FQFb[v]) / (v + 2)


def _next_E(v: int, B: Indexed, D: Indexed) -> np.ndarray:
    """E~_{v+1} of (57), printed with a factor 2 and without the transpose."""
    return _sum(apply(transpose(B[i]), D[v - i]) for i in range(-1, v + 2)) / (v + 1)


def _next_s(v: int, A: Indexed, D: Indexed, constant: np.ndarray) -> np.ndarray:
    """s_{v+1} of (58)."""
    squares = _sum(dot(D[i], D[v - i]) for i in range(-1, v + 2))
    return (0.5 * squares + np.trace(A[v], axis1=-2, axis2=-1) - 0.5 * constant[v]) / (v + 1)


def _recursion(z: Schroedinger) -> tuple[Indexed, ...]:
    """Theorem 3: A~, B~, C~, D~, E~, s up to the power N, from a potential with N terms."""
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


def _kernel(data: TaylorData, delta: np.ndarray, order: int | None, tolerance: float) -> KernelCoefficients:
    if len(data.constant) < (order or 1) + 2:
        raise ValueError(
            f"order {order or 1} needs {(order or 1) + 2} Taylor terms, not {len(data.constant)}"
        )
    z = schroedinger(data)
    coefficients = _recursion(z)
    order, remainder = _cut(_term_sizes(z, coefficients, delta), order, tolerance)

    A, B, C, D, E, s = (value(np.stack([c[v] for v in range(order + 1)]), delta) for c in coefficients)
    n = D.shape[-1]
    leading = 0.5 * np.eye(n) / delta[..., None, None]
    A, B, C = A - leading, B + 2.0 * leading, C - leading

    # Back to x: z = B(delta) x + b(delta) at the end, z = B(0) y at the start; at both e^{x'Omega x/2}.
    start, end, b = z.B[0], value(z.B, delta), value(z.b, delta)
    Ab = apply(A, b)
    volume = np.linalg.slogdet(start)[1] - 0.5 * n * np.log(2.0 * np.pi * delta)
    return KernelCoefficients(
        A=symmetric(transpose(end) @ A @ end + 0.5 * value(z.Omega, delta)),
        B=transpose(end) @ B @ start,
        C=symmetric(transpose(start) @ C @ start - 0.5 * z.Omega[0]),
        D=apply(transpose(end), D + 2.0 * Ab),
        E=apply(transpose(start), E + apply(transpose(B), b)),
        s=s + dot(Ab + D, b) + volume,
        order=order,
        remainder=remainder,
    )


def _term_sizes(z: Schroedinger, coefficients: tuple[Indexed, ...], delta: np.ndarray) -> np.ndarray:
    """The largest term at each power of delta, (powers, ...); the kernel multiplies z = B x + b by
    1/delta."""

    def size(term: np.ndarray) -> np.ndarray:
        return np.max(np.abs(term.reshape(*delta.shape, -1)), axis=-1)

    F = np.linalg.inv(z.B[0])
    sizes = []
    for v in range(len(z.FQF) + 1):
        terms = [size(c[v]) for c in coefficients] + [size(z.B[v] @ F) / delta, size(z.b[v]) / delta]
        terms += [size(z.Omega[v])] if v < len(z.Omega) else []
        sizes.append(np.max(terms, axis=0) * delta**v)
    return np.stack(sizes)


def _cut(sizes: np.ndarray, order: int | None, tolerance: float) -> tuple[int, np.ndarray]:
    """Where to stop, and the sum of the terms left out; those not computed count as much as the last two."""
    tails = [np.sum(sizes[v + 1 :], axis=0) + sizes[-1] + sizes[-2] for v in range(len(sizes))]
    if order is None:
        order = next((v for v in range(1, len(sizes)) if np.max(tails[v]) <= tolerance), len(sizes) - 1)
    return order, tails[order]


def _sum(terms) -> np.ndarray:
    return np.sum(list(terms), axis=0)
