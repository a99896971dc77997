"""Gaussian kernels of linear-quadratic equations of one state, as filters on a uniform grid.

A transition (`numerics/transition.py`) takes the unit mass at y to

    exp(k0 + k1 y + k2 y^2) N(x; a y + b, V),

where b and k1 are linear in the inputs e = (1, e_1, ...) of the equation, and k0 is a quadratic form.  Rates of observation
enter in this way after the transitions have been computed.  Because x y = (x^2 + y^2 - (x - y)^2) / 2, the kernel is the
convolution with a Gaussian of the variance V / a between two exponentials of quadratic polynomials.  Where V / a is large
enough in squares of the spacing, its samples are a filter of positive numbers, which is accurate relative to every value, far
into the tails.  Else it is a filter that is exact for band-limited densities, which is accurate relative to the maximum.
"""

from __future__ import annotations

from math import erfc
from typing import NamedTuple

import numpy as np
from numba import complex128, float64, int64

from zakai.numerics.arrays import Array, Number
from zakai.numerics.compiled import helper, kernel
from zakai.numerics.exponentials import exponentiate
from zakai.numerics.line.density import highest_of
from zakai.numerics.line.steps import LEAST, Transition, failed
from zakai.numerics.transition import Transition as LinearTransition


class Channel(NamedTuple):
    """The kernel for given inputs: a, b, V, k0, k1, k2."""

    scale: Number
    shift: Number
    variance: Number
    constant: Number
    slope: Number
    curvature: Number


def chosen(transitions: LinearTransition, k: int, inputs: Array) -> Channel:
    """Return the kernel of interval k for the inputs (k,)."""
    scale, shift, variance, information, slope, constant = (part[k] for part in transitions)
    return Channel(
        scale[0, 0], shift[0] @ inputs, variance[0, 0], inputs @ constant @ inputs, slope[0] @ inputs, -0.5 * information[0, 0]
    )


def packed(transitions: LinearTransition, rows: Array) -> Array:
    """Return the parameters (R, .) of the kernels of some intervals for all inputs, as `filters.kernel_of` reads them."""
    scale, shift, variance, information, slope, constant = (part[rows].reshape(len(rows), -1) for part in transitions)
    return np.concatenate([scale, shift, variance, constant, slope, -0.5 * information], axis=1)


def around(channel: Channel, origin: float) -> Channel:
    """Return the kernel for x and y relative to `origin`."""
    return channel._replace(
        shift=channel.shift + (channel.scale - 1.0) * origin,
        constant=channel.constant + (channel.slope + channel.curvature * origin) * origin,
        slope=channel.slope + 2.0 * channel.curvature * origin,
    )


WIDE = 1.96  # variance of a kernel, in squares of the spacing, from which its samples are a filter
BAND = 0.625  # part of the frequencies of a grid for which the filters of narrow kernels are exact
_NODES = 128  # of the periodic transfer function of a narrow kernel
_TAPS = 50
_FREQUENCIES = 2.0 * np.pi / _NODES * np.arange(_NODES // 2 + 1)
# From values at the frequencies to coefficients, by the rule of trapezoids.
_COSINES = 2.0 / _NODES * np.cos(_FREQUENCIES[:, None] * np.arange(_TAPS))
_COSINES[[0, -1]] *= 0.5
# One up to the band, and one half at the end.
_PASSED = np.array([0.5 * erfc((one - np.pi) * 5.2 / ((1.0 - BAND) * np.pi)) for one in _FREQUENCIES])


@helper
def taps_of(variance: float, depth: float, most: int, narrow: bool) -> Array:
    """Return the filter (T,) of a Gaussian kernel, at distances 0 .. T - 1.

    It is up to `most` of its samples, down to exp(-depth), or for a narrow kernel the coefficients of a periodic transfer
    function that agrees with exp(-variance w^2 / 2) in the band.
    """
    if not narrow:
        taps = np.empty(int(min(np.ceil(np.sqrt(2.0 * depth * variance)) + 1, float(most))))
        for n in range(taps.size):
            taps[n] = -0.5 * n * n / variance - 0.5 * np.log(2.0 * np.pi * variance)
        exponentiate(taps)
        return taps
    taps, transfer, beyond = np.zeros(_TAPS), np.empty(_FREQUENCIES.size), np.empty(_FREQUENCIES.size)
    for i in range(transfer.size):
        transfer[i] = -0.5 * variance * _FREQUENCIES[i] ** 2
        beyond[i] = -0.5 * variance * (2.0 * np.pi - _FREQUENCIES[i]) ** 2
    exponentiate(transfer)
    exponentiate(beyond)
    for i in range(transfer.size):
        weight = transfer[i] * _PASSED[i] + beyond[i] * (1.0 - _PASSED[i])
        for n in range(_TAPS):
            taps[n] += weight * _COSINES[i, n]
    return taps


def narrow_taps(variance: float) -> tuple[Array, Array]:
    """Return the filter (T,) of a narrow kernel, as `taps_of`, and its derivative with respect to the variance."""
    squares, others = 0.5 * _FREQUENCIES**2, 0.5 * (2.0 * np.pi - _FREQUENCIES) ** 2
    passed, beyond = np.exp(-variance * squares) * _PASSED, np.exp(-variance * others) * (1.0 - _PASSED)
    return (passed + beyond) @ _COSINES, -(squares * passed + others * beyond) @ _COSINES


@helper
def filtered(values: Array, taps: Array, after: Array, scale: Array, narrow: bool) -> tuple[float, float]:
    """Replace values by after times their convolution with a Gaussian, whose filter is given.

    The filter is short, so that the rounding of a value is relative to values nearby.  A narrow kernel has negative parts: values
    that are rounding become zero, each by itself, because a mode may lie beyond them.  Returns the rounding error relative to the
    sum, and the largest value that may have become zero relative to the maximum, both of values times a scale.
    """
    size = values.size
    count = 1 + (min(size, taps.size) + 2) // 4 * 4
    padded, weights, moduli = np.zeros(size + 2 * count), np.zeros(count), np.empty(size)
    for n in range(min(count, taps.size)):
        weights[n] = taps[n]
    for j in range(size):
        padded[count + j] = values[j]
        values[j] *= weights[0]
        moduli[j] = abs(values[j])
    for n in range(1, count, 4):  # four distances at once, as many as registers hold
        a, b, c, d = padded[count - n :], padded[count - n - 1 :], padded[count - n - 2 :], padded[count - n - 3 :]
        e, f, g, h = padded[count + n :], padded[count + n + 1 :], padded[count + n + 2 :], padded[count + n + 3 :]
        one, two, three, four = weights[n], weights[n + 1], weights[n + 2], weights[n + 3]
        if narrow:
            for j in range(size):
                first, second, third, fourth = a[j] + e[j], b[j] + f[j], c[j] + g[j], d[j] + h[j]
                values[j] = values[j] + (one * first + two * second) + (three * third + four * fourth)
                near, far = abs(one) * first + abs(two) * second, abs(three) * third + abs(four) * fourth
                moduli[j] = moduli[j] + near + far
        else:
            for j in range(size):
                near, far = one * (a[j] + e[j]) + two * (b[j] + f[j]), three * (c[j] + g[j]) + four * (d[j] + h[j])
                values[j] = values[j] + near + far
    total, top, noise, lost = 0.0, 0.0, 0.0, 0.0
    for j in range(size):
        weight = after[j] * scale[j]
        if narrow:
            noise += 4e-16 * moduli[j] * weight
            if not values[j] > 1e-12 * moduli[j]:
                values[j] = 0.0
                lost = max(lost, 1e-12 * moduli[j] * weight)
        total += values[j] * weight
        top = max(top, values[j] * weight)
        values[j] *= after[j]
    if not (0.0 < total < np.inf):
        return np.inf, 1.0
    return 2e-15 + noise / total, lost / top


@kernel(float64(float64[::1], float64[::1], float64, float64, float64))
def wrapped(values: Array, inner: Array, shift: float, variance: float, depth: float) -> float:
    """Replace values on the circle by their convolution with a Gaussian of this mean, in spacings; return the rounding error."""
    size, half = values.size, 0.5 / variance
    if 2.0 * (np.pi / size) ** 2 * variance > 40.0:  # nothing is left of any wave
        total = 0.0
        for j in range(size):
            total += values[j]
        for j in range(size):
            values[j] = total / size
        return 2e-15
    top, near = 1.0 / np.sqrt(2.0 * np.pi * variance), int(np.floor(shift + 0.5))
    reach = int(np.ceil(np.sqrt(2.0 * depth * variance)))
    for j in range(size):
        inner[j] = values[j]
        values[j] = 0.0
    for n in range(near - reach, near + reach + 1):
        weight, by = top * np.exp(-half * (n - shift) ** 2), n % size
        for j in range(by, size):
            values[j] += weight * inner[j - by]
        for j in range(by):
            values[j] += weight * inner[j - by + size]
    return 2e-15


@helper
def _quadratic(values: Array, slope: float, curvature: float) -> None:
    """Write exp(slope n + curvature n^2), n the index from the middle, by recurrence."""
    half, step = values.size // 2, np.exp(2.0 * curvature)
    for side in (1, -1):
        value, ratio = 1.0, np.exp(side * slope + curvature)
        for n in range(half + 1 if side < 0 else values.size - half):
            values[half + side * n] = value
            value *= ratio
            ratio *= step


def kernel_size(inputs: int) -> int:
    """Return the number of parameters of the kernel of an interval, see `kernel_of`."""
    return 3 + 2 * inputs + inputs * inputs


@helper
def kernel_of(parameters: Array, observed: Array, length: float, to: Array) -> None:
    """Write a, b, V, k0, k1, k2 of a kernel for increments (m,) over an interval of a length, infinite where none acts inside.

    With the inputs e = (1, increments / length) the parameters are those of `gaussian_kernels.packed`.
    """
    count = 1 + observed.size
    shift, variance, constant = parameters[1 : 1 + count], parameters[1 + count], parameters[2 + count : -1 - count]
    slope = parameters[-1 - count : -1]
    to[0], to[1], to[2], to[3], to[4], to[5] = parameters[0], 0.0, variance, 0.0, 0.0, parameters[-1]
    for i in range(count):
        one = observed[i - 1] / length if i > 0 else 1.0
        to[1] += shift[i] * one
        to[4] += slope[i] * one
        for j in range(count):
            other = observed[j - 1] / length if j > 0 else 1.0
            to[3] += constant[i * count + j] * one * other


@helper
def convolved(
    density: Array, phi: Array, channel: Array, middle: float, spacing: float, finest: float, depth: float, closed: bool
) -> Transition:
    """Replace a density by that after a Gaussian kernel in the gauge e^phi.

    Args:
        density: the density (N,).
        phi: phi (N,).
        channel: a, b, V, k0, k1, k2.
        middle: the point of the index N // 2, relative to the origin of the kernel.
        finest: the smallest spacing that may be asked for.
        depth: the depth of the tails, as a logarithm below the maximum, to which filters are accurate.
        closed: whether the grid goes around the circle.
    """
    size = density.size
    early, late, gauge = np.empty(size), np.empty(size), np.empty(size)
    a, shift, variance, k0, k1, k2 = channel[0], channel[1], channel[2], channel[3], channel[4], channel[5]
    if not (variance > 0.0 and a > 0.0):
        return failed(variance, 0.0)
    width, needed, at = variance / a / (spacing * spacing), 0.0, highest_of(density)
    narrow: bool = width < WIDE
    if narrow:
        needed = spacing * np.sqrt(width / (1.1 * WIDE))
        if closed or needed > finest:
            return failed(variance, needed)
    shift += (a - 1.0) * middle
    k0 += (k1 + k2 * middle) * middle
    k1 += 2.0 * k2 * middle
    log_factor = k0 - 0.5 * np.log(a)
    for j in range(size):
        gauge[j] = phi[j] - phi[at] if phi[j] != phi[at] else 0.0
    exponentiate(gauge)
    if closed:
        if a != 1.0 or k1 != 0.0 or k2 != 0.0:
            return failed(variance, 0.0)
        for j in range(size):
            density[j] /= gauge[j]
        rounding, clipped = wrapped(density, early, shift / spacing, width, depth), 0.0
        for j in range(size):
            density[j] *= gauge[j]
    else:
        log_factor -= 0.5 * shift * shift / variance
        pull, square = k1 - a * shift / variance, k2 + 0.5 * a * (1.0 - a) / variance
        _quadratic(early, pull * spacing, square * spacing**2)
        _quadratic(late, shift / variance * spacing, 0.5 * (a - 1.0) / variance * spacing**2)
        for j in range(size):
            early[j], late[j] = early[j] / gauge[j], late[j] * gauge[j]
            if not (LEAST < early[j] < 1.0 / LEAST and LEAST < late[j] < 1.0 / LEAST):  # products may underflow
                return failed(variance, 0.0)
        for j in range(size):
            density[j] *= early[j]
            early[j] = 1.0
        rounding, clipped = filtered(density, taps_of(width, depth, size, narrow), late, early, narrow)
    return Transition(0.0, rounding, clipped, variance, a, needed, log_factor, 0.0, 0.0)


_APPLIED = [
    t[::1](float64[::1], float64, float64, int64, t[::1], t, t, t)  # type: ignore[call-overload]
    for t in (float64, complex128)
]


@kernel(*_APPLIED)
def applied(
    sources: Array, first: float, spacing: float, size: int, weights: Array, scale: Number, shift: Number, variance: Number
) -> Array:
    """Return sum_j N(x_i; scale y_j + shift, variance) weights_j at x_i = first + spacing i, i = 0 .. size - 1, by recurrence."""
    result = np.zeros(size, weights.dtype)
    half = 0.5 / variance
    top = 1.0 / np.sqrt(2.0 * np.pi * variance)
    falloff = np.exp(-2.0 * half * spacing * spacing)
    for j in range(sources.size):
        w = weights[j] * top
        if w == 0:
            continue
        mean = scale * sources[j] + shift
        near = int(np.floor((mean.real - first) / spacing + 0.5))
        near = min(max(near, 0), size - 1)
        rest = first + spacing * near - mean
        peak = w * np.exp(-half * rest * rest)
        value = peak
        ratio = np.exp(-half * (2.0 * rest * spacing + spacing * spacing))
        for i in range(near, size):
            result[i] += value
            value *= ratio
            ratio *= falloff
            if abs(value.real) < 1e-300:
                break
        value = peak
        ratio = np.exp(-half * (-2.0 * rest * spacing + spacing * spacing))
        for i in range(near - 1, -1, -1):
            value *= ratio
            ratio *= falloff
            if abs(value.real) < 1e-300:
                break
            result[i] += value
    return result
