"""The parts of one step besides the transition: the grid that it needs, the check of the prediction, and a sample.

A sample multiplies the density, v -> v exp(b), b = h'S^-1 (y - h / 2).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.compiled import helper
from zakai.numerics.exponentials import exponentiate
from zakai.numerics.line.averages import IMPOSSIBLE
from zakai.numerics.line.density import spectrum
from zakai.numerics.line.outlook import FAR
from zakai.numerics.line.place import log_likelihood
from zakai.numerics.line.segment import FAILED, OK, RANGE
from zakai.numerics.line.terms import DRIFT, exponent_added

Array = NDArray[Any]

_OVERFLOW = 690.0
_LEAST = 1e-280  # value of a density where its product with a likelihood is largest
_MOST_GROWTH = 1e80


@helper
def extent(
    now: Array, low: int, high: int, channel: Array, drifts: Array, table: Array, spread: float, tau: float, middle: float,
    spacing: float, cut: float,
) -> tuple[float, float]:  # fmt: skip
    """Return the range of points that a density occupies until it is after the transition, as if it were Gaussian.

    It is NaN where the density moves so far that the grid should move with it.
    """
    half, by = now.size // 2, 0.0
    left, right = float(low - half), float(high - half)
    if np.isnan(channel[0]):
        down, up = 0.0, 0.0
        for r in range(drifts.size):
            down, up = down + drifts[r] * table[r, DRIFT, low], up + drifts[r] * table[r, DRIFT, high]
        by = min(abs(down), abs(up)) * tau / spacing if down * up > 0.0 else 0.0
        left, right = left + min(down * tau / spacing, 0.0), right + max(up * tau / spacing, 0.0)
    else:
        shift, spread = (channel[1] + (channel[0] - 1.0) * middle) / spacing, channel[2]
        left, right = channel[0] * left + shift, channel[0] * right + shift
    centre, width = 0.5 * (left + right), 0.5 * abs(right - left)
    width = np.sqrt(width * width - 2.0 * np.log(cut) * spread / spacing**2) + 2.0
    if by > FAR * (high - low + 2.0 * (width - 0.5 * (right - left))):
        return np.nan, np.nan
    return min(centre - width + half, float(low)), max(centre + width + half, float(high))


@helper
def checked(
    now: Array, low: int, high: int, weak: bool, positive: bool, closed: bool, search: bool, cut: float,
    negligible: float, spacing: float, cosines: Array, sines: Array, answer: Array,
) -> tuple[int, float, float, float, float, float]:  # fmt: skip
    """Normalise a prediction that is accurate; return OK, its mass, aliasing, mass at the ends, negative mass, highest frequency.

    The frequency is found with `search`.  `answer` receives the support; where another grid is needed, its range in points and
    its spacing.
    """
    size = now.size
    left, right, first, last, negative, aliasing, middle, highest, _ = spectrum(now, cut, negligible, cosines, sines, search)
    bound = max(100.0 * cut, 0.0 if positive else 4.0 * aliasing)
    edge = 0.0 if closed else max(left, right)
    if not positive:  # what is outside of the band is filtered too
        aliasing = max(aliasing, middle)
    answer[0], answer[1], answer[2] = float(low), float(high), 0.7 * spacing
    status, mass = OK, 0.0
    if not (aliasing <= 30.0 * negligible):
        status = RANGE if not weak and aliasing < np.inf else FAILED
    elif not (edge <= bound):
        status = RANGE if edge < np.inf else FAILED
        answer[0] = min(low, (0 if left > bound else low) - size // 3 * (left > bound))
        answer[1] = max(high, (size if right > bound else high) + size // 3 * (right > bound))
        answer[2] = spacing
    else:
        for j in range(size):
            now[j] = max(now[j], 0.0)
            mass += now[j]
        if not (1e-200 < mass < 1e200):
            status = FAILED
        for j in range(size):
            now[j] /= mass
        answer[0], answer[1] = first, last
    return status, mass, aliasing, edge, negative, highest


@helper
def copied(table: Array, start: int, to: Array) -> None:
    """Copy the columns of terms (R, 4 + m, T) from `start` on."""
    for r in range(to.shape[0]):
        for i in range(to.shape[1]):
            for j in range(to.shape[2]):
                to[r, i, j] = table[r, i, start + j]


@helper
def likelihood(h: Array, centre: Array, precision: Array, observed: Array, b: Array) -> float:
    """Write the logarithm b of the likelihood relative to where h is `centre` (m,); return it there, without its constant."""
    for j in range(b.size):
        b[j] = 0.0
    exponent_added(h, centre, precision, observed, 1.0, 1.0, b)
    return log_likelihood(centre, False, precision, observed)


@helper
def product(now: Array, b: Array) -> tuple[float, float, float]:
    """Replace probabilities by their normalised product with exp(b).

    Returns:
        The logarithm of the sum, which is NaN where the product almost vanishes; by how much errors relative to the maximum
        grow; and the depth of the product below the maximum of the density, in nats.
    """
    largest, top, best, total, growth, depth = 0.0, 0, -np.inf, 0.0, 0.0, 0.0
    logs = np.empty(now.size)
    for j in range(now.size):
        if not (b[j] > IMPOSSIBLE):
            b[j] = IMPOSSIBLE
        largest = max(largest, now[j])
        logs[j] = np.log(now[j]) if now[j] > 0 else -np.inf
        if logs[j] + b[j] > best:
            best, top = logs[j] + b[j], j
    if not (best < np.inf and now[top] > _LEAST):
        return np.nan, growth, depth
    reference, scale, factors = np.log(largest), 1.0 / now[top], np.empty(now.size)
    for j in range(now.size):
        factors[j] = min(b[j] - b[top], _OVERFLOW)
    exponentiate(factors)
    for j in range(now.size):
        growth += factors[j]
        now[j] = now[j] * scale * factors[j] if b[j] - b[top] < _OVERFLOW else np.exp(logs[j] + b[j] - best)
        total += now[j]
    for j in range(now.size):
        now[j] /= total
        if now[j] > 0:
            depth += now[j] * (reference - logs[j])
    return np.log(total) + best, min(growth / total * largest * scale, _MOST_GROWTH), depth
