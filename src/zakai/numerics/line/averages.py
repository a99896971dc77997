"""Coefficients that vary in time: parts of an interval in which few nodes resolve them, and averages over a part.

The averages are those of Magnus' integrator of fourth order without commutators: the mean takes the place of the coefficients
where that is accurate, else two averages with weights, one after the other.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import complex128, float64

from zakai.numerics.arrays import Array
from zakai.numerics.compiled import helper, kernel
from zakai.numerics.line.density import highest_of, support
from zakai.numerics.line.steps import CELL, DRIFT, IMPOSSIBLE, SLOPE, Coefficients, add, exponent_added, observation_of

NODES = 6
_nodes, _weights = np.polynomial.legendre.leggauss(NODES)
GAUSS_NODES: Array = (_nodes + 1.0) / 2.0
GAUSS_WEIGHTS: Array = _weights / 2.0

_V, _M = float64[::1], float64[:, ::1]


@kernel(float64[:, :, ::1](_M, _V, _V, _V), complex128[:, :, ::1](complex128[:, ::1], _V, _V, _V))
def polynomials_at_nodes(coefficients: Array, starts: Array, stops: Array, lengths: Array) -> Array:
    """Return polynomials of time (D, R), the highest power first, at the nodes of intervals and at their ends (K, Q + 1, R)."""
    result = np.empty((starts.size, NODES + 1, coefficients.shape[1]), coefficients.dtype)
    for k in range(starts.size):
        for q in range(NODES + 1):
            t = stops[k] if q == NODES else min(starts[k] + lengths[k] * GAUSS_NODES[q], stops[k])
            for r in range(coefficients.shape[1]):
                value = coefficients[0, r]
                for row in range(1, coefficients.shape[0]):
                    value = value * t + coefficients[row, r]
                result[k, q, r] = value
    return result


PROBES = 129  # times of an interval at which coefficients are compared with their interpolants
_PROBES_OF_PART = 21
_PROBES = np.linspace(0.0, 1.0, PROBES)
RESOLVED_IN_TIME = 1e-8  # relative error of the interpolants of coefficients in time
MOST_PARTS = 16  # in which an interval is cut at a time
_MOST = 600


def interpolation(points: Array) -> Array:
    """Return the matrix from values at the Gauss nodes to values at points in [0, 1]."""
    return np.asarray((2.0 * points[:, None] - 1.0) ** _POWERS @ _COEFFICIENTS)


_POWERS = np.arange(NODES)
_COEFFICIENTS = np.linalg.inv((2.0 * GAUSS_NODES[:, None] - 1.0) ** _POWERS)


@lru_cache(maxsize=16)
def _probes(count: int) -> tuple[Array, Array]:
    points = np.linspace(0.0, 1.0, count)
    return points, interpolation(points)


def probed(starts: Array, stops: Array) -> Array:
    """Return times (K, P) at which coefficients are compared with their interpolants, of which the last are before the ends."""
    return np.asarray(np.clip(starts + (stops - starts) * _PROBES, starts, np.nextafter(stops, starts)))


def parts_needed(exact: Array, nodes: Array) -> Array:
    """Return in how many parts (K,) interpolants of values at nodes (K, Q, ...) agree with probes (K, P, ...), 0 for never."""
    exact, nodes = exact.reshape(*exact.shape[:2], -1), nodes.reshape(*nodes.shape[:2], -1)
    scale = np.maximum(np.abs(exact).max(axis=1), 1e-300)
    rest = np.abs(_TO_PROBES @ nodes - exact).max(axis=1) / scale
    excess = rest.max(axis=1) / RESOLVED_IN_TIME
    if (excess <= 1.0).all():
        return np.ones(len(excess), int)
    more = np.ceil(1.1 * np.nan_to_num(excess) ** (1.0 / len(GAUSS_NODES)))
    return np.where(excess <= 1.0, 1, np.where(np.isfinite(excess), np.clip(more, 2, MOST_PARTS), 0)).astype(int)


_TO_PROBES = interpolation(_PROBES)


class Panels(NamedTuple):
    """The `bounds` of the parts; `error` is the relative error of the integrals that remains where there are too many."""

    bounds: list[tuple[float, float]]
    error: float


def panels(coefficients: Callable[[Array], Array], start: float, stop: float, tolerance: float = RESOLVED_IN_TIME) -> Panels:
    """Return parts of [start, stop] in each of which the polynomial through six Gauss nodes agrees with the coefficients.

    Args:
        coefficients: function of times (T,) that returns (T, C).
        start, stop: the interval.
        tolerance: largest difference, relative to the largest modulus of each coefficient.
    """
    accepted: list[tuple[float, float]] = []
    stack, scale, error = [(start, stop)], np.zeros(1), 0.0
    while stack:
        first, last = stack.pop()
        length = last - first
        share = length / (stop - start)
        points, matrix = _probes(max(_PROBES_OF_PART, 1 + int((PROBES - 1) * 2.0 ** np.round(np.log2(share)))))
        values = coefficients(first + length * points)
        scale = np.maximum(np.maximum(scale, np.abs(values).max(axis=0)), 1e-300)
        rest = np.abs(matrix @ coefficients(first + length * GAUSS_NODES) - values).max(axis=0) / scale
        # What matters is the integral over a part.
        bad = float(rest.max()) * share
        if bad <= tolerance * max(share, 1e-3) or share < 1e-9 or len(accepted) + len(stack) > _MOST:
            if bad > tolerance:
                error += bad
            accepted.append((first, last))
        else:
            middle = first + 0.5 * length
            stack += [(middle, last), (first, middle)]
    return Panels(accepted, error)


_EXACT = 1e-14  # second Legendre coefficient in time, relative to the mean, that is rounding
MOST_MAGNUS = 32  # equal parts of an interval with two averages each
MEAN, EARLY, LATE, DIFFERENCE, SECOND = range(5)  # weights of a part


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
WHOLE = np.ones((1, 5, 1))  # of coefficients that do not depend on time


@helper
def averaged(
    table: Array, c: Coefficients, weights: Array, at: int, spacing: float, closed: bool, fields: tuple[Array, Array, Array]
) -> tuple[float, float, float, float]:
    """Write phi, f and b of an average; return length, int G dt, shift and the constant of b."""
    (phi, drift, b), tau = fields, c.length
    size, fraction, spread, mean, constant = b.size, 0.0, 0.0, 0.0, 0.0
    for j in range(size):
        phi[j], drift[j], b[j] = 0.0, 0.0, 0.0
    for q in range(weights.size):
        fraction += weights[q]
        spread += weights[q] * c.covariances[q] * tau
    for r in range(table.shape[0]):
        weight = 0.0
        for q in range(weights.size):
            weight += weights[q] * c.drifts[q, r]
        if weight != 0.0:
            for j in range(size):
                phi[j] += weight * table[r, CELL, j]
                drift[j] += weight * table[r, DRIFT, j]
                b[j] += weight * table[r, SLOPE, j]
    length = fraction * tau
    G = spread / length
    if closed:
        for j in range(size):
            mean += phi[j] / (2.0 * np.pi * fraction)
    constant -= 0.5 * length * ((drift[at] / fraction - mean) * (drift[at] / fraction + mean) / G + b[at] / fraction)
    own = constant
    for j in range(size):
        drift[j] /= fraction
        phi[j] = (phi[j] / fraction - mean * spacing) / G
        b[j] = -0.5 * length * ((drift[j] - mean) * (drift[j] + mean) / G + b[j] / fraction) - own
    if c.inside:
        for q in range(c.outputs.shape[0]):
            w = fraction if c.outputs.shape[0] == 1 else weights[q]
            h, centre = observation_of(table, c.outputs[q], at)
            constant += exponent_added(h, centre, c.precisions[q], c.observed, w, w * tau, b)
    for j in range(size):
        if not (b[j] > IMPOSSIBLE):
            b[j] = IMPOSSIBLE
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
def _generated(
    u: Array, drift: Array, potential: Array, spread: float, spacing: float, weight: float, closed: bool, to: Array
) -> None:
    """Add the integral of the equation's right-hand side with a weight, by differences of fourth order."""
    size, around, flow = u.size, np.zeros(u.size + 4), np.zeros(u.size + 4)
    for j in range(size):
        around[j + 2], flow[j + 2] = u[j], drift[j] * u[j]
    skipped = 0 if closed else 2  # points at the ends of a line
    if closed:
        for j in range(2):
            around[j], flow[j] = around[size + j], flow[size + j]
            around[size + 2 + j], flow[size + 2 + j] = around[2 + j], flow[2 + j]
    one, two = weight / (12.0 * spacing), 0.5 * weight * spread / (12.0 * spacing * spacing)
    a, b, c, d, e = around[:size], around[1 : size + 1], around[2 : size + 2], around[3 : size + 3], around[4:]
    first, second, fourth, fifth = flow[:size], flow[1 : size + 1], flow[3 : size + 3], flow[4:]
    for j in range(skipped, size - skipped):
        curved = 16.0 * (b[j] + d[j]) - a[j] - e[j] - 30.0 * c[j]
        to[j] += two * curved - one * (8.0 * (fourth[j] - second[j]) - fifth[j] + first[j]) + weight * potential[j] * c[j]


# Which operator (B, D, E) acts on which density, with which weight, and to which density it is added.  From the density 0 they
# make 4 = [B, D] and 5 = [B, [B, E]] = B (B E - 2 E B) + E B B; the first four are those without E.
_PRODUCTS = np.array(
    [
        (0, 0, 1, 1), (1, 0, 1, 2), (0, 2, 1, 4), (1, 1, -1, 4), (2, 0, 1, 3), (0, 3, 1, 6), (2, 1, -2, 6), (0, 6, 1, 5),
        (0, 1, 1, 7), (2, 7, 1, 5),
    ]
)  # fmt: skip


@helper
def operators(table: Array, c: Coefficients, averages: Array, at: int, to: Array, spreads: Array) -> bool:
    """Write f and the potential (3, 2, N), and int G dt (3,), of B, D and E in a part of an interval, see `averaging`.

    Returns whether E is rounding: the coefficients are linear in time.
    """
    tau, linear = c.length, not c.inside or c.outputs.shape[0] == 1
    to[:] = 0.0
    for i in range(3):
        weights, whole = averages[MEAN if i == 0 else (DIFFERENCE if i == 1 else SECOND)], 0.0
        spreads[i] = 0.0
        for q in range(weights.size):
            spreads[i] += tau * weights[q] * c.covariances[q]
            whole += weights[q]
        for r in range(table.shape[0]):
            weight = 0.0
            largest = 0.0
            for q in range(weights.size):
                weight += tau * weights[q] * c.drifts[q, r]
                largest = max(largest, abs(c.drifts[q, r]))
            linear &= i < 2 or abs(weight) <= _EXACT * tau * largest
            if weight != 0.0:
                add(to[i, 0], weight, table[r, DRIFT])
        if c.inside and (i == 0 or c.outputs.shape[0] > 1):
            for q in range(c.outputs.shape[0]):
                w = whole if c.outputs.shape[0] == 1 else weights[q]
                h, centre = observation_of(table, c.outputs[q], at)
                exponent_added(h, centre, c.precisions[q], c.observed, w, w * tau, to[i, 1])
    return linear and abs(spreads[2]) <= _EXACT * spreads[0]


@helper
def averaging(
    values: Array, parts: Array, spreads: Array, linear: bool, spacing: float, closed: bool
) -> tuple[float, float]:
    """Return estimates of the errors of the mean and of two averages in a part of an interval.

    With the integral B of the operator, D the difference of the averages and E the second Legendre coefficient they are
    [B, D] / 4 + [B, [B, E]] / 10, and of fifth order 5 |[B, D] / 4|^(5/3) + [B, [B, E]] / 10.  Of coefficients that are `linear`
    in time E is left out.
    """
    begin, end = 0, values.size
    if not closed:  # where the density counts, and the points of three differences beyond
        begin, end = support(values, 1e-12)
        begin, end = max(begin - 6, 0), min(end + 7, values.size)
    values, size = values[begin:end], end - begin
    result = np.zeros((8, size))
    add(result[0], 1.0, values)
    for i in range(4 if linear else len(_PRODUCTS)):
        operator, of, weight, to = _PRODUCTS[i]
        drift, potential = parts[operator, 0, begin:end], parts[operator, 1, begin:end]
        _generated(result[of], drift, potential, spreads[operator], spacing, float(weight), closed, result[to])
    one, two, mass, limit = 0.0, 0.0, 0.0, 1e-12 * values[highest_of(values)]
    for j in range(size):
        mass += values[j]
        if values[j] > limit:
            one += abs(result[4, j])
            two += abs(result[5, j])
    one, two = 0.25 * one / mass, 0.1 * two / mass
    return one + two, 5.0 * one ** (5.0 / 3.0) + two
