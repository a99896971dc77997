"""Steps on one grid in one compiled loop.

The transition of an interval is by the modes of the operator (`line_modes`), a Gaussian kernel (`line_filters`) or a splitting
into diffusion and a potential (`line_splitting`).  A sample multiplies the density after the transition (`line_sample`); an
increment is a part of the potential, or of the kernel.

With kernels or potentials the grid is a window of a longer table, and the loop moves it by whole spacings.  It stops before the
first step that is not accurate enough, or needs another grid or table, and returns why.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import boolean, float64, int64, types
from numpy.typing import NDArray

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.line_averages import AVERAGES
from zakai.numerics.line_density import circular_moments, highest_of, moments, separated, spectrum, support, waves
from zakai.numerics.line_filters import BAND, convolved
from zakai.numerics.line_modes import LOG_NOISE, decomposed, narrow
from zakai.numerics.line_sample import likelihood, product
from zakai.numerics.line_splitting import divided
from zakai.numerics.line_terms import DRIFT, PHI, Transition, failed, observation_of
from zakai.numerics.line_weak import WEAK_SHARE, weak_error, weaken
from zakai.numerics.line_window import ALIGNMENT, CUT

Array = NDArray[Any]

COLUMNS = (
    "gained", "mean", "variance", "aliasing", "edge", "negative", "time", "depth", "growth", "made", "error", "log_floor",
)  # fmt: skip
# The transition: whole with a sample after it, split with increments inside, whole with increments inside, split with a sample.
FACTOR, SPLIT, KERNEL, SPLIT_FACTOR = 0, 1, 2, 3
OK, FAILED, RANGE, AFTER, TABLE = 0, 1, 2, 3, 4  # why the loop ends
RELIABLE = 1e-3  # of the promised error: smaller estimates are not reported
MARGIN = 96  # points of a table of coefficients in time beyond the grid, of which a third may be used before it is made again


class Mechanisms(NamedTuple):
    """What the steps of a record may need; only that is compiled.

    `modes`: transitions by modes, else `kernels` or `splits` or both; `samples`: samples after the transition; `weak`: their
    likelihoods have kinks and act in the weak sense.
    """

    modes: bool
    kernels: bool
    splits: bool
    samples: bool
    weak: bool


class Grid(NamedTuple):
    """The data of a grid: `modes` (N, N), their transpose, `rates` (N,), and terms `table` (K, R, 4 + m, T) as in `line_terms`.

    K = 1 where the terms do not depend on the interval.  With modes the table is that of the grid, and `covariance` the largest
    G.  Else it is longer than the grid, which begins at `start`; the first point of the table is `offset` away from the origin of
    the kernels.  `fine` (m, F) are the values of an h with kinks at the nodes of `line_weak`, else empty.
    """

    modes: Array
    transposed: Array
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
    k0, k1, k2 of Gaussian kernels, NaN where the transition is split.  `drifts`
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


class Segment(NamedTuple):
    """The densities after the first steps, the first points of their grids in the table, and their reports.

    `why` is why the loop ended, and `answer` the range of the grid that it needs, relative to the centre of the present one, and
    its spacing.
    """

    densities: Array
    starts: Array
    reports: Array
    why: int
    answer: Array


_V, _M, _T, _Q = float64[::1], float64[:, ::1], float64[:, :, ::1], float64[:, :, :, ::1]


@helper
def _extent(
    now: Array, low: int, high: int, channel: Array, drifts: Array, table: Array, spread: float, tau: float, middle: float,
    spacing: float, cut: float,
) -> tuple[float, float]:  # fmt: skip
    """Return the range of points that a density occupies after the transition, as if it were Gaussian."""
    half = now.size // 2
    left, right = float(low - half), float(high - half)
    if np.isnan(channel[0]):
        down, up = 0.0, 0.0
        for r in range(drifts.size):
            down, up = down + drifts[r] * table[r, DRIFT, low], up + drifts[r] * table[r, DRIFT, high]
        left, right = left + min(down * tau / spacing, 0.0), right + max(up * tau / spacing, 0.0)
    else:
        shift, spread = (channel[1] + (channel[0] - 1.0) * middle) / spacing, channel[2]
        left, right = channel[0] * left + shift, channel[0] * right + shift
    centre, width = 0.5 * (left + right), 0.5 * abs(right - left)
    width = np.sqrt(width * width - 2.0 * np.log(cut) * spread / spacing**2) + 2.0
    return min(centre - width + half, float(low)), max(centre + width + half, float(high))


@helper
def _checked(
    now: Array, low: int, high: int, filters: bool, weak: bool, positive: bool, closed: bool, cut: float, negligible: float,
    spacing: float, cosines: Array, sines: Array, answer: Array,
) -> tuple[int, float, float, float, float, float]:  # fmt: skip
    """Normalise a prediction that is accurate; return OK, its mass, aliasing, mass at the ends, negative mass, highest frequency.

    `answer` receives the support; where another grid is needed, its range in points and its spacing.
    """
    size = now.size
    left, right, first, last, negative, aliasing, middle, highest, _ = spectrum(now, cut, negligible, cosines, sines)
    bound = max(100.0 * cut, 0.0 if positive else 4.0 * aliasing)
    edge = 0.0 if closed else max(left, right)
    if filters and not positive:  # what is outside of the band is filtered too
        aliasing = max(aliasing, middle)
    answer[0], answer[1], answer[2] = float(low), float(high), 0.7 * spacing
    status, mass = OK, 0.0
    if not (aliasing <= 30.0 * negligible):
        status = RANGE if filters and not weak and aliasing < np.inf else FAILED
    elif not (edge <= bound):
        status = RANGE if (filters or weak) and edge < np.inf else FAILED
        answer[0] = min(low, (0 if left > bound else low) - size // 3 * (left > bound))
        answer[1] = max(high, (size if right > bound else high) + size // 3 * (right > bound))
        answer[2] = spacing
    else:
        for j in range(size):
            now[j] = max(now[j], 0.0)
            mass += now[j]
        if not (1e-200 < mass < 1e200):
            status = FAILED
        for j in range(size):
            now[j] /= mass
        answer[0], answer[1] = first, last
    return status, mass, aliasing, edge, negative, highest


@cache
def _loop(modal: bool, kernels: bool, splits: bool, samples: bool, weak: bool) -> Any:
    """Return the loop with the code of these mechanisms only."""
    filters = not modal

    @kernel(
        types.UniTuple(int64, 2)(  # type: ignore[no-untyped-call]
            _V, int64, _Q, float64, _M, _M, _V, _T, _M, _M, float64, float64, boolean, int64[::1], _V, _M, _Q, _V, _M, _T, _T, _M,
            float64, float64, _V, _V, _M, int64[::1], _M, _M
        )
    )  # fmt: skip
    def advance(
        values: Array, start: int, table: Array, covariance: float, modes: Array, transposed: Array, rates: Array,
        averages: Array, cosines: Array, sines: Array, offset: float, spacing: float, closed: bool, kinds: Array, lengths: Array,
        observed: Array, precisions: Array, constants: Array, channels: Array, drifts: Array, outputs: Array, covariances: Array,
        error: float, log_floor: float, limits: Array, answer: Array, densities: Array, starts: Array, out: Array, fine: Array,
    ) -> tuple[int, int]:  # fmt: skip
        """Return the number of steps, and why the loop ended."""
        negligible, most, generous, size, length = limits[0], limits[1], limits[4], values.size, table.shape[3]
        half, timed, movable = size // 2, table.shape[0] > 1, filters and not closed
        now, local = values.copy(), np.empty((table.shape[1], table.shape[2], size))
        b, change = np.empty(size), np.empty(size)
        home, place, status, done = start, -1, OK, 0
        for k in range(lengths.size):
            own, row, tau = k if timed else 0, out[k], lengths[k]
            cut = max(limits[3], min(30.0 * np.exp(log_floor), CUT))
            low, high = support(now, cut)
            if place != start or timed:
                _copied(table[own], start, local)
                place = start
            if movable:
                first, last = _extent(
                    now, low, high, channels[k], drifts[k, 0], local, covariances[k, 0] * tau, tau,
                    offset + spacing * (start + half), spacing, cut,
                )  # fmt: skip
                answer[0], answer[1], answer[2], status = first, last, spacing, OK
                if not (last - first < 1e9):
                    status = FAILED
                    break
                fewer = 1.7 * (1.2 * (last - first) + 2 * ALIGNMENT) < size
                if last - first > size or (size > generous and fewer):
                    status = RANGE
                    break
                if first < 0 or last > size - 1:
                    by = ALIGNMENT * int(np.floor((0.5 * (first + last) - half) / ALIGNMENT + 0.5))
                    if abs(by) > length or start + by < 0 or start + by + size > length or (timed and abs(by) > MARGIN // 2):
                        status = RANGE
                        break
                    for j in range(size):
                        b[j] = now[j]
                    for j in range(size):
                        now[j] = b[j + by] if 0 <= j + by < size else 0.0
                    start, place = start + by, start + by
                    _copied(table[own], start, local)
                    low, high = support(now, cut)
            # The transition.
            at, before, inside = highest_of(now), moments(now)[2], kinds[k] == SPLIT or kinds[k] == KERNEL
            depth, finest = 8.0 - np.log(cut), (high - low) * 1.2 * spacing / (limits[5] - 2 * ALIGNMENT)
            move = failed(0.0, 0.0)
            if modal:
                if closed or not narrow(high - low, spacing, covariance * tau):
                    rounding = decomposed(now, local[0, PHI], modes, transposed, rates, tau, 0.1 * most, closed)
                    move = Transition(0.0, rounding, 0.0, 0.0, 1.0, 0.0, 0.0)
            elif kernels and not np.isnan(channels[k, 0]):
                middle = offset + spacing * (start + half)
                move = convolved(now, local[0, PHI], channels[k], middle, spacing, finest, depth, closed)
            elif splits:
                move = divided(
                    now, local, drifts[k], outputs[k], precisions[k], covariances[k], averages, observed[k], inside, tau, spacing,
                    closed, depth, limits[2], finest,
                )  # fmt: skip
            if not (move.error < np.inf and move.rounding < max(1e-11, 1e-3 * most)):
                answer[0], answer[1], answer[2] = float(low), float(high), move.needed
                status = RANGE if move.needed > 0.0 and not (move.error < np.inf) else FAILED
                break
            positive = filters and move.needed == 0.0
            status, mass, aliasing, edge, negative, highest = _checked(
                now, low, high, filters, weak, positive, closed, cut, negligible, spacing, cosines, sines, answer
            )
            if status != OK:
                break
            predicted, gained = moments(now)[2], np.log(mass) + constants[k] + move.exponent
            if filters:
                log_floor *= min(max(predicted / max(move.contraction**2 * before, 1e-300), 1.0), 20.0)
                log_floor = max(log_floor, np.log(max(cut, move.clipped)))
                floor = np.exp(log_floor) + edge + (0.0 if positive else aliasing)
            else:
                log_floor = LOG_NOISE
                floor = np.exp(log_floor) + aliasing + edge + move.rounding
            # The sample, on a finer grid where the product is not resolved.
            worst, growth, below, seen = aliasing, 0.0, 0.0, False
            if samples:
                h, centre = observation_of(local, outputs[k, 0], at)
                gained += likelihood(h, centre, precisions[k, 0], observed[k], b)
                if weak:
                    for i in range(centre.size):
                        seen |= precisions[k, 0, i, i] != 0.0
                    if seen:
                        weaken(fine, start, precisions[k, 0], observed[k], centre, b, change)
                        seen = False
                for j in range(size):
                    seen |= b[j] != 0.0
                if seen:
                    added, growth, below = product(now, b)
                    left, right, answer[0], answer[1], _, aliasing, _, top, _ = spectrum(now, cut, negligible, cosines, sines)
                    limit = 30.0 * negligible
                    if weak:  # of a kink the spectrum falls slowly
                        aliasing, limit = 0.5 * weak_error(now, change), WEAK_SHARE * most
                    else:
                        highest = top
                    if not (aliasing <= limit):
                        answer[0], answer[1], answer[2] = float(low), float(high), 0.6 * spacing
                        status = RANGE if positive and not weak and aliasing < np.inf else FAILED
                        break
                    if np.isnan(added) or not (closed or max(left, right) < 1e-10):
                        status = FAILED
                        break
                    if not closed:
                        edge = max(edge, min(left, right) if positive else max(left, right))
                    worst, gained = max(worst, aliasing), gained + added
            # The report.
            row[1], row[2] = moments(now)[1:]
            width = row[2]
            if closed:
                row[1], row[2] = circular_moments(now, cosines, sines)
            made = 2.0 * worst + 10.0 * edge + move.rounding + move.error + 10.0 * negative + min(floor * growth, 1.0)
            if not (made <= most):
                status = FAILED
                break
            ratio = np.sqrt(max(before * width, 0.0)) / max(predicted, 1e-300)
            if inside:
                ratio *= np.exp(-min(0.5 * move.spread / max(before * spacing * spacing, 1e-300), 5.0))
            ratio = 1.0 if separated(now) else min(max(ratio, 0.3), 1.0)
            # No estimate is reliable far below the tolerance.
            error = max(made + error * ratio, RELIABLE * most)
            row[0], row[3], row[4], row[5], row[6] = gained, worst, edge, negative, move.rounding + move.error
            row[7] = below / max(np.log(most) - np.log(floor), 2.3) if floor > 0.0 else 0.0
            log_floor = min(log_floor + max(below - 1.0, 0.0), 0.0)
            row[8], row[9], row[10], row[11] = growth, made, error, log_floor
            for j in range(size):
                densities[k, j] = now[j]
            starts[k], home, done = start, start, k + 1
            # Whether the same grid serves for the next step: as in `line_window.fitted`.
            low, high = int(answer[0]), int(answer[1])
            if filters or weak:
                low, high = support(now, cut)
            resolving = (BAND if filters else 0.92) * (size // 2) / (max(highest, 0.0) + 1.0)
            least, points = max(3, size // 16), high - low + 1.0
            if resolving < 0.97 or (not timed and abs(home + half - length // 2) > length // 4):
                status = AFTER
            elif closed:
                status = AFTER if size > generous and size > 2.2 * size / resolving else OK
            elif modal:
                fewer = size > generous and size > 1.6 * (1.2 * points * min(1.0, 1.0 / resolving) + 16.0)
                status = AFTER if fewer or low < least or high >= size - least else OK
            elif timed and abs(start - MARGIN) > MARGIN // 3:
                status = TABLE
            if status != OK:
                break
        if status == RANGE:  # the step is tried again on another grid, from that of the last state
            for i in range(2):
                answer[i] = spacing * (answer[i] + start - home - half)
        return done, status

    return advance


@helper
def _copied(table: Array, start: int, to: Array) -> None:
    """Copy the columns of terms (R, 4 + m, T) from `start` on."""
    for r in range(to.shape[0]):
        for i in range(to.shape[1]):
            for j in range(to.shape[2]):
                to[r, i, j] = table[r, i, start + j]


_WHOLE = np.ones((1, 5, 1))


def advance(
    mechanisms: Mechanisms, values: Array, grid: Grid, steps: Steps, error: float, log_floor: float, limits: Limits
) -> Segment:
    """Return the first steps, as many as are accurate on one grid.

    Args:
        mechanisms: what the steps may need.
        values: probabilities (N,).
        grid: the grid.
        steps: the steps.
        error: the estimate of the relative error of `values`.
        log_floor: the logarithm of the error of small values, relative to the largest.
        limits: what a step must keep.
    """
    count, size = len(steps.lengths), len(values)
    densities, out, starts = np.empty((count, size)), np.empty((count, len(COLUMNS))), np.empty(count, np.int64)
    answer = np.zeros(3)
    averages = AVERAGES if steps.covariances.shape[1] > 1 else _WHOLE
    done, why = _loop(*mechanisms)(
        np.ascontiguousarray(values), grid.start, grid.table, grid.covariance, grid.modes, grid.transposed, grid.rates, averages,
        *waves(size), grid.offset, grid.spacing, grid.closed, *steps, error, log_floor, np.array(limits), answer, densities,
        starts, out, grid.fine,
    )  # fmt: skip
    return Segment(densities[:done], starts[:done], out[:done], why, answer)
