"""The transition of an interval by the modes of a symmetric operator: v -> after U exp(-time rates) U' v / after."""

from __future__ import annotations

from math import erfc
from typing import Any

import numpy as np
from numba import float64, void
from numpy.typing import NDArray

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.exponentials import exponentiate
from zakai.numerics.line.density import highest_of
from zakai.numerics.line.place import PER, weigh, weighed
from zakai.numerics.line.window import CUT

Array = NDArray[Any]
_V = float64[::1]

LOG_NOISE = -33.4  # logarithm of the error of a decomposition relative to the maximum
_NEGLIGIBLE = 42.0  # -log of the factor of a mode that is negligible
_SPREAD = 0.01  # of the value at an abrupt end that the interpolant spreads to the middle of the grid
_FALL = 4.2  # half of the range of erfc(y) / 2 from one to zero


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
def unresolved(values: Array, cosines: Array, sines: Array) -> float:
    """Return the largest spectrum of values in the highest eighth of the frequencies, relative to the mass."""
    size, mass, found = values.size, 0.0, 0.0
    for j in range(size):
        mass += values[j]
    for k in range(size // 2, 7 * (size // 2) // 8 - 1, -max(1, size // 64)):
        real, imag, at = 0.0, 0.0, 0
        for j in range(size):
            real, imag = real + cosines[at] * values[j], imag + sines[at] * values[j]
            at += k
            at -= size if at >= size else 0
        found = max(found, real * real + imag * imag)
    return np.sqrt(found) / abs(mass)


@helper
def gathered(values: Array, at: Array, found: Array) -> None:
    """Write the values at indices of a grid times the matrix of interpolation from its points (N,)."""
    for j in range(found.size):
        found[j] = 0.0
    for i in range(values.size):
        near = np.floor(at[i] + 0.5)
        part = np.sin(np.pi * (at[i] - near)) / np.pi * values[i]
        if abs(at[i] - near) < 1e-12:
            if 0 <= near < found.size:
                found[int(near)] += values[i] * (1.0 if near % 2 == 0 else -1.0)
            continue
        part = part if near % 2 == 0 else -part
        for j in range(found.size):
            found[j] += part / (at[i] - j)
    for j in range(1, found.size, 2):
        found[j] = -found[j]


@helper
def carried(
    now: Array, at: Array, same: bool, closed: bool, scale: Array, modes: Array, rates: Array, tau: float, first: int, last: int,
    most: float, moved: Array,
) -> tuple[float, float]:  # fmt: skip
    """Write the density (N,) of the grid of the modes after an interval; return its rounding error and that of the scale.

    The rounding error is infinite where beyond the support it might exceed `most`.

    Args:
        now: the density (n,) before.
        at: its points as indices of the grid of the modes.
        same: whether these are the points of the grid of the modes.
        closed: whether the grid goes around the circle.
        scale: log s (T,) at the points of rows.
        modes, rates: the rows of U' and lambda.
        tau: the length of the interval.
        first, last: the points between which the density is kept.
        most: the largest error.
        moved: receives the density.
    """
    size, top, weights = moved.size, highest_of(now), np.empty(8)
    inner, logs, after, unsure, total, end = np.zeros(now.size), np.zeros(now.size), np.empty(size), 0.0, 0.0, 0.0
    limit, reference = CUT * now[top], scale[PER * top] if same else 0.0
    if not same:
        reference = weighed(scale, weigh(at[top] * PER, scale.size, 1, weights), 1, weights)
    for j in range(size):
        after[j] = scale[PER * j] - reference
    exponentiate(after)
    if same:
        coefficients = inner
        for j in range(size):
            inner[j] = now[j] / after[j]
            if not closed and (now[j] <= limit or j < 2 or j >= size - 2):  # abrupt ends, which the interpolant spreads
                end = max(end, inner[j])
    else:
        coefficients = np.empty(size)
        for i in range(now.size):
            if now[i] > limit:
                own = weighed(scale, weigh(at[i] * PER, scale.size, 1, weights), 1, weights)
                rough = weighed(scale, weigh(at[i] * PER, scale.size, 2, weights), 2, weights)
                logs[i], unsure, total = reference - own, unsure + now[i] * abs(own - rough), total + now[i]
        exponentiate(logs)
        for i in range(now.size):
            inner[i] = now[i] * logs[i] if now[i] > limit else 0.0
        unsure /= total
        gathered(inner, at, coefficients)
        for j in range(first):  # the waves that R' leaves everywhere; where they end abruptly, the derivatives spread that
            fall = 0.5 * erfc(_FALL * (2.0 * (first - j) / first - 1.0))
            coefficients[j] *= fall
            coefficients[size - 1 - j] *= fall
    decay = decayed(rates, tau)
    square = 0.0
    for j in range(size):
        square += coefficients[j] * coefficients[j]
    noise = 4e-16 * np.sqrt(square) * max(1.0, decay[0])
    propagate(modes, decay, coefficients)
    # Beyond the support there is only rounding, which must not be amplified.
    outside, highest, largest = max(after[first], after[last]), 0.0, 0.0
    while first < last and not coefficients[first] > noise:
        first += 1
    while last > first and not coefficients[last] > noise:
        last -= 1
    for j in range(size):
        moved[j] = after[j] * coefficients[j] if first <= j <= last else 0.0
        if first <= j <= last:
            highest, largest = max(highest, after[j]), max(largest, moved[j])
    if not (largest > 0.0 and noise * outside < most * largest):
        return np.inf, unsure
    return (noise + _SPREAD * end) * highest / largest, unsure
