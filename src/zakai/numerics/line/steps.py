"""What the steps of the compiled loop of one-state filters share: arguments, results, and all of a step but its transition.

A term (4 + m, T) has the rows phi of Gaussian kernels or of a decomposition, the integral of f over the spacing above a point,
f, f' and h.  The functions of an interval are sums of terms with factors that depend on time.  A sample multiplies the density,

    v -> v exp(b),      b = h'S^-1 (y - h / 2).
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np
from numba import float64, int64, types

from zakai.numerics.arrays import Array
from zakai.numerics.compiled import helper
from zakai.numerics.exponentials import exponentiate
from zakai.numerics.line.density import spectrum
from zakai.numerics.line.grid_choice import FAR, log_likelihood
from zakai.numerics.line.resolution import SPECTRUM_FACTOR

# The figures of a step's report; the last four are those of a splitting, and where its grid begins.
(
    GAINED, MEAN, VARIANCE, ALIASING, EDGE, NEGATIVE, TIME, DEPTH, GROWTH, MADE, ERROR, LOG_FLOOR, START, PAIRS, SUBSTEPS, NEEDED
) = range(16)  # fmt: skip
FIGURES = NEEDED + 1
# The transition: whole with a sample after it, split with increments inside, whole with increments inside, split with a sample.
FACTOR, SPLIT, KERNEL, SPLIT_FACTOR = range(4)
TABLE_MARGIN = 96  # points of a table of coefficients in time beyond the grid; a third may be used before it is made again


class Status(Enum):
    """Why a compiled loop ends, in words; the kernels return the numbers of these."""

    OK = "all steps are done"
    FAILED = "a step misses the tolerance, or a number is not finite"
    RANGE = "the step needs a grid with another range or spacing, which the answer tells"
    AFTER = "the next step needs another grid"
    TABLE = "the next step needs another table of the coefficients in time"
    UNRESOLVED = "the product with a sample needs a much finer grid"
    NARROW = "the density is so narrow that a coarser grid for its transition and one of its own serve it better"
    BROAD = "the density is so broad that one grid serves it better"
    GRID = "the modes of the grid in the answer are not known"
    SIZE = "the product with a sample needs a grid of more points"

    @property
    def number(self) -> int:
        """The number that kernels return."""
        return STATUSES.index(self)


STATUSES = list(Status)
OK, FAILED, RANGE, AFTER, TABLE, UNRESOLVED, NARROW, BROAD, GRID, SIZE = range(len(STATUSES))  # for kernels


class Mechanisms(NamedTuple):
    """What the steps of a record may need; only that is compiled.

    `kernels` or `splits` or both, these with coefficients that are `varying` within an interval; `samples`: samples after the
    transition; `weak`: their likelihoods have kinks and act in the weak sense; `closed`: grids around the circle.
    """

    kernels: bool
    splits: bool
    varying: bool
    samples: bool
    weak: bool
    closed: bool


class Grid(NamedTuple):
    """The data of a grid: terms `table` (K, R, 4 + m, T) as in `line/steps.py`, K = 1 where they do not depend on the interval.

    The table is longer than the grid, which begins at `start`; its first point is `offset` away from the origin of the kernels.
    `fine` (m, F, P) are the values of an h with kinks or jumps at the nodes of `line/product.py`, else empty.
    """

    table: Array
    start: int
    offset: float
    spacing: float
    fine: Array


class Steps(NamedTuple):
    """K intervals.

    `kinds` (K,) are FACTOR, SPLIT, KERNEL or SPLIT_FACTOR.  `shares` (K,) are the parts of `Limits.splitting` that an interval
    may leave.  `precisions` (K, P, m, m) are the inverses of S, zero where nothing is observed.  `constants` (K,) are those of
    the log-likelihoods.  `kernels` (K, .) are the parameters of Gaussian kernels (`gaussian_kernels.kernel_of`), NaN where the
    transition is split.  `drifts` (K, Q, R) and `outputs` (K, P, R) are the factors of the terms of f and h, and `covariances`
    (K, Q) are G, at the Gauss nodes of an interval, or one number where they do not
    depend on time.
    """

    kinds: Array
    lengths: Array
    shares: Array
    precisions: Array
    constants: Array
    kernels: Array
    drifts: Array
    outputs: Array
    covariances: Array

    def part(self, rows: slice) -> Steps:
        """Return some of the intervals."""
        return Steps(*(part[rows] for part in self))


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


class Start(NamedTuple):
    """Where steps begin: probabilities (N,), the estimate of their relative error, and the logarithm of that of small values.

    The last is relative to the largest value.
    """

    values: Array
    error: float
    log_floor: float


class Constants(NamedTuple):
    """The weights of averages (P, 5, Q), and the cosines and sines (N / 2 + 1, N) of a grid."""

    averages: Array
    cosines: Array
    sines: Array


class Results(NamedTuple):
    """What receives the densities (K, N) and the reports (K, .)."""

    densities: Array
    reports: Array


# Their types in kernels.
_V, _M, _T, _Q = float64[::1], float64[:, ::1], float64[:, :, ::1], float64[:, :, :, ::1]
START_TYPE = types.NamedTuple([_V, float64, float64], Start)
GRID_TYPE = types.NamedTuple([_Q, int64, float64, float64, _T], Grid)
STEPS_TYPE = types.NamedTuple([int64[::1], _V, _V, _Q, _V, _M, _T, _T, _M], Steps)
CONSTANTS_TYPE = types.NamedTuple([_T, _M, _M], Constants)
RESULTS_TYPE = types.NamedUniTuple(_M, 2, Results)


class Coefficients(NamedTuple):
    """The coefficients of one interval as a transition reads them: a row of `Steps`, what is observed, and the length.

    With `inside` the observation acts inside the interval.
    """

    drifts: Array
    outputs: Array
    precisions: Array
    covariances: Array
    observed: Array
    length: float
    inside: bool


class Resolution(NamedTuple):
    """What is asked of a prediction on a grid; `positive` tells that small values are accurate.

    The highest frequency is found with `search`.
    """

    positive: bool
    search: bool
    cut: float
    negligible: float
    spacing: float


class Segment(NamedTuple):
    """The densities (K, N) after the first steps and their reports (K, FIGURES).

    The column `start` of a report is the first point of the grid in the table.  `status` is why the loop ended, and `answer` the
    range of the grid that it needs, relative to the centre of the present one, and its spacing.
    """

    densities: Array
    reports: Array
    status: Status
    answer: Array


IMPOSSIBLE = -1e8  # exponent where a formula has no value
PHI, CELL, DRIFT, SLOPE, OBSERVED = range(5)  # rows of a term


class Transition(NamedTuple):
    """The figures of a transition.

    `error` is that of a splitting, infinite where the transition failed; `rounding` the rounding error and `clipped` the largest
    value that may have become zero, relative to the maximum; `spread` the variance of its noise and `contraction` the factor of
    deviations; `needed` the spacing that filters of positive numbers need, where that of the grid is larger, else zero;
    `log_factor` a constant of the logarithm of the mass; `pairs` of averages and `substeps` of a splitting.
    """

    error: float
    rounding: float
    clipped: float
    spread: float
    contraction: float
    needed: float
    log_factor: float
    pairs: float
    substeps: float


@helper
def failed(spread: float, needed: float) -> Transition:
    """Return the figures of a transition that failed."""
    return Transition(np.inf, np.inf, 1.0, spread, 1.0, needed, 0.0, 0.0, 0.0)


@helper
def add(to: Array, weight: float, values: Array) -> None:
    """Add values with a weight."""
    for j in range(to.size):
        to[j] += weight * values[j]


@helper
def observation_of(table: Array, outputs: Array, at: int) -> tuple[Array, Array]:
    """Return h (m, N), the sum of terms (R, 4 + m, N) with factors (R,), and its values (m,) at a point."""
    h, centre = np.zeros((table.shape[1] - OBSERVED, table.shape[2])), np.empty(table.shape[1] - OBSERVED)
    for r in range(outputs.size):
        if outputs[r] != 0.0:
            for i in range(centre.size):
                add(h[i], outputs[r], table[r, OBSERVED + i])
    for i in range(centre.size):
        centre[i] = h[i, at]
    return h, centre


@helper
def exponent_added(h: Array, centre: Array, precision: Array, observed: Array, weight: float, share: float, b: Array) -> float:
    """Add h'S^-1 (weight y - share h / 2) less its value where h is `centre` (m,); return that value.

    Large numbers cancel in this way before they are squared.
    """
    constant = 0.0
    for i in range(centre.size):
        weighted, own = 0.0, h[i]
        for l in range(centre.size):
            if precision[i, l] != 0.0:
                weighted += precision[i, l] * (weight * observed[l] - share * centre[l])
                constant += centre[i] * precision[i, l] * (weight * observed[l] - 0.5 * share * centre[l])
                pull, other = 0.5 * share * precision[i, l], h[l]
                for j in range(b.size):
                    b[j] -= pull * (other[j] - centre[l]) * (own[j] - centre[i])
        for j in range(b.size):
            b[j] += weighted * (own[j] - centre[i])
    return constant


OVERFLOW = 690.0  # exponent below which exp is finite
LEAST = 1e-240  # factor or value of a density whose products with all values that count are normal numbers


@helper
def extent(
    density: Array, ends: tuple[int, int], channel: Array, table: Array, c: Coefficients, middle: float, spacing: float,
    cut: float,
) -> tuple[float, float]:  # fmt: skip
    """Return the range of points that a density occupies until it is after the transition, as if it were Gaussian.

    It is NaN where the density moves so far that the grid should move with it.
    """
    half, by, tau, spread, (low, high) = density.size // 2, 0.0, c.length, c.covariances[0] * c.length, ends
    drifts = c.drifts[0]
    left, right = float(low - half), float(high - half)
    if np.isnan(channel[0]):
        down, up = 0.0, 0.0
        for r in range(drifts.size):
            down, up = down + drifts[r] * table[r, DRIFT, low], up + drifts[r] * table[r, DRIFT, high]
        by = min(abs(down), abs(up)) * tau / spacing if down * up > 0.0 else 0.0
        left, right = left + min(down * tau / spacing, 0.0), right + max(up * tau / spacing, 0.0)
    else:
        shift, spread = (channel[1] + (channel[0] - 1.0) * middle) / spacing, channel[2]
        left, right = channel[0] * left + shift, channel[0] * right + shift
    centre, width = 0.5 * (left + right), 0.5 * abs(right - left)
    width = np.sqrt(width * width - 2.0 * np.log(cut) * spread / spacing**2) + 2.0
    if by > FAR * (high - low + 2.0 * (width - 0.5 * (right - left))):
        return np.nan, np.nan
    return min(centre - width + half, float(low)), max(centre + width + half, float(high))


@helper
def checked(
    density: Array, ends: tuple[int, int], weak: bool, closed: bool, asked: Resolution, waves: tuple[Array, Array], answer: Array
) -> tuple[int, float, float, float, float, float]:
    """Normalise a prediction that is accurate; return OK, its mass, aliasing, mass at the ends, negative mass, highest frequency.

    `answer` receives the support; where another grid is needed, its range in points and
    its spacing.
    """
    size, (low, high), (positive, search, cut, negligible, spacing) = density.size, ends, asked
    left, right, first, last, negative, aliasing, middle, highest, _ = spectrum(density, cut, negligible, *waves, search)
    bound = max(100.0 * cut, 0.0 if positive else 4.0 * aliasing)
    edge = 0.0 if closed else max(left, right)
    if not positive:  # what is outside of the band is filtered too
        aliasing = max(aliasing, middle)
    answer[0], answer[1], answer[2] = float(low), float(high), 0.7 * spacing
    status, mass = OK, 0.0
    if not (aliasing <= SPECTRUM_FACTOR * negligible):
        status = RANGE if not weak and aliasing < np.inf else FAILED
    elif not (edge <= bound):
        status = RANGE if edge < np.inf else FAILED
        answer[0] = min(low, (0 if left > bound else low) - size // 3 * (left > bound))
        answer[1] = max(high, (size if right > bound else high) + size // 3 * (right > bound))
        answer[2] = spacing
    else:
        for j in range(size):
            density[j] = max(density[j], 0.0)
            mass += density[j]
        if not (1e-200 < mass < 1e200):
            status = FAILED
        for j in range(size):
            density[j] /= mass
        answer[0], answer[1] = first, last
    return status, mass, aliasing, edge, negative, highest


@helper
def copied(table: Array, start: int, to: Array) -> None:
    """Copy the columns of terms (R, 4 + m, T) from `start` on."""
    for r in range(to.shape[0]):
        for i in range(to.shape[1]):
            for j in range(to.shape[2]):
                to[r, i, j] = table[r, i, start + j]


@helper
def likelihood(h: Array, centre: Array, precision: Array, observed: Array, b: Array) -> float:
    """Write the logarithm b of the likelihood relative to where h is `centre` (m,); return it there, without its constant."""
    for j in range(b.size):
        b[j] = 0.0
    exponent_added(h, centre, precision, observed, 1.0, 1.0, b)
    return log_likelihood(centre, False, precision, observed)


@helper
def product(density: Array, b: Array) -> tuple[float, float, float]:
    """Replace probabilities by their normalised product with exp(b).

    Returns:
        The logarithm of the sum, which is NaN where the product almost vanishes; by how much errors relative to the maximum
        grow; and the depth of the product below the maximum of the density, in nats.
    """
    largest, top, best, total, growth, depth = 0.0, 0, -np.inf, 0.0, 0.0, 0.0
    logs = np.empty(density.size)
    for j in range(density.size):
        if not (b[j] > IMPOSSIBLE):
            b[j] = IMPOSSIBLE
        largest = max(largest, density[j])
        logs[j] = np.log(density[j]) if density[j] > 0 else -np.inf
        if logs[j] + b[j] > best:
            best, top = logs[j] + b[j], j
    if not (best < np.inf and density[top] > LEAST):
        return np.nan, growth, depth
    reference, scale, factors = np.log(largest), 1.0 / density[top], np.empty(density.size)
    for j in range(density.size):
        factors[j] = min(b[j] - b[top], OVERFLOW)
    exponentiate(factors)
    for j in range(density.size):
        growth += factors[j]
        density[j] = density[j] * scale * factors[j] if b[j] - b[top] < OVERFLOW else np.exp(logs[j] + b[j] - best)
        total += density[j]
    for j in range(density.size):
        density[j] /= total
        if density[j] > 0:
            depth += density[j] * (reference - logs[j])
    return np.log(total) + best, growth / total * largest * scale, depth
