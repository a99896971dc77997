"""The transition of an interval by the modes of a symmetric operator: v -> after U exp(-time rates) U' v / after."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import float64, void
from numpy.typing import NDArray

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.exponentials import exponentiate
from zakai.numerics.line_density import highest_of

Array = NDArray[Any]
_V = float64[::1]

LOG_NOISE = -33.4  # logarithm of the error of a decomposition relative to the maximum
_SUPPORT = 1e-13  # values relative to the maximum beyond which a density counts as ended
_NEGLIGIBLE = 42.0  # -log of the factor of a mode that is negligible
_SPREAD = 0.01  # of the value at an abrupt end that the interpolant spreads to the middle of the grid


@helper
def decayed(rates: Array, time: float) -> Array:
    """Return exp(-time rates) of the modes that are not negligible; the rates increase."""
    count = 1
    while count < rates.size and time * (rates[count] - rates[0]) < _NEGLIGIBLE:
        count += 1
    decay = np.empty(count)
    for n in range(count):
        decay[n] = -time * rates[n]
    exponentiate(decay)
    return decay


@kernel(void(_V, _V, _V), reordered=True)
def propagate(modes: Array, decay: Array, values: Array) -> None:
    """Replace values (N,) by U decay U' of them, with the rows of U' one after the other (N^2,) and the decay of the first M."""
    size = values.size
    found = np.zeros(size)
    for n in range(decay.size):
        row, coefficient = modes[n * size : (n + 1) * size], 0.0
        for j in range(size):
            coefficient += row[j] * values[j]
        coefficient *= decay[n]
        for j in range(size):
            found[j] += coefficient * row[j]
    for j in range(size):
        values[j] = found[j]


@helper
def decomposed(
    now: Array, phi: Array, modes: Array, decay: Array, most: float, closed: bool
) -> float:
    """Replace a density by that after an interval, after = exp(phi); return the relative error.

    It is that of rounding, and of values that end abruptly after division by the gauge, which the interpolant spreads over the
    grid; infinite where beyond the support it might exceed `most`.

    Args:
        now: the density (N,).
        phi: the logarithm of the gauge (N,).
        modes: the rows of U' one after the other (N^2,).
        decay: exp(-time rates) (M,) of the modes that are not negligible.
        most: the largest error.
        closed: whether the grid goes around the circle.
    """
    at = highest_of(now)
    reach, top, highest, end, limit = 0.0, 0.0, 0.0, 0.0, _SUPPORT * now[at]
    after, inner = np.empty(now.size), np.empty(now.size)
    for j in range(now.size):
        after[j] = phi[j] - phi[at]
    exponentiate(after)
    for j in range(now.size):
        inner[j] = now[j] / after[j]
        reach += inner[j] * inner[j]
        if not closed and (now[j] <= limit or j < 2 or j >= now.size - 2):
            end = max(end, inner[j])
    propagate(modes, decay, inner)
    # Beyond the support there is only rounding, which must not be amplified.
    noise = 4e-16 * np.sqrt(reach)
    left, right = 0, now.size - 1
    while left < right and not inner[left] > noise:
        now[left] = 0.0
        left += 1
    while right > left and not inner[right] > noise:
        now[right] = 0.0
        right -= 1
    for j in range(left, right + 1):
        now[j] = after[j] * inner[j]
        top = max(top, now[j])
        highest = max(highest, after[j])
    outside = max(after[0], after[now.size - 1])
    if not (top > 0.0 and noise * outside < most * top):
        return np.inf
    error: float = (noise + _SPREAD * end) * highest / top
    return error
