"""Steps on one grid in one compiled loop, for transitions with a decomposition and for Gaussian kernels.

A sample multiplies the density after the transition (`numerics/line_transition.py`).  An increment acts in three parts,

    exp(b / 6) exp(tau A / 2) exp(2 b / 3 - tau G b'^2 / 72) exp(tau A / 2) exp(b / 6),     b = h'S^-1 dy - tau h'S^-1 h / 2,

in as many substeps as its error asks for (`numerics/line_splitting.py`).

For Gaussian kernels the grid is a window of a long table, and the loop moves it by whole spacings.  It stops before the first
step that is not accurate enough, or needs another grid or kernels of more substeps, and says so.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import boolean, float64, int64, types
from numpy.typing import NDArray

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.line_splitting import exponent_of, residual
from zakai.numerics.line_transition import (
    BAND,
    WIDE,
    circular_moments,
    decomposed,
    filtered,
    moments,
    quadratic,
    separated,
    shifted,
    support,
    wrapped,
)
from zakai.numerics.line_window import ALIGNMENT, CUT, figures_of, waves

Array = NDArray[Any]

COLUMNS = (
    "gained", "mean", "variance", "aliasing", "edge", "negative", "time", "depth", "growth", "made", "error", "log_floor",
)  # fmt: skip
FACTOR, SPLIT, KERNEL = 0, 1, 2  # the observation acts after the transition, inside by splitting, or inside the kernel
OK, FAILED, SUBSTEPS, RANGE, AFTER = 0, 1, 2, 3, 4  # why the loop ends
LOG_NOISE = -33.4  # logarithm of the error of a decomposition relative to the maximum
MOST_SUBSTEPS = 16
NARROW = 7.0  # support of a density, in standard deviations of the noise, below which a step is left to another grid
RELIABLE = 1e-3  # of the promised error: smaller estimates are not reported


class Grid(NamedTuple):
    """What a step knows of its grid: `modes` and `rates` of the decomposition; `table` (2 + 3 m, T), rows phi, f, h, h', h''.

    Without Gaussian kernels the transition is e^phi exp(tau A) e^-phi, f the drift, and the table that of the grid.  With them
    phi is the gauge and f its derivative, and the table is longer than the grid, which begins at `start`; its first point is
    `offset` away from the origin of the kernels.
    """

    modes: Array
    rates: Array
    table: Array
    start: int
    offset: float
    covariance: float
    spacing: float
    closed: bool


class Steps(NamedTuple):
    """The K steps to take.

    `kinds` (K,) are FACTOR, SPLIT or KERNEL.  `observed` (K, m) are zero where nothing is observed, as are the inverses of S
    `precisions` (K, m, m).  `constants` (K,) are those of the log-likelihoods.  `channels` (K, P, 6) are a, b, V, k0, k1, k2 of
    Gaussian kernels: of the whole interval, of its halves, of its quarters, and so on, NaN where they are not known; empty for a
    system without time.
    """

    kinds: Array
    lengths: Array
    observed: Array
    precisions: Array
    constants: Array
    channels: Array

    def after(self, count: int) -> Steps:
        """Return the steps without the first ones."""
        return Steps(*(part[count:] for part in self))


class Limits(NamedTuple):
    """What a step must keep.

    `negligible` is the spectrum that need not be resolved, `error` the largest error that is made, `splitting` that of one
    increment, `cut` the density relative to its maximum that a grid must hold, `generous` the size of a grid that is kept though
    fewer points would do, and `finest` that of the largest grid that is taken so that kernels are filters of positive numbers.
    """

    negligible: float
    error: float
    splitting: float
    cut: float
    generous: float
    finest: float


class Taken(NamedTuple):
    """The densities after the steps that were taken, the first points of their grids in the table, what is reported of them.

    `why` says why the loop ended, and `answer` what it needs: the number of substeps, or the range of a grid relative to the
    centre of the present one and its spacing.
    """

    densities: Array
    starts: Array
    reports: Array
    why: int
    answer: Array


_V, _M, _T = float64[::1], float64[:, ::1], float64[:, :, ::1]


@kernel(boolean(float64, float64, float64))
def narrow(points: float, spacing: float, variance: float) -> bool:
    """Whether noise of a variance makes the support of a density far wider: its grid cannot serve after the interval."""
    within: bool = points * spacing < NARROW * np.sqrt(variance)
    return within


@helper
def _attempt(
    now: Array, table: Array, modes: Array, rates: Array, cosines: Array, sines: Array, kind: int, tau: float,
    observed: Array, precision: Array, constant: float, channels: Array, offset: float, covariance: float, spacing: float,
    closed: bool, limits: Array, log_floor: float, row: Array, answer: Array,
) -> int:  # fmt: skip
    """Advance a density by one interval on one grid; write the report; return OK or what is needed instead.

    `answer` receives the support and the spacing that is needed, in spacings.
    """
    negligible, most, most_splitting = limits[0], limits[1], limits[2]
    cut = max(limits[3], min(30.0 * np.exp(log_floor), CUT))
    size, m = now.size, observed.size
    half, gaussian = size // 2, channels.shape[0] > 0
    gauge, drift = table[0], table[1]
    h, slope, curvature = table[2 : 2 + m], table[2 + m : 2 + 2 * m], table[2 + 2 * m :]
    b, first, second, inner = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    early, late, scale = np.empty(size), np.empty(size), np.empty(size)
    outer, between = np.empty(size), np.empty(size)
    at = 0
    begin = np.empty(size)
    for j in range(size):
        begin[j] = now[j]
        if now[j] > now[at]:
            at = j
    low, high = support(now, cut)
    width_before = moments(now)[2]
    if kind == FACTOR and not gaussian and not closed and narrow(high - low, spacing, covariance * tau):
        return FAILED
    share = 0.0 if kind == KERNEL else (tau if kind == SPLIT else 1.0)
    seen = exponent_of(h, slope, curvature, precision, observed, at, share, b, first, second) > 0.0
    for i in range(m):
        for l in range(m):
            if kind == FACTOR:
                constant -= 0.5 * (observed[i] - h[i, at]) * precision[i, l] * (observed[l] - h[l, at])
            else:
                constant += h[i, at] * precision[i, l] * (observed[l] - 0.5 * share * h[l, at])
    for j in range(size):
        scale[j] = np.exp(gauge[j] - gauge[at]) if gauge[j] != gauge[at] else 1.0
        early[j], late[j] = 1.0 / scale[j], scale[j]
    # The transition: whole, or in two halves of each of some equal substeps.
    inside = kind == SPLIT and seen
    splitting, rounding, substeps, positive = 0.0, 0.0, 1, gaussian
    spread, exponent, contraction = covariance * tau, 0.0, 1.0
    clipped = 0.0  # largest value beside values that became zero
    while True:
        parts = 2 * substeps if inside else 1
        rounding, clipped, positive = 0.0, 0.0, gaussian
        for j in range(size):
            now[j] = begin[j]
        if gaussian:
            if 2 * parts - 1 > channels.shape[0] or np.isnan(channels[parts - 1, 0]):
                answer[0] = parts
                return SUBSTEPS
            spread, exponent, contraction, narrowest = 0.0, 0.0, 1.0, np.inf
            for part in range(parts):
                a, variance = channels[parts - 1 + part, 0], channels[parts - 1 + part, 2]
                if not (variance > 0.0 and a > 0.0):
                    return FAILED
                spread += variance
                contraction *= a
                narrowest = min(narrowest, variance / a)
            if narrowest < WIDE * spacing * spacing:
                positive = False
                needed = np.sqrt(narrowest / (1.1 * WIDE))
                count = 2.0 * np.pi / needed if closed else (high - low) * spacing / needed * 1.2 + 2 * ALIGNMENT
                if count < limits[5]:
                    answer[0], answer[1], answer[2] = (low - half) * spacing, (high - half) * spacing, needed
                    return RANGE
        if inside:
            for j in range(size):
                if not gaussian and b[j] > 40.0 and now[j] < 1e-6 * now[at]:
                    return FAILED
                outer[j] = np.exp(b[j] / (6.0 * substeps))
                between[j] = outer[j] ** 4 * np.exp(-spread / substeps / 72.0 * (first[j] / substeps) ** 2)
        for part in range(parts):
            time = tau / parts
            if inside and part % 2 == 0:
                for j in range(size):
                    now[j] *= outer[j]
            if gaussian:
                a, shift, variance, k0, k1, k2 = channels[parts - 1 + part]
                shift += (a - 1.0) * offset
                k0 += (k1 + k2 * offset) * offset
                k1 += 2.0 * k2 * offset
                time = variance / a
                exponent += k0 - 0.5 * np.log(a)
                if closed:
                    if a != 1.0 or k1 != 0.0 or k2 != 0.0 or not positive:
                        return FAILED
                    rounding += wrapped(now, inner, shift / spacing, time / (spacing * spacing), 8.0 - np.log(cut))
                else:
                    exponent -= 0.5 * shift * shift / variance
                    pull, square = k1 - a * shift / variance, k2 + 0.5 * a * (1.0 - a) / variance
                    quadratic(early, pull * spacing, square * spacing**2, scale, True)
                    quadratic(late, shift / variance * spacing, 0.5 * (a - 1.0) / variance * spacing**2, scale, False)
                    noise, end = filtered(now, early, late, time / (spacing * spacing), 8.0 - np.log(cut))
                    rounding, clipped = rounding + noise, max(clipped, end)
            else:
                rounding += decomposed(now, modes, rates, early, late, inner, time, 0.1 * most, closed)
            if inside:
                for j in range(size):
                    now[j] *= between[j] if part % 2 == 0 else outer[j]
        if not inside or substeps > 1:
            break
        flow, change, acceleration = drift, np.zeros(size), 0.0
        if gaussian:
            one, two = channels[1], channels[2]
            acceleration = (two[2] - one[2]) * 4.0 / tau**2
            flow = np.empty(size)
            for j in range(size):
                x = (j - half) * spacing + offset
                flow[j] = ((one[0] + two[0] - 2.0) * x + one[1] + two[1]) / tau + drift[j] * spread / tau
                change[j] = ((two[0] - one[0]) * x + two[1] - one[1]) * 4.0 / tau**2 + drift[j] * acceleration
        splitting = residual(now, b, first, second, flow, change, spread / tau, acceleration, spacing, tau)
        if splitting <= most_splitting:
            break
        needed = np.ceil((splitting / most_splitting) ** 0.25)
        if not (needed <= MOST_SUBSTEPS):
            return FAILED
        substeps = int(needed)
        while gaussian and substeps & (substeps - 1):  # kernels are known for powers of two
            substeps += 1
        splitting /= substeps**4
        exponent = 0.0
    constant += exponent
    if not (rounding < max(1e-11, 1e-3 * most)):
        return FAILED
    left, right, begins, ends, negative, aliasing, middle, highest, nyquist = figures_of(now, cut, negligible, cosines, sines)
    bound = max(100.0 * cut, 0.0 if positive else 4.0 * aliasing)
    edge = 0.0 if closed else max(left, right)
    if gaussian and not positive:  # what is outside of the band is filtered too
        aliasing = max(aliasing, middle)
    if not (aliasing <= 30.0 * negligible):
        answer[0], answer[1], answer[2] = (low - half) * spacing, (high - half) * spacing, 0.7 * spacing
        return RANGE if gaussian and aliasing < np.inf else FAILED
    if not (edge <= bound):
        if not gaussian or np.isnan(edge):
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
    if kind == FACTOR and seen:
        # The sample: as in `line_posterior`, on a finer grid where the product is not resolved.
        largest, best, total = 0.0, -np.inf, 0.0
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
        left, right, begins, ends, lost, aliasing, middle, highest, nyquist = figures_of(now, cut, negligible, cosines, sines)
        if not (aliasing <= 30.0 * negligible):
            answer[0], answer[1], answer[2] = (low - half) * spacing, (high - half) * spacing, 0.6 * spacing
            return RANGE if positive and aliasing < np.inf else FAILED
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
    if kind != FACTOR:
        ratio *= np.exp(-min(0.5 * spread / max(width_before * spacing * spacing, 1e-300), 5.0))
    row[0], row[3], row[4], row[5], row[6] = gained, worst, edge, negative, rounding + splitting
    row[7] = depth / max(np.log(most) - np.log(floor), 2.3) if floor > 0.0 else 0.0
    row[8], row[9] = growth, made
    ratio = 1.0 if separated(now) else min(max(ratio, 0.3), 1.0)
    # No estimate is reliable far below the tolerance.
    row[10] = max(made + row[10] * ratio, RELIABLE * most)
    row[11] = min(log_floor + max(depth - 1.0, 0.0), 0.0)
    if gaussian:
        first_one, last_one = support(now, cut)
        begins, ends = float(first_one), float(last_one)
    answer[0], answer[1], answer[2] = begins, ends, (BAND if gaussian else 0.92) * nyquist / (max(highest, 0.0) + 1.0)
    return OK


@kernel(
    types.UniTuple(int64, 2)(  # type: ignore[no-untyped-call]
        _V, int64, _M, _M, _V, _M, _M, float64, float64, float64, boolean, int64[::1], _V, _M, _T, _V, _T, float64, float64,
        _V, _V, _M, int64[::1], _M
    )
)  # fmt: skip
def _advance(
    values: Array, start: int, table: Array, modes: Array, rates: Array, cosines: Array, sines: Array,
    offset: float, covariance: float, spacing: float, closed: bool, kinds: Array, lengths: Array, observed: Array,
    precisions: Array, constants: Array, channels: Array, error: float, log_floor: float, limits: Array, answer: Array,
    densities: Array, starts: Array, out: Array,
) -> tuple[int, int]:  # fmt: skip
    """The number of steps that were taken, and why the loop ended."""
    size, generous = values.size, limits[4]
    half, gaussian = size // 2, channels.shape[1] > 0
    movable = gaussian and not closed
    home = start + half
    now = values.copy()
    local = table[:, start : start + size].copy()
    resolving = 0.0  # not known
    for k in range(lengths.size):
        if movable:
            # The range after the transition, as if the density were Gaussian.
            cut = max(limits[3], min(30.0 * np.exp(log_floor), CUT))
            low, high = support(now, cut)
            centre, width, spread = 0.5 * (low + high) - half, 0.5 * (high - low), 0.0
            at = offset + spacing * (start + half)
            parts = channels[k, :1] if not np.isnan(channels[k, 0, 0]) else channels[k, 1:3]
            for part in range(parts.shape[0]):
                a, shift, variance = parts[part, 0], parts[part, 1] + (parts[part, 0] - 1.0) * at, parts[part, 2]
                centre, width, spread = a * centre + shift / spacing, abs(a) * width, a * a * spread + variance
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
                if start + by < 0 or start + by + size > table.shape[1]:
                    return k, FAILED
                now, start = shifted(now, by, size), start + by
                local = table[:, start : start + size].copy()
        row = out[k]
        row[10] = error
        status = _attempt(
            now, local, modes, rates, cosines, sines, kinds[k], lengths[k], observed[k], precisions[k], constants[k],
            channels[k], offset + spacing * (start + half), covariance, spacing, closed, limits, log_floor, row, answer,
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
        if resolving < 0.97 or abs(home - table.shape[1] // 2) > table.shape[1] // 4:
            return k + 1, AFTER
        if closed:
            if size > generous and size > 2.2 * size / resolving:
                return k + 1, AFTER
        elif not movable:
            if low < margin or high >= size - margin:
                return k + 1, AFTER
            if size > generous and size > 1.6 * (1.2 * points * min(1.0, 1.0 / resolving) + 16.0):
                return k + 1, AFTER
    return lengths.size, OK


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
    taken, why = _advance(
        np.ascontiguousarray(values), grid.start, grid.table, grid.modes, grid.rates, *waves(size), grid.offset,
        grid.covariance, grid.spacing, grid.closed, *steps, error, log_floor, np.array(limits), answer, densities, starts, out,
    )  # fmt: skip
    return Taken(densities[:taken], starts[:taken], out[:taken], why, answer)
