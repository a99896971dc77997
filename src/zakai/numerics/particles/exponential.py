"""Runge-Kutta weights for dx/dt = L x + g(x, t), exact where g is constant: the fourth-order scheme of Cox and Matthews.

    y_2 = P g_1,   y_3 = P g_2,   y_4 = e^(hL/2) y_2 + P (2 g_3 - g_1),   y = h B_1 g_1 + h B_2 (g_2 + g_3) + h B_4 g_4

y is the change of x, g_k = f(x + y_k) - L y_k, and P = h/2 phi_1(hL/2).  With L = 0 it is the classical scheme.

References:
    Cox and Matthews 2002, Exponential time differencing for stiff systems.
    Skaflestad and Wright 2009, The scaling and modified squaring method for matrix functions related to the exponential.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.numerics.compiled import helper
from zakai.numerics.small_matrices import assign, multiply

Array = Any
# The rows of weights (7, n, n): P, e^(hL/2), h B_1, h B_2, h B_4, h phi_1(hL), which the midpoint rule takes, and -L.
HALF, HALFWAY, FIRST, MIDDLE, LAST, WHOLE, MINUS_L, WEIGHTS = 0, 1, 2, 3, 4, 5, 6, 7
# Norm of L times a step below which the classical scheme is as good (its error of exp is 2e-4 there).
STIFF = 0.5


@helper
def norm_of(L: Array) -> float:
    """Return the largest sum of magnitudes of a row."""
    largest = 0.0
    for i in range(L.shape[0]):
        total = 0.0
        for j in range(L.shape[1]):
            total += abs(L[i, j])
        largest = max(largest, total)
    return largest


@helper
def _functions(L: Array, length: float, phi: Array) -> None:
    """Write e^z, phi_1(z), phi_2(z), phi_3(z) (4, n, n) of z = length L."""
    n, halves, norm = L.shape[0], 0, norm_of(L) * abs(length)
    while norm > 0.5 and halves < 60:
        norm, halves = 0.5 * norm, halves + 1
    z, product, term = np.empty((n, n)), np.empty((n, n)), np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            z[i, j] = L[i, j] * length / 2.0**halves
    phi[:] = 0.0
    for i in range(n):
        term[i, i] = 1.0 / 6.0
    for k in range(14):  # of phi_3 = sum z^k / (k + 3)!
        for i in range(n):
            for j in range(n):
                phi[3, i, j] += term[i, j]
        multiply(product, z, term)
        for i in range(n):
            for j in range(n):
                term[i, j] = product[i, j] / (k + 4)
    constant = 0.5
    for a in range(2, -1, -1):  # phi_a = z phi_(a+1) + 1 / a!
        multiply(phi[a], z, phi[a + 1])
        for i in range(n):
            phi[a, i, i] += constant
        constant = 1.0
    for _ in range(halves):
        multiply(product, phi[1], phi[2])
        for i in range(n):
            for j in range(n):
                phi[3, i, j] = (product[i, j] + 2.0 * phi[3, i, j] + phi[2, i, j]) / 8.0
        multiply(product, phi[1], phi[1])
        for i in range(n):
            for j in range(n):
                phi[2, i, j] = (product[i, j] + 2.0 * phi[2, i, j]) / 4.0
        multiply(product, phi[0], phi[1])
        for i in range(n):
            for j in range(n):
                phi[1, i, j] = (product[i, j] + phi[1, i, j]) / 2.0
        multiply(product, phi[0], phi[0])
        assign(phi[0], product)


@helper
def write_weights(L: Array, length: float, out: Array) -> None:
    """Write the weights (7, n, n) of a step of this length."""
    n = L.shape[0]
    phi = np.empty((4, n, n))
    _functions(L, 0.5 * length, phi)
    for i in range(n):
        for j in range(n):
            out[HALF, i, j], out[HALFWAY, i, j] = 0.5 * length * phi[1, i, j], phi[0, i, j]
    _functions(L, length, phi)
    for i in range(n):
        for j in range(n):
            one, two, three = phi[1, i, j], phi[2, i, j], phi[3, i, j]
            out[FIRST, i, j] = length * (one - 3.0 * two + 4.0 * three)
            out[MIDDLE, i, j] = length * (2.0 * two - 4.0 * three)
            out[LAST, i, j] = length * (4.0 * three - two)
            out[WHOLE, i, j] = length * one
            out[MINUS_L, i, j] = -L[i, j]


@helper
def distinct_weights(L: Array, times: Array, which: Array) -> Array:
    """Return the weights (K, 7, n, n) of the lengths of the events (E, 2); `which` (E,) receives theirs, -1 for no stiff one."""
    n, count, norm = L.shape[0], 0, norm_of(L)
    lengths = np.empty(times.shape[0])
    for e in range(times.shape[0]):
        which[e], length = -1, times[e, 1] - times[e, 0]
        if not norm * length > STIFF:
            continue
        for k in range(count):
            if abs(lengths[k] - length) <= 1e-13 * length:
                which[e] = k
        if which[e] < 0:
            which[e], lengths[count] = count, length
            count += 1
    out = np.empty((count, WEIGHTS, n, n))
    for k in range(count):
        write_weights(L, lengths[k], out[k])
    return out
