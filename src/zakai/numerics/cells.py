"""Densities of one state as averages over cells of equal size: what a picture draws of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from zakai.numerics.compiled import kernel

Array = NDArray[Any]

SEEN = 1e-6  # of the largest value of a density: what is below everywhere is outside of its window
_SUMMED = 1e-10  # of the largest value on the grid: smaller terms change nothing that is drawn
_AT = 1e-8  # distance from a grid point, in spacings, at which the interpolant is its value
_REACH = 7.0  # standard deviations at which a Gaussian is below 1e-10 of its peak


def grid_cells(log_values: Array, closed: bool, count: int) -> tuple[float, float, Array]:
    """Return the density that is band-limited on the grid 0, 1, ..., size - 1 as averages over `count` cells.

    Args:
        log_values: (size,) logarithms of the density, up to a constant.
        closed: whether the grid goes once around a circle.
        count: number of cells.

    Returns:
        The ends of the window that holds the mass, as indices of the grid, and the averages (count,), up to a factor.  On a
        circle the window may go beyond the last index.
    """
    out = np.empty(count)
    if not closed:
        return (*_line_cells(np.ascontiguousarray(log_values), out), out)
    values = np.exp(log_values - np.max(log_values))
    size = len(values)
    first, length = arc(values > SEEN)
    start, terms = arc(values > _SUMMED)
    low, high = first - 1.0, first + length + 0.0
    if 2 * (high - low) > size:  # the whole circle, from the point opposite to the mean
        mean = np.angle(values @ np.exp(2j * np.pi / size * np.arange(size))) * size / (2 * np.pi)
        low, high = mean - 0.5 * size, mean + 0.5 * size
        start, terms = 0, size
    signed = np.take(values, np.arange(start, start + terms), mode="wrap")
    signed[1::2] *= -1.0
    _interpolate(signed, size, start, low, high, out)
    return low, high, out


def arc(inside: Array) -> tuple[int, int]:
    """Return the first index and the length of the shortest arc of a circle that holds all places that are `inside`."""
    places = np.flatnonzero(inside)
    gaps = np.diff(np.append(places, places[0] + len(inside)))
    widest = int(np.argmax(gaps))
    return int(places[(widest + 1) % len(places)]), len(inside) - int(gaps[widest]) + 1


@kernel(
    types.void(types.float64[::1], types.int64, types.int64, types.float64, types.float64, types.float64[::1]),
    reordered=True,
)
def _interpolate(signed: Array, size: int, start: int, low: float, high: float, out: Array) -> None:
    """Write averages over cells from `low` to `high`: of the interpolant of (-1)^i `signed`[i] at the points `start` + i.

    It is the sinc interpolant where the size is zero, else the trigonometric one of `size` values; those not given are zero.
    """
    count, closed = len(signed), size > 0
    cell = (high - low) / len(out)
    within = max(1, math.ceil(2.0 * cell))  # two points for each of the grid
    angles = np.pi / max(size, 1) * np.arange(count if closed else 0)
    cosines, sines = np.cos(angles), np.sin(angles)
    for r in range(len(out)):
        total = 0.0
        for s in range(within):
            x = low + cell * (r + (s + 0.5) / within) - start
            nearest = math.floor(x + 0.5)
            rest, at = x - nearest, int(nearest) % size if closed else int(nearest)
            if abs(rest) < _AT:
                total += signed[at] * (1.0 if at % 2 == 0 else -1.0) if 0 <= at < count else 0.0
                continue
            found, c, d = 0.0, 1.0, 0.0
            if closed:
                c, d = math.cos(math.pi * x / size), math.sin(math.pi * x / size)
            if not closed:
                for i in range(count):
                    found += signed[i] / (x - i)
            elif size % 2:
                for i in range(count):
                    found += signed[i] / (d * cosines[i] - c * sines[i])
            else:
                for i in range(count):
                    found += signed[i] * (c * cosines[i] + d * sines[i]) / (d * cosines[i] - c * sines[i])
            # sin(pi (x - i)) = sin(pi rest) (-1)^(nearest - i)
            sine = math.sin(math.pi * rest) * (1.0 if int(nearest) % 2 == 0 else -1.0)
            total += sine / (size if closed else math.pi) * found
        out[r] = max(total / within, 0.0)


@kernel(types.Tuple((types.float64, types.float64))(types.float64[::1], types.float64[::1]))
def _line_cells(log_values: Array, out: Array) -> tuple[float, float]:
    """Write the averages over cells for a grid on the line, and return the ends of the window, as `grid_cells` does."""
    size, largest = len(log_values), np.max(log_values)
    signed = np.empty(size)
    start, stop, first, last = size, 0, size, 0
    for i in range(size):
        value = math.exp(log_values[i] - largest)
        if value > _SUMMED:
            start, stop = min(start, i), i + 1
        if value > SEEN:
            first, last = min(first, i), i
        signed[i] = value
    low, high = max(first - 1.0, -0.5), min(last + 1.0, size - 0.5)
    signed = signed[start:stop]
    signed[1::2] *= -1.0
    _interpolate(signed, 0, start, low, high, out)
    return low, high


@kernel(
    types.void(
        types.float64[::1], types.float64[::1], types.float64[::1], types.float64, types.float64, types.int64, types.float64[::1]
    )
)
def mixture_cells(weights: Array, means: Array, deviations: Array, low: float, cell: float, within: int, out: Array) -> None:
    """Write the averages over cells of a sum of Gaussians, each by the recurrence of its values at equal distances.

    Args:
        weights: (k,).
        means: (k,).
        deviations: (k,) standard deviations.
        low: the start of the first cell.
        cell: the size of a cell.
        within: number of points in a cell of which the average is that of the cell.
        out: (count,), overwritten.
    """
    step = cell / within
    last = len(out) * within - 1
    out[:] = 0.0
    for k in range(len(weights)):
        scale, begin = step / deviations[k], low + 0.5 * step
        middle = int(min(max(math.floor((means[k] - begin) / step + 0.5), 0.0), float(last)))
        z = (begin + middle * step - means[k]) / deviations[k]
        if abs(z) > _REACH:
            continue
        height = weights[k] / (deviations[k] * within * math.sqrt(2.0 * math.pi)) * math.exp(-0.5 * z * z)
        reach = int(_REACH / scale) + 1
        shrink = math.exp(-scale * scale)
        for direction in (1, -1):
            value = height
            ratio = math.exp(-scale * (direction * z + 0.5 * scale))
            at = middle
            if direction < 0:
                value, ratio, at = value * ratio, ratio * shrink, middle - 1
            for _ in range(reach):
                if at < 0 or at > last:
                    break
                out[at // within] += value
                value *= ratio
                ratio *= shrink
                at += direction
