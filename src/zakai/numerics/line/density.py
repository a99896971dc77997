"""Figures of a density on a uniform grid: moments, support, modes and spectrum, in compiled code."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import boolean, float64, int64, types

from zakai.numerics.arrays import Array
from zakai.numerics.compiled import helper, kernel

_F = float64


@helper
def moments(values: Array) -> tuple[float, float, float]:
    """Return the sum of values, and their mean and variance as an index from the middle."""
    mass, mean, square = 0.0, 0.0, 0.0
    half = values.size // 2
    for j in range(values.size):
        mass += values[j]
        mean += (j - half) * values[j]
    mean /= mass
    for j in range(values.size):
        square += (j - half - mean) ** 2 * values[j]
    return mass, mean, square / mass


@kernel(types.UniTuple(_F, 2)(_F[::1], _F[:, ::1], _F[:, ::1]), reordered=True)  # type: ignore[no-untyped-call]
def circular_moments(values: Array, cosines: Array, sines: Array) -> tuple[float, float]:
    """Return the argument of E exp(i x) as an index from the middle, and the variance in squares of the spacing.

    The square of a wrapped deviation d is pi^2 / 3 + 4 sum (-1)^k cos(k d) / k^2.
    """
    size = values.size
    spacing, mass, mean, variance = 2.0 * np.pi / size, 0.0, 0.0, np.pi**2 / 3.0
    for j in range(size):
        mass += values[j]
    for k in range(1, size // 2):
        real, imag = 0.0, 0.0
        for j in range(size):
            real += cosines[k, j] * values[j]
            imag += sines[k, j] * values[j]
        real, imag = real / mass, imag / mass
        # The grid begins at -pi: cos(k x_j) = (-1)^k cos(2 pi k j / size).
        if k == 1 and real * real + imag * imag > 1e-18:
            mean = np.arctan2(-imag, -real)
        variance += 4.0 / k**2 * (np.cos(k * mean) * real + np.sin(k * mean) * imag)
    return mean / spacing, variance / spacing**2


def circular_rows(densities: Array, cosines: Array, sines: Array, reports: Array) -> None:
    """Write the `circular_moments` of densities (K, N) into the columns 1 and 2 of their reports."""
    for density, row in zip(densities, reports, strict=False):
        row[1], row[2] = circular_moments(density, cosines, sines)


@helper
def highest_of(values: Array) -> int:
    """Return the first index of the largest of values."""
    at = 0
    for j in range(values.size):
        if values[j] > values[at]:
            at = j
    return at


@helper
def shifted(values: Array, by: int) -> Array:
    """Return values on a grid of the same size that begins `by` points later, zero where there are none."""
    result = np.zeros(values.size)
    for j in range(max(0, by), min(values.size, by + values.size)):
        result[j - by] = values[j]
    return result


@kernel(types.UniTuple(int64, 2)(float64[::1], float64))  # type: ignore[no-untyped-call]
def support(values: Array, cut: float) -> tuple[int, int]:
    """Return the first and last index of values above `cut` times their maximum."""
    bound = cut * max(values[highest_of(values)], 0.0)
    first, last = 0, values.size - 1
    while first < last and not values[first] > bound:
        first += 1
    while last > first and not values[last] > bound:
        last -= 1
    return first, last


@kernel(boolean(float64[::1]))
def separated(values: Array) -> bool:
    """Return whether a density has modes apart from each other, whose weights keep their errors."""
    peak, valley, least = 0.0, np.inf, 1e-4 * max(values[highest_of(values)], 0.0)
    for j in range(values.size):
        valley = min(valley, values[j])
        if peak > least and values[j] > least and min(peak, values[j]) > 3.0 * valley:
            return True
        if values[j] > peak:
            peak, valley = values[j], values[j]
    return False


@lru_cache(maxsize=16)
def waves(size: int) -> tuple[Array, Array]:
    """Return cos(2 pi k i / size) and the sines (size // 2 + 1, size)."""
    turns, angle = np.outer(np.arange(size // 2 + 1), np.arange(size)) % size, 2.0 * np.pi / size * np.arange(size)
    return np.cos(angle)[turns], np.sin(angle)[turns]


def spectrum_of_many(values: Array, cut: float, negligible: float) -> tuple[float, ...]:
    """Return the figures of `spectrum` of a large grid, from all frequencies, by the fast Fourier transform."""
    nyquist, top, total, mass = len(values) // 2, max(values.max(), 0.0), np.abs(values).sum(), values.sum()
    result = np.abs(np.fft.rfft(values)) / (abs(mass) or np.inf)
    aliasing, middle = result[nyquist * 7 // 8 :].max(), result[nyquist * 5 // 8 : nyquist * 3 // 4].max()
    counting = np.flatnonzero(result[: nyquist * 7 // 8] > (negligible if aliasing <= negligible else 4.0 * aliasing))
    used = np.flatnonzero(values > (max(cut, min(aliasing, 1e-4)) if cut >= 1e-14 else cut) * top)
    first, last = used[[0, -1]] if len(used) else [len(values) - 1] * 2
    left, right = (np.max(np.abs(ends)) / (top or np.inf) for ends in (values[:2], values[-2:]))
    negative = 0.5 * (total - mass) / (total or np.inf)
    if not total < np.inf:
        aliasing = middle = np.inf
    highest = counting[-1] if len(counting) else 0
    return left, right, float(first), float(last), negative, aliasing, middle, float(highest), float(nyquist)


@kernel(types.UniTuple(_F, 9)(_F[::1], _F, _F, _F[:, ::1], _F[:, ::1], boolean), reordered=True)  # type: ignore[no-untyped-call]
def spectrum(values: Array, cut: float, negligible: float, cosines: Array, sines: Array, search: bool) -> tuple[float, ...]:
    """Return figures of the ends and of the spectrum of values (N,), N > 2; of a large grid few frequencies are computed.

    Args:
        values: (N,).
        cut: the smallest value that counts, relative to the largest.
        negligible: the modulus of a frequency that does not count, relative to the mass.
        cosines, sines: `waves` of N.
        search: whether the highest frequency that is not negligible is found.

    Returns:
        The largest moduli of the two outermost points on the left and on the right, relative to the maximum; the first and last
        point above `cut` times the maximum; the negative share of the mass; relative to the mass, the largest spectrum in the
        highest eighth of the frequencies, and around eleven sixteenths of the highest; the highest frequency that is not
        negligible, or a bound of it, and the number of frequencies.
    """
    size = values.shape[0]
    nyquist = size // 2
    top, total, mass = 0.0, 0.0, 0.0
    for i in range(size):
        top = max(top, values[i])
        total += abs(values[i])
        mass += values[i]
    # The even part at 0 .. N / 2, and the odd part.
    even, odd = np.zeros(nyquist + 1), np.zeros(nyquist + 1)
    even[0] = values[0]
    for i in range(1, nyquist + 1):
        mirrored = values[size - i] if 2 * i < size else 0.0
        even[i], odd[i] = values[i] + mirrored, values[i] - mirrored
    scale = 1.0 / abs(mass) if mass != 0.0 else 0.0
    aliasing, middle, highest = 0.0, 0.0, -1
    stride = max(1, nyquist // 32)
    k, top_known = nyquist, False
    while k > 0:
        in_top = k >= nyquist * 7 // 8
        in_middle = nyquist * 5 // 8 <= k < nyquist * 3 // 4
        if in_top or in_middle or (search and highest < 0):
            if not in_top and not top_known:
                top_known = True
                if aliasing > negligible:
                    # Above, nothing can be resolved: what counts is noise or too much for this grid.
                    negligible = 4.0 * aliasing
            real, imag = 0.0, 0.0
            for i in range(nyquist + 1):
                real += cosines[k, i] * even[i]
                imag += sines[k, i] * odd[i]
            size_here = scale * np.sqrt(real * real + imag * imag)
            if in_top:
                aliasing = max(aliasing, size_here)
            elif in_middle:
                middle = max(middle, size_here)
            if highest < 0 and size_here > negligible and not in_top:
                highest = k + stride - 1
        elif k < nyquist * 5 // 8:
            break
        k -= stride
    if highest < 0:
        highest = nyquist if aliasing > negligible else stride - 1
    if cut >= 1e-14:  # smaller values are accurate
        cut = max(cut, min(aliasing, 1e-4))
    first, last = 0, size - 1
    while first < size - 1 and not values[first] > cut * top:
        first += 1
    while last > first and not values[last] > cut * top:
        last -= 1
    inverse = 1.0 / top if top > 0 else 0.0
    left = max(abs(values[0]), abs(values[1])) * inverse
    right = max(abs(values[size - 1]), abs(values[size - 2])) * inverse
    negative = 0.5 * (total - mass) / total if total > 0 else 0.0
    if not (total < np.inf):
        aliasing = middle = np.inf
    return left, right, float(first), float(last), negative, aliasing, middle, float(highest), float(nyquist)
