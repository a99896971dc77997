"""A sample multiplies a density on a grid: v -> v exp(b), b = h'S^-1 (y - h / 2)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.compiled import helper
from zakai.numerics.line_terms import exponent_added

Array = NDArray[Any]

_IMPOSSIBLE = -1e8  # logarithm of a likelihood where a formula has no value


@helper
def likelihood(h: Array, centre: Array, precision: Array, observed: Array, b: Array) -> float:
    """Write the logarithm b of the likelihood relative to where h is `centre` (m,); return it there, without its constant."""
    gained = 0.0
    for j in range(b.size):
        b[j] = 0.0
    exponent_added(h, centre, precision, observed, 1.0, 1.0, b)
    for i in range(observed.size):
        for l in range(observed.size):
            if precision[i, l] != 0.0:
                gained -= 0.5 * (observed[i] - centre[i]) * precision[i, l] * (observed[l] - centre[l])
    return gained


@helper
def product(now: Array, b: Array) -> tuple[float, float, float]:
    """Replace probabilities by their normalised product with exp(b).

    Returns:
        The logarithm of the sum, which is NaN where the product vanishes; by how much errors relative to the maximum grow; and
        the depth of the product below the maximum of the density, in nats.
    """
    largest, best, total, growth, depth = 0.0, -np.inf, 0.0, 0.0, 0.0
    logs = np.empty(now.size)
    for j in range(now.size):
        if not (b[j] > _IMPOSSIBLE):
            b[j] = _IMPOSSIBLE
        largest = max(largest, now[j])
        logs[j] = np.log(now[j]) if now[j] > 0 else -np.inf
        best = max(best, logs[j] + b[j])
    for j in range(now.size):
        now[j] = np.exp(logs[j] + b[j] - best)
        total += now[j]
    if not (-np.inf < best < np.inf and total > 0):
        return np.nan, growth, depth
    reference = np.log(largest)
    for j in range(now.size):
        growth += np.exp(min(b[j] + reference - best - np.log(total), 200.0))
        now[j] /= total
        if now[j] > 0:
            depth += now[j] * (reference - logs[j])
    return np.log(total) + best, growth, depth
