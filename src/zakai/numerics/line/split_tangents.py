"""Derivatives of the transition of an interval by splitting (`line/splitting.py`), with respect to several parameters at once.

The density and its derivatives pass the factors and the convolutions of the splitting:

    v -> e^a v,      dv -> e^a (dv + da v);      v -> K v,      dv -> K dv + dV (dK / dV) v,

K the convolution with a Gaussian of the variance V.  The coefficients are complex: their imaginary parts are the derivatives, in
units of the step of `complex_step`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import float64, int64, void
from numpy.typing import NDArray

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.complex_step import STEP
from zakai.numerics.line.averages import AVERAGES, EARLY, IMPOSSIBLE, LATE, MEAN
from zakai.numerics.line.filters import narrow_taps
from zakai.numerics.line.splitting import OVERFLOW, STEEPEST
from zakai.numerics.line.terms import CELL, DRIFT, OBSERVED, SLOPE

Array = NDArray[Any]

_V, _M, _T = float64[::1], float64[:, ::1], float64[:, :, ::1]
_DEPTH = 80.0  # logarithm below the maximum at which the samples of a kernel end


class Interval(NamedTuple):
    """What the filter did in an interval on a grid.

    `observed` (m,) acts `inside` the interval or not at all; `pairs` of averages of the coefficients, zero for the mean, were
    taken in `substeps`, with a kernel that is `narrow` in spacings or not.
    """

    length: float
    spacing: float
    closed: bool
    observed: Array
    inside: bool
    pairs: int
    substeps: int
    narrow: bool


class Coefficients(NamedTuple):
    """The terms of f and h on the grid (p, R, 4 + m, N), and the other coefficients in time as in `line_segment.Steps`, for p."""

    table: Array
    drifts: Array
    outputs: Array
    covariances: Array
    precisions: Array


class _Average(NamedTuple):
    """phi and b (p, N) of an average, b without its value `constant` (p,) at a point, int G dt and the shift (p,)."""

    phi: Array
    b: Array
    constant: Array
    spread: Array
    shift: Array


def through(interval: Interval, coefficients: Coefficients, density: Array, tangents: Array) -> tuple[Array, Array, Array]:
    """Return a density (N,) and its derivatives (p, N) after an interval, but for a factor, and its logarithm (p,)."""
    v, dv, at = density, tangents, int(np.argmax(density))
    log_factor = np.zeros(len(tangents), complex)
    for weights in _weights(interval, coefficients.covariances.shape[1]):
        average = _averaged(interval, coefficients, weights, at)
        v, dv = _split(interval, average, v, dv)
        log_factor = log_factor + average.constant
    return v, dv, log_factor


def _weights(interval: Interval, nodes: int) -> list[Array]:
    """Return the weights of the coefficients at nodes in the averages of an interval."""
    if nodes == 1:
        return [np.ones(1)]
    n = interval.pairs
    if n == 0:
        return [AVERAGES[0, MEAN]]
    return [AVERAGES[n * (n - 1) // 2 + part, which] for part in range(n) for which in (EARLY, LATE)]


def _averaged(interval: Interval, c: Coefficients, weights: Array, at: int) -> _Average:
    tau, fraction = interval.length, float(np.sum(weights))
    length, spread = fraction * tau, tau * (c.covariances @ weights)
    G = (spread / length)[:, None]
    factors = np.einsum("q,pqr->pr", weights, c.drifts)
    cell, drift, slope = (np.einsum("pr,prn->pn", factors, c.table[:, :, row]) / fraction for row in (CELL, DRIFT, SLOPE))
    mean = np.sum(cell, axis=1, keepdims=True) / (2.0 * np.pi) if interval.closed else np.zeros((len(cell), 1))
    phi = np.cumsum((cell - mean * interval.spacing) / G, axis=1)
    phi = np.concatenate([np.zeros((len(phi), 1)), phi[:, :-1]], axis=1)
    b = -0.5 * length * ((drift - mean) * (drift + mean) / G + slope)
    if interval.inside:
        steady = c.outputs.shape[1] == 1
        for q, weight in enumerate([fraction] if steady else weights):
            h = np.einsum("pr,prmn->pmn", c.outputs[:, q], c.table[:, :, OBSERVED:])
            rest = weight * (interval.observed[:, None] - 0.5 * tau * h)
            b = b + np.sum(h * (c.precisions[:, q] @ rest), axis=1)
    constant = b[:, at]
    b = b - constant[:, None]
    b = np.where(b.real > IMPOSSIBLE, b, IMPOSSIBLE)
    return _Average(phi - phi[:, at : at + 1], b, constant, spread, mean[:, 0] * length)


def _split(interval: Interval, average: _Average, v: Array, dv: Array) -> tuple[Array, Array]:
    phi, b, _, spread, shift = average
    count, spacing = interval.substeps, interval.spacing
    outer = b / (6.0 * count)
    first = _slope(b, spacing, interval.closed)
    middle = 4.0 * outer - (spread / (72.0 * count**3))[:, None] * first * first
    lost = ~((np.abs(phi[0].real) < OVERFLOW) & ((outer[0] - phi[0]).real < OVERFLOW))
    if interval.narrow:
        change = np.abs(np.diff(phi[0].real)) + 5.0 * np.abs(np.diff(outer[0].real))
        steep = ~(change < STEEPEST)
        lost[1:] |= steep
        lost[:-1] |= steep
    v, dv = np.where(lost, 0.0, v), np.where(lost, 0.0, dv)
    outer, phi, middle = (np.where(lost, low, one) for one, low in ((outer, -OVERFLOW), (phi, 0.0), (middle, -OVERFLOW)))
    exponents = [outer - phi, middle, 2.0 * outer, outer + phi]
    factors, slopes = np.exp([one[0].real for one in exponents]), np.array([one.imag for one in exponents]) / STEP
    order = np.array([0, *[1, 2] * count])
    order[-1] = 3
    variances, shifts = spread / (2.0 * count * spacing**2), shift / (2.0 * count * spacing)
    if interval.closed:
        return _around(v, dv, factors, slopes, variances, shifts, order)
    variance, turned = float(variances[0].real), np.ascontiguousarray(variances.imag) / STEP
    change = np.abs(np.diff(phi[0].real)) + 5.0 * np.abs(np.diff(outer[0].real))
    steepest = float(np.max(change[v[1:] > 1e-13 * np.max(v)], initial=0.0))
    taps = narrow_taps(variance) if interval.narrow else _samples(variance, steepest, len(v))
    _along(v, dv, factors, slopes, *(np.ascontiguousarray(one[: len(v)]) for one in taps), turned, order)
    return v, dv


def _slope(b: Array, spacing: float, closed: bool) -> Array:
    """Return the differences of `line_splitting.differences`."""
    size = b.shape[1]
    found = np.empty_like(b)
    far, near = b[:, 5:-1] - b[:, 1:-5], b[:, 4:-2] - b[:, 2:-4]
    found[:, 3:-3] = (0.75 * near - 0.15 * far + (b[:, 6:] - b[:, :-6]) / 60.0) / spacing
    ends = np.array([0, 1, 2, size - 3, size - 2, size - 1])
    below, above = (ends - 1) % size, (ends + 1) % size
    if not closed:
        below, above = np.maximum(ends - 1, 0), np.minimum(ends + 1, size - 1)
    found[:, ends] = (b[:, above] - b[:, below]) / (spacing * np.where(closed | (above - below == 2), 2.0, 1.0))
    return found


def _around(
    v: Array, dv: Array, factors: Array, slopes: Array, variances: Array, shifts: Array, order: Array
) -> tuple[Array, Array]:
    """Return what `_along` gives, on the circle: the kernels have variances and shifts (p,)."""
    size = len(v)
    waves = 2.0 * np.pi / size * np.arange(size // 2 + 1)
    transfer = np.exp(-0.5 * variances[0].real * waves**2 - 1j * waves * shifts[0].real)
    change = (-0.5 * waves**2 * variances.imag[:, None] - 1j * waves * shifts.imag[:, None]) / STEP
    for i, which in enumerate(order):
        if i:
            spectrum = np.fft.rfft(v)
            v, dv = np.fft.irfft(transfer * spectrum, size), np.fft.irfft(transfer * (np.fft.rfft(dv) + spectrum * change), size)
        v, dv = factors[which] * v, factors[which] * (dv + v * slopes[which])
    return v, dv


@helper
def _convolve(row: Array, taps: Array, padded: Array, to: Array) -> None:
    """Add the convolution of a row (N,) with a symmetric filter, its values at distances 0 .. T - 1."""
    size, count = row.size, taps.size
    for j in range(size):
        padded[count + j] = row[j]
        to[j] += taps[0] * row[j]
    for n in range(1, count):
        weight, below, above = taps[n], padded[count - n : count - n + size], padded[count + n : count + n + size]
        for j in range(size):
            to[j] += weight * (below[j] + above[j])


@kernel(void(_V, _M, _M, _T, _V, _V, _V, int64[::1]))
def _along(
    v: Array, dv: Array, factors: Array, slopes: Array, taps: Array, changes: Array, turned: Array, order: Array
) -> None:
    """Replace a density and its derivatives (p, N) by those after convolutions and factors.

    Args:
        v, dv: the density and the derivatives.
        factors: exponentials (4, N).
        slopes: the derivatives of their logarithms (4, p, N).
        taps, changes: the filter of a convolution and its derivative with respect to the variance (T,).
        turned: the derivatives of the variance (p,).
        order: which factor stands before, between and after the convolutions.
    """
    size, padded = v.size, np.zeros(v.size + 2 * taps.size)
    moved, changed, row = np.empty(size), np.empty(size), np.empty(size)
    for i in range(order.size):
        if i > 0:
            moved[:], changed[:] = 0.0, 0.0
            _convolve(v, taps, padded, moved)
            _convolve(v, changes, padded, changed)
            for l in range(turned.size):
                for j in range(size):
                    row[j] = turned[l] * changed[j]
                _convolve(dv[l], taps, padded, row)
                dv[l, :] = row
            v[:] = moved
        which = order[i]
        for l in range(turned.size):
            for j in range(size):
                dv[l, j] = factors[which, j] * (dv[l, j] + v[j] * slopes[which, l, j])
        for j in range(size):
            v[j] *= factors[which, j]


def _samples(variance: float, steepest: float, most: int) -> tuple[Array, Array]:
    """Return up to `most` samples of a Gaussian between exponentials of a slope, and their derivatives in the variance."""
    squares = np.arange(min(np.ceil(np.sqrt(2.0 * _DEPTH * variance) + steepest * variance) + 1.0, most)) ** 2
    taps = np.exp(-0.5 * squares / variance) / np.sqrt(2.0 * np.pi * variance)
    return taps, taps * 0.5 * (squares / variance - 1.0) / variance
