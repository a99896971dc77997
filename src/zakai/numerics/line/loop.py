"""Steps on one grid in one compiled loop.

The transition of an interval is by the modes of the operator (`line/modes.py`), a Gaussian kernel (`line/gaussian_kernels.py`) or
a splitting into diffusion and a potential (`line/splitting.py`).  A sample multiplies the density after the transition
(`line/steps.py`); an increment is a part of the potential, or of the kernel.

With kernels or potentials the grid is a window of a longer table, and the loop moves it by whole spacings.  It stops before the
first step that is not accurate enough, or needs another grid or table, and returns why.
"""

from __future__ import annotations

from functools import cache, lru_cache
from itertools import product as product_of
from typing import Any

import numpy as np
from numba import float64, int64, types

from zakai.numerics.arrays import Array
from zakai.numerics.compiled import kernel
from zakai.numerics.line import steps as ls
from zakai.numerics.line.averages import AVERAGES, WHOLE
from zakai.numerics.line.density import circular_rows, highest_of, moments, separated, shifted, spectrum, support, waves
from zakai.numerics.line.gaussian_kernels import BAND, convolved, kernel_of
from zakai.numerics.line.product import WEAK_SHARE, weak_error, weaken
from zakai.numerics.line.resolution import GROSS, RELIABLE, RESOLVED, SPECTRUM_FACTOR, step_error
from zakai.numerics.line.splitting import Accuracy, divided
from zakai.numerics.line.window import ALIGNMENT, CUT

_V, _M = float64[::1], float64[:, ::1]


@cache
def _loop(kernels: bool, splits: bool, varying: bool, samples: bool, weak: bool, closed: bool) -> Any:
    """Return the loop with the code of these mechanisms only."""

    @kernel(
        types.UniTuple(int64, 2)(  # type: ignore[no-untyped-call]
            ls.START_TYPE, ls.GRID_TYPE, ls.STEPS_TYPE, int64, _M, _V, ls.CONSTANTS_TYPE, ls.RESULTS_TYPE
        )
    )  # fmt: skip
    def advance(
        state: ls.Start, grid: ls.Grid, steps: ls.Steps, begin: int, observed: Array, limits: Array, known: ls.Constants,
        results: ls.Results,
    ) -> tuple[int, int]:  # fmt: skip
        """Return the number of steps, and why the loop ended; the last report receives the answer."""
        values, error, log_floor = state
        table, start, offset, spacing, fine = grid
        kinds, lengths, shares, precisions, constants, kernel_parameters, drifts, outputs, covariances = steps
        averages, cosines, sines = known
        densities, out = results
        negligible, most, generous, size, length = limits[0], limits[1], limits[4], values.size, table.shape[3]
        half, timed, near = size // 2, table.shape[0] > 1, length == size + 2 * ls.TABLE_MARGIN
        density, local = values.copy(), np.empty((table.shape[1], table.shape[2], size))
        b, change, channel, answer = np.empty(size), np.empty(size), np.empty(6), out[-1]
        channel[0] = np.nan
        home, place, status, done = start, -1, ls.OK, 0
        for i in range(observed.shape[0]):
            k = begin + i
            own, row, tau, kind = i if timed else 0, out[i], lengths[k], kinds[k]
            inside, seen = kind == ls.SPLIT or kind == ls.KERNEL, False
            if samples:
                for j in range(observed.shape[1]):
                    seen |= precisions[k, 0, j, j] != 0.0
            c = ls.Coefficients(drifts[k], outputs[k], precisions[k], covariances[k], observed[i], tau, inside)
            cut = max(limits[3], min(30.0 * np.exp(log_floor), CUT))
            low, high = support(density, cut)
            if place != start or timed:
                ls.copied(table[own], start, local)
                place = start
            if kernels:
                kernel_of(kernel_parameters[k], observed[i], tau if kind == ls.KERNEL else np.inf, channel)
            if not closed:
                middle = offset + spacing * (start + half)
                first, last = ls.extent(density, (low, high), channel, local, c, middle, spacing, cut)
                answer[0], answer[1], answer[2], status = first, last, spacing, ls.OK
                if not (last - first < 1e9):
                    status = ls.FAILED
                    break
                fewer = 1.7 * (1.2 * (last - first) + 2 * ALIGNMENT) < size
                if last - first > size or (size > generous and fewer):
                    status = ls.RANGE
                    break
                if first < 0 or last > size - 1:
                    by = ALIGNMENT * int(np.floor((0.5 * (first + last) - half) / ALIGNMENT + 0.5))
                    beyond = abs(by) > length or start + by < 0 or start + by + size > length
                    if beyond or (near and abs(by) > ls.TABLE_MARGIN // 2):
                        status = ls.RANGE
                        break
                    density = shifted(density, by)
                    start, place = start + by, start + by
                    ls.copied(table[own], start, local)
                    low, high = support(density, cut)
            # The transition.
            at, before = highest_of(density), moments(density)[2]
            depth, finest = 8.0 - np.log(cut), (high - low) * 1.2 * spacing / (limits[5] - 2 * ALIGNMENT)
            move = ls.failed(0.0, 0.0)
            if kernels and not np.isnan(channel[0]):
                middle = offset + spacing * (start + half)
                move = convolved(density, local[0, ls.PHI], channel, middle, spacing, finest, depth, closed)
            elif splits:
                accuracy = Accuracy(depth, limits[2] * shares[k], finest)
                move = divided(density, local, c, averages, spacing, closed, varying, accuracy)
            if not (move.error < np.inf and move.rounding < max(RESOLVED, 1e-3 * most)):
                answer[0], answer[1], answer[2] = float(low), float(high), move.needed
                status = ls.RANGE if move.needed > 0.0 and not (move.error < np.inf) else ls.FAILED
                break
            positive = move.needed == 0.0
            asked = ls.Resolution(positive, weak or not seen, cut, negligible, spacing)
            status, mass, aliasing, edge, negative, highest = ls.checked(
                density, (low, high), weak, closed, asked, (cosines, sines), answer
            )
            if status != ls.OK:
                break
            (_, mean, variance), gained = moments(density), np.log(mass) + constants[k] + move.log_factor
            predicted = variance
            log_floor *= min(max(predicted / max(move.contraction**2 * before, 1e-300), 1.0), 20.0)
            log_floor = max(log_floor, np.log(max(cut, move.clipped)))
            floor = np.exp(log_floor) + edge + (0.0 if positive else aliasing)
            # The sample, on a finer grid where the product is not resolved.
            worst, growth, below = aliasing, 0.0, 0.0
            if seen:
                h, centre = ls.observation_of(local, outputs[k, 0], at)
                gained += ls.likelihood(h, centre, precisions[k, 0], observed[i], b)
                if weak:
                    weaken(fine, start, precisions[k, 0], observed[i], centre, b, change)
                added, growth, below = ls.product(density, b)
                left, right, answer[0], answer[1], _, aliasing, _, top, _ = spectrum(
                    density, cut, negligible, cosines, sines, not weak
                )
                limit = SPECTRUM_FACTOR * negligible
                if weak:  # of a kink the spectrum falls slowly
                    aliasing, limit = 0.5 * weak_error(density, change), WEAK_SHARE * most
                else:
                    highest = top
                if not (aliasing <= limit):
                    answer[0], answer[1], answer[2] = float(low), float(high), 0.6 * spacing
                    status = ls.FAILED if weak or not positive or not (aliasing < np.inf) else ls.RANGE
                    if not closed and status == ls.RANGE and aliasing > GROSS:
                        status = ls.UNRESOLVED
                    break
                if np.isnan(added) or not (closed or max(left, right) < 1e-10):
                    status = ls.FAILED
                    break
                if not closed:
                    edge = max(edge, min(left, right) if positive else max(left, right))
                worst, gained, (_, mean, variance) = max(worst, aliasing), gained + added, moments(density)
            # The report.
            row[ls.MEAN], row[ls.VARIANCE] = mean, variance
            made = step_error(worst, edge, negative, move.rounding + move.error, floor * growth)
            if not (made <= most):
                status = ls.FAILED
                break
            ratio = np.sqrt(max(before * variance, 0.0)) / max(predicted, 1e-300)
            if inside:
                ratio *= np.exp(-min(0.5 * move.spread / max(before * spacing * spacing, 1e-300), 5.0))
            ratio = 1.0 if separated(density) else min(max(ratio, 0.3), 1.0)
            # No estimate is reliable far below the tolerance.
            error = max(made + error * ratio, RELIABLE * most)
            row[ls.GAINED], row[ls.ALIASING], row[ls.EDGE], row[ls.NEGATIVE] = gained, worst, edge, negative
            row[ls.TIME] = move.rounding + move.error
            row[ls.DEPTH] = below / max(np.log(most) - np.log(floor), 2.3) if floor > 0.0 else 0.0
            log_floor = min(log_floor + max(below - 1.0, 0.0), 0.0)
            row[ls.GROWTH], row[ls.MADE], row[ls.ERROR], row[ls.LOG_FLOOR] = growth, made, error, log_floor
            for j in range(size):
                densities[i, j] = density[j]
            row[ls.START], row[ls.PAIRS], row[ls.SUBSTEPS], row[ls.NEEDED] = start, move.pairs, move.substeps, move.needed
            home, done = start, i + 1
            # Whether the same grid serves for the next step: as in `window.fitted`.
            resolving = BAND * (size // 2) / (max(highest, 0.0) + 1.0)
            if resolving < 0.97 or (not near and abs(home + half - length // 2) > length // 4):
                status = ls.AFTER
            elif closed:
                status = ls.AFTER if size > generous and size > 2.2 * size / resolving else ls.OK
            elif near and abs(start - ls.TABLE_MARGIN) > ls.TABLE_MARGIN // 3:
                status = ls.TABLE
            if status != ls.OK:
                break
        if status == ls.RANGE or status == ls.UNRESOLVED:  # the step is tried again on another grid, from that of the last state
            for j in range(2):
                answer[j] = spacing * (answer[j] + start - home - half)
        return done, status

    return advance


def declare_usual() -> None:
    """Declare the loops of all mechanisms but those of samples of an h with kinks, so that they can be compiled beforehand."""
    for samples, closed in ((False, False), (True, False), (True, True)):
        for kernels, splits, varying in ((True, False, False), *product_of((False, True), (True,), (False, True))):
            _loop(kernels, splits, varying, samples, False, closed)


def advance(
    mechanisms: ls.Mechanisms, state: ls.Start, grid: ls.Grid, steps: ls.Steps, first: int, observed: Array, limits: Array
) -> ls.Segment:
    """Return steps, as many as are accurate on one grid.

    Args:
        mechanisms: what the steps may need.
        state: where the steps begin.
        steps: the intervals, of which `first` is the first that is taken.
        observed: what is observed in the intervals from there on (K, m), zero where nothing is.
        limits: what a step must keep, as the fields of `Limits`.
    """
    count, size = len(observed), len(state.values)
    results = ls.Results(np.empty((count, size)), np.empty((count + 1, ls.FIGURES)))
    known = _constants(size, mechanisms.varying)
    done, number = _loop(*mechanisms)(state, grid, steps, first, observed, limits, known, results)
    densities, out = results
    if done < count:
        densities = densities[:done]
    if mechanisms.closed:
        circular_rows(densities, known.cosines, known.sines, out)
    return ls.Segment(densities, out[:done], ls.STATUSES[number], out[-1, :3])


@lru_cache(maxsize=32)
def _constants(size: int, varying: bool) -> ls.Constants:
    """Return what the loop reads of all grids of a size."""
    return ls.Constants(AVERAGES if varying else WHOLE, *waves(size))
