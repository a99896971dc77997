"""Steps on one grid in one compiled loop.

The transition of an interval is a Gaussian kernel or the decomposition of the operator (`numerics/line_transition.py`), or it is
split into diffusion and a potential (`numerics/line_splitting.py`).  A sample multiplies the density after the transition; an
increment is a part of the potential, or of the kernel.

With kernels or potentials the grid is a window of a longer table, and the loop moves it by whole spacings.  It stops before the
first step that is not accurate enough, or needs another grid or table, and returns why.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import boolean, float64, int64, types
from numpy.typing import NDArray

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.line_splitting import (
    AVERAGES,
    DRIFT,
    EARLY,
    LATE,
    MEAN,
    MOST_MAGNUS,
    PHI,
    add,
    averaged,
    averaging,
    differences,
    exponent_added,
    observation_of,
    residual,
    split,
)
from zakai.numerics.line_transition import (
    BAND,
    WIDE,
    circular_moments,
    decomposed,
    filtered,
    highest_of,
    moments,
    quadratic,
    separated,
    shifted,
    support,
    taps_of,
    wrapped,
)
from zakai.numerics.line_weak import WEAK_SHARE, weak_error, weaken
from zakai.numerics.line_window import ALIGNMENT, CUT, figures_of, waves

Array = NDArray[Any]

COLUMNS = (
    "gained", "mean", "variance", "aliasing", "edge", "negative", "time", "depth", "growth", "made", "error", "log_floor",
)  # fmt: skip
# The transition: whole with a sample after it, split with increments inside, whole with increments inside, split with a sample.
FACTOR, SPLIT, KERNEL, SPLIT_FACTOR = 0, 1, 2, 3
OK, FAILED, RANGE, AFTER, TABLE = 0, 1, 2, 3, 4  # why the loop ends
LOG_NOISE = -33.4  # logarithm of the error of a decomposition relative to the maximum
NARROW = 7.0  # support of a density, in standard deviations of the noise, below which a step is left to another grid
MOST_SUBSTEPS = 64
RELIABLE = 1e-3  # of the promised error: smaller estimates are not reported
MARGIN = 96  # points of a table of coefficients in time beyond the grid, of which a third may be used before it is made again


class Grid(NamedTuple):
    """What a step knows of its grid: `modes` and `rates` of the decomposition, and the terms `table` (K, R, 4 + m, T).

    The rows of a term are phi of Gaussian kernels or of the decomposition, the integral of f over the spacing above a point, f,
    f' and h.  K = 1 where the terms do not depend on the interval.  With a decomposition the table is that of the grid.  Else it
    is longer than the grid, which begins at `start`; the first point of the table is `offset` away from the origin of the
    kernels.  `covariance` is the largest G, where there is a decomposition.  `fine` (m, F) are the values of an h with kinks at
    the nodes of `line_weak`, else empty.
    """

    modes: Array
    rates: Array
    table: Array
    covariance: float
    start: int
    offset: float
    spacing: float
    closed: bool
    fine: Array


class Steps(NamedTuple):
    """The K steps to take.

    `kinds` (K,) are FACTOR, SPLIT, KERNEL or SPLIT_FACTOR.  `observed` (K, m) are zero where nothing is observed, as are the
    inverses of S `precisions` (K, P, m, m).  `constants` (K,) are those of the log-likelihoods.  `channels` (K, 6) are a, b, V,
    k0, k1, k2 of Gaussian kernels, NaN where the transition is split; (K, 0) where the operator has a decomposition.  `drifts`
    (K, Q, R) and `outputs` (K, P, R) are the factors of the terms of f and h, and `covariances` (K, Q) are G, at the Gauss nodes
    of an interval, or one number where they do not depend on time.
    """

    kinds: Array
    lengths: Array
    observed: Array
    precisions: Array
    constants: Array
    channels: Array
    drifts: Array
    outputs: Array
    covariances: Array

    def after(self, count: int) -> Steps:
        """Return the steps without the first ones."""
        return Steps(*(part[count:] for part in self))


class Limits(NamedTuple):
    """What a step must keep.

    `negligible` is the spectrum that need not be resolved, `error` the largest error that is made, `splitting` that of the
    splitting of one interval, `cut` the density relative to its maximum that a grid must hold, `generous` the size of a grid that
    is kept though fewer points would do, and `finest` that of the largest grid that is taken so that kernels are filters of
    positive numbers.
    """

    negligible: float
    error: float
    splitting: float
    cut: float
    generous: float
    finest: float


class Taken(NamedTuple):
    """The densities after the steps that were taken, the first points of their grids in the table, what is reported of them.

    `why` says why the loop ended, and `answer` the range of the grid that it needs, relative to the centre of the present one,
    and its spacing.
    """

    densities: Array
    starts: Array
    reports: Array
    why: int
    answer: Array


_V, _M, _T, _Q = float64[::1], float64[:, ::1], float64[:, :, ::1], float64[:, :, :, ::1]


@helper
def _divided(
    now: Array, table: Array, drifts: Array, outputs: Array, precisions: Array, covariances: Array, averages: Array,
    observed: Array, inside: bool, tau: float, at: int, spacing: float, closed: bool, depth: float, most: float, finest: float,
) -> tuple[float, float, float, float, float, float]:  # fmt: skip
    """Replace a density by that after a split interval, in as many averages and substeps as its error asks for.

    The samples of a Gaussian of the variance V, in squares of the spacing, are a filter of positive numbers with the relative
    error 2 exp(-2 pi^2 V).  Narrower kernels are taken where these would need a spacing below `finest`.

    Returns the error, that of rounding, what may have become zero, int G dt, the spacing that positive filters need where this
    one is too large, else zero, and the constant of the exponents; infinite errors where the interval is not accurate.
    """
    size, begin = now.size, np.zeros(now.size)
    add(begin, 1.0, now)
    phi, first, second = np.empty(size), np.empty(size), np.empty(size)
    drift, b = np.empty(size), np.empty(size)
    varying = averages.shape[0] > 1
    magnus, substeps = 0, 1  # two averages of each of so many parts, or the mean
    if varying:
        whole, pair = averaging(
            now, table, drifts, outputs, precisions, covariances, averages[0], tau, observed, inside, at, spacing
        )
        if whole > most:
            magnus = int(min(max(np.ceil(1.1 * (pair / most) ** 0.25), 1.0), 1e6))
    if magnus > MOST_MAGNUS:
        return np.inf, np.inf, 1.0, 0.0, 0.0, 0.0
    for _ in range(8):
        for j in range(size):
            now[j] = begin[j]
        parts = max(magnus, 1)
        splitting, time, divided, rounding, clipped, spread, constant, needed = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        wide = np.log(1e4 * parts * substeps / most) / (2.0 * np.pi**2)
        for i in range(2 * magnus if magnus > 0 else 1):
            weights = averages[parts * (parts - 1) // 2 + i // 2]
            which = MEAN if magnus == 0 else (EARLY if i % 2 == 0 else LATE)
            length, own_spread, shift, added = averaged(
                table, drifts, outputs, precisions, covariances, weights[which], tau, observed, inside, at, spacing, closed, phi,
                drift, b,
            )  # fmt: skip
            if not (own_spread > 0.0):
                return np.inf, np.inf, 1.0, spread, 0.0, constant
            variance = 0.5 * own_spread / substeps
            if variance < wide * spacing * spacing:
                needed = np.sqrt(variance / (1.05 * wide))
                if closed or needed > finest:
                    return np.inf, np.inf, 1.0, spread, needed, constant
            differences(b, spacing, closed, first, second)
            noise, end = split(now, phi, b, first, own_spread, shift, substeps, spacing, depth, closed, needed > 0.0)
            if needed > 0.0 and not (noise < 1e-2 * most):  # perhaps the exponents vary too much between points
                return np.inf, np.inf, 1.0, spread, max(needed, 0.6 * spacing), constant
            error = residual(now, b, first, second, drift, own_spread, spacing, length)
            splitting += error / substeps**4
            rounding, clipped, spread, constant = rounding + noise, max(clipped, end), spread + own_spread, constant + added
            if varying and (magnus == 0 or i % 2 == 1):
                whole, pair = averaging(
                    now, table, drifts, outputs, precisions, covariances, weights, tau, observed, inside, at, spacing
                )
                time, divided = time + (pair if magnus > 0 else whole), divided + pair
            total = moments(now)[0]
            if not (1e-200 < total < 1e200):
                splitting = np.inf
            if not (splitting < np.inf):
                break
        if splitting <= most and time <= most:
            return splitting + time, rounding, clipped, spread, needed, constant
        if not (splitting + time < np.inf):
            substeps *= 4
        else:
            if time > most:
                magnus = int(min(max(np.ceil(1.1 * parts * (divided / most) ** 0.25), 1.0), 1e6))
            rest = splitting * (parts / max(magnus, 1)) ** 4
            substeps = int(min(np.ceil(substeps * max(1.02 * (rest / most) ** 0.25, 1.0 / substeps)), 1e6))
        if magnus > MOST_MAGNUS or max(magnus, 1) * substeps > MOST_SUBSTEPS:
            break
    return np.inf, np.inf, 1.0, 0.0, 0.0, 0.0


@helper
def _convolved(
    now: Array, phi: Array, channel: Array, middle: float, spacing: float, depth: float, closed: bool
) -> tuple[float, float, float]:
    """Replace a density by that after a Gaussian kernel; return rounding, what may have become zero, and the exponent."""
    size = now.size
    early, late, scale = np.empty(size), np.empty(size), np.ones(size)
    a, shift, variance, k0, k1, k2 = channel
    shift += (a - 1.0) * middle
    k0 += (k1 + k2 * middle) * middle
    k1 += 2.0 * k2 * middle
    exponent, width = k0 - 0.5 * np.log(a), variance / a / (spacing * spacing)
    at = highest_of(now)
    for j in range(size):
        if phi[j] != phi[at]:
            scale[j] = np.exp(phi[j] - phi[at])
    if closed:
        if a != 1.0 or k1 != 0.0 or k2 != 0.0 or width < WIDE:
            return np.inf, 1.0, exponent
        for j in range(size):
            now[j] /= scale[j]
        rounding = wrapped(now, early, shift / spacing, width, depth)
        for j in range(size):
            now[j] *= scale[j]
        return rounding, 0.0, exponent
    exponent -= 0.5 * shift * shift / variance
    pull, square = k1 - a * shift / variance, k2 + 0.5 * a * (1.0 - a) / variance
    quadratic(early, pull * spacing, square * spacing**2, scale, True)
    quadratic(late, shift / variance * spacing, 0.5 * (a - 1.0) / variance * spacing**2, scale, False)
    for j in range(size):
        now[j] *= early[j]
        scale[j] = 1.0
    rounding, clipped = filtered(now, taps_of(width, depth, size, width < WIDE), late, scale, width < WIDE)
    return rounding, clipped, exponent


@kernel(boolean(float64, float64, float64))
def narrow(points: float, spacing: float, variance: float) -> bool:
    """Whether noise of a variance makes the support of a density far wider: its grid cannot serve after the interval."""
    within: bool = points * spacing < NARROW * np.sqrt(variance)
    return within


@helper
def _attempt(
    now: Array, table: Array, modes: Array, rates: Array, averages: Array, cosines: Array, sines: Array, kind: int, tau: float,
    observed: Array, precisions: Array, constant: float, channel: Array, drifts: Array, outputs: Array, covariances: Array,
    covariance: float, middle: float, spacing: float, closed: bool, limits: Array, log_floor: float, row: Array, answer: Array,
    fine: Array, start: int,
) -> int:  # fmt: skip
    """Advance a density by one interval on one grid; write the report; return OK or what is needed instead.

    `answer` receives the support and the spacing that is needed, in spacings.
    """
    negligible, most = limits[0], limits[1]
    cut = max(limits[3], min(30.0 * np.exp(log_floor), CUT))
    size, m = now.size, observed.size
    half, gaussian = size // 2, channel.size > 0
    b = np.zeros(size)
    at = highest_of(now)
    low, high = support(now, cut)
    width_before = moments(now)[2]
    if not gaussian and not closed and narrow(high - low, spacing, covariance * tau):
        return FAILED
    precision = precisions[0]
    informative = kind == SPLIT or kind == KERNEL
    splitting, rounding, clipped, positive, spread, contraction = 0.0, 0.0, 0.0, gaussian, 0.0, 1.0
    depth = 8.0 - np.log(cut)
    if gaussian:
        if kind == SPLIT or kind == SPLIT_FACTOR:
            splitting, rounding, clipped, spread, needed, exponent = _divided(
                now, table, drifts, outputs, precisions, covariances, averages, observed, kind == SPLIT, tau, at, spacing, closed,
                depth, limits[2], ((high - low) * 1.2 * spacing / (limits[5] - 2 * ALIGNMENT)),
            )  # fmt: skip
            if not (splitting < np.inf):
                answer[0], answer[1], answer[2] = (low - half) * spacing, (high - half) * spacing, needed
                return RANGE if needed > 0.0 else FAILED
            positive = needed == 0.0
        else:
            spread, contraction = channel[2], channel[0]
            if not (spread > 0.0 and contraction > 0.0):
                return FAILED
            if spread < WIDE * contraction * spacing * spacing:
                positive, needed = False, np.sqrt(spread / contraction / (1.1 * WIDE))
                count = 2.0 * np.pi / needed if closed else (high - low) * spacing / needed * 1.2 + 2 * ALIGNMENT
                if count < limits[5]:
                    answer[0], answer[1], answer[2] = (low - half) * spacing, (high - half) * spacing, needed
                    return RANGE
            rounding, clipped, exponent = _convolved(now, table[0, PHI], channel, middle, spacing, depth, closed)
        constant += exponent
    else:
        phi, early, late = table[0, PHI], np.empty(size), np.empty(size)
        for j in range(size):
            late[j] = np.exp(phi[j] - phi[at]) if phi[j] != phi[at] else 1.0
            early[j] = 1.0 / late[j]
        rounding = decomposed(now, modes, rates, early, late, b, tau, 0.1 * most, closed)
    weakly, change = fine.shape[1] > 0, np.zeros(size)
    if not (rounding < max(1e-11, 1e-3 * most)):
        return FAILED
    left, right, begins, ends, negative, aliasing, upper, highest, nyquist = figures_of(now, cut, negligible, cosines, sines)
    bound = max(100.0 * cut, 0.0 if positive else 4.0 * aliasing)
    edge = 0.0 if closed else max(left, right)
    if gaussian and not positive:  # what is outside of the band is filtered too
        aliasing = max(aliasing, upper)
    if not (aliasing <= 30.0 * negligible):
        answer[0], answer[1], answer[2] = (low - half) * spacing, (high - half) * spacing, 0.7 * spacing
        return RANGE if gaussian and not weakly and aliasing < np.inf else FAILED
    if not (edge <= bound):
        if not (gaussian or weakly) or np.isnan(edge):
            return FAILED
        answer[0] = (min(low, (0 if left > bound else low) - size // 3 * (left > bound)) - half) * spacing
        answer[1] = (max(high, (size if right > bound else high) + size // 3 * (right > bound)) - half) * spacing
        answer[2] = spacing
        return RANGE
    mass = 0.0
    for j in range(size):
        now[j] = max(now[j], 0.0)
        mass += now[j]
    if not (1e-200 < mass < 1e200):
        return FAILED
    for j in range(size):
        now[j] /= mass
    gained, predicted, depth, growth, worst = np.log(mass) + constant, moments(now)[2], 0.0, 0.0, aliasing
    if gaussian:
        log_floor *= min(max(predicted / max(contraction**2 * width_before, 1e-300), 1.0), 20.0)
        log_floor = max(log_floor, np.log(max(cut, clipped)))
        floor = np.exp(log_floor) + edge + (0.0 if positive else aliasing)
    else:
        log_floor = LOG_NOISE
        floor = np.exp(log_floor) + aliasing + edge + rounding
    sampled = False
    if kind == FACTOR or kind == SPLIT_FACTOR:
        b = np.zeros(size)
        h = observation_of(table, outputs[0])
        exponent_added(h, precision, observed, 1.0, 1.0, at, b)
        if weakly and np.any(precision != 0.0):
            weaken(fine, start, precision, observed, h[:, at].copy(), b, change)
        for j in range(size):
            if not (b[j] > -1e8):
                b[j] = -1e8
            sampled |= b[j] != 0.0
        for i in range(m):
            for l in range(m):
                if precision[i, l] != 0.0:
                    gained -= 0.5 * (observed[i] - h[i, at]) * precision[i, l] * (observed[l] - h[l, at])
    if sampled:
        # The sample: as in `line_posterior`, on a finer grid where the product is not resolved.
        largest, best, total = 0.0, -np.inf, 0.0
        first, outer = np.empty(size), np.empty(size)
        for j in range(size):
            largest = max(largest, now[j])
            first[j] = np.log(now[j]) if now[j] > 0 else -np.inf
            best = max(best, first[j] + b[j])
        for j in range(size):
            outer[j] = np.exp(first[j] + b[j] - best)
            total += outer[j]
        if not (-np.inf < best < np.inf and total > 0):
            return FAILED
        reference = np.log(largest)
        for j in range(size):
            growth += np.exp(min(b[j] + reference - best - np.log(total), 200.0))
            now[j] = outer[j] / total
            if now[j] > 0:
                depth += now[j] * (reference - first[j])
        before = highest
        left, right, begins, ends, lost, aliasing, upper, highest, nyquist = figures_of(now, cut, negligible, cosines, sines)
        if weakly:  # of a kink the spectrum falls slowly
            aliasing, highest = 0.5 * weak_error(now, change), before
        if not (aliasing <= (WEAK_SHARE * most if weakly else 30.0 * negligible)):
            answer[0], answer[1], answer[2] = (low - half) * spacing, (high - half) * spacing, 0.6 * spacing
            return RANGE if positive and not weakly and aliasing < np.inf else FAILED
        if not closed:
            if not (max(left, right) < 1e-10):
                return FAILED
            edge = max(edge, min(left, right) if positive else max(left, right))
        worst = max(worst, aliasing)
        gained += np.log(total) + best
    width = 0.0
    if closed:
        _, row[1], row[2] = circular_moments(now, cosines, sines)
        width = moments(now)[2]
    else:
        _, row[1], row[2] = moments(now)
        width = row[2]
    made = 2.0 * worst + 10.0 * edge + rounding + splitting + 10.0 * negative + min(floor * growth, 1.0)
    if not (made <= most):
        return FAILED
    ratio = np.sqrt(max(width_before * width, 0.0)) / max(predicted, 1e-300)
    if informative:
        ratio *= np.exp(-min(0.5 * spread / max(width_before * spacing * spacing, 1e-300), 5.0))
    row[0], row[3], row[4], row[5], row[6] = gained, worst, edge, negative, rounding + splitting
    row[7] = depth / max(np.log(most) - np.log(floor), 2.3) if floor > 0.0 else 0.0
    row[8], row[9] = growth, made
    ratio = 1.0 if separated(now) else min(max(ratio, 0.3), 1.0)
    # No estimate is reliable far below the tolerance.
    row[10] = max(made + row[10] * ratio, RELIABLE * most)
    row[11] = min(log_floor + max(depth - 1.0, 0.0), 0.0)
    if gaussian or weakly:
        first_one, last_one = support(now, cut)
        begins, ends = float(first_one), float(last_one)
    answer[0], answer[1], answer[2] = begins, ends, (BAND if gaussian else 0.92) * nyquist / (max(highest, 0.0) + 1.0)
    return OK


@helper
def _cut(table: Array, start: int, to: Array) -> None:
    """Copy the columns of terms (R, 4 + m, T) from `start` on."""
    for r in range(to.shape[0]):
        for i in range(to.shape[1]):
            for j in range(to.shape[2]):
                to[r, i, j] = table[r, i, start + j]


@helper
def _flow(factors: Array, table: Array, at: int) -> float:
    """Return f at a point."""
    total = 0.0
    for r in range(factors.size):
        total += factors[r] * table[r, DRIFT, at]
    return total


@kernel(
    types.UniTuple(int64, 2)(  # type: ignore[no-untyped-call]
        _V, int64, _Q, float64, _M, _V, _T, _M, _M, float64, float64, boolean, int64[::1], _V, _M, _Q, _V, _M, _T, _T, _M,
        float64, float64, _V, _V, _M, int64[::1], _M, _M
    )
)  # fmt: skip
def _advance(
    values: Array, start: int, table: Array, covariance: float, modes: Array, rates: Array, averages: Array, cosines: Array,
    sines: Array, offset: float, spacing: float, closed: bool, kinds: Array, lengths: Array, observed: Array, precisions: Array,
    constants: Array, channels: Array, drifts: Array, outputs: Array, covariances: Array, error: float, log_floor: float,
    limits: Array, answer: Array, densities: Array, starts: Array, out: Array, fine: Array,
) -> tuple[int, int]:  # fmt: skip
    """The number of steps that were taken, and why the loop ended."""
    size, generous = values.size, limits[4]
    half, gaussian = size // 2, channels.shape[1] > 0
    movable, timed, length = gaussian and not closed, table.shape[0] > 1, table.shape[3]
    home = start + half
    now = values.copy()
    local = np.empty((table.shape[1], table.shape[2], size))
    place = -1
    resolving = 0.0  # not known
    for k in range(lengths.size):
        own = k if timed else 0
        if place != start or timed:
            _cut(table[own], start, local)
            place = start
        if movable:
            # The range after the transition, as if the density were Gaussian.
            cut = max(limits[3], min(30.0 * np.exp(log_floor), CUT))
            low, high = support(now, cut)
            left, right, spread = float(low - half), float(high - half), covariances[k, 0] * lengths[k]
            if np.isnan(channels[k, 0]):
                left += min(_flow(drifts[k, 0], local, low) * lengths[k] / spacing, 0.0)
                right += max(_flow(drifts[k, 0], local, high) * lengths[k] / spacing, 0.0)
            else:
                at = offset + spacing * (start + half)
                a, shift, spread = channels[k, 0], channels[k, 1] + (channels[k, 0] - 1.0) * at, channels[k, 2]
                left, right = a * left + shift / spacing, a * right + shift / spacing
            centre, width = 0.5 * (left + right), 0.5 * abs(right - left)
            width = np.sqrt(width * width - 2.0 * np.log(cut) * spread / spacing**2) + 2.0
            begins, ends = min(centre - width + half, float(low)), max(centre + width + half, float(high))
            count = ends - begins
            if not (count < 1e9):
                return k, FAILED
            if count > size or (size > generous and 1.7 * (1.2 * count + 2 * ALIGNMENT) < size):
                answer[0], answer[1], answer[2] = (begins - half) * spacing, (ends - half) * spacing, spacing
                return k, RANGE
            if begins < 0 or ends > size - 1:
                by = ALIGNMENT * int(np.round((0.5 * (begins + ends) - half) / ALIGNMENT))
                if abs(by) > length or start + by < 0 or start + by + size > length or (timed and abs(by) > MARGIN // 2):
                    answer[0], answer[1], answer[2] = (begins - half) * spacing, (ends - half) * spacing, spacing
                    return k, RANGE
                now, start = shifted(now, by, size), start + by
                _cut(table[own], start, local)
                place = start
        row = out[k]
        row[10] = error
        status = _attempt(
            now, local, modes, rates, averages, cosines, sines, kinds[k], lengths[k], observed[k], precisions[k], constants[k],
            channels[k], drifts[k], outputs[k], covariances[k], covariance, offset + spacing * (start + half), spacing, closed,
            limits, log_floor, row, answer, fine, start,
        )  # fmt: skip
        if status != OK:
            # The step is tried again on another grid, from the grid of the last state.
            if status == RANGE:
                answer[0], answer[1] = answer[0] + spacing * (start + half - home), answer[1] + spacing * (start + half - home)
            return k, status
        error, log_floor, resolving = row[10], row[11], answer[2]
        for j in range(size):
            densities[k, j] = now[j]
        starts[k] = start
        home = start + half
        # Whether the same grid serves for the next step: as in `line_window.fitted`.
        low, high = int(answer[0]), int(answer[1])
        margin = max(3, size // 16)
        points = high - low + 1.0
        if resolving < 0.97 or (not timed and abs(home - length // 2) > length // 4):
            return k + 1, AFTER
        if closed:
            if size > generous and size > 2.2 * size / resolving:
                return k + 1, AFTER
        elif not movable:
            if low < margin or high >= size - margin:
                return k + 1, AFTER
            if size > generous and size > 1.6 * (1.2 * points * min(1.0, 1.0 / resolving) + 16.0):
                return k + 1, AFTER
        elif timed and abs(start - MARGIN) > MARGIN // 3:
            return k + 1, TABLE
    return lengths.size, OK


_WHOLE = np.ones((1, 5, 1))


def advance(values: Array, grid: Grid, steps: Steps, error: float, log_floor: float, limits: Limits) -> Taken:
    """Return what the first steps, as many as the loop takes, lead to.

    Args:
        values: probabilities (N,).
        grid: the grid.
        steps: the steps.
        error: the estimate of the relative error of `values`.
        log_floor: the logarithm of the error of small values, relative to the largest.
        limits: what a step must keep.
    """
    count, size = len(steps.lengths), len(values)
    densities, out, starts = np.empty((count, size)), np.empty((count, len(COLUMNS))), np.empty(count, np.int64)
    answer = np.zeros(4)
    averages = AVERAGES if steps.covariances.shape[1] > 1 else _WHOLE
    taken, why = _advance(
        np.ascontiguousarray(values), grid.start, grid.table, grid.covariance, grid.modes, grid.rates, averages, *waves(size),
        grid.offset, grid.spacing, grid.closed, *steps, error, log_floor, np.array(limits), answer, densities, starts, out,
        grid.fine,
    )  # fmt: skip
    return Taken(densities[:taken], starts[:taken], out[:taken], why, answer)
