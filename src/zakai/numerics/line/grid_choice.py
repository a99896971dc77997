"""The grid for a density after an interval, and the grid for its product with a likelihood that may be much narrower.

After an interval the grid is one out of few, by the linear equation around the middle of the density.  For a product the
logarithm of the density is linear between the points of its grid; the likelihood is known by rows on a finer grid, `PER` points
in a spacing, and by polynomials through eight of them between: the values of h, or the logarithm itself.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai.numerics.arrays import Array
from zakai.numerics.compiled import helper
from zakai.numerics.line.density import highest_of
from zakai.numerics.line.window import ALIGNMENT, SIZES, SMALL, STENCIL_WEIGHTS

PER = 8  # points of rows in a spacing of the grid
_STENCIL = len(STENCIL_WEIGHTS)
DEPTH = 34.0  # logarithm below the largest value from which cells are left out
MOST_CELLS = 4096


@helper
def weigh(at: float, size: int, stride: int, weights: Array) -> int:
    """Write the weights of the polynomial through eight points of a row, `stride` apart, at an index; return the first point."""
    first = min(max(int(np.floor(at / stride)) - 3, 0), (size - 1) // stride - _STENCIL + 1)
    total = 0.0
    for k in range(_STENCIL):
        distance = at / stride - (first + k)
        if abs(distance) < 1e-9:
            for l in range(_STENCIL):
                weights[l] = 1.0 if l == k else 0.0
            return first * stride
        weights[k] = STENCIL_WEIGHTS[k] / distance
        total += weights[k]
    for k in range(_STENCIL):
        weights[k] /= total
    return first * stride


@helper
def weighed(row: Array, first: int, stride: int, weights: Array) -> float:
    """Return the value of the polynomial of a row."""
    total = 0.0
    for k in range(_STENCIL):
        total += weights[k] * row[first + k * stride]
    return total


@helper
def log_likelihood(h: Array, general: bool, precision: Array, observed: Array) -> float:
    """Return -(y - h)'S^-1 (y - h) / 2, or the logarithm itself where that is what is known."""
    if general:
        return h[0] if h[0] > -1e150 else -1e150
    total = 0.0
    for i in range(observed.size):
        for l in range(observed.size):
            if precision[i, l] != 0.0:
                total -= 0.5 * (observed[i] - h[i]) * precision[i, l] * (observed[l] - h[l])
    return total if total > -1e150 else -1e150


class Likelihood(NamedTuple):
    """A likelihood by rows on the grid of a density (N,).

    `rows` are h (m, T), or the log-likelihood (1, T) where it is `general`, T = PER (N - 1) + 1; `precision` and `observed` are
    S^-1 and y.
    """

    rows: Array
    general: bool
    precision: Array
    observed: Array


@helper
def _surveyed(
    left: float, width: float, logs: Array, likelihood: Likelihood, weights: Array, h: Array
) -> tuple[float, float, float]:
    """Return the largest of five values of the product in a cell, and the largest and the smallest of the likelihood."""
    rows, general, precision, observed = likelihood
    highest, top, bottom = -np.inf, -np.inf, np.inf
    for p in range(5):
        x = left + 0.25 * p * width
        first = weigh(x * PER, rows.shape[1], 1, weights)
        for i in range(rows.shape[0]):
            h[i] = weighed(rows[i], first, 1, weights)
        result = log_likelihood(h, general, precision, observed)
        j = min(int(x), logs.size - 2)
        highest = max(highest, logs[j] + (x - j) * (logs[j + 1] - logs[j]) + result)
        top, bottom = max(top, result), min(bottom, result)
    return highest, top, bottom


@helper
def placed(logs: Array, first: int, last: int, likelihood: Likelihood) -> tuple[float, float, float]:
    """Return the range of the product as indices of the grid, and the narrowest cell in it; NaN where there are too many.

    Cells whose bound is far below the largest value are left out, and the others divided until the likelihood changes
    by less than a deviation.

    Args:
        logs: the logarithm of the density (N,).
        first, last: the points between which it is not negligible.
    """
    left, width, level, best = np.empty(MOST_CELLS), np.empty(MOST_CELLS), np.empty((MOST_CELLS, 3)), -np.inf
    weights, h, count, done = np.empty(_STENCIL), np.empty(likelihood.rows.shape[0]), last - first, 0
    for j in range(count):
        left[j], width[j] = first + j, 1.0
    while done < count:
        for c in range(done, count):
            highest, top, bottom = _surveyed(left[c], width[c], logs, likelihood, weights, h)
            level[c, 0], level[c, 1], level[c, 2], best = highest, top, bottom, max(best, highest)
        # Cells that are done go to the front, cells to be divided to the back.
        retained, more = done, MOST_CELLS
        for c in range(done, count):
            highest, spread = level[c, 0], level[c, 1] - level[c, 2]
            if highest + 0.5 * spread + 1.0 >= best - DEPTH:
                depth = best - highest
                change = np.sqrt(2.0 * (depth + spread)) - np.sqrt(2.0 * depth)
                if change > 1.0 and width[c] > 1e-13 * logs.size:
                    if count + 2 * (MOST_CELLS - more + 1) > MOST_CELLS // 2:
                        return np.nan, np.nan, np.nan
                    more -= 1
                    left[more], width[more] = left[c], width[c]
                else:
                    left[retained], width[retained], level[retained, 0] = left[c], width[c], highest
                    retained += 1
        done = count = retained
        for c in range(more, MOST_CELLS):
            for part in range(2):
                left[count], width[count] = left[c] + 0.5 * part * width[c], 0.5 * width[c]
                count += 1
    low, high, finest = np.inf, -np.inf, np.inf
    for c in range(done):
        if level[c, 0] >= best - DEPTH:
            low, high, finest = min(low, left[c]), max(high, left[c] + width[c]), min(finest, width[c])
    return low, high, finest


@helper
def interpolated(values: Array, top: float, at: Array, result: Array, weights: Array) -> None:
    """Write the interpolant of a positive density at indices of its grid; small values by their logarithms."""
    signed = np.empty(values.size)
    for j in range(values.size):
        signed[j] = values[j] if j % 2 == 0 else -values[j]
    for i in range(at.size):
        result[i] = 0.0
    for j in range(values.size):
        if signed[j] != 0.0:
            for i in range(at.size):
                result[i] += signed[j] / (at[i] - j)
    for i in range(at.size):
        near = np.floor(at[i] + 0.5)
        if abs(at[i] - near) < 1e-12:
            result[i] = values[int(near)] if 0 <= near < values.size else 0.0
        else:
            sine = np.sin(np.pi * (at[i] - near)) / np.pi
            result[i] *= sine if near % 2 == 0 else -sine
        if not (result[i] >= SMALL * top):
            first, logs = weigh(at[i], values.size, 1, weights), 0.0
            for k in range(weights.size):
                logs += weights[k] * np.log(values[first + k]) if weights[k] != 0.0 else 0.0
            result[i] = np.exp(logs) if logs < np.log(2.0 * SMALL * top) and 0 <= at[i] <= values.size - 1 else 0.0


@helper
def differences(h: Array, centre: Array, general: bool, precision: Array, observed: Array) -> float:
    """Return a log-likelihood less that where h is `centre`; large numbers cancel before they are squared."""
    if general:
        return h[0] - centre[0]
    total = 0.0
    for i in range(centre.size):
        for l in range(centre.size):
            if precision[i, l] != 0.0:
                total += (h[i] - centre[i]) * precision[i, l] * (observed[l] - 0.5 * (h[l] + centre[l]))
    return total


@helper
def sampled(
    q: Array, ends: tuple[int, int], grid: tuple[float, float, float], likelihood: Likelihood, density: Array, b: Array
) -> tuple[float, float, float, float, bool]:
    """Write a density on a grid for its product with a likelihood, and the logarithm of that.

    Args:
        q: the density (N,) on a coarse grid.
        ends: the points between which it is not negligible.
        grid: the first point of the coarse grid, its spacing, and the unit of spacings.
        density: receives the density (n,).
        b: receives the logarithm (n,).

    Returns:
        The centre of the grid and its spacing, which is NaN where the product has no range; the value of the likelihood of which
        the logarithms are differences; the error of these; and whether the grid has enough points.
    """
    (grid_first, grid_spacing, unit), (rows, general, precision, observed) = grid, likelihood
    top, n, m, weights = q[highest_of(q)], density.size, rows.shape[0], np.empty(8)
    logs = np.empty(q.size)
    for j in range(q.size):
        logs[j] = np.log(max(q[j], 1e-30 * top))
    low, high, finest = placed(logs, ends[0], ends[1], likelihood)
    width = (high - low) * grid_spacing
    spacing = unit * 2.0 ** (0.25 * np.ceil(4.0 * np.log2(width / (n - ALIGNMENT - 2) / unit)))
    if not (width > 0.0 and spacing > 0.0):
        return 0.0, np.nan, 0.0, np.inf, True
    apart = ALIGNMENT * spacing
    centre = apart * np.floor((grid_first + 0.5 * (low + high) * grid_spacing) / apart + 0.5)
    at, h, middle, rough, unsure = np.empty(n), np.empty((n, m)), np.empty(m), np.empty(m), 0.0
    for i in range(n):
        at[i] = (centre + spacing * (i - n // 2) - grid_first) / grid_spacing
    interpolated(q, top, at, density, weights)
    for i in range(n):
        begin = weigh(at[i] * PER, rows.shape[1], 1, weights)
        for r in range(m):
            h[i, r] = weighed(rows[r], begin, 1, weights)
    best, most = -np.inf, 0
    for i in range(n):
        b[i] = log_likelihood(h[i], general, precision, observed)
        if density[i] > 0.0 and np.log(density[i]) + b[i] > best:
            best, most = np.log(density[i]) + b[i], i
    for r in range(m):
        middle[r] = h[most, r]
    constant, total = b[most], 0.0
    for i in range(n):
        b[i] = differences(h[i], middle, general, precision, observed)
        weight = np.exp(np.log(density[i]) + b[i] + constant - best) if density[i] > 0.0 else 0.0
        if weight > 1e-12:
            begin = weigh(at[i] * PER, rows.shape[1], 2, weights)
            for r in range(m):
                rough[r] = weighed(rows[r], begin, 2, weights)
            unsure += weight * abs(differences(rough, middle, general, precision, observed) - b[i])
            total += weight
    return centre, spacing, constant, unsure / total, spacing <= finest * grid_spacing


PROFILE = 4096  # offsets at which f and G are known without a grid
REACH = 7.6  # standard deviations of the noise by which the support grows, and by which waves of the interpolation spread
WIDENING = REACH
FAR = 3.0  # ranges of a density that it moves in an interval, above which grids move with it
DECAYED = 42.0  # -log of the factor of a mode that is negligible
SPACING = np.pi / np.sqrt(2.0 * DECAYED)  # largest spacing in standard deviations of the noise: the shortest wave is negligible
_APART = 32  # the centres of coarse grids are multiples of so many spacings
_SIZES = np.array(SIZES)


class Outlook(NamedTuple):
    """The spacing and the ends of a grid for the density after an interval, and the margin beyond these.

    The spacing is NaN where the density moves so far that the grid should move with it.
    """

    spacing: float
    left: float
    right: float
    margin: float


@helper
def outlook(low: float, high: float, tau: float, unit: float, profile: Array) -> Outlook:
    """Return what grid a density between two offsets needs after an interval, by the linear equation around its middle.

    Args:
        low, high: the ends of the support.
        tau: the length of the interval.
        unit: the scale of spacings.
        profile: f, f' and G (3, L) at offsets that are unit / PER apart, or of one point, of which only G is read: then the
            spacing is infinite where the interval makes the support far wider, else zero.
    """
    if profile.shape[1] == 1:
        return Outlook(np.inf if high - low < REACH * np.sqrt(profile[2, 0] * tau) else 0.0, low, high, 0.0)
    middle, per, last = profile.shape[1] // 2, PER / unit, profile.shape[1] - 1.0
    first, stop = int(min(max(np.floor(low * per) + middle, 0.0), last)), int(min(max(np.ceil(high * per) + middle, 0.0), last))
    least, most = profile[2, first], profile[2, first]
    for i in range(first, stop + 1):
        least, most = min(least, profile[2, i]), max(most, profile[2, i])
    wide = np.sqrt(most * tau)
    at = (first + stop) // 2
    here = -tau * profile[1, at]
    shift = tau * profile[0, at] * relative(here)
    there = -tau * profile[1, int(min(max(at + shift * per, 0.0), last))]
    fast, slow = max(here, there, 0.0), max(min(here, there), -1.0)
    spacing = SPACING * np.sqrt(least * tau * relative(2.0 * fast))
    spacing = unit * 2.0 ** (0.5 * np.floor(2.0 * np.log2(spacing / unit) + 1e-9))
    half, centre = 0.5 * (high - low) * np.exp(-slow) + REACH * wide * np.sqrt(relative(2.0 * slow)), 0.5 * (low + high)
    spacing = np.nan if abs(shift) > 2.0 * FAR * half else spacing
    return Outlook(spacing, centre - half + min(shift, 0.0), centre + half + max(shift, 0.0), REACH * wide)


@helper
def relative(x: float) -> float:
    """Return (1 - exp(-x)) / x."""
    return (1.0 - np.exp(-max(x, -5.0))) / max(x, -5.0) if abs(x) > 1e-8 else 1.0


def coarse_grid(low: float, high: float, spacing: float, margin: float) -> tuple[float, float, float]:
    """Return the centre, the spacing and the size of a coarse grid from `low` to `high` with a margin on both sides."""
    apart, size = _APART * spacing, np.inf
    for known in _SIZES[::-1]:
        if known >= (high - low + 2.0 * margin) / spacing + _APART + 2:
            size = float(known)
    return apart * np.floor(0.5 * (low + high) / apart + 0.5), spacing, size


wanted = helper(coarse_grid)


@helper
def place_of(index: Array, answer: Array) -> int:
    """Return which of the known grids is wanted, -1 for none."""
    for g in range(index.shape[0]):
        if index[g, 0] == answer[0] and index[g, 1] == answer[1] and index[g, 2] == answer[2]:
            return g
    return -1
