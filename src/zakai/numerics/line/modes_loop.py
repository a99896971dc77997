"""Steps by the modes of the operator with samples, in one compiled loop (`numerics/line/modes.py`).

Where a step stays on its grid a sample multiplies the values there,

    p(t + tau | y) = l(y | x) q / Z,        q = s U exp(-tau lambda) U' (p / s).

Else the product with the likelihood has a fine grid of its own (`numerics/line/grid_choice.py`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64, types

from zakai.numerics.arrays import Array
from zakai.numerics.compiled import helper, kernel
from zakai.numerics.line import steps as ls
from zakai.numerics.line.density import highest_of, moments, separated, spectrum, support
from zakai.numerics.line.grid_choice import PER, Likelihood, Outlook, differences, log_likelihood, outlook, place_of, sampled
from zakai.numerics.line.modes import KnownGrids, Start, predicted
from zakai.numerics.line.product import WEAK_SHARE, weak_error
from zakai.numerics.line.resolution import NOISE, RELIABLE, SPECTRUM_FACTOR, step_error
from zakai.numerics.line.window import CUT

_V, _M, _T = float64[::1], float64[:, ::1], float64[:, :, ::1]

LOG_NOISE = float(np.log(NOISE))


class Frame(NamedTuple):
    """What all grids share: the unit of spacings, whether they go around the circle, and the `profile` of `outlook`."""

    unit: float
    closed: bool
    profile: Array


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
    density, n, answer, place, stays = values.copy(), densities.shape[1], places[-1], -1, placement == STAY
    weak = general and special.shape[1] == 2
    for i in range(observed.shape[0]):
        k, row, half = begin + i, out[i], density.size // 2
        tau, alone = lengths[k], stays or (placement == OWN and i == 0)
        begins, ends = support(density, CUT)
        needed = Outlook(0.0, 0.0, 0.0, 0.0)
        if not closed:
            needed = outlook(centre + spacing * (begins - half), centre + spacing * (ends - half), tau, unit, profile)
        if np.isnan(needed.spacing):
            return i, ls.FAILED
        if stays and needed.spacing >= 1.41 * spacing:
            return i, ls.NARROW
        if not alone and not needed.spacing >= 1.41 * spacing:
            return i, ls.BROAD
        if not stays or i == 0:
            answer[0], answer[1], answer[2] = centre, spacing, density.size
            place = place_of(index, answer)
        move = predicted(
            Start(density, centre, spacing, error), needed, (begins, ends), (stays, alone, closed), tau, grids, limits,
            (place, answer),
        )  # fmt: skip
        if move.status != ls.OK:
            return i, move.status
        place, coarse, propagated, size = move.place, move.spacing, move.values, move.values.size
        after, before = moments(propagated)[2] * coarse**2, moments(density)[2] * spacing**2
        floor = np.exp(LOG_NOISE) + move.aliasing + move.edge + move.rounding
        # The sample.
        if owner >= -1:
            if place != owner:
                return i, ls.GRID
            rows = special[i]
        else:
            m, length = observed.shape[1], PER * (size - 1) + 1
            rows = known[move.rows : move.rows + m * length].reshape((m, length))
        b, constant, deeper, more, seen = np.empty(n), 0.0, 0.0, 0.0, True
        if stays:
            constant, seen = on_grid(rows, highest_of(density), general, precisions[k], observed[i], b)
            for j in range(n):
                density[j] = propagated[j]
        else:
            density = np.empty(n)
            likelihood = Likelihood(rows, general, precisions[k], observed[i])
            centre, spacing, constant, more, enough = sampled(
                propagated, move.ends, (move.begin, coarse, unit), likelihood, density, b
            )
            if not enough:
                return i, ls.SIZE
            for j in range(n):
                density[j] *= spacing / coarse
            deeper = np.log(propagated[highest_of(propagated)] * spacing / coarse) - np.log(density[highest_of(density)])
        added, growth, below = ls.product(density, b) if seen else (0.0, 0.0, 0.0)
        on_left, on_right, from_at, to_at, _, unsampled, _, highest, _ = spectrum(density, CUT, negligible, cosines, sines, stays)
        limit = SPECTRUM_FACTOR * negligible if seen else np.inf
        if weak:  # of a kink the spectrum falls slowly
            unsampled, limit = 0.5 * weak_error(density, rows[1]) if seen else 0.0, WEAK_SHARE * allowed
        if np.isnan(added):
            return i, ls.FAILED
        if not (unsampled <= limit):
            answer[0], answer[1], answer[2] = spacing * (begins - half), spacing * (ends - half), 0.6 * spacing
            if weak or not (unsampled < np.inf):
                return i, ls.FAILED
            return i, ls.SIZE if not stays else (ls.RANGE if closed else ls.UNRESOLVED)
        growth, below = growth * np.exp(min(deeper, 300.0)), below + deeper
        aliasing, rounding = max(move.aliasing, unsampled), move.rounding + (move.unsure + more)
        edge = move.edge if closed else max(move.edge, on_left, on_right)
        row[ls.MEAN], row[ls.VARIANCE] = moments(density)[1:]
        # What the ends of the grid absorb is missing.
        made = step_error(aliasing, edge, move.negative, rounding + abs(move.mass - 1.0), floor * growth)
        if not ((closed or not seen or max(on_left, on_right) < 1e-10) and made <= allowed):
            return i, ls.FAILED
        ratio = min(max(np.sqrt(before * row[ls.VARIANCE]) * spacing / after, 0.3), 1.0)
        # No estimate is reliable far below the tolerance.
        error = max(made + error * (1.0 if separated(density) else ratio), RELIABLE * allowed)
        row[ls.GAINED], row[ls.ALIASING], row[ls.EDGE] = np.log(move.mass) + constants[k] + constant + added, aliasing, edge
        row[ls.NEGATIVE], row[ls.TIME], row[ls.DEPTH] = move.negative, rounding, below / max(np.log(allowed) - np.log(floor), 2.3)
        row[ls.GROWTH], row[ls.MADE], row[ls.ERROR] = growth, made, error
        row[ls.LOG_FLOOR] = min(LOG_NOISE + max(below - 1.0, 0.0), 0.0)
        places[i, 0], places[i, 1], places[i, 2], places[i, 3] = centre, spacing, place, move.inset
        for j in range(n):
            densities[i, j] = density[j]
        if stays:
            first, last = support(density, CUT) if weak else (int(from_at), int(to_at))
            if not serves(size, first, last, 1.0 if weak else 0.92 * (size // 2) / (max(highest, 0.0) + 1.0), closed, generous):
                return i + 1, ls.AFTER
    return observed.shape[0], ls.OK


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
