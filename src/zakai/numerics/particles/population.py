"""Weights, resampling, and the families of particles that share an ancestor."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import types

from zakai.numerics.compiled import kernel
from zakai.numerics.particles.formulas import F1, F2, F3

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


@kernel(types.void(I4, I8, F1, F2, F1, F2, F1, F1))
def lineage(parents: Array, sizes: Array, weights: Array, deviations: Array, rounding: Array, means: Array, evidence: Array,
            families: Array) -> None:  # fmt: skip
    """Write the variances of means (lags, n) and of the log evidence (lags,), and the number of families, by generation.

    Args:
        parents: the ancestors of one generation after the other, newest first.
        sizes: the particles now, then those of each earlier generation (lags,).
        weights: of the particles (N,).
        deviations: of the particles from their mean (n, N).
        rounding: what resampling adds to the spread of the masses until each generation (lags,).
        means: receives the variances of the means.
        evidence: receives those of the log evidence.
        families: receives the numbers of families.
    """
    n, most, first = deviations.shape[0], sizes.max(), 0
    mass, sums = weights.copy(), np.empty((most, n))
    older_mass, older_sums = np.empty(most), np.empty((most, n))
    alive, count = np.empty(weights.size, np.int32), 0
    for i in range(weights.size):
        if weights[i] > 0.0:
            alive[count] = i
            count += 1
        for d in range(n):
            sums[i, d] = weights[i] * deviations[d, i]
    for lag in range(sizes.size):
        if lag:
            kept = 0
            for place in range(count):
                older_mass[parents[first + alive[place]]] = 0.0
            for place in range(count):
                f = alive[place]
                parent = parents[first + f]
                if older_mass[parent] == 0.0:
                    alive[kept] = parent
                    kept += 1
                    for d in range(n):
                        older_sums[parent, d] = 0.0
                older_mass[parent] += mass[f]
                for d in range(n):
                    older_sums[parent, d] += sums[f, d]
            first += sizes[lag - 1]
            count = kept
            mass, older_mass = older_mass, mass
            sums, older_sums = older_sums, sums
            if older_mass.size < most:
                older_mass = np.empty(most)
        square, factor = 0.0, sizes[lag] / max(sizes[lag] - 1, 1)
        for d in range(n):
            means[lag, d] = 0.0
        for place in range(count):
            f = alive[place]
            square += mass[f] * mass[f]
            for d in range(n):
                means[lag, d] += factor * sums[f, d] * sums[f, d]
        evidence[lag] = square - 1.0 / sizes[lag] - rounding[lag]
        families[lag] = count


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
