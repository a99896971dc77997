"""The transition of an interval by splitting, with increments that act inside: diffusion, and a potential for all the rest.

    u_t = G u'' / 2 - (f u)' + (h'S^-1 dy/dt - h'S^-1 h / 2) u

With constant coefficients and phi' = f / G the gauge v = e^-phi u leaves v_t = G v'' / 2 + (b / tau) v,

    b = h'S^-1 dy - tau h'S^-1 h / 2 - tau (f^2 / G + f') / 2,
    exp(b / 6) K exp(2 b / 3 - tau G b'^2 / 72) K exp(b / 6),     K the convolution with N(0, tau G / 2),

which is of fourth order in tau (Chin 1997, scheme A).  On the circle the mean of f becomes a shift of K.  The residual is, with
the third and fifth commutators for a Gaussian density of the variance P,

    tau^2 std(G^2 b'^2 b'') / 2160 + 7 tau^3 sqrt(8) (G / P) rms(G^2 b''^2) / 8640
    + tau^4 max(rate^2 rms([A, [b, A]]), std(L^4 b)) / 2880,

L the backward operator.  With s substeps of an interval, s^-4 of that.

Derivatives with respect to several parameters pass the same factors and convolutions:

    v -> e^a v,      dv -> e^a (dv + da v);      v -> K v,      dv -> K dv + dV (dK / dV) v.

There the coefficients are complex: their imaginary parts are the derivatives, in units of the step of `complex_step`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import float64, int64, void

from zakai.numerics.arrays import Array
from zakai.numerics.compiled import helper, kernel
from zakai.numerics.complex_step import STEP
from zakai.numerics.exponentials import exponentiate
from zakai.numerics.line.averages import AVERAGES, EARLY, LATE, MEAN, MOST_MAGNUS, averaged, averaging, operators
from zakai.numerics.line.density import highest_of, moments
from zakai.numerics.line.gaussian_kernels import filtered, narrow_taps, taps_of, wrapped
from zakai.numerics.line.steps import CELL, DRIFT, IMPOSSIBLE, OBSERVED, OVERFLOW, SLOPE, Coefficients, Transition, failed

MOST_SUBSTEPS = 64
STEEPEST = 0.5  # change of exponents between points for which the filter of a narrow kernel is accurate


class Accuracy(NamedTuple):
    """What a splitting must keep.

    `depth` is that of the tails, as a logarithm below the maximum, to which filters are accurate, `most` the largest error, and
    `finest` the smallest spacing that may be asked for.
    """

    depth: float
    most: float
    finest: float


class Filtering(NamedTuple):
    """The filter of an average: int G dt, the shift, substeps, and as in `Accuracy` the depth; the kernel is `narrow` or not."""

    spread: float
    shift: float
    substeps: float
    depth: float
    narrow: bool


@helper
def divided(
    density: Array, table: Array, c: Coefficients, averages: Array, spacing: float, closed: bool, varying: bool,
    accuracy: Accuracy,
) -> Transition:  # fmt: skip
    """Replace a density by that after a split interval, in as many averages and substeps as its error asks for.

    The samples of a Gaussian of the variance V, in squares of the spacing, are a filter of positive numbers with the relative
    error 2 exp(-2 pi^2 V).  Narrower kernels are used where these would need a spacing below `finest`.

    Args:
        density: the density (N,).
        table: see `steps.Grid`.
        averages: the weights of `line/averages.py`.
        closed: whether it goes around the circle.
        varying: whether the coefficients vary within the interval.
        accuracy: what is asked of the result.
    """
    size, at, (depth, most, finest) = density.size, highest_of(density), accuracy
    begin, phi, drift = density.copy(), np.empty(size), np.empty(size)
    b, first, second = np.empty(size), np.empty(size), np.empty(size)
    magnus, substeps = 0.0, 1.0  # pairs of averages, one after the other, or the mean
    both, spreads, linear = np.empty((3, 2, size if varying else 1)), np.empty(3), False
    if varying:
        linear = operators(table, c, averages[0], at, both, spreads)
        mean_error, pair_error = averaging(density, both, spreads, linear, spacing, closed)
        if mean_error > most:
            magnus = max(np.ceil(1.1 * (pair_error / most) ** 0.25), 1.0)
    for _ in range(8):
        if not (magnus <= MOST_MAGNUS and max(magnus, 1.0) * substeps <= MOST_SUBSTEPS):
            break
        parts = int(max(magnus, 1.0))
        splitting, time, pairs, rounding, clipped, spread, constant, needed = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        wide = np.log(1e4 * parts * substeps / most) / (2.0 * np.pi**2)
        for j in range(size):
            density[j] = begin[j]
        for i in range(2 * parts if magnus > 0.0 else 1):
            weights = averages[parts * (parts - 1) // 2 + i // 2]
            which = MEAN if magnus == 0.0 else (EARLY if i % 2 == 0 else LATE)
            length, own_spread, shift, added = averaged(table, c, weights[which], at, spacing, closed, (phi, drift, b))
            if not (own_spread > 0.0):
                return failed(spread, 0.0)
            variance = 0.5 * own_spread / substeps
            if variance < wide * spacing * spacing:
                needed = np.sqrt(variance / (1.05 * wide))
                if closed or needed > finest:
                    return failed(spread, needed)
            differences(b, spacing, closed, first, second)
            filtering = Filtering(own_spread, shift, substeps, depth, needed > 0.0)
            noise, end = split(density, phi, b, first, filtering, spacing, closed)
            if needed > 0.0 and not (noise < 1e-2 * most):  # perhaps the exponents vary too much between points
                return failed(spread, max(needed, 0.6 * spacing))
            splitting += residual(density, b, first, second, drift, own_spread, spacing, length) / substeps**4
            rounding, clipped, spread, constant = rounding + noise, max(clipped, end), spread + own_spread, constant + added
            if varying and (magnus == 0.0 or i % 2 == 1):
                if parts > 1:
                    linear = operators(table, c, weights, at, both, spreads)
                mean_error, pair_error = averaging(density, both, spreads, linear, spacing, closed)
                time, pairs = time + (pair_error if magnus > 0.0 else mean_error), pairs + pair_error
            total = moments(density)[0]
            if not (1e-200 < total < 1e200):
                splitting = np.inf
            if not (splitting < np.inf):
                break
        if splitting <= most and time <= most:
            return Transition(splitting + time, rounding, clipped, spread, 1.0, needed, constant, magnus, substeps)
        if not (splitting + time < np.inf):
            substeps *= 4.0
        else:
            if time > most:
                magnus = max(np.ceil(1.1 * parts * (pairs / most) ** 0.25), 1.0)
            rest = splitting * (parts / max(magnus, 1.0)) ** 4
            substeps = np.ceil(substeps * max(1.02 * (rest / most) ** 0.25, 1.0 / substeps))
    return failed(0.0, 0.0)


@helper
def differences(b: Array, spacing: float, closed: bool, first: Array, second: Array) -> None:
    """Write b' and b'' by differences of sixth order, at the ends of the line of second order."""
    size, inner = b.size, b.size - 6
    one, two = 1.0 / spacing, 1.0 / (spacing * spacing)
    left, middle, right = b[:inner], b[3 : inner + 3], b[6:]
    left_two, left_one, right_one, right_two = b[1 : inner + 1], b[2 : inner + 2], b[4 : inner + 4], b[5 : inner + 5]
    to_first, to_second = first[3 : inner + 3], second[3 : inner + 3]
    for j in range(inner):
        far, near = right_two[j] - left_two[j], right_one[j] - left_one[j]
        to_first[j] = one * (0.75 * near - 0.15 * far + (right[j] - left[j]) / 60.0)
        far, near = right_two[j] + left_two[j], right_one[j] + left_one[j]
        to_second[j] = two * (1.5 * near - 0.15 * far + (right[j] + left[j]) / 90.0 - 49.0 / 18.0 * middle[j])
    for end in range(3):
        for j in (end, size - 1 - end):
            below, above = (j - 1) % size, (j + 1) % size
            if not closed:
                below, above = max(j - 1, 0), min(j + 1, size - 1)
            first[j] = one * (b[above] - b[below]) / (2.0 if closed or above - below == 2 else 1.0)
            second[j] = two * (b[above] - 2.0 * b[j] + b[below])


@helper
def residual(
    values: Array, b: Array, first: Array, second: Array, drift: Array, spread: float, spacing: float, tau: float
) -> float:
    """Return the residual of the splitting, relative to the density."""
    size, G = values.size, spread / tau
    mass, mean, variance = moments(values)
    mean, variance = mean + size // 2, variance * spacing * spacing
    third = third_square = fourth_power = upward = flow = seen = 0.0
    twice_mean = twice_square = four_mean = four_square = 0.0
    one, two = 0.5 / spacing, 0.5 * G / (spacing * spacing)
    # L b, ..., L^4 b, L the backward operator by differences.
    powers = np.zeros((5, size))
    for j in range(1, size - 1):
        powers[1, j] = drift[j] * first[j] + 0.5 * G * second[j]
    for i in range(1, 4):
        for j in range(i + 1, size - i - 1):
            rise = (powers[i, j + 1] - powers[i, j - 1]) * one
            powers[i + 1, j] = drift[j] * rise + two * (powers[i, j + 1] - 2.0 * powers[i, j] + powers[i, j - 1])
    scale = 1.0 / mass
    for j in range(4, size - 4):
        p = values[j] * scale
        if p < 1e-12:
            continue
        seen += p
        part = G * G * first[j] * first[j] * second[j]
        third += p * part
        third_square += p * part * part
        fourth_power += p * (G * second[j]) ** 4
        upward += p * G * ((powers[1, j + 1] - powers[1, j - 1]) * one) ** 2
        twice_mean += p * powers[2, j]
        twice_square += p * powers[2, j] ** 2
        four_mean += p * powers[4, j]
        four_square += p * powers[4, j] ** 2
        flow += p * drift[j] * (j - mean) * spacing
    if not (seen > 0.5 and variance > 0):
        return np.inf
    growth, turning = G / variance, abs(flow) / variance
    deviation = np.sqrt(max(third_square - third * third, 0.0))
    curved = np.sqrt(fourth_power)
    twice = np.sqrt(max(twice_square - twice_mean * twice_mean, 0.0))
    four = np.sqrt(max(four_square - four_mean * four_mean, 0.0))
    commutator = twice + 2.0 * np.sqrt(upward * growth) + growth * np.sqrt(2.0 * curved)
    total: float = tau**2 / 2160.0 * deviation + 7.0 / 8640.0 * tau**3 * np.sqrt(8.0) * growth * curved
    return total + tau**4 / 2880.0 * max((growth + turning) ** 2 * commutator, four)


@helper
def split(
    density: Array, phi: Array, b: Array, first: Array, filtering: Filtering, spacing: float, closed: bool
) -> tuple[float, float]:
    """Replace a density by that after an average, in substeps; return the rounding error and what may have become zero.

    The filter of a narrow kernel is accurate where v is band-limited, that is where the exponents change little between points.
    """
    spread, shift, substeps, depth, narrow = filtering
    size, count, weight, part = density.size, 2 * int(substeps), 1.0 / (6.0 * substeps), spread / (2.0 * substeps)
    correction, negligible, clipped, steepest = spread / (72.0 * substeps**3), 1e-13 * density[highest_of(density)], 0.0, 0.0
    early, middle, joint, late, work = np.empty(size), np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    for j in range(1, size):
        change = abs(phi[j] - phi[j - 1]) + 5.0 * weight * abs(b[j] - b[j - 1])
        if density[j] > negligible:
            steepest = max(steepest, change)
        if narrow and not (change < STEEPEST):
            for i in (j - 1, j):
                if density[i] > negligible:
                    return np.inf, 1.0
                clipped, density[i] = max(clipped, density[i]), 0.0
    for j in range(size):
        outer, gauge = weight * b[j], phi[j]
        if not (abs(gauge) < OVERFLOW and outer - gauge < OVERFLOW):
            if density[j] > negligible or not (gauge < 0.0 or b[j] == IMPOSSIBLE):
                return np.inf, 1.0
            clipped = max(clipped, density[j])
            density[j], outer, gauge = 0.0, -OVERFLOW, 0.0
        early[j], work[j], middle[j] = outer, gauge, 4.0 * outer - correction * first[j] * first[j]
    for exponents in (early, work, middle):
        exponentiate(exponents)
    for j in range(size):
        late[j], joint[j] = early[j] * work[j], early[j] * early[j]
        density[j] *= early[j] / work[j]
    if not narrow:
        work[:] = 1.0
    variance = part / (spacing * spacing)
    # Between exponentials of such a slope the kernel is as wide, about a mean that the slope displaces.
    taps = taps_of(variance, 0.5 * (np.sqrt(2.0 * depth) + steepest * np.sqrt(variance)) ** 2, size, narrow)
    rounding, clipped = 0.0, clipped * 1e-13 / negligible
    for i in range(count):
        after = middle if i % 2 == 0 else (joint if i < count - 1 else late)
        if closed:
            rounding += wrapped(density, work, shift / (count * spacing), variance, depth)
            for j in range(size):
                density[j] *= after[j]
        else:
            if i == count - 1:
                for j in range(size):
                    work[j] = 1.0
            noise, end = filtered(density, taps, after, work, narrow)
            rounding, clipped = rounding + noise, max(clipped, end)
    return rounding, clipped


_V, _M, _T = float64[::1], float64[:, ::1], float64[:, :, ::1]


class Interval(NamedTuple):
    """What the filter did in an interval on a grid.

    `observed` (m,) acts `inside` the interval or not at all; `pairs` of averages of the coefficients, zero for the mean, were
    used in `substeps`, with a kernel that is `narrow` in spacings or not; `depth` as in `Accuracy`.
    """

    length: float
    spacing: float
    closed: bool
    observed: Array
    inside: bool
    pairs: int
    substeps: int
    narrow: bool
    depth: float


class TangentCoefficients(NamedTuple):
    """The terms of f and h on the grid (p, R, 4 + m, N), and the other coefficients in time as in `steps.Steps`, for p."""

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


def through(interval: Interval, coefficients: TangentCoefficients, density: Array, tangents: Array) -> tuple[Array, Array, Array]:
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


def _averaged(interval: Interval, c: TangentCoefficients, weights: Array, at: int) -> _Average:
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
    taps = narrow_taps(variance) if interval.narrow else _samples(variance, interval.depth, steepest, len(v))
    _along(v, dv, factors, slopes, *(np.ascontiguousarray(one[: len(v)]) for one in taps), turned, order)
    return v, dv


def _slope(b: Array, spacing: float, closed: bool) -> Array:
    """Return the differences of `splitting.differences`."""
    size = b.shape[1]
    result = np.empty_like(b)
    far, near = b[:, 5:-1] - b[:, 1:-5], b[:, 4:-2] - b[:, 2:-4]
    result[:, 3:-3] = (0.75 * near - 0.15 * far + (b[:, 6:] - b[:, :-6]) / 60.0) / spacing
    ends = np.array([0, 1, 2, size - 3, size - 2, size - 1])
    below, above = (ends - 1) % size, (ends + 1) % size
    if not closed:
        below, above = np.maximum(ends - 1, 0), np.minimum(ends + 1, size - 1)
    result[:, ends] = (b[:, above] - b[:, below]) / (spacing * np.where(closed | (above - below == 2), 2.0, 1.0))
    return result


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
def _along(v: Array, dv: Array, factors: Array, slopes: Array, taps: Array, changes: Array, turned: Array, order: Array) -> None:
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
    propagated, changed, row = np.empty(size), np.empty(size), np.empty(size)
    for i in range(order.size):
        if i > 0:
            propagated[:], changed[:] = 0.0, 0.0
            _convolve(v, taps, padded, propagated)
            _convolve(v, changes, padded, changed)
            for l in range(turned.size):
                for j in range(size):
                    row[j] = turned[l] * changed[j]
                _convolve(dv[l], taps, padded, row)
                dv[l, :] = row
            v[:] = propagated
        which = order[i]
        for l in range(turned.size):
            for j in range(size):
                dv[l, j] = factors[which, j] * (dv[l, j] + v[j] * slopes[which, l, j])
        for j in range(size):
            v[j] *= factors[which, j]


def _samples(variance: float, depth: float, steepest: float, most: int) -> tuple[Array, Array]:
    """Return up to `most` samples of a Gaussian between exponentials of a slope, and their derivatives in the variance."""
    squares = np.arange(min(np.ceil(np.sqrt(2.0 * depth * variance) + steepest * variance) + 1.0, most)) ** 2
    taps = np.exp(-0.5 * squares / variance) / np.sqrt(2.0 * np.pi * variance)
    return taps, taps * 0.5 * (squares / variance - 1.0) / variance
