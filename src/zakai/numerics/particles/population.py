"""Weights, resampling, and the families of particles that share an ancestor."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from zakai.numerics.compiled import kernel
from zakai.numerics.particles.formulas import F1, F2

Array = Any
I4 = types.int32[::1]


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


@kernel(types.void(I4, F1, F2, F1, F2, I4))
def merge(parents: Array, mass: Array, sums: Array, older_mass: Array, older_sums: Array, alive: Array) -> None:
    """Add masses (N,) and sums (N, n) of the particles `alive` to their ancestors', and write the ancestors that are alive.

    `alive` begins with the numbers of the particles, up to the first that is negative; `older_mass` (M,) and `older_sums` (M, n)
    are zero for all ancestors before.
    """
    kept = 0
    for place in range(alive.size):
        f = alive[place]
        if f < 0:
            break
        if mass[f] == 0.0:
            continue
        parent = parents[f]
        if older_mass[parent] == 0.0:
            alive[kept] = parent
            kept += 1
        older_mass[parent] += mass[f]
        for d in range(sums.shape[1]):
            older_sums[parent, d] += sums[f, d]
    if kept < alive.size:
        alive[kept] = -1


@kernel(types.UniTuple(types.float64, 2)(I4, F1, F2, F1))
def spread(alive: Array, mass: Array, sums: Array, out: Array) -> tuple[float, float]:
    """Return the sum of squared masses of families and their number, and write the sums (n,) of the squares of their sums."""
    total, count = 0.0, 0.0
    for d in range(out.size):
        out[d] = 0.0
    for place in range(alive.size):
        f = alive[place]
        if f < 0:
            break
        count += 1.0
        total += mass[f] * mass[f]
        for d in range(out.size):
            out[d] += sums[f, d] * sums[f, d]
    return total, count


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
