"""The transition of an interval by the modes of the operator, in compiled code.

The modes on a grid carry the density through an interval tau,

    q = s U exp(-tau lambda) U' R' (p / s),

with the values of p / s on the grid of the density and R the interpolation from the grid of the modes to it (its transpose
gives the integrals of modes times density).  Where a step stays on its grid, R is the identity and a sample multiplies the
values there.

Else no wave shorter than the standard deviation (tau G)^(1/2) of the noise is left after the interval: the modes of a coarse
grid that resolves this deviation serve, and the product with the likelihood has a fine grid of its own
(`numerics/line/grid_choice.py`).  Fine grids need no decomposition, and one coarse grid serves many.
"""

from __future__ import annotations

from math import erfc
from typing import NamedTuple

import numpy as np
from numba import float64, void

from zakai.numerics.arrays import Array
from zakai.numerics.compiled import helper, kernel
from zakai.numerics.exponentials import exponentiate
from zakai.numerics.line.density import highest_of
from zakai.numerics.line.grid_choice import DECAYED, PER, Outlook, place_of, wanted, weigh, weighed
from zakai.numerics.line.resolution import (
    EDGE_OF_ALIASING,
    LOST_MASS,
    RESOLVED,
    ROUNDING,
    SPECTRUM_FACTOR,
    SPECTRUM_SHARE,
    TRIALS,
)
from zakai.numerics.line.steps import FAILED, GRID, OK, RANGE
from zakai.numerics.line.window import CUT, LARGEST, Window

_V = float64[::1]

_SPREAD = 0.01  # of the value at an abrupt end that the interpolant spreads to the middle of the grid
FALL = 4.2  # half of the range of erfc(y) / 2 from one to zero


@helper
def decayed(rates: Array, time: float) -> Array:
    """Return exp(-time rates) of the modes that are not negligible; the rates increase."""
    count = 1
    while count < rates.size and time * (rates[count] - rates[0]) < DECAYED:
        count += 1
    decay = np.empty(count)
    for n in range(count):
        decay[n] = -time * rates[n]
    exponentiate(decay)
    return decay


@kernel(void(_V, _V, _V), reordered=True)
def propagate(modes: Array, decay: Array, values: Array) -> None:
    """Replace values (N,) by U decay U' of them, with the rows of U' one after the other (N^2,) and the decay of the first M."""
    size = values.size
    result = np.zeros(size)
    for n in range(decay.size):
        row, coefficient = modes[n * size : (n + 1) * size], 0.0
        for j in range(size):
            coefficient += row[j] * values[j]
        coefficient *= decay[n]
        for j in range(size):
            result[j] += coefficient * row[j]
    for j in range(size):
        values[j] = result[j]


@helper
def unresolved(values: Array, cosines: Array, sines: Array) -> float:
    """Return the largest spectrum of values in the highest eighth of the frequencies, relative to the mass."""
    size, mass, result = values.size, 0.0, 0.0
    for j in range(size):
        mass += values[j]
    for k in range(size // 2, 7 * (size // 2) // 8 - 1, -max(1, size // 64)):
        real, imag, at = 0.0, 0.0, 0
        for j in range(size):
            real, imag = real + cosines[at] * values[j], imag + sines[at] * values[j]
            at += k
            at -= size if at >= size else 0
        result = max(result, real * real + imag * imag)
    return np.sqrt(result) / abs(mass)


def gathered(values: Array, offsets: Array, window: Window) -> Array:
    """Return the values (J,) at offsets times the matrix of interpolation from a grid on the line to them (N,)."""
    at, result = (offsets - window.centre) / window.spacing + window.size // 2, np.empty(window.size)
    _gather(np.ascontiguousarray(values.real), at, result)
    return result + 1j * gathered(values.imag, offsets, window) if np.iscomplexobj(values) else result


@kernel(void(_V, _V, _V))
def _gather(values: Array, at: Array, result: Array) -> None:
    """Write the values at indices of a grid times the matrix of interpolation from its points (N,)."""
    for j in range(result.size):
        result[j] = 0.0
    for i in range(values.size):
        near = np.floor(at[i] + 0.5)
        part = np.sin(np.pi * (at[i] - near)) / np.pi * values[i]
        if abs(at[i] - near) < 1e-12:
            if 0 <= near < result.size:
                result[int(near)] += values[i] * (1.0 if near % 2 == 0 else -1.0)
            continue
        part = part if near % 2 == 0 else -part
        for j in range(result.size):
            result[j] += part / (at[i] - j)
    for j in range(1, result.size, 2):
        result[j] = -result[j]


class Modes(NamedTuple):
    """The rows of U' (N^2,), lambda (N,), and log s (T,) at the points of rows."""

    modes: Array
    rates: Array
    scale: Array


@helper
def carried(
    density: Array, at: Array, shape: tuple[bool, bool], known: Modes, tau: float, ends: tuple[int, int], most: float,
    propagated: Array,
) -> tuple[float, float]:  # fmt: skip
    """Write the density (N,) of the grid of the modes after an interval; return its rounding error and that of the scale.

    The rounding error is infinite where beyond the support it might exceed `most`.

    Args:
        density: the density (n,) before.
        at: its points as indices of the grid of the modes.
        shape: whether these are the points of the grid of the modes, and whether it goes around the circle.
        tau: the length of the interval.
        ends: the points between which the density is retained.
        most: the largest error.
        propagated: receives the density.
    """
    (same, closed), (modes, rates, scale), (first, last) = shape, known, ends
    size, top, weights = propagated.size, highest_of(density), np.empty(8)
    inner, logs, after, unsure, total, end = np.zeros(density.size), np.zeros(density.size), np.empty(size), 0.0, 0.0, 0.0
    limit, reference = CUT * density[top], scale[PER * top] if same else 0.0
    if not same:
        reference = weighed(scale, weigh(at[top] * PER, scale.size, 1, weights), 1, weights)
    for j in range(size):
        after[j] = scale[PER * j] - reference
    exponentiate(after)
    if same:
        coefficients = inner
        for j in range(size):
            inner[j] = density[j] / after[j]
            if not closed and (density[j] <= limit or j < 2 or j >= size - 2):  # abrupt ends, which the interpolant spreads
                end = max(end, inner[j])
    else:
        coefficients = np.empty(size)
        for i in range(density.size):
            if density[i] > limit:
                own = weighed(scale, weigh(at[i] * PER, scale.size, 1, weights), 1, weights)
                rough = weighed(scale, weigh(at[i] * PER, scale.size, 2, weights), 2, weights)
                logs[i], unsure, total = reference - own, unsure + density[i] * abs(own - rough), total + density[i]
        exponentiate(logs)
        for i in range(density.size):
            inner[i] = density[i] * logs[i] if density[i] > limit else 0.0
        unsure /= total
        _gather(inner, at, coefficients)
        for j in range(first):  # the waves that R' leaves everywhere; where they end abruptly, the derivatives spread that
            fall = 0.5 * erfc(FALL * (2.0 * (first - j) / first - 1.0))
            coefficients[j] *= fall
            coefficients[size - 1 - j] *= fall
    decay = decayed(rates, tau)
    square = 0.0
    for j in range(size):
        square += coefficients[j] * coefficients[j]
    noise = ROUNDING * np.sqrt(square) * max(1.0, decay[0])
    propagate(modes, decay, coefficients)
    # Beyond the support there is only rounding, which must not be amplified.
    outside, highest, largest = max(after[first], after[last]), 0.0, 0.0
    while first < last and not coefficients[first] > noise:
        first += 1
    while last > first and not coefficients[last] > noise:
        last -= 1
    for j in range(size):
        propagated[j] = after[j] * coefficients[j] if first <= j <= last else 0.0
        if first <= j <= last:
            highest, largest = max(highest, after[j]), max(largest, propagated[j])
    if not (largest > 0.0 and noise * outside < most * largest):
        return np.inf, unsure
    return (noise + _SPREAD * end) * highest / largest, unsure


class Start(NamedTuple):
    """A density (n,), the centre of its grid, relative to the origin, its spacing, and the estimate of its relative error."""

    values: Array
    centre: float
    spacing: float
    error: float


class KnownGrids(NamedTuple):
    """Grids one after the other in `numbers`, and the centre, spacing, size and first number of each (G, 4).

    There are lambda (N,), U' (N, N), a cosine and a sine (N,) of the lowest frequency, log s and h (1 + m, T) at PER points in a
    spacing.
    """

    numbers: Array
    entries: Array


class Prediction(NamedTuple):
    """The density (N,) after an interval on the grid of its modes, of sum one, or the `status` with which the loop ends.

    `place` is that of the grid among those that are known, `begin` and `spacing` are its first point and its spacing, `rows` is
    where its h begins.  At `inset` points at either end there is no density, and between `ends` it is not negligible.  `mass` is
    the sum before; the errors are the spectrum, the density at the ends, the negative mass, rounding, and that of the scale.
    """

    status: int
    values: Array
    place: int
    begin: float
    spacing: float
    rows: int
    inset: int
    ends: tuple[int, int]
    mass: float
    aliasing: float
    edge: float
    negative: float
    rounding: float
    unsure: float


@helper
def predicted(
    start: Start, needed: Outlook, ends: tuple[int, int], shape: tuple[bool, bool, bool], tau: float, grids: KnownGrids,
    limits: Array, grid: tuple[int, Array],
) -> Prediction:  # fmt: skip
    """Return the density after an interval, on coarse grids until one resolves and holds it.

    Args:
        start: the density (n,) before, and its grid.
        needed: what grid it needs after the interval.
        ends: the points between which it is not negligible.
        shape: whether the step stays on its grid, whether the modes are those of this grid, and whether that is a circle.
        tau: the length of the interval.
        grids: the grids whose modes are known.
        limits: as the fields of `steps.Limits`.
        grid: the place of the grid, and what receives the answer of `advance`.
    """
    (density, centre, spacing, _), (coarse, left, right, beyond), (stays, alone, closed) = start, needed, shape
    (begins, stops), (known, index), (place, answer) = ends, grids, grid
    negligible, allowed, half, margin = limits[0], limits[1], density.size // 2, beyond
    if alone:
        coarse, margin = spacing, 0.0
    status, propagated, inset, offset, first, last = OK, density, 0, 0, 0, 0
    begin, rounding, unsure, aliasing, edge, top = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for trial in range(TRIALS):
        if not alone:
            answer[0], answer[1], answer[2] = wanted(left, right, coarse, margin)
            place = place_of(index, answer)
        if place < 0:
            status = GRID if answer[2] <= LARGEST else FAILED
            break
        size, offset = int(index[place, 2]), int(index[place, 3])
        begin, length = index[place, 0] - coarse * (size // 2), PER * (size - 1) + 1
        rates, offset = known[offset : offset + size], offset + size
        modes, offset = known[offset : offset + size * size], offset + size * size
        cosine, sine, offset = known[offset : offset + size], known[offset + size : offset + 2 * size], offset + 2 * size
        scale, offset = known[offset : offset + length], offset + length
        at, propagated, inset = np.empty(density.size), np.empty(size), int(np.ceil(margin / coarse))
        for j in range(density.size):
            at[j] = (centre + spacing * (j - half) - begin) / coarse
        first, last = inset, size - 1 - inset
        rounding, unsure = carried(
            density, at, (alone, closed), Modes(modes, rates, scale), tau, (first, last), 0.1 * allowed, propagated
        )
        aliasing, top = unresolved(propagated, cosine, sine), propagated[highest_of(propagated)]
        on_left = max(abs(propagated[first]), abs(propagated[first + 1]))
        on_right = max(abs(propagated[last]), abs(propagated[last - 1]))
        edge, bound = 0.0 if closed else max(on_left, on_right) / top, max(RESOLVED, EDGE_OF_ALIASING * aliasing)
        resolved = aliasing <= max(SPECTRUM_FACTOR * negligible, SPECTRUM_SHARE * allowed)
        if not (aliasing < np.inf and rounding <= max(RESOLVED, 1e-3 * allowed) and (resolved or not stays)):
            status = FAILED
            break
        if edge <= bound and resolved:
            break
        if stays:
            on = size // 3
            answer[0] = spacing * ((-on if on_left > bound * top else begins) - half)
            answer[1] = spacing * ((size + on if on_right > bound * top else stops) - half)
            answer[2] = spacing
            status = RANGE
            break
        if trial == TRIALS - 1:
            status = FAILED
            break
        alone, margin = False, beyond
        left -= (last - first) * coarse / 3.0 if on_left > bound * top else 0.0
        right += (last - first) * coarse / 3.0 if on_right > bound * top else 0.0
        if edge <= bound:  # the spectrum of a Gaussian falls as exp(-c k^2)
            short = np.log(negligible) / np.log(min(max(aliasing, negligible), 0.3))
            coarse *= 2.0 ** (-0.5 * min(max(np.ceil(np.log2(short)), 1.0), 4.0))
    mass, negative, low, high = 0.0, 0.0, last, first
    if status == OK:
        for j in range(first, last + 1):
            negative -= min(propagated[j], 0.0)
            propagated[j] = max(propagated[j], 0.0)
            mass += propagated[j]
            if propagated[j] > CUT * top:
                low, high = min(low, j), j
        if not (abs(mass - 1.0) < LOST_MASS):
            status = FAILED
        for j in range(propagated.size):
            propagated[j] /= mass
    inner = max(low - 1, first), min(high + 1, last)
    return Prediction(
        status, propagated, place, begin, coarse, offset, inset, inner, mass, aliasing, edge, negative, rounding, unsure
    )
