"""The values between the points of a uniform grid: band-limited interpolants, and logarithms where values are small."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import boolean, complex128, float64
from numpy.typing import NDArray

from zakai.numerics.compiled import helper, kernel

Array = NDArray[Any]

EXACT = 1e-12  # distance from a point, in spacings, at which its own value is returned
_SMALL = 1e-8  # of the maximum: below, the interpolant is the rounding of large values
_STENCIL = np.arange(-3.0, 5.0)
_WEIGHTS = np.array([1.0 / np.prod([i - j for j in _STENCIL if j != i]) for i in _STENCIL])
_SIGNATURES = [t[::1](t[::1], float64[::1], boolean) for t in (float64, complex128)]  # type: ignore[call-overload]


@kernel(*_SIGNATURES, reordered=True)
def band_limited(values: Array, at: Array, closed: bool) -> Array:
    """Return the sinc (line) or trigonometric (circle) interpolant of values (N,) at indices (J,), zero beyond a line."""
    size, found, signed = values.size, np.zeros(at.size, values.dtype), values.copy()
    for j in range(1, size, 2):
        signed[j] = -values[j]
    turns = np.pi / size * np.arange(-size, size) if closed else np.zeros(0)
    cosines, sines = np.cos(turns), np.sin(turns)
    for i in range(at.size):
        near = np.floor(at[i] + 0.5)
        rest, total = at[i] - near, found[i]
        if not (closed or -0.5 < at[i] < size - 0.5):
            continue
        if abs(rest) < EXACT:
            found[i] = values[int(near) % size]
            continue
        # sin(pi (at - j)) = (-1)^(near - j) sin(pi (at - near)).
        sine = np.sin(np.pi * rest) if near % 2.0 == 0.0 else -np.sin(np.pi * rest)
        if closed:
            # cot(pi (at - j) / size), with the angle as a sum.
            own, turn, first = np.cos(np.pi / size * rest), np.sin(np.pi / size * rest), int(near) % size + size
            for j in range(size):
                cosine, other = cosines[first - j], sines[first - j]
                total += signed[j] * ((own * cosine - turn * other) / (turn * cosine + own * other))
            found[i] = total * (sine / size)
        else:
            for j in range(size):
                total += signed[j] * (1.0 / (at[i] - j))
            found[i] = total * (sine / np.pi)
    return found


@helper
def _of_logs(values: Array, logs: Array, at: float, closed: bool) -> Any:
    """Return the exponential of the polynomial through the nearest eight logarithms, zero where there is none."""
    size, near = values.size, int(np.floor(at))
    zero = 0.0 * logs[0]
    if not closed:
        if not -0.5 < at < size - 0.5:
            return zero
        near = min(max(near, 3), size - 5)
    total, weights = zero, 0.0
    for n in range(8):
        j = (near + n - 3) % size
        if not values[j].real > 0.0:
            return zero
        distance = at - near - _STENCIL[n]
        if abs(distance) < EXACT:
            return values[j]
        total, weights = total + _WEIGHTS[n] / distance * logs[j], weights + _WEIGHTS[n] / distance
    found = np.exp(total / weights)
    return found if np.isfinite(found.real) else zero


@helper
def _logs(values: Array) -> Array:
    logs = np.zeros(values.size, values.dtype)
    for j in range(values.size):
        if values[j].real > 0.0:
            logs[j] = np.log(values[j])
    return logs


@kernel(*_SIGNATURES)
def of_logs(values: Array, at: Array, closed: bool) -> Array:
    """Return the exponentials of the polynomials through the nearest eight logarithms of values (N,) at indices (J,).

    They are zero where one of these values is zero, and beyond a line.
    """
    logs, found = _logs(values), np.zeros(at.size, values.dtype)
    for i in range(at.size):
        found[i] = _of_logs(values, logs, at[i], closed)
    return found


@kernel(*_SIGNATURES)
def density_between(values: Array, at: Array, closed: bool) -> Array:
    """Return a density (N,) at indices (J,): the band-limited interpolant, and small values by their logarithms."""
    found, logs, top = band_limited(values, at, closed), _logs(values), values[0].real
    for j in range(values.size):
        top = max(top, values[j].real)
    bound = _SMALL * top
    for i in range(at.size):
        if not found[i].real >= bound:
            found[i] = _of_logs(values, logs, at[i], closed)
            if not found[i].real < 2.0 * bound:
                found[i] = 0.0
    return found
