"""Many intervals backward in time for one state, in a compiled loop: by the decomposition of the operator.

A message b is p(later observations | x) at the points of the filter's grid, up to a constant.  It is kept where its product with
the filter's density is not negligible, and is zero elsewhere: no path between the supports of two products leads there.

A decomposition acts on psi = F e^s b on a longer grid, with an F that falls to zero towards its ends
(`methods/line/gauge.py`); the adjoints of splittings are in `line/adjoint.py`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import boolean, float64, int64, types
from numpy.typing import NDArray

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.line.density import circular_moments, highest_of, moments, spectrum, support, waves
from zakai.numerics.line.modes import decayed, propagate
from zakai.numerics.line.window import CUT

Array = NDArray[Any]

SMALLEST = 1e-13  # value of a smoothed density relative to its maximum that is not rounding
UNRESOLVED = 1e-5  # spectrum of a smoothed density at the highest frequencies up to which sums over the points are integrals
FEWEST = 12  # points of a message
ROUGH = 0.01  # of the error that an interval may make: what a grid and rounding may leave
ROUNDING = 1e-15  # of the maximum: smaller values of psi are not kept
SURE = 100.0  # errors of psi from which its small values count
LEAST = 1e-11  # of the maximum: the same
NOISE = 4e-16  # rounding of a decomposition relative to the norm of psi
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


class Taken(NamedTuple):
    """The message before the last `number` intervals, which were taken, and the smoothed densities (K, N) with their reports."""

    message: Message
    number: int
    products: Array
    reports: Array


_V, _M = float64[::1], float64[:, ::1]


@helper
def multiplied(
    b: Array, density: Array, floor: float, negligible: float, closed: bool, cosines: Array, sines: Array, product: Array,
    row: Array,
) -> tuple[int, int]:  # fmt: skip
    """Write the product with a density, of sum one, and its report; divide b by the sum; return the support, or (0, -1)."""
    size, total, least = b.size, 0.0, floor * density[highest_of(density)]
    for j in range(size):
        product[j] = density[j] * b[j] if density[j] > least else 0.0
    least = SMALLEST * product[highest_of(product)]
    for j in range(size):
        product[j] = product[j] if product[j] > least else 0.0
        total += product[j]
    if not (1e-250 < total < 1e250):
        return 0, -1
    for j in range(size):
        product[j] /= total
        b[j] /= total
    left, right, _, _, _, aliasing, _, _, _ = spectrum(product, CUT, SMALLEST, cosines, sines, False)
    row[LOG_MASS] += np.log(total)
    row[ALIASING], row[EDGE] = aliasing, 0.0 if closed else max(left, right)
    if closed:
        row[MEAN_AT], row[VARIANCE] = circular_moments(product, cosines, sines)
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
def kept(before: float, between: float, after: float) -> float:
    """Return the share of the error of b that an interval leaves, from variances."""
    return min(max(between / np.sqrt(max(before * after, 1e-300)), 0.3), 1.0)


@kernel(
    types.Tuple((int64, float64, float64, float64))(  # type: ignore[no-untyped-call]
        _V, float64, float64, _V, _M, _V, _V, _V, _V, int64, int64, _M, _V, boolean, float64, float64, _M, _M, _M, _M, _M, _M
    )
)  # fmt: skip
def _decomposed(
    psi: Array, scale: float, error: float, product: Array, densities: Array, floors: Array, modes: Array, rates: Array,
    gauge: Array, place: int, stride: int, logs: Array, lengths: Array, closed: bool, most: float, negligible: float,
    cosines: Array, sines: Array, long_cosines: Array, long_sines: Array, products: Array, out: Array,
) -> tuple[int, float, float, float]:  # fmt: skip
    """How many intervals were taken, the error, the logarithm of the scale of psi, which is replaced, and its reliable values."""
    size, longer, reliable, ratio = product.size, rates.size, 0.0, 0.0
    b, now = np.empty(size), np.empty(longer)
    first, last = (0, size - 1) if closed else support(product, negligible)
    at = place + stride * highest_of(product)
    for j in range(size):
        b[j] = psi[place + stride * j] * np.exp(gauge[at] - gauge[place + stride * j])
    for i in range(lengths.size - 1, -1, -1):
        tau, row, taken, likelihood = lengths[i], out[i], lengths.size - 1 - i, logs[i]
        before, top, norm = spread(b, first, last), -np.inf, 0.0
        for j in range(longer):
            top = max(top, likelihood[j])
        for j in range(longer):
            now[j] = psi[j] * np.exp(likelihood[j] - top)
            norm += now[j] * now[j]
        for j in range(first, last + 1):
            b[j] *= np.exp(likelihood[place + stride * j] - likelihood[at])
        between, decay = spread(b, first, last), decayed(rates, tau)
        propagate(modes, decay, now)
        highest = now[highest_of(now)]
        noise = NOISE * np.sqrt(norm) * max(1.0, decay[0])
        left, right, _, _, _, aliasing, _, _, _ = spectrum(now, CUT, SMALLEST, long_cosines, long_sines, False)
        level = max(noise, (ROUNDING + 2.0 * aliasing) * highest)
        # b relative to where its product with the density is largest.
        density, least = densities[i], floors[i] * densities[i, highest_of(densities[i])]
        reference, weight, total = -np.inf, 0.0, 0.0
        for j in range(size):
            if density[j] > least:
                inner = max(now[place + stride * j], ROUNDING * highest)
                reference = max(reference, np.log(inner * density[j]) - gauge[place + stride * j])
        if not (-np.inf < reference < np.inf):
            return taken, error, scale, reliable
        for j in range(size):
            b[j] = 0.0
            if density[j] > least:
                ratio = np.exp(-gauge[place + stride * j] - reference)
                b[j] = max(now[place + stride * j], ROUNDING * highest) * ratio
                weight += density[j] * ratio
                total += density[j] * b[j]
        made = level * weight / total + (0.0 if closed else 10.0 * max(left, right))
        if not (made < ROUGH * most):
            return taken, error, scale, reliable
        row[LOG_MASS] = scale + top + reference
        first, last = multiplied(b, density, floors[i], negligible, closed, cosines, sines, products[i], row)
        if last < 0:
            return taken, error, scale, reliable
        at = place + stride * highest_of(products[i])
        error = made + error * kept(before, between, spread(b, first, last))
        row[ERROR] = error
        scale, reliable = np.log(highest / total) - reference, max(SURE * level / highest, LEAST)
        for j in range(longer):
            psi[j] = now[j] / highest
    return lengths.size, error, scale, reliable


def by_modes(
    message: Message, before: Filtered, gauged: Gauged, logs: Array, lengths: Array, closed: bool, limits: Limits
) -> Taken:
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
    taken, error, scale, least = _decomposed(
        psi, message.scale, message.error, message.product, before.densities, before.floors, gauged.modes.ravel(), *gauged[1:],
        logs, lengths, closed, limits.error, limits.negligible, *waves(size), *waves(len(gauged.rates)), products, out,
    )  # fmt: skip
    first, last = 0, len(psi) - 1
    if taken and not closed:
        small, peak = np.flatnonzero(psi <= least), gauged.place + gauged.stride * int(np.argmax(products[count - taken]))
        first = int(np.max(small, where=small < peak, initial=-1)) + 1
        last = int(np.min(small, where=small > peak, initial=len(psi))) - 1
    psi = np.maximum(psi, ROUNDING)
    found = Message(psi, scale, first, last, 0, error, message.product)
    return Taken(found, taken, products[count - taken :], out[count - taken :])
