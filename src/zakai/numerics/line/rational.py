"""Exponentials of the Kolmogorov operator on Gauss-Lobatto panels by rational functions.

    u_t = (G u)'' / 2 - (f u)' + V u,      (G u)' / 2 - f u = 0 at the ends

With u = r v, where v is continuous and the number r of each panel is such that r G is continuous, the weak form with the mass at
the points is M v_t = B v,

    B = sum over panels r (D' W (f - D G / 2) + W V),      M = sum over panels r W,

and the step of a rational function with simple poles is exp(h M^-1 B) v = sum over poles z of 2 Re c (h B - z M)^-1 M v.  The
transposed B takes functions of the state backward.  The inner points of each panel are eliminated first (static condensation),
for all panels and poles side by side; what is left is a tridiagonal system for the ends of the panels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import complex128, float64

from zakai.numerics.arrays import Array
from zakai.numerics.compiled import kernel
from zakai.numerics.lobatto import Element, rule

LANES = 24  # systems that are eliminated side by side: they fit into the cache of a core


class Poles(NamedTuple):
    """The poles (K,) of a rational function above the real axis, and their residues."""

    values: Array
    residues: Array


# Best approximations on the negative axis, with errors of 3e-10 and 4e-14 (Trefethen, Weideman and Schmelzer 2006).
COARSE = Poles(
    np.array([
        4.027732483731141 + 1.193856067333943j, 3.283752900100038 + 3.594386774813735j, 1.7154060337885453 + 6.038934929045367j,
        -0.8944046821709826 + 8.582756902508674j, -5.161191251646408 + 11.375156254840705j,
    ]),
    np.array([
        -4.818382059005325 - 21.054597597184184j, 7.117165209499453 + 8.819533323128907j, -2.5655849971272375 - 1.216385735866052j,
        0.27258698546172666 + 0.014211728318711078j, -0.005784903977342005 + 0.0006858507045012924j,
    ]),
)  # fmt: skip
FINE = Poles(
    np.array([
        5.62317153474907 + 1.1940664287035054j, 5.089374564868055 + 3.5888160956106345j, 3.993400429645279 + 6.004818060147936j,
        2.269816525848304 + 8.461717806887696j, -0.20872377765454347 + 10.991232026342253j,
        -3.7032391601860652 + 13.656333463723643j, -8.897735413193399 + 16.63093520843589j,
    ]),
    np.array([
        -27.876162290790504 - 102.15000629233164j, 46.93490458646216 + 45.64454383897618j, -23.498979418912768 - 5.808219208520475j,
        4.807233308888861 - 1.3211122031058917j, -0.37636336735203735 + 0.33520468313172247j,
        0.009438720569245423 - 0.01718573631108834j, -7.153878175282853e-05 + 0.00014361901758410176j,
    ]),
)  # fmt: skip
# Pade's approximation of type (7, 8), of order 15: its poles are to the right, so that it is stable for motion, too.
STABLE = Poles(
    np.array([
        10.169446006657514 + 1.6492017968222277j, 9.40637121369074 + 4.969217287623294j, 7.738688146830548 + 8.370879306237983j,
        4.685494632821197 + 12.01057859981379j,
    ]),
    np.array([
        2612.6208468682107 - 13549.06014743892j, -3848.544415437437 + 5690.315433804313j, 1334.8647374600173 - 702.4310104980137j,
        -94.9411688907913 - 25.47666248176777j,
    ]),
)  # fmt: skip


def weak_form(element: Element, covariance: Array, drift: Array, potential: Array, scale: Array) -> Array:
    """Return B (P, n, n) of panels for G, f and V at their points (P n,), and r (P,)."""
    panels, own = (len(element.halves), 1, element.size), rule(element.size)
    transport = own.derivative.T * own.weights
    G, f, V = (np.reshape(part, panels) for part in (covariance, drift, potential))
    result = transport * f - (transport @ own.derivative) * (0.5 * G / element.halves[:, None, None])
    inner = np.arange(element.size)
    result[:, inner, inner] += element.halves[:, None] * own.weights * V[:, 0]
    return np.asarray(result * scale[:, None, None])


def joined(element: Element, values: Array) -> Array:
    """Return the sums (P (n - 1) + 1,) over panels of values (P n,) at their points."""
    parts = values.reshape(-1, element.size)
    result = np.zeros(parts.shape[0] * (element.size - 1) + 1, values.dtype)
    result[:-1] = parts[:, :-1].reshape(-1)
    result[element.size - 1 :: element.size - 1] += parts[:, -1]
    return result


def separated(element: Element, values: Array) -> Array:
    """Return values at the points of panels (..., P n) from those of a continuous function (..., P (n - 1) + 1)."""
    count, size = len(element.halves), element.size
    places = (np.arange(count)[:, None] * (size - 1) + np.arange(size)).reshape(-1)
    return np.asarray(values[..., places])


def exponential(element: Element, blocks: Array, masses: Array, step: float, poles: Poles, values: Array) -> Array:
    """Return exp(h M^-1 B) v; complex arguments carry derivatives.

    Args:
        element: the panels.
        blocks: B (P, n, n).
        masses: M at the points of the panels (P n,).
        step: h.
        poles: the rational function.
        values: v (P (n - 1) + 1,).
    """
    shape = blocks.shape[:2]
    right = joined(element, masses) * values
    real = np.ascontiguousarray(blocks.real), np.ascontiguousarray(masses.real).reshape(shape), step, poles.values
    x = solutions(*real, right.real[None].astype(complex))
    result = 2.0 * (poles.residues @ x).real
    if any(map(np.iscomplexobj, (blocks, masses, values))):
        at = separated(element, x).reshape(-1, *shape)
        moved = step * np.einsum("pij,kpj->kpi", blocks.imag, at)
        moved = moved - poles.values[:, None, None] * masses.imag.reshape(shape) * at
        change = right.imag - np.array([joined(element, one.reshape(-1)) for one in moved])
        result = result + 2.0j * (poles.residues @ solutions(*real, change)).real
    return np.asarray(result)


@kernel(complex128[:, ::1](float64[:, :, ::1], float64[:, ::1], float64, complex128[::1], complex128[:, ::1]))
def solutions(blocks: Array, masses: Array, step: float, poles: Array, right: Array) -> Array:
    """Return x (K, P (n - 1) + 1) with (h B - z M) x = b for each pole; the b are the rows of `right`, or its only one."""
    P, n = masses.shape
    K, last = poles.size, n - 1
    total = P * K
    chunks = (total + LANES - 1) // LANES
    upper_re, upper_im = np.empty((chunks, n, n, LANES)), np.empty((chunks, n, n, LANES))
    y_re, y_im = np.empty((chunks, n, LANES)), np.empty((chunks, n, LANES))
    ends, x = np.zeros((K, P + 1, 3), np.complex128), np.zeros((K, P * last + 1), np.complex128)
    order = np.append(np.arange(1, last), np.array([0, last]))
    factor_re, factor_im = np.empty(LANES), np.empty(LANES)
    for c in range(chunks):
        re, im, yr, yi = upper_re[c], upper_im[c], y_re[c], y_im[c]
        for lane in range(LANES):
            k = min(c * LANES + lane, total - 1) // P
            q = min(c * LANES + lane, total - 1) - k * P
            row = min(k, right.shape[0] - 1)
            for a in range(n):
                i = order[a]
                for b in range(n):
                    re[a, b, lane], im[a, b, lane] = step * blocks[q, i, order[b]], 0.0
                re[a, a, lane] -= poles[k].real * masses[q, i]
                im[a, a, lane] = -poles[k].imag * masses[q, i]
                own = right[row, q * last + i] if 0 < i else 0.0j  # the ends of panels count once
                if q == 0 and i == 0:
                    own = right[row, 0]
                yr[a, lane], yi[a, lane] = own.real, own.imag
        for k in range(n - 2):
            for lane in range(LANES):
                inverse = 1.0 / (re[k, k, lane] * re[k, k, lane] + im[k, k, lane] * im[k, k, lane])
                re[k, k, lane], im[k, k, lane] = re[k, k, lane] * inverse, -im[k, k, lane] * inverse
            for i in range(k + 1, n):
                for lane in range(LANES):
                    factor_re[lane] = re[i, k, lane] * re[k, k, lane] - im[i, k, lane] * im[k, k, lane]
                    factor_im[lane] = re[i, k, lane] * im[k, k, lane] + im[i, k, lane] * re[k, k, lane]
                for j in range(k + 1, n):
                    for lane in range(LANES):
                        re[i, j, lane] -= factor_re[lane] * re[k, j, lane] - factor_im[lane] * im[k, j, lane]
                        im[i, j, lane] -= factor_re[lane] * im[k, j, lane] + factor_im[lane] * re[k, j, lane]
                for lane in range(LANES):
                    yr[i, lane] -= factor_re[lane] * yr[k, lane] - factor_im[lane] * yi[k, lane]
                    yi[i, lane] -= factor_re[lane] * yi[k, lane] + factor_im[lane] * yr[k, lane]
        for lane in range(min(LANES, total - c * LANES)):
            k = (c * LANES + lane) // P
            q = c * LANES + lane - k * P
            a, b = n - 2, n - 1
            ends[k, q, 1] += complex(re[a, a, lane], im[a, a, lane])
            ends[k, q, 2] += complex(re[a, b, lane], im[a, b, lane])
            ends[k, q + 1, 0] += complex(re[b, a, lane], im[b, a, lane])
            ends[k, q + 1, 1] += complex(re[b, b, lane], im[b, b, lane])
            x[k, q * last] += complex(yr[a, lane], yi[a, lane])
            x[k, (q + 1) * last] += complex(yr[b, lane], yi[b, lane])
    for k in range(K):
        for q in range(1, P + 1):
            factor = ends[k, q, 0] / ends[k, q - 1, 1]
            ends[k, q, 1] -= factor * ends[k, q - 1, 2]
            x[k, q * last] -= factor * x[k, (q - 1) * last]
        x[k, P * last] /= ends[k, P, 1]
        for q in range(P - 1, -1, -1):
            x[k, q * last] = (x[k, q * last] - ends[k, q, 2] * x[k, (q + 1) * last]) / ends[k, q, 1]
    for c in range(chunks):
        re, im, yr, yi = upper_re[c], upper_im[c], y_re[c], y_im[c]
        for lane in range(LANES):
            k = min(c * LANES + lane, total - 1) // P
            q = min(c * LANES + lane, total - 1) - k * P
            left, other = x[k, q * last], x[k, (q + 1) * last]
            yr[n - 2, lane], yi[n - 2, lane], yr[n - 1, lane], yi[n - 1, lane] = left.real, left.imag, other.real, other.imag
        for i in range(n - 3, -1, -1):
            for j in range(i + 1, n):
                for lane in range(LANES):
                    yr[i, lane] -= re[i, j, lane] * yr[j, lane] - im[i, j, lane] * yi[j, lane]
                    yi[i, lane] -= re[i, j, lane] * yi[j, lane] + im[i, j, lane] * yr[j, lane]
            for lane in range(LANES):
                value = yr[i, lane] * re[i, i, lane] - yi[i, lane] * im[i, i, lane]
                yi[i, lane] = yr[i, lane] * im[i, i, lane] + yi[i, lane] * re[i, i, lane]
                yr[i, lane] = value
        for lane in range(min(LANES, total - c * LANES)):
            k = (c * LANES + lane) // P
            q = c * LANES + lane - k * P
            for a in range(n - 2):
                x[k, q * last + a + 1] = complex(yr[a, lane], yi[a, lane])
    return x
