"""The transition of an interval by splitting, with increments that act inside: diffusion, and a potential for all the rest.

    u_t = G u'' / 2 - (f u)' + (h'S^-1 dy/dt - h'S^-1 h / 2) u

With constant coefficients and phi' = f / G the gauge v = e^-phi u leaves v_t = G v'' / 2 + (b / tau) v,

    b = h'S^-1 dy - tau h'S^-1 h / 2 - tau (f^2 / G + f') / 2,
    exp(b / 6) K exp(2 b / 3 - tau G b'^2 / 72) K exp(b / 6),     K the convolution with N(0, tau G / 2),

which is of fourth order in tau (Chin 1997, scheme A).  On the circle the mean of f becomes a shift of K.  The residual is, with
the third and fifth commutators for a Gaussian density of the variance P,

    tau^2 std(G^2 b'^2 b'') / 2160 + 7 tau^3 sqrt(8) (G / P) rms(G^2 b''^2) / 8640
    + tau^4 max(rate^2 rms([A, [b, A]]), std(L^4 b)) / 2880,

L the backward operator.  With s substeps of an interval, s^-4 of that.

Of coefficients that vary within the interval the mean takes the place of the constants where that is accurate, else two averages
with weights, one after the other: Magnus' integrator of fourth order without commutators.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.compiled import helper
from zakai.numerics.line_panels import GAUSS_NODES, GAUSS_WEIGHTS, NODES
from zakai.numerics.line_transition import filtered, largest, moments, taps_of, wrapped

Array = NDArray[Any]

PHI, CELL, DRIFT, SLOPE, OBSERVED = 0, 1, 2, 3, 4  # rows of a term: phi, int f over the spacing above a point, f, f', h
MOST_MAGNUS = 32  # equal parts of an interval with two averages each
_IMPOSSIBLE = -1e8  # exponent where a formula has no value
_OVERFLOW = 690.0
_STEEPEST = 0.5  # change of exponents between points for which the filter of a narrow kernel is accurate


MEAN, EARLY, LATE, DIFFERENCE, SECOND = 0, 1, 2, 3, 4  # weights of a part


def _averages() -> Array:
    """Return the weights (P, 5, 6) of the six Gauss nodes in each of n equal parts of an interval, n = 1 .. MOST_MAGNUS.

    They give the integral over the part, the two averages of the integrator, their difference, and the second Legendre
    coefficient.
    """
    y = 2.0 * GAUSS_NODES - 1.0
    own = GAUSS_WEIGHTS * np.array([np.ones(NODES), 0.5 - y, 0.5 + y, 2.0 * y, 2.5 * (3.0 * y**2 - 1.0)])
    inverse = np.linalg.inv(np.polynomial.legendre.legvander(y, NODES - 1))
    parts = [(n, part) for n in range(1, MOST_MAGNUS + 1) for part in range(n)]
    nodes = [2.0 * (part + GAUSS_NODES) / n - 1.0 for n, part in parts]
    between = [np.polynomial.legendre.legvander(at, NODES - 1) @ inverse / n for at, (n, _) in zip(nodes, parts, strict=True)]
    return np.array([own @ matrix for matrix in between])


AVERAGES = _averages()  # those of n parts begin at n (n - 1) / 2


@helper
def add(to: Array, weight: float, values: Array) -> None:
    """Add values with a weight."""
    for j in range(to.size):
        to[j] += weight * values[j]


@helper
def exponent_added(h: Array, precision: Array, observed: Array, weight: float, share: float, at: int, b: Array) -> float:
    """Add h'S^-1 (weight y - share h / 2) less its value at a point, which is returned.

    Large numbers cancel in this way before they are squared.
    """
    constant = 0.0
    for i in range(h.shape[0]):
        weighted, centre = 0.0, h[i, at]
        for l in range(h.shape[0]):
            if precision[i, l] != 0.0:
                weighted += precision[i, l] * (weight * observed[l] - share * h[l, at])
                constant += centre * precision[i, l] * (weight * observed[l] - 0.5 * share * h[l, at])
        for l in range(h.shape[0]):
            pull, other = 0.5 * share * precision[i, l], h[l, at]
            if pull != 0.0:
                for j in range(b.size):
                    b[j] -= pull * (h[l, j] - other) * (h[i, j] - centre)
        if weighted != 0.0:
            for j in range(b.size):
                b[j] += weighted * (h[i, j] - centre)
    return constant


@helper
def observation_of(table: Array, outputs: Array) -> Array:
    """Return h (m, N), the sum of the terms of a table with factors (R,)."""
    found = np.zeros((table.shape[1] - OBSERVED, table.shape[2]))
    for r in range(outputs.size):
        if outputs[r] != 0.0:
            for i in range(found.shape[0]):
                add(found[i], outputs[r], table[r, OBSERVED + i])
    return found


@helper
def averaged(
    table: Array, drifts: Array, outputs: Array, precisions: Array, covariances: Array, weights: Array, tau: float,
    observed: Array, inside: bool, at: int, spacing: float, closed: bool, phi: Array, drift: Array, b: Array,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Write phi, f and b of an average; return length, int G dt, shift and the constant of b."""
    size, fraction, spread, mean, constant = b.size, 0.0, 0.0, 0.0, 0.0
    for j in range(size):
        phi[j], drift[j], b[j] = 0.0, 0.0, 0.0
    for q in range(weights.size):
        fraction += weights[q]
        spread += weights[q] * covariances[q] * tau
    for r in range(table.shape[0]):
        weight = 0.0
        for q in range(weights.size):
            weight += weights[q] * drifts[q, r]
        if weight != 0.0:
            add(phi, weight, table[r, CELL])
            add(drift, weight, table[r, DRIFT])
            add(b, weight, table[r, SLOPE])
    length = fraction * tau
    G = spread / length
    for j in range(size):
        phi[j] /= fraction * G
        drift[j] /= fraction
    if closed:
        for j in range(size):
            mean += phi[j] * G / (2.0 * np.pi)
        for j in range(size):
            phi[j] -= mean * spacing / G
    own = -0.5 * length * ((drift[at] - mean) * (drift[at] + mean) / G + b[at] / fraction)
    constant += own
    for j in range(size):
        b[j] = -0.5 * length * ((drift[j] - mean) * (drift[j] + mean) / G + b[j] / fraction) - own
    if inside:
        for q in range(outputs.shape[0]):
            w = fraction if outputs.shape[0] == 1 else weights[q]
            constant += exponent_added(observation_of(table, outputs[q]), precisions[q], observed, w, w * tau, at, b)
    for j in range(size):
        if not (b[j] > _IMPOSSIBLE):
            b[j] = _IMPOSSIBLE
    # phi, from its derivative, relative to the point `at`.
    total, step = 0.0, phi[at]
    phi[at] = 0.0
    for j in range(at + 1, size):
        total += step
        step = phi[j]
        phi[j] = total
    total = 0.0
    for j in range(at - 1, -1, -1):
        total -= phi[j]
        phi[j] = total
    return length, spread, mean * length, constant


@helper
def differences(b: Array, spacing: float, closed: bool, first: Array, second: Array) -> None:
    """Write b' and b'' by differences of sixth order, at the ends of the line of second order."""
    size, inner = b.size, b.size - 6
    one, two = 1.0 / spacing, 1.0 / (spacing * spacing)
    left, middle, right = b[:inner], b[3 : inner + 3], b[6:]
    left_two, left_one, right_one, right_two = b[1 : inner + 1], b[2 : inner + 2], b[4 : inner + 4], b[5 : inner + 5]
    to_first, to_second = first[3 : inner + 3], second[3 : inner + 3]
    for j in range(inner):
        far, near = right_two[j] - left_two[j], right_one[j] - left_one[j]
        to_first[j] = one * (0.75 * near - 0.15 * far + (right[j] - left[j]) / 60.0)
        far, near = right_two[j] + left_two[j], right_one[j] + left_one[j]
        to_second[j] = two * (1.5 * near - 0.15 * far + (right[j] + left[j]) / 90.0 - 49.0 / 18.0 * middle[j])
    for end in range(3):
        for j in (end, size - 1 - end):
            below, above = (j - 1) % size, (j + 1) % size
            if not closed:
                below, above = max(j - 1, 0), min(j + 1, size - 1)
            first[j] = one * (b[above] - b[below]) / (2.0 if closed or above - below == 2 else 1.0)
            second[j] = two * (b[above] - 2.0 * b[j] + b[below])


@helper
def residual(
    values: Array, b: Array, first: Array, second: Array, drift: Array, spread: float, spacing: float, tau: float
) -> float:
    """Return the residual of the splitting, relative to the density."""
    size, G = values.size, spread / tau
    mass, mean, variance = moments(values)
    mean, variance = mean + size // 2, variance * spacing * spacing
    third = third_square = fourth_power = upward = flow = seen = 0.0
    twice_mean = twice_square = four_mean = four_square = 0.0
    one, two = 0.5 / spacing, 0.5 * G / (spacing * spacing)
    # L b, ..., L^4 b, L the backward operator by differences.
    powers = np.zeros((5, size))
    for j in range(1, size - 1):
        powers[1, j] = drift[j] * first[j] + 0.5 * G * second[j]
    for i in range(1, 4):
        for j in range(i + 1, size - i - 1):
            rise = (powers[i, j + 1] - powers[i, j - 1]) * one
            powers[i + 1, j] = drift[j] * rise + two * (powers[i, j + 1] - 2.0 * powers[i, j] + powers[i, j - 1])
    scale = 1.0 / mass
    for j in range(4, size - 4):
        p = values[j] * scale
        if p < 1e-12:
            continue
        seen += p
        part = G * G * first[j] * first[j] * second[j]
        third += p * part
        third_square += p * part * part
        fourth_power += p * (G * second[j]) ** 4
        upward += p * G * ((powers[1, j + 1] - powers[1, j - 1]) * one) ** 2
        twice_mean += p * powers[2, j]
        twice_square += p * powers[2, j] ** 2
        four_mean += p * powers[4, j]
        four_square += p * powers[4, j] ** 2
        flow += p * drift[j] * (j - mean) * spacing
    if not (seen > 0.5 and variance > 0):
        return np.inf
    growth, turning = G / variance, abs(flow) / variance
    deviation = np.sqrt(max(third_square - third * third, 0.0))
    curved = np.sqrt(fourth_power)
    twice = np.sqrt(max(twice_square - twice_mean * twice_mean, 0.0))
    four = np.sqrt(max(four_square - four_mean * four_mean, 0.0))
    commutator = twice + 2.0 * np.sqrt(upward * growth) + growth * np.sqrt(2.0 * curved)
    total: float = tau**2 / 2160.0 * deviation + 7.0 / 8640.0 * tau**3 * np.sqrt(8.0) * growth * curved
    return total + tau**4 / 2880.0 * max((growth + turning) ** 2 * commutator, four)


@helper
def _generated(u: Array, parts: Array, spread: float, spacing: float, weight: float, to: Array) -> None:
    """Add the integral of the equation's right-hand side with a weight, by differences of fourth order."""
    inner, flow = u.size - 4, np.empty(u.size)
    for j in range(u.size):
        flow[j] = parts[0, j] * u[j]
    one, two = weight / (12.0 * spacing), 0.5 * weight * spread / (12.0 * spacing * spacing)
    a, b, c, d, e = u[:inner], u[1 : inner + 1], u[2 : inner + 2], u[3 : inner + 3], u[4:]
    first, second, fourth, fifth = flow[:inner], flow[1 : inner + 1], flow[3 : inner + 3], flow[4:]
    own, found = parts[1, 2 : inner + 2], to[2 : inner + 2]
    for j in range(inner):
        curved = 16.0 * (b[j] + d[j]) - a[j] - e[j] - 30.0 * c[j]
        found[j] += two * curved - one * (8.0 * (fourth[j] - second[j]) - fifth[j] + first[j]) + weight * own[j] * c[j]


# Which operator (B, D, E) acts on which density, with which weight, and to which density it is added.  From the density 0 they
# make 4 = [B, D] and 5 = [B, [B, E]] = B (B E - 2 E B) + E B B.
_PRODUCTS = np.array(
    [
        (0, 0, 1, 1), (1, 0, 1, 2), (0, 2, 1, 4), (1, 1, -1, 4), (2, 0, 1, 3), (0, 3, 1, 6), (2, 1, -2, 6), (0, 6, 1, 5),
        (0, 1, 1, 7), (2, 7, 1, 5),
    ]
)  # fmt: skip


@helper
def averaging(
    values: Array, table: Array, drifts: Array, outputs: Array, precisions: Array, covariances: Array, averages: Array,
    tau: float, observed: Array, inside: bool, at: int, spacing: float,
) -> tuple[float, float]:  # fmt: skip
    """Return estimates of the errors of the mean and of two averages in a part of an interval.

    With the integral B of the operator, D the difference of the averages and E the second Legendre coefficient they are
    [B, D] / 4 + [B, [B, E]] / 10, and of fifth order 5 |[B, D] / 4|^(5/3) + [B, [B, E]] / 10.
    """
    size = values.size
    parts, spreads, found = np.zeros((3, 2, size)), np.zeros(3), np.zeros((8, size))
    for i in range(3):
        weights, whole = averages[MEAN if i == 0 else (DIFFERENCE if i == 1 else SECOND)], 0.0
        for q in range(weights.size):
            spreads[i] += tau * weights[q] * covariances[q]
            whole += weights[q]
            for r in range(table.shape[0]):
                add(parts[i, 0], tau * weights[q] * drifts[q, r], table[r, DRIFT])
        if inside and (i == 0 or outputs.shape[0] > 1):
            for q in range(outputs.shape[0]):
                w = whole if outputs.shape[0] == 1 else weights[q]
                exponent_added(observation_of(table, outputs[q]), precisions[q], observed, w, w * tau, at, parts[i, 1])
    add(found[0], 1.0, values)
    for operator, of, weight, to in _PRODUCTS:
        _generated(found[of], parts[operator], spreads[operator], spacing, float(weight), found[to])
    one, two, mass, limit = 0.0, 0.0, 0.0, 1e-12 * largest(values)
    for j in range(size):
        mass += values[j]
        if values[j] > limit:
            one += abs(found[4, j])
            two += abs(found[5, j])
    one, two = 0.25 * one / mass, 0.1 * two / mass
    return one + two, 5.0 * one ** (5.0 / 3.0) + two


@helper
def split(
    now: Array, phi: Array, b: Array, first: Array, spread: float, shift: float, substeps: int, spacing: float, depth: float,
    closed: bool, narrow: bool,
) -> tuple[float, float]:  # fmt: skip
    """Replace a density by that after an average, in substeps; return the rounding error and what may have become zero.

    The filter of a narrow kernel is accurate where v is band-limited, that is where the exponents change little between points.
    """
    size, weight, part = now.size, 1.0 / (6.0 * substeps), spread / (2.0 * substeps)
    correction, negligible, clipped = spread / (72.0 * substeps**3), 1e-13 * largest(now), 0.0
    middle, joint, late, work = np.empty(size), np.empty(size), np.empty(size), np.ones(size)
    for j in range(1, size):
        if narrow and not (abs(phi[j] - phi[j - 1]) + 5.0 * weight * abs(b[j] - b[j - 1]) < _STEEPEST):
            for i in (j - 1, j):
                if now[i] > negligible:
                    return np.inf, 1.0
                clipped, now[i] = max(clipped, now[i]), 0.0
    for j in range(size):
        outer, gauge = weight * b[j], phi[j]
        if not (abs(gauge) < _OVERFLOW and outer - gauge < _OVERFLOW):
            if now[j] > negligible or not (gauge < 0.0 or b[j] == _IMPOSSIBLE):
                return np.inf, 1.0
            clipped = max(clipped, now[j])
            now[j], outer, gauge = 0.0, -_OVERFLOW, 0.0
        now[j] *= np.exp(outer - gauge)
        middle[j] = np.exp(4.0 * outer - correction * first[j] * first[j])
        late[j] = np.exp(outer + gauge)
        joint[j] = np.exp(2.0 * outer) if substeps > 1 else 1.0
        work[j] = np.exp(gauge) if narrow else 1.0
    variance = part / (spacing * spacing)
    taps = taps_of(variance, depth, size, narrow)
    rounding, clipped = 0.0, clipped * 1e-13 / negligible
    for i in range(2 * substeps):
        after = middle if i % 2 == 0 else (joint if i < 2 * substeps - 1 else late)
        if closed:
            rounding += wrapped(now, work, shift / (2.0 * substeps * spacing), variance, depth)
            for j in range(size):
                now[j] *= after[j]
        else:
            if i == 2 * substeps - 1:
                for j in range(size):
                    work[j] = 1.0
            noise, end = filtered(now, taps, after, work, narrow)
            rounding, clipped = rounding + noise, max(clipped, end)
    return rounding, clipped
