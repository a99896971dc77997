"""The Gaussian kernels of short intervals by Gauss' collocation method of order 16."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import complex128, float64, void
from numpy.typing import NDArray

from zakai.numerics.compiled import kernel
from zakai.numerics.transition import Coefficients

Array = NDArray[Any]

STAGES = 8


class Channels(NamedTuple):
    """The kernels exp(e'k0 e + k1.e y + k2 y^2) N(x; a y + b.e, V) of K intervals: a, V, k2 (K,), b, k1 (K, k), k0 (K, k, k)."""

    scale: Array
    shift: Array
    variance: Array
    constant: Array
    slope: Array
    curvature: Array


def _collocation() -> tuple[Array, Array, Array]:
    nodes, weights = np.polynomial.legendre.leggauss(STAGES)
    nodes, weights = (nodes + 1.0) / 2.0, weights / 2.0
    powers = np.arange(STAGES)
    integrals = nodes[:, None] ** (powers + 1) / (powers + 1)
    matrix = integrals @ np.linalg.inv(nodes[:, None] ** powers)
    return nodes, matrix, weights


NODES, _MATRIX, _WEIGHTS = (np.ascontiguousarray(part) for part in _collocation())


def collocated(c: Coefficients, length: Array) -> Channels:
    """One step each of Gauss' collocation method (order 16); coefficients (K, stages)."""
    kind = np.result_type(*c)
    inputs = c.offset.shape[-1]
    arrays = [np.ascontiguousarray(part, kind) for part in c]
    found = np.empty((len(length), 3 + 2 * inputs + inputs * inputs), kind)
    _integrated(*arrays, np.ascontiguousarray(length, float), _MATRIX, _WEIGHTS, found)
    shift, slope = found[:, 3 : 3 + inputs], found[:, 3 + inputs : 3 + 2 * inputs]
    constant = found[:, 3 + 2 * inputs :].reshape(-1, inputs, inputs)
    return Channels(found[:, 0], shift, found[:, 1], constant, slope, found[:, 2])


_F, _C = float64, complex128


_SIGNATURES = [
    void(t[:, ::1], t[:, :, ::1], t[:, ::1], t[:, ::1], t[:, :, ::1], t[:, :, ::1], _F[::1], _F[:, ::1], _F[::1], t[:, ::1])
    for t in (_F, _C)
]


@kernel(*_SIGNATURES)
def _integrated(
    L: Array, l: Array, G: Array, Q: Array, p: Array, r: Array, lengths: Array, matrix: Array, weights: Array, found: Array
) -> None:
    """Write a, V, k2, b, k1, k0 of each interval, by quadrature.

    V' = G + 2 (L + Q V) V,   a' = F a,   b' = F b + l + V p,   F = L + 2 Q V,
    k2' = Q a^2,   k1' = (2 Q b + p) a,   k0' = Q b^2 + p b + r + Q V + L.
    """
    stages, inputs = l.shape[1], l.shape[2]
    V, rate, a, b = np.zeros(stages, L.dtype), np.zeros(stages, L.dtype), np.zeros(stages, L.dtype), np.zeros(stages, L.dtype)
    before = np.zeros((inputs, stages), L.dtype)
    for k in range(lengths.size):
        tau, row = lengths[k], found[k]
        for i in range(stages):
            V[i] = 0.0 * L[k, 0]
        for _ in range(60):
            for i in range(stages):
                rate[i] = G[k, i] + 2.0 * (L[k, i] + Q[k, i] * V[i]) * V[i]
            change, largest = 0.0, 0.0
            for i in range(stages):
                total = 0.0 * rate[0]
                for j in range(stages):
                    total += matrix[i, j] * rate[j]
                change, largest = max(change, abs((tau * total - V[i]).real)), max(largest, abs(total.real) * tau)
                V[i] = tau * total
            if not (change > 1e-17 * largest):
                break
        log_a, variance = 0.0 * rate[0], 0.0 * rate[0]
        for i in range(stages):
            variance += tau * weights[i] * (G[k, i] + 2.0 * (L[k, i] + Q[k, i] * V[i]) * V[i])
            rate[i] = L[k, i] + 2.0 * Q[k, i] * V[i]
            log_a += tau * weights[i] * rate[i]
        for i in range(stages):
            total = 0.0 * rate[0]
            for j in range(stages):
                total += matrix[i, j] * rate[j]
            a[i] = np.exp(tau * total)
        row[0], row[1], row[2] = np.exp(log_a), variance, 0.0
        for i in range(stages):
            row[2] += tau * weights[i] * Q[k, i] * a[i] * a[i]
        for e in range(inputs):
            shift, slope = 0.0 * rate[0], 0.0 * rate[0]
            for i in range(stages):
                b[i] = (l[k, i, e] + V[i] * p[k, i, e]) / a[i]
                shift += tau * weights[i] * b[i]
            for i in range(stages):
                total = 0.0 * rate[0]
                for j in range(stages):
                    total += matrix[i, j] * b[j]
                before[e, i] = tau * total * a[i]
                slope += tau * weights[i] * (2.0 * Q[k, i] * before[e, i] + p[k, i, e]) * a[i]
            row[3 + e], row[3 + inputs + e] = row[0] * shift, slope
        for e in range(inputs):
            for o in range(inputs):
                total = 0.0 * rate[0]
                for i in range(stages):
                    own = Q[k, i] * before[e, i] * before[o, i]
                    own += 0.5 * (p[k, i, e] * before[o, i] + p[k, i, o] * before[e, i])
                    if e == 0:
                        own += 0.5 * r[k, i, o]
                    if o == 0:
                        own += 0.5 * r[k, i, e]
                    if e == 0 and o == 0:
                        own += Q[k, i] * V[i] + L[k, i]
                    total += tau * weights[i] * own
                row[3 + 2 * inputs + inputs * e + o] = total
