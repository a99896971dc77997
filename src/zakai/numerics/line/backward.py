"""Many intervals backward in time for one state, in compiled loops: by modes of the operator, or by adjoints of splittings.

A message b is p(later observations | x) at the points of the filter's grid, up to a constant.  It is retained where its product
with the filter's density is not negligible, and is zero elsewhere: no path between the supports of two products leads there.

A decomposition acts on psi = F e^s b on a longer grid, with an F that falls to zero towards its ends
(`methods/line/message.py`).  The adjoint of a splitting (`numerics/line/splitting.py`) is the same splitting with phi replaced by
-phi and the averages in reverse order.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64, types

from zakai.numerics.arrays import Array
from zakai.numerics.compiled import helper, kernel
from zakai.numerics.line.averages import AVERAGES, EARLY, LATE, MEAN, MOST_MAGNUS, WHOLE, averaged, averaging, operators
from zakai.numerics.line.density import circular_moments, highest_of, moments, shifted, spectrum, support, waves
from zakai.numerics.line.modes import decayed, propagate
from zakai.numerics.line.resolution import RESOLVED, ROUNDING, SMOOTHER_SHARE
from zakai.numerics.line.splitting import MOST_SUBSTEPS, STEEPEST, Filtering, differences, residual, split
from zakai.numerics.line.steps import (
    CONSTANTS_TYPE,
    GRID_TYPE,
    RESULTS_TYPE,
    SPLIT,
    STEPS_TYPE,
    Coefficients,
    Constants,
    Grid,
    Results,
    Steps,
    copied,
)
from zakai.numerics.line.window import CUT

UNRESOLVED = 1e-5  # spectrum of a smoothed density at the highest frequencies up to which sums over the points are integrals
FEWEST = 12  # points of a message
SMALLEST = 1e-15  # of the maximum: smaller values of psi count as this
SURE = 100.0  # errors of psi from which its small values count
LOG_MASS, MEAN_AT, VARIANCE, ALIASING, EDGE, ERROR = range(6)  # what is reported of a smoothed density


class Limits(NamedTuple):
    """What an interval must keep.

    `error` is the error that it may make, `splitting` that of its splitting.  Smaller values of a smoothed density than
    `negligible`, relative to its maximum, do not count, nor values of the filter's density below `cut`.
    """

    error: float
    splitting: float
    negligible: float
    cut: float


class Message(NamedTuple):
    """b at the points of a grid (N,), zero but from `first` to `last`, or psi on a longer grid (D,), divided by a scale.

    `scale` is the logarithm of the scale, `start` the first point of the grid in the table; `product` (N,) is the smoothed
    density at the same time.
    """

    values: Array
    scale: float
    first: int
    last: int
    start: int
    error: float
    product: Array


class Filtered(NamedTuple):
    """The filter's densities (K, N) before the intervals, their first points in the table, and the error of small values."""

    densities: Array
    starts: Array
    floors: Array


class Gauged(NamedTuple):
    """The rows of `modes` (D, D) are those of psi on a longer grid, with their rates and s (D,).

    Every point from `place` on in steps of `stride` is one of the grid.
    """

    modes: Array
    rates: Array
    gauge: Array
    place: int
    stride: int


class BackwardSteps(NamedTuple):
    """The message before the last `number` intervals, and the smoothed densities (K, N) with their reports."""

    message: Message
    number: int
    products: Array
    reports: Array


class Observed(NamedTuple):
    """What is observed in intervals.

    `logs` (K, N) are the log-likelihoods of what is observed at their ends, `values` (K, m) what is observed in them, zero where
    nothing is; `closed` is whether the grids go around the circle.
    """

    logs: Array
    values: Array
    closed: bool


_V, _M = float64[::1], float64[:, ::1]
MESSAGE = types.NamedTuple([_V, float64, int64, int64, int64, float64, _V], Message)
FILTERED = types.NamedTuple([_M, int64[::1], _V], Filtered)
GAUGED = types.NamedTuple([_V, _V, _V, int64, int64], Gauged)
OBSERVED = types.NamedTuple([_M, _M, boolean], Observed)
LIMITS = types.NamedUniTuple(float64, 4, Limits)


@helper
def multiplied(
    b: Array, density: Array, floor: float, negligible: float, closed: bool, waves: tuple[Array, Array], product: Array,
    row: Array,
) -> tuple[int, int]:  # fmt: skip
    """Write the product with a density, of sum one, and its report; divide b by the sum; return the support, or (0, -1)."""
    size, total, least = b.size, 0.0, floor * density[highest_of(density)]
    for j in range(size):
        product[j] = density[j] * b[j] if density[j] > least else 0.0
    least = CUT * product[highest_of(product)]
    for j in range(size):
        product[j] = product[j] if product[j] > least else 0.0
        total += product[j]
    if not (1e-250 < total < 1e250):
        return 0, -1
    for j in range(size):
        product[j] /= total
        b[j] /= total
    left, right, _, _, _, aliasing, _, _, _ = spectrum(product, CUT, CUT, *waves, False)
    row[LOG_MASS] += np.log(total)
    row[ALIASING], row[EDGE] = aliasing, 0.0 if closed else max(left, right)
    if closed:
        row[MEAN_AT], row[VARIANCE] = circular_moments(product, *waves)
    else:
        _, row[MEAN_AT], row[VARIANCE] = moments(product)
    if not (aliasing <= UNRESOLVED):
        return 0, -1
    begins, ends = (0, size - 1) if closed else support(product, negligible)
    return (begins, ends) if ends - begins >= FEWEST - 1 else (0, -1)


@helper
def spread(b: Array, first: int, last: int) -> float:
    """Return the variance of b as a density between two points, in squares of the spacing."""
    mass, mean, square = 0.0, 0.0, 0.0
    for j in range(first, last + 1):
        mass += b[j]
        mean += (j - first) * b[j]
    mean /= mass
    for j in range(first, last + 1):
        square += (j - first - mean) ** 2 * b[j]
    return square / mass


@helper
def error_share(before: float, between: float, after: float) -> float:
    """Return the share of the error of b that an interval leaves, from variances."""
    return min(max(between / np.sqrt(max(before * after, 1e-300)), 0.3), 1.0)


@kernel(
    types.Tuple((int64, float64, float64, float64))(  # type: ignore[no-untyped-call]
        MESSAGE, FILTERED, GAUGED, OBSERVED, _V, LIMITS, types.UniTuple(_M, 4), RESULTS_TYPE
    )
)  # fmt: skip
def _decomposed(
    message: Message, filtered: Filtered, gauged: Gauged, observed: Observed, lengths: Array, limits: Limits,
    waves: tuple[Array, Array, Array, Array], results: Results,
) -> tuple[int, float, float, float]:  # fmt: skip
    """Return the number of intervals, the error, the logarithm of the scale of psi, which is replaced, and its reliable values.

        psi(start) = U exp(-tau lambda) U' (l psi(stop)),      l the likelihood of what is observed at the end
    """
    psi, scale, _, _, _, error, product = message
    densities, _, floors = filtered
    modes, rates, gauge, place, stride = gauged
    logs, _, closed = observed
    most, negligible, (products, out) = limits.error, limits.negligible, results
    cosines, sines, long_cosines, long_sines = waves
    size, longer, reliable, ratio = product.size, rates.size, 0.0, 0.0
    b, propagated = np.empty(size), np.empty(longer)
    first, last = (0, size - 1) if closed else support(product, negligible)
    at = place + stride * highest_of(product)
    for j in range(size):
        b[j] = psi[place + stride * j] * np.exp(gauge[at] - gauge[place + stride * j])
    for i in range(lengths.size - 1, -1, -1):
        tau, row, completed, likelihood = lengths[i], out[i], lengths.size - 1 - i, logs[i]
        before, top, norm = spread(b, first, last), -np.inf, 0.0
        for j in range(longer):
            top = max(top, likelihood[j])
        for j in range(longer):
            propagated[j] = psi[j] * np.exp(likelihood[j] - top)
            norm += propagated[j] * propagated[j]
        for j in range(first, last + 1):
            b[j] *= np.exp(likelihood[place + stride * j] - likelihood[at])
        between, decay = spread(b, first, last), decayed(rates, tau)
        propagate(modes, decay, propagated)
        highest = propagated[highest_of(propagated)]
        noise = ROUNDING * np.sqrt(norm) * max(1.0, decay[0])
        left, right, _, _, _, aliasing, _, _, _ = spectrum(propagated, CUT, CUT, long_cosines, long_sines, False)
        level = max(noise, (SMALLEST + 2.0 * aliasing) * highest)
        # b relative to where its product with the density is largest.
        density, least = densities[i], floors[i] * densities[i, highest_of(densities[i])]
        reference, weight, total = -np.inf, 0.0, 0.0
        for j in range(size):
            if density[j] > least:
                inner = max(propagated[place + stride * j], SMALLEST * highest)
                reference = max(reference, np.log(inner * density[j]) - gauge[place + stride * j])
        if not (-np.inf < reference < np.inf):
            return completed, error, scale, reliable
        for j in range(size):
            b[j] = 0.0
            if density[j] > least:
                ratio = np.exp(-gauge[place + stride * j] - reference)
                b[j] = max(propagated[place + stride * j], SMALLEST * highest) * ratio
                weight += density[j] * ratio
                total += density[j] * b[j]
        made = level * weight / total + (0.0 if closed else 10.0 * max(left, right))
        if not (made < SMOOTHER_SHARE * most):
            return completed, error, scale, reliable
        row[LOG_MASS] = scale + top + reference
        first, last = multiplied(b, density, floors[i], negligible, closed, (cosines, sines), products[i], row)
        if last < 0:
            return completed, error, scale, reliable
        at = place + stride * highest_of(products[i])
        error = made + error * error_share(before, between, spread(b, first, last))
        row[ERROR] = error
        scale, reliable = np.log(highest / total) - reference, max(SURE * level / highest, RESOLVED)
        for j in range(longer):
            psi[j] = propagated[j] / highest
    return lengths.size, error, scale, reliable


def by_modes(
    message: Message, before: Filtered, gauged: Gauged, logs: Array, lengths: Array, closed: bool, limits: Limits
) -> BackwardSteps:
    """Return the message before the last intervals, as many as the decomposition takes.

    Args:
        message: psi on the longer grid.
        before: the filter's densities.
        gauged: the decomposition.
        logs: the log-likelihoods of what is observed at the end of each interval, on the longer grid (K, D).
        lengths: (K,).
        closed: whether the grid goes around the circle.
        limits: what an interval must keep.
    """
    count, size = len(lengths), len(message.product)
    psi, products, out = message.values.copy(), np.empty((count, size)), np.zeros((count, 6))
    both = *waves(size), *waves(len(gauged.rates))
    completed, error, scale, least = _decomposed(
        message._replace(values=psi), before, gauged._replace(modes=gauged.modes.ravel()), Observed(logs, out, closed), lengths,
        limits, both, Results(products, out),
    )  # fmt: skip
    first, last = 0, len(psi) - 1
    if completed and not closed:
        small, peak = np.flatnonzero(psi <= least), gauged.place + gauged.stride * int(np.argmax(products[count - completed]))
        first = int(np.max(small, where=small < peak, initial=-1)) + 1
        last = int(np.min(small, where=small > peak, initial=len(psi))) - 1
    psi = np.maximum(psi, SMALLEST)
    result = Message(psi, scale, first, last, 0, error, message.product)
    return BackwardSteps(result, completed, products[count - completed :], out[count - completed :])


EXCURSION = 3.9  # standard deviations of the noise that a path between two points goes beyond them, but for exp(-30)


@helper
def held(before: Array, by: int, after: Array, noise: float) -> bool:
    """Return whether a grid holds the paths between two densities on it, with this deviation of the noise in spacings.

    The first density begins `by` points later.  Halfway a path deviates by half of the noise.
    """
    low, high = np.inf, -np.inf
    for values, shift in ((before, by), (after, 0)):
        _, mean, variance = moments(values)
        middle, reach = mean + values.size // 2 + shift, 5.0 * np.sqrt(variance)
        low, high = min(low, middle - reach), max(high, middle + reach)
    return low - 2.5 * noise >= 0.0 and high + 2.5 * noise <= before.size - 1.0


@helper
def _split(
    values: Array, product: Array, table: Array, c: Coefficients, averages: Array, places: tuple[int, int, int],
    shape: tuple[float, bool], accuracy: tuple[float, float],
) -> tuple[float, float]:  # fmt: skip
    """Replace b by that before a split interval; return its error, infinite where it is not accurate, and the constant.

    Args:
        values: b (N,).
        product: the smoothed density (N,) at the end.
        table: the terms of f and h at the points.
        places: the point of which exponents are differences, and the first and the last point of b.
        shape: the spacing, and whether the grid goes around the circle.
        accuracy: the depth of the tails and the largest error.
    """
    size, (at, first, last), (spacing, closed), (depth, most) = values.size, places, shape, accuracy
    phi, slope, curvature, drift, b = np.empty(size), np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    made, constant, magnus = 0.0, 0.0, 0
    if averages.shape[0] > 1:
        both, spreads = np.empty((3, 2, size)), np.empty(3)
        linear = operators(table, c, averages[0], at, both, spreads)
        made, pair = averaging(product, both, spreads, linear, spacing, closed)
        if not (made <= most):
            magnus = int(min(max(np.ceil(1.1 * (pair / most) ** 0.25), 1.0), 1e6))
            made = pair / float(magnus) ** 4
        if magnus > MOST_MAGNUS or not (made < np.inf):
            return np.inf, 0.0
    parts, count = max(magnus, 1), max(2 * magnus, 1)
    for i in range(count - 1, -1, -1):
        weights = averages[parts * (parts - 1) // 2 + i // 2]
        which = MEAN if magnus == 0 else (EARLY if i % 2 == 0 else LATE)
        length, spread, shift, added = averaged(table, c, weights[which], at, spacing, closed, (phi, drift, b))
        if not spread > 0.0:
            return np.inf, 0.0
        differences(b, spacing, closed, slope, curvature)
        error = residual(product, b, slope, curvature, drift, spread, spacing, length)
        substeps = max((count * error / most) ** 0.25, 1.0)
        if not (count * substeps < MOST_SUBSTEPS):
            return np.inf, 0.0
        whole = int(np.ceil(substeps))
        narrow = 0.5 * spread / whole < np.log(1e4 * parts * whole / most) / (2.0 * np.pi**2) * spacing * spacing
        if narrow:
            for j in range(first + 1, last + 1):
                if closed or not (abs(phi[j] - phi[j - 1]) + abs(b[j] - b[j - 1]) < STEEPEST):
                    return np.inf, 0.0
        for j in range(size):
            phi[j] = -phi[j]
        noise, _ = split(values, phi, b, slope, Filtering(spread, -shift, float(whole), depth, narrow), spacing, closed)
        made, constant = made + error / float(whole) ** 4 + noise, constant + added
        if not (made < most * 2.0 + 1e-2 * most):
            return np.inf, 0.0
    return made, constant


@kernel(
    types.Tuple((int64, int64, int64, int64, float64))(  # type: ignore[no-untyped-call]
        MESSAGE, FILTERED, GRID_TYPE, STEPS_TYPE, OBSERVED, LIMITS, CONSTANTS_TYPE, RESULTS_TYPE
    )
)  # fmt: skip
def _adjoint(
    message: Message, filtered: Filtered, grid: Grid, steps: Steps, seen: Observed, limits: Limits, known: Constants,
    results: Results,
) -> tuple[int, int, int, int, float]:  # fmt: skip
    """Return the number of intervals, and the support, the start and the error of the message b, which is replaced."""
    b, _, first, last, start, error, product = message
    densities, starts, floors = filtered
    table, _, _, spacing, _ = grid
    kinds, lengths, _, precisions, _, _, drifts, outputs, covariances = steps
    logs, observed, closed = seen
    _, most, negligible, cut = limits
    averages, cosines, sines = known
    products, out = results
    size, timed, depth = b.size, table.shape[0] > 1, 8.0 - np.log(cut)
    for i in range(lengths.size - 1, -1, -1):
        row, completed, low, high = out[i], lengths.size - 1 - i, 0, size - 1
        if start < 0 or start + size > table.shape[3]:
            return completed, first, last, start, error
        if not closed:  # the paths from one support to the other
            begins, ends = support(densities[i], CUT)
            noise = np.sqrt(max(covariances[i].max(), 0.0) * lengths[i]) / spacing
            if not held(densities[i], starts[i] - start, product, noise):
                return completed, first, last, start, error
            margin = int(EXCURSION * noise) + 1
            low = max(min(first, begins + starts[i] - start) - margin, low)
            high = min(max(last, ends + starts[i] - start) + margin, high)
        points = high - low + 1
        local, inner, result = np.empty((table.shape[1], table.shape[2], points)), np.empty(points), np.zeros(size)
        copied(table[i if timed else 0], start + low, local)
        at, before = highest_of(product), spread(b, first, last)
        row[LOG_MASS] = logs[i, at]
        for j in range(first, last + 1):
            result[j] = b[j] * np.exp(logs[i, j] - logs[i, at])
        between = spread(result, first, last)
        for j in range(points):
            inner[j] = result[low + j]
        c = Coefficients(drifts[i], outputs[i], precisions[i], covariances[i], observed[i], lengths[i], kinds[i] == SPLIT)
        places = at - low, first - low, last - low
        made, constant = _split(
            inner, product[low : high + 1], local, c, averages, places, (spacing, closed), (depth, most)
        )
        for j in range(size):
            result[j] = inner[j - low] if low <= j <= high else 0.0
        row[LOG_MASS] += constant
        if not (made < np.inf):
            return completed, first, last, start, error
        if starts[i] != start:
            result = shifted(result, starts[i] - start)
        begins, ends = multiplied(result, densities[i], floors[i], negligible, closed, (cosines, sines), products[i], row)
        if ends < 0:
            return completed, first, last, start, error
        first, last, start = begins, ends, starts[i]
        error = made + error * error_share(before, between, spread(result, first, last))
        row[ERROR] = error
        for j in range(size):
            b[j] = result[j] if first <= j <= last else 0.0
            product[j] = products[i, j]
    return lengths.size, first, last, start, error


def by_adjoints(
    message: Message, before: Filtered, grid: Grid, steps: Steps, observed: Observed, limits: Limits
) -> BackwardSteps:
    """Return the message before the last intervals, as many as the adjoints of splittings take.

    Args:
        message: b on the grid.
        before: the filter's densities.
        grid: the table of the grids.
        steps: the intervals.
        observed: what is observed in them; the log-likelihoods are on the grid of the density at the end of each.
        limits: what an interval must keep.
    """
    count, size = len(steps.lengths), len(message.values)
    b, product, products, out = message.values.copy(), message.product.copy(), np.empty((count, size)), np.zeros((count, 6))
    known = Constants(AVERAGES if steps.covariances.shape[1] > 1 else WHOLE, *waves(size))
    completed, first, last, start, error = _adjoint(
        message._replace(values=b, product=product), before, grid, steps, observed, limits, known, Results(products, out)
    )
    if completed:
        out[-1, LOG_MASS] += message.scale
    here = slice(count - completed, None)
    return BackwardSteps(Message(b, 0.0, first, last, start, error, product), completed, products[here], out[here])
