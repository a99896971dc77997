"""Transitions of one interval on one grid: filters, and the decomposition of a symmetric operator.

A transition is v -> after K before v.  A Gaussian kernel exp(k0 + k1 y + k2 y^2) N(x; a y + b, V) takes this form on one grid
for x and y, because x y = (x^2 + y^2 - (x - y)^2) / 2: K is the convolution with a Gaussian of the variance V / a, and before
and after are exponentials of quadratic polynomials.  Where V / a is large enough in spacings, K is a filter of positive numbers,
which is accurate relative to every value, far into the tails.  Else K is a filter that is exact for band-limited densities, which
is accurate relative to the maximum, as is K = U exp(-time rates) U' where the operator has a decomposition.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import boolean, float64, int64, types
from numpy.typing import NDArray
from scipy.special import erfc

from zakai.numerics.compiled import helper, kernel

Array = NDArray[Any]

WIDE = 1.96  # variance of a kernel, in squares of the spacing, from which its samples are a filter
BAND = 0.625  # part of the frequencies of a grid for which the filters of narrow kernels are exact
_SUPPORT = 1e-13  # values relative to the maximum beyond which a density counts as ended
_SPREAD = 0.01  # of the value at an abrupt end that the interpolant spreads to the middle of the grid
_NODES = 128  # of the periodic transfer function of a narrow kernel
_TAPS = 50
_COSINES = np.cos(2.0 * np.pi / _NODES * np.arange(_NODES))
_FREQUENCIES = 2.0 * np.pi / _NODES * np.arange(_NODES // 2 + 1)
_PASSED = 0.5 * erfc((_FREQUENCIES - np.pi) * 5.2 / ((1.0 - BAND) * np.pi))  # one up to the band, and one half at the end


@helper
def moments(values: Array) -> tuple[float, float, float]:
    """The sum of values, and their mean and variance as an index from the middle."""
    mass, mean, square = 0.0, 0.0, 0.0
    half = values.size // 2
    for j in range(values.size):
        mass += values[j]
        mean += (j - half) * values[j]
    mean /= mass
    for j in range(values.size):
        square += (j - half - mean) ** 2 * values[j]
    return mass, mean, square / mass


@helper
def circular_moments(values: Array, cosines: Array, sines: Array) -> tuple[float, float, float]:
    """The sum of values on the circle, the argument of E exp(i x) as an index from the middle, the variance in squared spacings.

    The square of a wrapped deviation d is pi^2 / 3 + 4 sum (-1)^k cos(k d) / k^2.
    """
    size = values.size
    spacing = 2.0 * np.pi / size
    mass = 0.0
    for j in range(size):
        mass += values[j]
    # The grid begins at -pi: cos(k x_j) = (-1)^k cos(2 pi k j / size).
    real, imag = -np.dot(cosines[1], values) / mass, -np.dot(sines[1], values) / mass
    mean = np.arctan2(imag, real) if real * real + imag * imag > 1e-18 else 0.0
    variance = np.pi**2 / 3.0
    for k in range(1, size // 2):
        real, imag = np.dot(cosines[k], values) / mass, np.dot(sines[k], values) / mass
        variance += 4.0 / k**2 * (np.cos(k * mean) * real + np.sin(k * mean) * imag)
    return mass, mean / spacing, variance / spacing**2


@helper
def largest(values: Array) -> float:
    """The largest of values, which are not all negative."""
    top = 0.0
    for j in range(values.size):
        top = max(top, values[j])
    return top


@helper
def highest_of(values: Array) -> int:
    """The first index of the largest of values."""
    at = 0
    for j in range(values.size):
        if values[j] > values[at]:
            at = j
    return at


@kernel(types.UniTuple(int64, 2)(float64[::1], float64))  # type: ignore[no-untyped-call]
def support(values: Array, cut: float) -> tuple[int, int]:
    """The first and last index of values above `cut` times their maximum."""
    bound = cut * largest(values)
    first, last = 0, values.size - 1
    while first < last and not values[first] > bound:
        first += 1
    while last > first and not values[last] > bound:
        last -= 1
    return first, last


@kernel(boolean(float64[::1]))
def separated(values: Array) -> bool:
    """Whether a density has modes apart from each other, whose weights keep their errors."""
    peak, valley, least = 0.0, np.inf, 1e-4 * largest(values)
    for j in range(values.size):
        valley = min(valley, values[j])
        if peak > least and values[j] > least and min(peak, values[j]) > 3.0 * valley:
            return True
        if values[j] > peak:
            peak, valley = values[j], values[j]
    return False


@helper
def shifted(values: Array, by: int, size: int) -> Array:
    """The values on a grid that begins `by` points later and has another size."""
    found = np.zeros(size)
    for j in range(max(0, by), min(values.size, by + size)):
        found[j - by] = values[j]
    return found


@helper
def quadratic(found: Array, slope: float, curvature: float, scale: Array, divided: bool) -> None:
    """Write exp(slope n + curvature n^2), n the index from the middle, times or divided by a scale, by recurrence."""
    half = found.size // 2
    step = np.exp(2.0 * curvature)
    value, ratio = 1.0, np.exp(slope + curvature)
    for j in range(half, found.size):
        found[j] = value / scale[j] if divided else value * scale[j]
        value *= ratio
        ratio *= step
    value, ratio = 1.0, np.exp(curvature - slope)
    for j in range(half - 1, -1, -1):
        value *= ratio
        ratio *= step
        found[j] = value / scale[j] if divided else value * scale[j]


@helper
def taps_of(variance: float, depth: float, most: int, narrow: bool) -> Array:
    """The filter (T,) of a Gaussian kernel, at distances 0 .. T - 1.

    It is up to `most` of its samples, down to exp(-depth), or for a narrow kernel the coefficients of a periodic transfer
    function that agrees with exp(-variance w^2 / 2) in the band.
    """
    if not narrow:
        found = np.empty(int(min(np.ceil(np.sqrt(2.0 * depth * variance)) + 1, float(most))))
        top = 1.0 / np.sqrt(2.0 * np.pi * variance)
        for n in range(found.size):
            found[n] = top * np.exp(-0.5 * n * n / variance)
        return found
    transfer, found = np.empty(_FREQUENCIES.size), np.empty(_TAPS)
    for i in range(transfer.size):
        w = _FREQUENCIES[i]
        transfer[i] = np.exp(-0.5 * variance * w * w) * _PASSED[i]
        transfer[i] += np.exp(-0.5 * variance * (2.0 * np.pi - w) ** 2) * (1.0 - _PASSED[i])
    for n in range(_TAPS):
        total = 0.5 * (transfer[0] + transfer[-1] * _COSINES[n * (_NODES // 2) % _NODES])
        for i in range(1, transfer.size - 1):
            total += transfer[i] * _COSINES[i * n % _NODES]
        found[n] = total * 2.0 / _NODES
    return found


@helper
def filtered(now: Array, taps: Array, after: Array, scale: Array, narrow: bool) -> tuple[float, float]:
    """Replace values by after times their convolution with a Gaussian, whose filter is given.

    The filter is short, so that the rounding of a value is relative to values nearby.  A narrow kernel has negative parts: values
    that are rounding become zero, each by itself, because a mode may lie beyond them.  Returns the rounding error relative to the
    sum, and the largest value that may have become zero relative to the maximum, both of values times a scale.
    """
    size = now.size
    count = 1 + min(size, taps.size) // 2 * 2
    padded, weights = np.zeros(size + 2 * count), np.zeros(count)
    for n in range(min(count, taps.size)):
        weights[n] = taps[n]
    for j in range(size):
        padded[count + j] = now[j]
        now[j] *= weights[0]
    moduli = np.empty(size)
    for j in range(size):
        moduli[j] = abs(now[j])
    for n in range(1, count, 2):
        below, above = padded[count - n : count - n + size], padded[count + n : count + n + size]
        lower, higher = padded[count - n - 1 : count - n - 1 + size], padded[count + n + 1 : count + n + 1 + size]
        near, far = weights[n], weights[n + 1]
        for j in range(size):
            now[j] += near * (below[j] + above[j]) + far * (lower[j] + higher[j])
        if narrow:
            near, far = abs(near), abs(far)
            for j in range(size):
                moduli[j] += near * (below[j] + above[j]) + far * (lower[j] + higher[j])
    total, top, noise, lost = 0.0, 0.0, 0.0, 0.0
    for j in range(size):
        weight = after[j] * scale[j]
        if narrow:
            noise += 4e-16 * moduli[j] * weight
            if not now[j] > 1e-12 * moduli[j]:
                now[j] = 0.0
                lost = max(lost, 1e-12 * moduli[j] * weight)
        total += now[j] * weight
        top = max(top, now[j] * weight)
        now[j] *= after[j]
    if not (0.0 < total < np.inf):
        return np.inf, 1.0
    return 2e-15 + noise / total, lost / top


@kernel(float64(float64[::1], float64[::1], float64, float64, float64))
def wrapped(now: Array, inner: Array, shift: float, variance: float, depth: float) -> float:
    """Replace values on the circle by their convolution with a Gaussian of this mean, in spacings."""
    size, half = now.size, 0.5 / variance
    if 2.0 * (np.pi / size) ** 2 * variance > 40.0:  # nothing is left of any wave
        total = 0.0
        for j in range(size):
            total += now[j]
        for j in range(size):
            now[j] = total / size
        return 2e-15
    top, near = 1.0 / np.sqrt(2.0 * np.pi * variance), int(np.floor(shift + 0.5))
    reach = int(np.ceil(np.sqrt(2.0 * depth * variance)))
    for j in range(size):
        inner[j] = now[j]
        now[j] = 0.0
    for n in range(near - reach, near + reach + 1):
        weight, by = top * np.exp(-half * (n - shift) ** 2), n % size
        for j in range(by, size):
            now[j] += weight * inner[j - by]
        for j in range(by):
            now[j] += weight * inner[j - by + size]
    return 2e-15


@helper
def decomposed(
    now: Array, modes: Array, rates: Array, before: Array, after: Array, inner: Array, time: float, most: float, closed: bool
) -> float:
    """Replace values by after U exp(-time rates) U' before values; return their relative error.

    It is that of rounding, and of values that end abruptly after division by the gauge, which the interpolant spreads over the
    grid; infinite where beyond the support it might exceed `most`.
    """
    reach, top, highest, end = 0.0, 0.0, 0.0, 0.0
    limit = _SUPPORT * largest(now)
    for j in range(now.size):
        inner[j] = now[j] * before[j]
        reach += inner[j] * inner[j]
        if not closed and (now[j] <= limit or j < 2 or j >= now.size - 2):
            end = max(end, inner[j])
    coefficients = np.dot(inner, modes)
    for j in range(now.size):
        coefficients[j] *= np.exp(-time * rates[j])
    moved = np.dot(modes, coefficients)
    # Beyond the support there is only rounding, which must not be amplified.
    noise = 4e-16 * np.sqrt(reach)
    left, right = 0, now.size - 1
    while left < right and not moved[left] > noise:
        now[left] = 0.0
        left += 1
    while right > left and not moved[right] > noise:
        now[right] = 0.0
        right -= 1
    for j in range(left, right + 1):
        now[j] = after[j] * moved[j]
        top = max(top, now[j])
        highest = max(highest, after[j])
    outside = max(after[0], after[now.size - 1])
    if not (top > 0.0 and noise * outside < most * top):
        return np.inf
    error: float = (noise + _SPREAD * end) * highest / top
    return error
