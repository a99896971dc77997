"""Many intervals backward in time for one state, in a compiled loop: the adjoints of splittings (`line/splitting.py`).

The adjoint of a splitting is the same splitting with phi replaced by -phi and the averages in reverse order.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import boolean, float64, int64, types
from numpy.typing import NDArray

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.line.averages import AVERAGES, EARLY, LATE, MEAN, MOST_MAGNUS, averaged, averaging, operators
from zakai.numerics.line.backward import ERROR, LOG_MASS, SMALLEST, Filtered, Limits, Message, Taken, kept, multiplied, spread
from zakai.numerics.line.density import highest_of, moments, shifted, support, waves
from zakai.numerics.line.segment import SPLIT, Grid, Steps
from zakai.numerics.line.splitting import STEEPEST, differences, residual, split
from zakai.numerics.line.step import copied

Array = NDArray[Any]

MOST_SUBSTEPS = 512
EXCURSION = 3.9  # standard deviations of the noise that a path between two points goes beyond them, but for exp(-30)
_WHOLE = np.ones((1, 5, 1))
_V, _M, _T, _Q = float64[::1], float64[:, ::1], float64[:, :, ::1], float64[:, :, :, ::1]


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
    now: Array, product: Array, table: Array, drifts: Array, outputs: Array, precisions: Array, covariances: Array,
    averages: Array, observed: Array, inside: bool, tau: float, at: int, first: int, last: int, spacing: float, closed: bool,
    depth: float, most: float,
) -> tuple[float, float]:  # fmt: skip
    """Replace b by that before a split interval; return its error, infinite where it is not accurate, and the constant."""
    size = now.size
    phi, slope, curvature, drift, b = np.empty(size), np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    made, constant, magnus = 0.0, 0.0, 0
    if averages.shape[0] > 1:
        both, spreads = np.empty((3, 2, size)), np.empty(3)
        operators(table, drifts, outputs, precisions, covariances, averages[0], tau, observed, inside, at, both, spreads)
        made, pair = averaging(product, both, spreads, spacing, closed)
        if not (made <= most):
            magnus = int(min(max(np.ceil(1.1 * (pair / most) ** 0.25), 1.0), 1e6))
            made = pair / float(magnus) ** 4
        if magnus > MOST_MAGNUS or not (made < np.inf):
            return np.inf, 0.0
    parts, count = max(magnus, 1), max(2 * magnus, 1)
    for i in range(count - 1, -1, -1):
        weights = averages[parts * (parts - 1) // 2 + i // 2]
        which = MEAN if magnus == 0 else (EARLY if i % 2 == 0 else LATE)
        length, spread, shift, added = averaged(
            table, drifts, outputs, precisions, covariances, weights[which], tau, observed, inside, at, spacing, closed, phi,
            drift, b,
        )  # fmt: skip
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
        noise, _ = split(now, phi, b, slope, spread, -shift, whole, spacing, depth, closed, narrow)
        made, constant = made + error / float(whole) ** 4 + noise, constant + added
        if not (made < most * 2.0 + 1e-2 * most):
            return np.inf, 0.0
    return made, constant


@kernel(
    types.Tuple((int64, int64, int64, int64, float64))(  # type: ignore[no-untyped-call]
        _V, int64, int64, int64, float64, _V, _M, int64[::1], _V, _Q, float64, boolean, _M, boolean[::1], _V, _M, _Q, _T, _T, _M,
        _T, float64, float64, float64, _M, _M, _M, _M,
    )
)  # fmt: skip
def _adjoint(
    b: Array, first: int, last: int, start: int, error: float, product: Array, densities: Array, starts: Array, floors: Array,
    table: Array, spacing: float, closed: bool, logs: Array, inside: Array, lengths: Array, observed: Array,
    precisions: Array, drifts: Array, outputs: Array, covariances: Array, averages: Array, most: float,
    negligible: float, cut: float, cosines: Array, sines: Array, products: Array, out: Array,
) -> tuple[int, int, int, int, float]:  # fmt: skip
    """How many intervals were taken, and the support, the start and the error of the message b, which is replaced."""
    size, timed, depth = b.size, table.shape[0] > 1, 8.0 - np.log(cut)
    for i in range(lengths.size - 1, -1, -1):
        row, taken, low, high = out[i], lengths.size - 1 - i, 0, size - 1
        if start < 0 or start + size > table.shape[3]:
            return taken, first, last, start, error
        if not closed:  # the paths from one support to the other
            begins, ends = support(densities[i], SMALLEST)
            noise = np.sqrt(max(covariances[i].max(), 0.0) * lengths[i]) / spacing
            if not held(densities[i], starts[i] - start, product, noise):
                return taken, first, last, start, error
            margin = int(EXCURSION * noise) + 1
            low = max(min(first, begins + starts[i] - start) - margin, low)
            high = min(max(last, ends + starts[i] - start) + margin, high)
        points = high - low + 1
        local, now, found = np.empty((table.shape[1], table.shape[2], points)), np.empty(points), np.zeros(size)
        copied(table[i if timed else 0], start + low, local)
        at, before = highest_of(product), spread(b, first, last)
        row[LOG_MASS] = logs[i, at]
        for j in range(first, last + 1):
            found[j] = b[j] * np.exp(logs[i, j] - logs[i, at])
        between = spread(found, first, last)
        for j in range(points):
            now[j] = found[low + j]
        made, constant = _split(
            now, product[low : high + 1], local, drifts[i], outputs[i], precisions[i], covariances[i], averages, observed[i],
            inside[i], lengths[i], at - low, first - low, last - low, spacing, closed, depth, most,
        )  # fmt: skip
        for j in range(size):
            found[j] = now[j - low] if low <= j <= high else 0.0
        row[LOG_MASS] += constant
        if not (made < np.inf):
            return taken, first, last, start, error
        if starts[i] != start:
            found = shifted(found, starts[i] - start)
        begins, ends = multiplied(found, densities[i], floors[i], negligible, closed, cosines, sines, products[i], row)
        if ends < 0:
            return taken, first, last, start, error
        first, last, start = begins, ends, starts[i]
        error = made + error * kept(before, between, spread(found, first, last))
        row[ERROR] = error
        for j in range(size):
            b[j] = found[j] if first <= j <= last else 0.0
            product[j] = products[i, j]
    return lengths.size, first, last, start, error


def by_adjoints(
    message: Message, before: Filtered, grid: Grid, logs: Array, steps: Steps, observed: Array, closed: bool, limits: Limits
) -> Taken:
    """Return the message before the last intervals, as many as the adjoints of splittings take.

    Args:
        message: b on the grid.
        before: the filter's densities.
        grid: the table of the grids.
        logs: the log-likelihoods of what is observed at the end of each interval (K, N), on the grid of the density there.
        steps: the intervals.
        observed: what is observed in them (K, m), zero where nothing is.
        closed: whether the grid is around the circle.
        limits: what an interval must keep.
    """
    count, size = len(steps.lengths), len(message.values)
    b, product, products, out = message.values.copy(), message.product.copy(), np.empty((count, size)), np.zeros((count, 6))
    kinds, lengths, _, precisions, _, _, *rest = steps
    averages = AVERAGES if steps.covariances.shape[1] > 1 else _WHOLE
    taken, first, last, start, error = _adjoint(
        b, message.first, message.last, message.start, message.error, product, *before, grid.table, grid.spacing, closed,
        logs, kinds == SPLIT, lengths, observed, precisions, *rest, averages, limits.splitting, limits.negligible, limits.cut,
        *waves(size), products, out,
    )  # fmt: skip
    if taken:
        out[-1, LOG_MASS] += message.scale
    return Taken(Message(b, 0.0, first, last, start, error, product), taken, products[count - taken :], out[count - taken :])
