"""Steps on one grid in one compiled loop.

The transition of an interval is by the modes of the operator (`line_modes`), a Gaussian kernel (`line_filters`) or a splitting
into diffusion and a potential (`line_splitting`).  A sample multiplies the density after the transition (`line_step`); an
increment is a part of the potential, or of the kernel.

With kernels or potentials the grid is a window of a longer table, and the loop moves it by whole spacings.  It stops before the
first step that is not accurate enough, or needs another grid or table, and returns why.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numba import float64, int64, types
from numpy.typing import NDArray

from zakai.numerics.compiled import kernel
from zakai.numerics.line_averages import AVERAGES
from zakai.numerics.line_density import circular_moments, highest_of, moments, separated, spectrum, support, waves
from zakai.numerics.line_filters import BAND, convolved
from zakai.numerics.line_modes import LOG_NOISE, decomposed, narrow
from zakai.numerics.line_segment import (
    AFTER,
    COLUMNS,
    FAILED,
    KERNEL,
    MARGIN,
    OK,
    RANGE,
    RELIABLE,
    SPLIT,
    TABLE,
    Grid,
    Limits,
    Mechanisms,
    Segment,
    Steps,
)  # fmt: skip
from zakai.numerics.line_splitting import divided
from zakai.numerics.line_step import checked, copied, extent, likelihood, product
from zakai.numerics.line_terms import PHI, Transition, failed, observation_of
from zakai.numerics.line_weak import WEAK_SHARE, weak_error, weaken
from zakai.numerics.line_window import ALIGNMENT, CUT

Array = NDArray[Any]

_V, _M, _T, _Q = float64[::1], float64[:, ::1], float64[:, :, ::1], float64[:, :, :, ::1]


@cache
def _loop(modal: bool, kernels: bool, splits: bool, samples: bool, weak: bool, closed: bool) -> Any:
    """Return the loop with the code of these mechanisms only."""
    filters = not modal

    @kernel(
        types.UniTuple(int64, 2)(  # type: ignore[no-untyped-call]
            _V, int64, _Q, float64, _M, _M, _V, _T, _M, _M, float64, float64, int64[::1], _V, _M, _Q, _V, _M, _T, _T, _M,
            float64, float64, _V, _V, _M, int64[::1], _M, _M
        )
    )  # fmt: skip
    def advance(
        values: Array, start: int, table: Array, covariance: float, modes: Array, transposed: Array, rates: Array,
        averages: Array, cosines: Array, sines: Array, offset: float, spacing: float, kinds: Array, lengths: Array,
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
                copied(table[own], start, local)
                place = start
            if movable:
                first, last = extent(
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
                    copied(table[own], start, local)
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
            status, mass, aliasing, edge, negative, highest = checked(
                now, low, high, filters, weak, positive, closed, cut, negligible, spacing, cosines, sines, answer
            )
            if status != OK:
                break
            predicted, gained = moments(now)[2], np.log(mass) + constants[k] + move.log_factor
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
        *waves(size), grid.offset, grid.spacing, *steps, error, log_floor, np.array(limits), answer, densities,
        starts, out, grid.fine,
    )  # fmt: skip
    return Segment(densities[:done], starts[:done], out[:done], why, answer)
