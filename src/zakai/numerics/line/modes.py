"""Steps by the modes of the operator, in one compiled loop.

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
from typing import Any, NamedTuple

import numpy as np
from numba import boolean, float64, int64, types, void
from numpy.typing import NDArray

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.exponentials import exponentiate
from zakai.numerics.line.density import highest_of, moments, separated, spectrum, support
from zakai.numerics.line.grid_choice import (
    PER,
    Likelihood,
    Outlook,
    differences,
    log_likelihood,
    outlook,
    place_of,
    sampled,
    wanted,
    weigh,
    weighed,
)
from zakai.numerics.line.product import WEAK_SHARE, weak_error
from zakai.numerics.line.resolution import (
    EDGE,
    EDGE_OF_ALIASING,
    LEAST_ROUNDING,
    LOST_MASS,
    RELIABLE,
    ROUNDING,
    SPECTRUM_FACTOR,
    SPECTRUM_SHARE,
    TRIALS,
    step_error,
)
from zakai.numerics.line.steps import (
    AFTER,
    BROAD,
    FAILED,
    GRID,
    NARROW,
    OK,
    RANGE,
    SIZE,
    UNRESOLVED,
    product,
)
from zakai.numerics.line.window import CUT, LARGEST

Array = NDArray[Any]

_V, _M, _T = float64[::1], float64[:, ::1], float64[:, :, ::1]

LOG_NOISE = -33.4  # logarithm of the error of a decomposition relative to the maximum
_NEGLIGIBLE = 42.0  # -log of the factor of a mode that is negligible
_SPREAD = 0.01  # of the value at an abrupt end that the interpolant spreads to the middle of the grid
FALL = 4.2  # half of the range of erfc(y) / 2 from one to zero


@helper
def decayed(rates: Array, time: float) -> Array:
    """Return exp(-time rates) of the modes that are not negligible; the rates increase."""
    count = 1
    while count < rates.size and time * (rates[count] - rates[0]) < _NEGLIGIBLE:
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


@helper
def gathered(values: Array, at: Array, result: Array) -> None:
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
    now: Array, at: Array, shape: tuple[bool, bool], known: Modes, tau: float, ends: tuple[int, int], most: float,
    propagated: Array,
) -> tuple[float, float]:  # fmt: skip
    """Write the density (N,) of the grid of the modes after an interval; return its rounding error and that of the scale.

    The rounding error is infinite where beyond the support it might exceed `most`.

    Args:
        now: the density (n,) before.
        at: its points as indices of the grid of the modes.
        shape: whether these are the points of the grid of the modes, and whether it goes around the circle.
        known: the modes.
        tau: the length of the interval.
        ends: the points between which the density is retained.
        most: the largest error.
        propagated: receives the density.
    """
    (same, closed), (modes, rates, scale), (first, last) = shape, known, ends
    size, top, weights = propagated.size, highest_of(now), np.empty(8)
    inner, logs, after, unsure, total, end = np.zeros(now.size), np.zeros(now.size), np.empty(size), 0.0, 0.0, 0.0
    limit, reference = CUT * now[top], scale[PER * top] if same else 0.0
    if not same:
        reference = weighed(scale, weigh(at[top] * PER, scale.size, 1, weights), 1, weights)
    for j in range(size):
        after[j] = scale[PER * j] - reference
    exponentiate(after)
    if same:
        coefficients = inner
        for j in range(size):
            inner[j] = now[j] / after[j]
            if not closed and (now[j] <= limit or j < 2 or j >= size - 2):  # abrupt ends, which the interpolant spreads
                end = max(end, inner[j])
    else:
        coefficients = np.empty(size)
        for i in range(now.size):
            if now[i] > limit:
                own = weighed(scale, weigh(at[i] * PER, scale.size, 1, weights), 1, weights)
                rough = weighed(scale, weigh(at[i] * PER, scale.size, 2, weights), 2, weights)
                logs[i], unsure, total = reference - own, unsure + now[i] * abs(own - rough), total + now[i]
        exponentiate(logs)
        for i in range(now.size):
            inner[i] = now[i] * logs[i] if now[i] > limit else 0.0
        unsure /= total
        gathered(inner, at, coefficients)
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


class Frame(NamedTuple):
    """What all grids share: the unit of spacings, whether they go around the circle, and the `profile` of `outlook`."""

    unit: float
    closed: bool
    profile: Array


class KnownGrids(NamedTuple):
    """Grids one after the other in `numbers`, and the centre, spacing, size and first number of each (G, 4).

    There are lambda (N,), U' (N, N), a cosine and a sine (N,) of the lowest frequency, log s and h (1 + m, T) at PER points in a
    spacing.
    """

    numbers: Array
    entries: Array


class Special(NamedTuple):
    """h, or where it is `general` the log-likelihood, of the first intervals (S, ., T) on the grid `owner`.

    The owner is -1 for none, and -2 where the h of `KnownGrids` holds.  T is N for steps that stay.  With a second row of
    log-likelihoods they act in the weak sense, and that row is their relative change by another rule.
    """

    rows: Array
    owner: int
    general: bool


class Samples(NamedTuple):
    """What is observed (K, m) from interval `begin` on, and as in `steps.Steps` of all intervals lengths, S^-1 and constants."""

    begin: int
    observed: Array
    lengths: Array
    precisions: Array
    constants: Array


class Results(NamedTuple):
    """The `waves` of the size n of densities, and what receives the results.

    These are the densities (K, n); the centres, the spacings, which grid of modes was taken, and its points at either end at
    which there is no density (K + 1, 4); and the reports.
    """

    cosines: Array
    sines: Array
    densities: Array
    places: Array
    reports: Array


STAY, OWN, PLACE = range(3)  # steps on the grid of the density; on its own grid the first transition, or none


@kernel(
    types.UniTuple(int64, 2)(  # type: ignore[no-untyped-call]
        types.NamedTuple([_V, float64, float64, float64], Start), types.NamedTuple([float64, boolean, _M], Frame),
        types.NamedTuple([_V, _M], KnownGrids), types.NamedTuple([_T, int64, boolean], Special), int64,
        types.NamedTuple([int64, _M, _V, _T, _V], Samples), _V, types.NamedUniTuple(_M, 5, Results)
    )
)  # fmt: skip
def advance(
    start: Start, frame: Frame, grids: KnownGrids, given: Special, placement: int, samples: Samples, limits: Array,
    results: Results,
) -> tuple[int, int]:  # fmt: skip
    """Return the number of steps, and why the loop ended.

    The last row of `places` receives the answer: the centre, the spacing and the size of the grid whose modes are needed (GRID),
    or the range of the grid that the step needs, relative to the centre of the present one, and its spacing (RANGE).

    Args:
        start: the density and its grid.
        frame: what all grids share.
        grids: the grids whose modes are known.
        given: the likelihoods, or an h that depends on t.
        placement: STAY, OWN or PLACE.
        samples: what is observed.
        limits: as the fields of `steps.Limits`.
        results: what receives the results.
    """
    values, centre, spacing, error = start
    unit, closed, profile = frame
    known, index = grids
    special, owner, general = given
    begin, observed, lengths, precisions, constants = samples
    cosines, sines, densities, places, out = results
    negligible, allowed, generous = limits[0], limits[1], limits[4]
    now, n, answer, place, stays = values.copy(), densities.shape[1], places[-1], -1, placement == STAY
    weak = general and special.shape[1] == 2
    for i in range(observed.shape[0]):
        k, row, half = begin + i, out[i], now.size // 2
        tau, alone = lengths[k], stays or (placement == OWN and i == 0)
        begins, ends = support(now, CUT)
        needed = Outlook(0.0, 0.0, 0.0, 0.0)
        if not closed:
            needed = outlook(centre + spacing * (begins - half), centre + spacing * (ends - half), tau, unit, profile)
        coarse, left, right, beyond = needed
        if np.isnan(coarse):
            return i, FAILED
        if stays and coarse >= 1.41 * spacing:
            return i, NARROW
        if not alone and not coarse >= 1.41 * spacing:
            return i, BROAD
        margin = 0.0 if alone else beyond
        coarse = spacing if alone else coarse
        if not stays or i == 0:
            answer[0], answer[1], answer[2] = centre, spacing, now.size
        # The transition.
        for trial in range(TRIALS):
            if not alone:
                answer[0], answer[1], answer[2] = wanted(left, right, coarse, margin)
            if not stays or i == 0:
                place = place_of(index, answer)
            if place < 0:
                return i, GRID if answer[2] <= LARGEST else FAILED
            size, offset = int(index[place, 2]), int(index[place, 3])
            begin_at, length = index[place, 0] - coarse * (size // 2), PER * (size - 1) + 1
            rates, offset = known[offset : offset + size], offset + size
            modes, offset = known[offset : offset + size * size], offset + size * size
            cosine, sine, offset = known[offset : offset + size], known[offset + size : offset + 2 * size], offset + 2 * size
            scale, offset = known[offset : offset + length], offset + length
            at, propagated, inset = np.empty(now.size), np.empty(size), int(np.ceil(margin / coarse))
            for j in range(now.size):
                at[j] = (centre + spacing * (j - half) - begin_at) / coarse
            first, last = inset, size - 1 - inset
            rounding, unsure = carried(
                now, at, (alone, closed), Modes(modes, rates, scale), tau, (first, last), 0.1 * allowed, propagated
            )
            aliasing, top = unresolved(propagated, cosine, sine), propagated[highest_of(propagated)]
            on_left = max(abs(propagated[first]), abs(propagated[first + 1]))
            on_right = max(abs(propagated[last]), abs(propagated[last - 1]))
            edge, bound = 0.0 if closed else max(on_left, on_right) / top, max(EDGE, EDGE_OF_ALIASING * aliasing)
            resolved = aliasing <= max(SPECTRUM_FACTOR * negligible, SPECTRUM_SHARE * allowed)
            if not (aliasing < np.inf and rounding <= max(LEAST_ROUNDING, 1e-3 * allowed) and (resolved or not stays)):
                return i, FAILED
            if edge <= bound and resolved:
                break
            if stays:
                on = size // 3
                answer[0] = spacing * ((-on if on_left > bound * top else begins) - half)
                answer[1] = spacing * ((size + on if on_right > bound * top else ends) - half)
                answer[2] = spacing
                return i, RANGE
            if trial == TRIALS - 1:
                return i, FAILED
            alone, margin = False, beyond
            left -= (last - first) * coarse / 3.0 if on_left > bound * top else 0.0
            right += (last - first) * coarse / 3.0 if on_right > bound * top else 0.0
            if edge <= bound:  # the spectrum of a Gaussian falls as exp(-c k^2)
                short = np.log(negligible) / np.log(min(max(aliasing, negligible), 0.3))
                coarse *= 2.0 ** (-0.5 * min(max(np.ceil(np.log2(short)), 1.0), 4.0))
        mass, negative, from_, to = 0.0, 0.0, last, first
        for j in range(first, last + 1):
            negative -= min(propagated[j], 0.0)
            propagated[j] = max(propagated[j], 0.0)
            mass += propagated[j]
            if propagated[j] > CUT * top:
                from_, to = min(from_, j), j
        if not (abs(mass - 1.0) < LOST_MASS):
            return i, FAILED
        missing = abs(mass - 1.0)
        for j in range(size):
            propagated[j] /= mass
        predicted, before = moments(propagated)[2] * coarse**2, moments(now)[2] * spacing**2
        floor = np.exp(LOG_NOISE) + aliasing + edge + rounding
        # The sample.
        if owner >= -1:
            if place != owner:
                return i, GRID
            rows = special[i]
        else:
            rows = known[offset : offset + observed.shape[1] * length].reshape((observed.shape[1], length))
        b, constant, deeper, more, seen = np.empty(n), 0.0, 0.0, 0.0, True
        if stays:
            constant, seen = on_grid(rows, highest_of(now), general, precisions[k], observed[i], b)
            for j in range(n):
                now[j] = propagated[j]
        else:
            now = np.empty(n)
            likelihood = Likelihood(rows, general, precisions[k], observed[i])
            centre, spacing, constant, more, enough = sampled(
                propagated, (max(from_ - 1, first), min(to + 1, last)), (begin_at, coarse, unit), likelihood, now, b
            )
            if not enough:
                return i, SIZE
            for j in range(n):
                now[j] *= spacing / coarse
            deeper = np.log(propagated[highest_of(propagated)] * spacing / coarse) - np.log(now[highest_of(now)])
        added, growth, below = product(now, b) if seen else (0.0, 0.0, 0.0)
        on_left, on_right, from_at, to_at, _, unsampled, _, highest, _ = spectrum(now, CUT, negligible, cosines, sines, stays)
        limit = SPECTRUM_FACTOR * negligible if seen else np.inf
        if weak:  # of a kink the spectrum falls slowly
            unsampled, limit = 0.5 * weak_error(now, rows[1]) if seen else 0.0, WEAK_SHARE * allowed
        if np.isnan(added):
            return i, FAILED
        if not (unsampled <= limit):
            answer[0], answer[1], answer[2] = spacing * (begins - half), spacing * (ends - half), 0.6 * spacing
            if weak or not (unsampled < np.inf):
                return i, FAILED
            return i, SIZE if not stays else (RANGE if closed else UNRESOLVED)
        growth, below = min(growth * np.exp(min(deeper, 300.0)), 1e80), below + deeper
        aliasing, unsure = max(aliasing, unsampled), unsure + more
        if not closed:
            edge = max(edge, on_left, on_right)
        row[1], row[2] = moments(now)[1:]
        # What the ends of the grid absorb is missing.
        made = step_error(aliasing, edge, negative, rounding + unsure + missing, floor * growth)
        if not ((closed or not seen or max(on_left, on_right) < 1e-10) and made <= allowed):
            return i, FAILED
        ratio = min(max(np.sqrt(before * row[2]) * spacing / predicted, 0.3), 1.0)
        # No estimate is reliable far below the tolerance.
        error = max(made + error * (1.0 if separated(now) else ratio), RELIABLE * allowed)
        row[0], row[3], row[4] = np.log(mass) + constants[k] + constant + added, aliasing, edge
        row[5], row[6], row[7] = negative, rounding + unsure, below / max(np.log(allowed) - np.log(floor), 2.3)
        row[8], row[9], row[10], row[11], row[12] = growth, made, error, min(LOG_NOISE + max(below - 1.0, 0.0), 0.0), 0.0
        places[i, 0], places[i, 1], places[i, 2], places[i, 3] = centre, spacing, place, inset
        for j in range(n):
            densities[i, j] = now[j]
        if stays:
            from_, to = int(from_at), int(to_at)
            if weak:
                from_, to = support(now, CUT)
            if not serves(size, from_, to, 1.0 if weak else 0.92 * (size // 2) / (max(highest, 0.0) + 1.0), closed, generous):
                return i + 1, AFTER
    return observed.shape[0], OK


@helper
def on_grid(rows: Array, at: int, general: bool, precision: Array, observed: Array, b: Array) -> tuple[float, bool]:
    """Write the logarithm of a likelihood at the points of a grid relative to one of these; return it there, and if it varies."""
    stride, seen = (rows.shape[1] - 1) // (b.size - 1), False
    h, centre = np.empty(rows.shape[0]), np.empty(rows.shape[0])
    for i in range(h.size):
        centre[i] = rows[i, stride * at]
    for j in range(b.size):
        for i in range(h.size):
            h[i] = rows[i, stride * j]
        b[j] = differences(h, centre, general, precision, observed)
        seen |= b[j] != 0.0
    return log_likelihood(centre, general, precision, observed), seen


@helper
def serves(size: int, first: int, last: int, resolving: float, closed: bool, generous: float) -> bool:
    """Return whether a grid serves for the next step, as in `window.fitted`.

    Args:
        size: its points.
        first, last: the support of the density.
        resolving: the spacing that is needed, in spacings.
        closed: whether the grid goes around the circle.
        generous: the size up to which a grid is kept though fewer points would do.
    """
    least = max(3, size // 16)
    if resolving < 0.97:
        return False
    if closed:
        return not (size > generous and resolving > 2.2)
    fewer = size > generous and size > 1.6 * (1.2 * (last - first + 1.0) * min(1.0, 1.0 / resolving) + 16.0)
    return not (fewer or first < least or last >= size - least)
