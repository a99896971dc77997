"""Steps on one grid in one compiled loop, for transitions with a decomposition and for Gaussian kernels.

A transition is v -> constant after U exp(-time rates) U' before v. For a system without time it is exp(tau A), A the
Kolmogorov operator, with before = 1 / scale and after = scale. A Gaussian kernel exp(k0 + k1 y + k2 y^2) N(x; a y + b, V)
takes this form on one grid for x and y, because x y = (x^2 + y^2 - (x - y)^2) / 2: U diagonalizes the second derivative,
time is V / a, and before and after are exponentials of quadratic polynomials. Wide kernels are filters of positive numbers,
which are accurate in the tails.

A sample multiplies the density after the transition.  An increment acts in three parts,

    exp(b / 6) exp(tau A / 2) exp(2 b / 3 - tau G b'^2 / 72) exp(tau A / 2) exp(b / 6),     b = h'S^-1 dy - tau h'S^-1 h / 2,

which is of fourth order in tau (Chin 1997, scheme A).  The residual of the splitting is, with the third and fifth commutators
for a Gaussian density of the variance P,

    tau^2 std(G^2 b'^2 b'') / 2160 + 7 tau^3 sqrt(8) (G / P) rms(G^2 b''^2) / 8640 + tau^4 rate^2 rms([A, [b, A]]) / 2880
    + tau^3 rms((dL/dt) b) / 2880,

L the backward operator.  With s substeps of an increment, s^-4 of that.  The loop stops before the first step that is not
accurate enough or needs another grid.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import boolean, float64, int64, types, void
from numpy.typing import NDArray

from zakai.numerics.compiled import kernel
from zakai.numerics.line_window import CUT, figures_of, waves

Array = NDArray[Any]

COLUMNS = ("gained", "mean", "variance", "aliasing", "edge", "negative", "time", "depth", "growth", "made", "error")
FACTOR, SPLIT, KERNEL = 0, 1, 2  # the observation acts after the transition, inside by splitting, or inside the kernel
_NOISE = 3e-15
_WIDE = 1.96  # variance of a kernel, in squares of the spacing, from which its samples are a filter
MOST_SUBSTEPS = 8


class Grid(NamedTuple):
    """What a step knows of its grid: `modes` and `rates` of the transition; tables (N,), (m, N).

    `drift` is f where the system does not depend on time, and phi' for Gaussian kernels in the gauge e^phi.
    """

    modes: Array
    transposed: Array
    rates: Array
    scale: Array
    drift: Array
    h: Array
    slope: Array
    curvature: Array
    covariance: float
    spacing: float


class Steps(NamedTuple):
    """The K steps to take.

    `kinds` (K,) are FACTOR, SPLIT or KERNEL.  `observed` (K, m) are zero where nothing is observed, as are the inverses of S
    `precisions` (K, m, m).  `constants` (K,) are those of the log-likelihoods.  `channels` (K, P, 6) are a, b, V, k0, k1, k2 of
    Gaussian kernels for x relative to the centre of the grid: of the whole interval, of its halves, of its quarters, and so on,
    as many as there are; empty for a system without time.
    """

    kinds: Array
    lengths: Array
    observed: Array
    precisions: Array
    constants: Array
    channels: Array


class Limits(NamedTuple):
    """What a step must keep: the spectrum that need not be resolved, the largest error that is made, and of the splitting."""

    negligible: float
    error: float
    splitting: float
    generous: int


_V, _M, _T = float64[::1], float64[:, ::1], float64[:, :, ::1]


@kernel(types.UniTuple(float64, 3)(_V))  # type: ignore[no-untyped-call]
def _moments(values: Array) -> tuple[float, float, float]:
    """The sum of values, and their mean and variance as an index from the middle."""
    mass, mean, square = 0.0, 0.0, 0.0
    half = values.size // 2
    for j in range(values.size):
        mass += values[j]
        mean += (j - half) * values[j]
        square += (j - half) ** 2 * values[j]
    mean /= mass
    return mass, mean, square / mass - mean * mean


@kernel(float64(_V, _V, _V, _V, _V, _V, float64, float64, float64, float64))
def _residual(
    values: Array, b: Array, first: Array, second: Array, drift: Array, change: Array, covariance: float, acceleration: float,
    spacing: float, tau: float,
) -> float:  # fmt: skip
    """The residual of the splitting of an increment, relative to the density; `change` and `acceleration` are df/dt and dG/dt."""
    size, G = values.size, covariance
    mass, mean, variance = _moments(values)
    mean, variance = mean + size // 2, variance * spacing * spacing
    third = third_square = bent = upward = twice = twice_square = flow = seen = moving = 0.0
    for j in range(2, size - 2):
        p = values[j] / mass
        if p < 1e-12:
            continue
        seen += p
        part = G * G * first[j] * first[j] * second[j]
        third += p * part
        third_square += p * part * part
        bent += p * (G * second[j]) ** 4
        moving += p * (change[j] * first[j] + 0.5 * acceleration * second[j]) ** 2
        # L b at three points, L the backward operator, and its differences.
        below = drift[j - 1] * first[j - 1] + 0.5 * G * second[j - 1]
        here = drift[j] * first[j] + 0.5 * G * second[j]
        above = drift[j + 1] * first[j + 1] + 0.5 * G * second[j + 1]
        rise = (above - below) / (2.0 * spacing)
        again = drift[j] * rise + 0.5 * G * (above - 2.0 * here + below) / (spacing * spacing)
        upward += p * G * rise * rise
        twice += p * again
        twice_square += p * again * again
        flow += p * drift[j] * (j - mean) * spacing
    if not (seen > 0.5 and variance > 0):
        return np.inf
    growth, turning = G / variance, abs(flow) / variance
    spread = np.sqrt(max(third_square - third * third, 0.0))
    curved = np.sqrt(bent)
    commutator = np.sqrt(max(twice_square - twice * twice, 0.0)) + 2.0 * np.sqrt(upward * growth) + growth * np.sqrt(2.0 * curved)
    residual = tau**2 / 2160.0 * spread + 7.0 / 8640.0 * tau**3 * np.sqrt(8.0) * growth * curved
    residual += tau**3 / 2880.0 * np.sqrt(moving)
    total: float = residual + tau**4 / 2880.0 * (growth + turning) ** 2 * commutator
    return total


@kernel(float64(_M, _M, _M, _M, _V, int64, float64, _V, _V, _V))
def _exponent(
    h: Array, slope: Array, curvature: Array, precision: Array, observed: Array, at: int, share: float, b: Array, first: Array,
    second: Array,
) -> float:  # fmt: skip
    """Write h'S^-1 (y - share h / 2) less its value at a point, and its derivatives; return the largest difference.

    Large numbers cancel in this way before they are squared.
    """
    m, size, largest = h.shape[0], h.shape[1], 0.0
    for j in range(size):
        total, turned, bent = 0.0, 0.0, 0.0
        for i in range(m):
            pull, bend, weighted = 0.0, 0.0, 0.0
            for l in range(m):
                pull += precision[i, l] * (h[l, j] - h[l, at])
                bend += precision[i, l] * slope[l, j]
                weighted += precision[i, l] * (observed[l] - share * h[l, at])
            total += (h[i, j] - h[i, at]) * (weighted - 0.5 * share * pull)
            turned += slope[i, j] * (weighted - share * pull)
            bent += curvature[i, j] * (weighted - share * pull) - share * slope[i, j] * bend
        if not (total > -1e8):
            total, turned, bent = -1e8, 0.0, 0.0
        b[j], first[j], second[j] = total, turned, bent
        largest = max(largest, abs(total))
    return largest


@kernel(void(_V, float64, float64, _V, boolean))
def _quadratic(found: Array, slope: float, curvature: float, scale: Array, divided: bool) -> None:
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


@kernel(float64(_V, _V, _V, _V, float64))
def _filtered(now: Array, before: Array, after: Array, inner: Array, variance: float) -> float:
    """Replace values by after times the convolution of before values with a Gaussian; all of it is positive."""
    size, half = now.size, 0.5 / variance
    top = 1.0 / np.sqrt(2.0 * np.pi * variance)
    for j in range(size):
        inner[j] = now[j] * before[j]
        now[j] = top * inner[j]
    for n in range(1, min(size, int(np.ceil(9.0 * np.sqrt(variance))) + 1)):
        weight = top * np.exp(-half * n * n)
        for j in range(n, size):
            now[j] += weight * inner[j - n]
        for j in range(size - n):
            now[j] += weight * inner[j + n]
    total = 0.0
    for j in range(size):
        now[j] *= after[j]
        total += now[j]
    return 2e-15 if total < np.inf else np.inf


@kernel(float64(_V, _M, _M, _V, _V, _V, _V, float64, float64))
def _transition(
    now: Array, modes: Array, transposed: Array, rates: Array, before: Array, after: Array, inner: Array, time: float, most: float
) -> float:  # fmt: skip
    """Replace values by after U exp(-time rates) U' before values; return their relative rounding error.

    It is infinite where beyond the support it might exceed `most`.
    """
    reach, top, highest = 0.0, 0.0, 0.0
    for j in range(now.size):
        inner[j] = now[j] * before[j]
        reach += inner[j] * inner[j]
    coefficients = np.dot(transposed, inner)
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
    rounding: float = noise * highest / top
    return rounding


@kernel(
    types.UniTuple(int64, 2)(  # type: ignore[no-untyped-call]
        _V, _M, _M, _V, _V, _V, _M, _M, _M, float64, float64, int64[::1], _V, _M, _T, _V, _T, float64, float64, float64, float64,
        int64, _M, _M, _M, _M
    )
)  # fmt: skip
def _advance(
    values: Array, modes: Array, transposed: Array, rates: Array, scale: Array, drift: Array, h: Array, slope: Array,
    curvature: Array, covariance: float, spacing: float, kinds: Array, lengths: Array, observed: Array, precisions: Array,
    constants: Array, channels: Array, before: float, negligible: float, most: float, most_splitting: float, generous: int,
    cosines: Array, sines: Array, densities: Array, out: Array,
) -> tuple[int, int]:  # fmt: skip
    """The number of steps that were taken, and of the substeps that the next one needs where their kernels are not known.

    The second number is -1 where the density needs another grid for the next step.
    """
    size, m = values.size, h.shape[0]
    now = values.copy()
    b, first, second, outer, inner = np.zeros(size), np.zeros(size), np.zeros(size), np.zeros(size), np.zeros(size)
    begin, between, flow, change = np.zeros(size), np.zeros(size), drift.copy(), np.zeros(size)
    early, late = np.zeros(size), np.zeros(size)
    gaussian = channels.shape[1] > 0
    half = size // 2
    error = before
    if not gaussian:
        _quadratic(early, 0.0, 0.0, scale, True)
        _quadratic(late, 0.0, 0.0, scale, False)
    for k in range(lengths.size):
        tau, precision, constant = lengths[k], precisions[k], constants[k]
        share = 0.0 if kinds[k] == KERNEL else (tau if kinds[k] == SPLIT else 1.0)
        at = int(np.argmax(now))
        _, mean, width_before = _moments(now)
        seen = _exponent(h, slope, curvature, precision, observed[k], at, share, b, first, second) > 0.0
        for i in range(m):
            for l in range(m):
                if kinds[k] == FACTOR:
                    constant -= 0.5 * (observed[k, i] - h[i, at]) * precision[i, l] * (observed[k, l] - h[l, at])
                else:
                    constant += h[i, at] * precision[i, l] * (observed[k, l] - 0.5 * share * h[l, at])
        # The transition: whole, or in two halves of each of some equal substeps.
        splitting, rounding, edge, aliasing_before = 0.0, 0.0, 0.0, 0.0
        inside = kinds[k] == SPLIT and seen
        for j in range(size):
            begin[j] = now[j]
            if inside and b[j] > 40.0 and now[j] < 1e-6 * now[at]:
                return k, 0
        substeps = 1
        spread, exponent = covariance * tau, 0.0
        while True:
            parts = 2 * substeps if inside else 1
            rounding = 0.0
            if gaussian:
                if 2 * parts - 1 > channels.shape[1]:
                    return k, substeps
                spread, exponent = 0.0, 0.0
                for part in range(parts):
                    a, shift, variance, k0, k1, k2 = channels[k, parts - 1 + part]
                    if not (variance > 0.0 and a > 0.0):
                        return k, 0
                    spread += variance
                    exponent += k0 - 0.5 * shift * shift / variance - 0.5 * np.log(a)
            if inside:
                for j in range(size):
                    outer[j] = np.exp(b[j] / (6.0 * substeps))
                    between[j] = np.exp(2.0 * b[j] / (3.0 * substeps) - spread / substeps / 72.0 * (first[j] / substeps) ** 2)
            for part in range(parts):
                time = tau / parts
                if gaussian:
                    a, shift, variance, k0, k1, k2 = channels[k, parts - 1 + part]
                    time = variance / a
                    _quadratic(
                        early,
                        (k1 - a * shift / variance) * spacing,
                        (k2 + 0.5 * a * (1.0 - a) / variance) * spacing**2,
                        scale,
                        True,
                    )
                    _quadratic(late, shift / variance * spacing, 0.5 * (a - 1.0) / variance * spacing**2, scale, False)
                if inside and part % 2 == 0:
                    for j in range(size):
                        now[j] *= outer[j]
                if gaussian and time > _WIDE * spacing * spacing:
                    rounding += _filtered(now, early, late, inner, time / (spacing * spacing))
                else:
                    rounding += _transition(now, modes, transposed, rates, early, late, inner, time, 0.1 * most)
                if inside:
                    for j in range(size):
                        now[j] *= between[j] if part % 2 == 0 else outer[j]
            if not inside:
                break
            if substeps == 1:
                acceleration = 0.0
                if gaussian:
                    one, two = channels[k, 1], channels[k, 2]
                    acceleration = (two[2] - one[2]) * 4.0 / tau**2
                    for j in range(size):
                        x = (j - half) * spacing
                        flow[j] = ((one[0] + two[0] - 2.0) * x + one[1] + two[1]) / tau + drift[j] * spread / tau
                        change[j] = ((two[0] - one[0]) * x + two[1] - one[1]) * 4.0 / tau**2 + drift[j] * acceleration
                whole = _residual(now, b, first, second, flow, change, spread / tau, acceleration, spacing, tau)
                splitting = whole
                if whole > most_splitting:
                    needed = np.ceil((whole / most_splitting) ** 0.25)
                    if not (needed <= MOST_SUBSTEPS):
                        return k, 0
                    substeps = int(needed)
                    while gaussian and substeps & (substeps - 1):  # kernels are known for powers of two
                        substeps += 1
                    splitting = whole / substeps**4
                    for j in range(size):
                        now[j] = begin[j]
                    continue
                if not (whole <= most_splitting):
                    return k, 0
            break
        constant += exponent
        if not (rounding < max(1e-11, 1e-3 * most)):
            return k, 0
        left, right, low, high, negative, aliasing, middle, highest, nyquist = figures_of(now, CUT, negligible, cosines, sines)
        edge = max(left, right)
        if not (edge <= max(1e-11, 4.0 * aliasing)) or not (aliasing <= 30.0 * negligible):
            return k, 0
        mass = 0.0
        for j in range(size):
            if now[j] < 0.0:
                now[j] = 0.0
            mass += now[j]
        if not (1e-200 < mass < 1e200):
            return k, 0
        gained = np.log(mass) + constant
        for j in range(size):
            now[j] /= mass
        _, mean, width = _moments(now)
        predicted, depth, growth, floor = width, 0.0, 0.0, _NOISE + aliasing + edge + rounding
        if kinds[k] == FACTOR and seen:
            # The sample: as in `line_posterior`.
            aliasing_before = aliasing
            largest, best = 0.0, -np.inf
            for j in range(size):
                largest = max(largest, now[j])
            for j in range(size):
                first[j] = np.log(now[j]) if now[j] > 0 else -np.inf
                best = max(best, first[j] + b[j])
            total = 0.0
            for j in range(size):
                outer[j] = np.exp(first[j] + b[j] - best)
                total += outer[j]
            if not (-np.inf < best < np.inf and total > 0):
                return k, 0
            reference = np.log(largest)
            for j in range(size):
                growth += np.exp(min(b[j] + reference - best - np.log(total), 80.0))
                now[j] = outer[j] / total
                if now[j] > 0:
                    depth += now[j] * (reference - first[j])
            left, right, low, high, lost, aliasing, middle, highest, nyquist = figures_of(now, CUT, negligible, cosines, sines)
            edge = max(edge, left, right)
            if not (max(left, right) < 1e-10) or not (aliasing <= 30.0 * negligible):
                return k, 0
            gained += np.log(total) + best
            _, mean, width = _moments(now)
        worst = max(aliasing, aliasing_before)
        made = 2.0 * worst + 10.0 * edge + rounding + splitting + 10.0 * negative + min(floor * growth, 1.0)
        if not (made <= most):
            return k, 0
        ratio = np.sqrt(max(width_before * width, 0.0)) / max(predicted, 1e-300)
        if kinds[k] != FACTOR:
            ratio *= np.exp(-min(0.5 * spread / max(width_before * spacing * spacing, 1e-300), 5.0))
        error = made + error * min(max(ratio, 0.3), 1.0)
        densities[k] = now
        row = out[k]
        row[0], row[1], row[2], row[3], row[4], row[5] = gained, mean, width, worst, edge, negative
        row[6], row[7], row[8], row[9], row[10] = rounding + splitting, depth, growth, made, error
        # Whether the same grid serves for the next step: as in `line_window.fitted`.
        margin = max(3, size // 16)
        points = high - low + 1.0
        resolving = 0.92 * nyquist / (max(highest, 0.0) + 1.0)
        if low < margin or high >= size - margin or resolving < 0.97:
            return k + 1, -1
        if size > generous and size > 1.6 * (1.2 * points * min(1.0, 1.0 / resolving) + 16.0):
            return k + 1, -1
    return lengths.size, 0


def advance(values: Array, grid: Grid, steps: Steps, before: float, limits: Limits) -> tuple[Array, Array, int]:
    """Return the densities (J, N) after the first J of K intervals, what is reported of them (J, 11), see `COLUMNS`, and how many
    substeps the next step needs where their kernels are missing; else zero, or -1 if the density needs another grid.

    Args:
        values: probabilities (N,).
        grid: the grid.
        steps: the steps.
        before: the estimate of the relative error of `values`.
        limits: what a step must keep.
    """
    count, size = len(steps.lengths), len(values)
    densities, out = np.empty((count, size)), np.empty((count, len(COLUMNS)))
    taken, substeps = _advance(
        np.ascontiguousarray(values), grid.modes, grid.transposed, grid.rates, grid.scale, grid.drift, grid.h, grid.slope,
        grid.curvature, grid.covariance, grid.spacing, steps.kinds, steps.lengths, steps.observed, steps.precisions,
        steps.constants, steps.channels, before, limits.negligible, limits.error, limits.splitting, limits.generous, *waves(size),
        densities, out,
    )  # fmt: skip
    return densities[:taken], out[:taken], substeps
