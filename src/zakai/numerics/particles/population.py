"""Weights, resampling, moments, and the sums of groups of particles."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import types

from zakai.numerics.compiled import kernel
from zakai.numerics.formula_kernel import BLOCK
from zakai.numerics.particles.elementary import sin_row
from zakai.numerics.particles.formulas import F1, F2, F3
from zakai.numerics.particles.noise import root_of

Array = Any
_NEGLIGIBLE = 40.0  # of the logarithm of a weight, below the largest
I4, I8 = types.int32[::1], types.int64[::1]


@kernel(types.void(F1, types.float64, I4))
def systematic(weights: Array, offset: float, out: Array) -> None:
    """Write the ancestors (M,) of M particles by systematic resampling; the weights (N,) sum to one, `offset` is in (0, 1)."""
    count, total, j = out.size, 0.0, 0
    for i in range(weights.size):
        total += weights[i]
        while j < count and (j + offset) / count < total:
            out[j] = i
            j += 1
    while j < count:
        out[j] = weights.size - 1
        j += 1


@kernel(types.void(F2, F1, types.boolean[::1], F1))
def mean_directions(x: Array, weights: Array, angles: Array, mean: Array) -> None:
    """Write the mean directions of those rows of weighted particles (n, N) that are angles; zero where there is none."""
    n, count = x.shape
    sines, cosines = np.empty(BLOCK), np.empty(BLOCK)
    for d in range(n):
        if not angles[d]:
            continue
        along, across = 0.0, 0.0
        for first in range(0, count, BLOCK):
            size = min(BLOCK, count - first)
            sin_row(x[d, first : first + size], 0, sines[:size])
            sin_row(x[d, first : first + size], 1, cosines[:size])
            for i in range(size):
                across += weights[first + i] * sines[i]
                along += weights[first + i] * cosines[i]
        mean[d] = math.atan2(across, along) if math.hypot(along, across) >= 1e-9 else 0.0


@kernel(types.void(F2, F1, types.boolean[::1], F1, F2, F2), reordered=True)
def moments(x: Array, weights: Array, angles: Array, mean: Array, deviations: Array, cov: Array) -> None:
    """Write the mean (n,), the deviations from it (n, N) and the covariance (n, n) of weighted particles (n, N).

    Those of angles are in [-pi, pi), and `mean` holds their mean directions.  No row of elementary functions is computed here:
    these need the order of their sums.
    """
    n, count = x.shape
    other = np.empty((n, BLOCK))
    for d in range(n):
        if angles[d]:
            continue
        total = 0.0
        for i in range(count):
            total += weights[i] * x[d, i]
        mean[d] = total
    cov[:] = 0.0
    for first in range(0, count, BLOCK):
        size = min(BLOCK, count - first)
        for d in range(n):
            for i in range(size):
                deviations[d, first + i] = x[d, first + i] - mean[d]
            if angles[d]:
                for i in range(size):
                    apart = deviations[d, first + i]
                    deviations[d, first + i] = apart - 2.0 * math.pi * np.floor(apart / (2.0 * math.pi) + 0.5)
            for i in range(size):
                other[d, i] = weights[first + i] * deviations[d, first + i]
        for d in range(n):
            for e in range(d + 1):
                total = 0.0
                for i in range(size):
                    total += other[d, i] * deviations[e, first + i]
                cov[d, e] += total
    for d in range(n):
        for e in range(d):
            cov[e, d] = cov[d, e]


class Sums(NamedTuple):
    """The sums of weights (R,), of weighted deviations and of their squares (R, n) of the particles of each island.

    `independent` (n,) are the variances of the means of independent particles with these weights.
    """

    masses: Array
    deviations: Array
    squares: Array
    independent: Array


@kernel(types.void(I8, F1, F2, types.NamedTuple((F1, F2, F2, F1), Sums)), reordered=True)
def sums_of_islands(bounds: Array, weights: Array, deviations: Array, out: Any) -> None:
    """Write the sums over the particles of each island, from one of the bounds (R + 1,) to the next."""
    masses, sums, squares, independent = out
    n, count = deviations.shape
    for d in range(n):
        independent[d] = 0.0
    for island in range(bounds.size - 1):
        masses[island] = 0.0
        for i in range(bounds[island], bounds[island + 1]):
            masses[island] += weights[i]
        for d in range(n):
            total, square, wide = 0.0, 0.0, 0.0
            for i in range(bounds[island], bounds[island + 1]):
                part = weights[i] * deviations[d, i]
                total += part
                square += part * part
                wide += part * deviations[d, i]
            sums[island, d], squares[island, d] = total, wide
            independent[d] += square
    for d in range(n):
        independent[d] *= count / max(count - 1, 1)


@kernel(types.void(F2, F2, F2))
def carry(across: Array, cov: Array, T: Array) -> None:
    """Write T = across cov^-1 (n, n), in the directions in which particles differ.

    cov^-1 is that of the rows and columns of the pivots of Cholesky's factor, and zero elsewhere.
    """
    n = cov.shape[0]
    R, solved = np.empty((n, n)), np.empty(n)
    pivots = np.empty(n, np.int64)
    rank = root_of(cov, R, pivots)
    T[:] = 0.0
    for row in range(n):
        for k in range(rank):
            total = across[row, pivots[k]]
            for j in range(k):
                total -= R[pivots[k], j] * solved[j]
            solved[k] = total / R[pivots[k], k]
        for k in range(rank - 1, -1, -1):
            total = solved[k]
            for j in range(k + 1, rank):
                total -= R[pivots[j], k] * T[row, pivots[j]]
            T[row, pivots[k]] = total / R[pivots[k], k]


class Candidates(NamedTuple):
    """What a later state may come from: N particles, and its own past.

    `centres` (n, N), `whiten` (N or 1, n, n), the inverses of Cholesky's factors of the covariances, `logs` (N,), which contain
    their determinants where these differ, `own` (M,), the logarithms of the weight of the own past of each later state, and
    `period` (n,), that of an angle, else zero.
    """

    centres: Array
    whiten: Array
    logs: Array
    own: Array
    period: Array


@kernel(types.void(F2, types.NamedTuple((F2, F3, F1, F1, F1), Candidates), F1, I4))
def backward_draws(later: Array, candidates: Any, uniforms: Array, out: Array) -> None:
    """Write for each later state (n, M) one of N candidates, drawn with the weights exp(logs) N(later; centre, covariance).

    -1 stands for its own past.
    """
    centres, whiten, logs, own, period = candidates
    n, count = centres.shape
    single = whiten.shape[0] == 1
    found, d = np.empty(count), np.empty(n)
    for j in range(later.shape[1]):
        top = own[j]
        for i in range(count):
            value = logs[i]
            for a in range(n):
                if value < top - _NEGLIGIBLE:
                    break
                d[a] = later[a, j] - centres[a, i]
                if period[a] > 0.0:
                    d[a] -= period[a] * np.floor(d[a] / period[a] + 0.5)
                w = 0.0
                for b in range(a + 1):
                    w += whiten[0 if single else i, a, b] * d[b]
                value -= 0.5 * w * w
            found[i] = value
            top = max(top, value)
        total = mine = np.exp(own[j] - top) if top > -np.inf else 0.0
        for i in range(count):
            apart = found[i] - top if top > -np.inf else 0.0
            found[i] = np.exp(apart) if apart > -_NEGLIGIBLE else 0.0
            total += found[i]
        rest, place = uniforms[j] * total - mine, count - 1
        if rest <= 0.0 and mine > 0.0:
            out[j] = -1
            continue
        for i in range(count):
            rest -= found[i]
            if rest <= 0.0:
                place = i
                break
        out[j] = place


def normalised(logs: Array) -> tuple[Array, float]:
    """Return weights that sum to one, and the logarithm of the sum of exp(logs); -inf and equal weights where it is zero."""
    top = float(np.max(logs))
    if not np.isfinite(top):
        return np.full(len(logs), 1.0 / len(logs)), -np.inf
    weights = np.exp(logs - top)
    total = float(weights.sum())
    weights /= total
    return weights, top + float(np.log(total))


def effective(weights: Array) -> float:
    """Return the effective sample size 1 / sum w^2."""
    return 1.0 / float(weights @ weights)


def next_power(before: Array, logs: Array, wanted: float, low: float) -> float:
    """Return the largest power in (low, 1] for which weights exp(before + (power - low) logs) keep an effective size."""
    if effective(normalised(before + (1.0 - low) * logs)[0]) >= wanted:
        return 1.0
    left, right = low, 1.0
    for _ in range(30):
        middle = 0.5 * (left + right)
        enough = effective(normalised(before + (middle - low) * logs)[0]) >= wanted
        left, right = (middle, right) if enough else (left, middle)
    return max(left, low + 1e-6)
