"""The splitting of an increment from the transition in an interval: the exponent of its factors, and the error that it leaves.

    exp(b / 6) exp(tau A / 2) exp(2 b / 3 - tau G b'^2 / 72) exp(tau A / 2) exp(b / 6),     b = h'S^-1 dy - tau h'S^-1 h / 2,

is of fourth order in tau (Chin 1997, scheme A).  The residual is, with the third and fifth commutators for a Gaussian density of
the variance P,

    tau^2 std(G^2 b'^2 b'') / 2160 + 7 tau^3 sqrt(8) (G / P) rms(G^2 b''^2) / 8640
    + tau^4 max(rate^2 rms([A, [b, A]]), std(L^4 b)) / 2880 + tau^3 rms((dL/dt) b) / 2880,

L the backward operator.  With s substeps of an increment, s^-4 of that.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.compiled import helper
from zakai.numerics.line_transition import moments

Array = NDArray[Any]


@helper
def residual(
    values: Array, b: Array, first: Array, second: Array, drift: Array, change: Array, covariance: float, acceleration: float,
    spacing: float, tau: float,
) -> float:  # fmt: skip
    """The residual of the splitting of an increment, relative to the density; `change` and `acceleration` are df/dt and dG/dt."""
    size, G = values.size, covariance
    mass, mean, variance = moments(values)
    mean, variance = mean + size // 2, variance * spacing * spacing
    third = third_square = fourth_power = upward = flow = seen = moving = 0.0
    twice_mean = twice_square = four_mean = four_square = 0.0
    # b, L b, ..., L^4 b, L the backward operator by differences.
    powers = np.zeros((5, size))
    for j in range(size):
        powers[0, j] = b[j]
    for j in range(1, size - 1):
        powers[1, j] = drift[j] * first[j] + 0.5 * G * second[j]
    for i in range(1, 4):
        for j in range(i + 1, size - i - 1):
            rise = (powers[i, j + 1] - powers[i, j - 1]) / (2.0 * spacing)
            second_difference = (powers[i, j + 1] - 2.0 * powers[i, j] + powers[i, j - 1]) / (spacing * spacing)
            powers[i + 1, j] = drift[j] * rise + 0.5 * G * second_difference
    for j in range(4, size - 4):
        p = values[j] / mass
        if p < 1e-12:
            continue
        seen += p
        part = G * G * first[j] * first[j] * second[j]
        third += p * part
        third_square += p * part * part
        fourth_power += p * (G * second[j]) ** 4
        moving += p * (change[j] * first[j] + 0.5 * acceleration * second[j]) ** 2
        upward += p * G * ((powers[1, j + 1] - powers[1, j - 1]) / (2.0 * spacing)) ** 2
        twice_mean += p * powers[2, j]
        twice_square += p * powers[2, j] ** 2
        four_mean += p * powers[4, j]
        four_square += p * powers[4, j] ** 2
        flow += p * drift[j] * (j - mean) * spacing
    if not (seen > 0.5 and variance > 0):
        return np.inf
    growth, turning = G / variance, abs(flow) / variance
    spread = np.sqrt(max(third_square - third * third, 0.0))
    curved = np.sqrt(fourth_power)
    twice = np.sqrt(max(twice_square - twice_mean * twice_mean, 0.0))
    four = np.sqrt(max(four_square - four_mean * four_mean, 0.0))
    commutator = twice + 2.0 * np.sqrt(upward * growth) + growth * np.sqrt(2.0 * curved)
    residual = tau**2 / 2160.0 * spread + 7.0 / 8640.0 * tau**3 * np.sqrt(8.0) * growth * curved
    residual += tau**3 / 2880.0 * np.sqrt(moving)
    total: float = residual + tau**4 / 2880.0 * max((growth + turning) ** 2 * commutator, four)
    return total


@helper
def exponent_of(
    h: Array, slope: Array, curvature: Array, precision: Array, observed: Array, at: int, share: float, b: Array, first: Array,
    second: Array,
) -> float:  # fmt: skip
    """Write h'S^-1 (y - share h / 2) less its value at a point, and its derivatives; return the largest difference.

    Large numbers cancel in this way before they are squared.
    """
    m, size, largest = h.shape[0], h.shape[1], 0.0
    for j in range(size):
        b[j], first[j], second[j] = 0.0, 0.0, 0.0
    for i in range(m):
        weighted, centre = 0.0, h[i, at]
        for l in range(m):
            weighted += precision[i, l] * (observed[l] - share * h[l, at])
        for j in range(size):
            b[j] += weighted * (h[i, j] - centre)
            first[j] += weighted * slope[i, j]
            second[j] += weighted * curvature[i, j]
        for l in range(m):
            other, pull = h[l, at], share * precision[i, l]
            if pull == 0.0:
                continue
            for j in range(size):
                apart = pull * (h[l, j] - other)
                b[j] -= 0.5 * apart * (h[i, j] - centre)
                first[j] -= apart * slope[i, j]
                second[j] -= apart * curvature[i, j] + pull * slope[i, j] * slope[l, j]
    for j in range(size):
        if not (b[j] > -1e8):
            b[j], first[j], second[j] = -1e8, 0.0, 0.0
        largest = max(largest, abs(b[j]))
    return largest
