"""Steps of densities that are much narrower than the noise of an interval, in one compiled loop.

After an interval tau no wave shorter than the standard deviation (tau G)^(1/2) of the noise is left.  The modes of the operator
on a coarse grid that resolves this deviation carry the density,

    q = s U exp(-tau lambda) U' R' (p / s),

with the values of p / s on a fine grid of its own and R the interpolation from the coarse grid to the fine one (its transpose
gives the integrals of modes times density).  The product of q with the likelihood of a sample has a fine grid of its own again,
which `line_place` finds.  Fine grids need no decomposition, and one coarse grid serves many.
"""

from __future__ import annotations

from math import erfc
from typing import Any

import numpy as np
from numba import boolean, float64, int64, types
from numpy.typing import NDArray

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.exponentials import exponentiate
from zakai.numerics.line_density import highest_of, moments, separated, spectrum, support
from zakai.numerics.line_modes import LOG_NOISE, decayed, propagate
from zakai.numerics.line_outlook import outlook, place_of, wanted
from zakai.numerics.line_place import PER, sampled, weigh, weighed
from zakai.numerics.line_segment import RELIABLE
from zakai.numerics.line_step import product
from zakai.numerics.line_window import CUT, LARGEST

Array = NDArray[Any]

DONE, BROAD, GRID, SIZE, FAILED = range(5)  # why the loop ends
_EDGE = 1e-11  # density at the outermost points, relative to the maximum
_FALL = 4.2  # half of the range of erfc(y) / 2 from one to zero
_ATTEMPTS = 6  # coarse grids on which a step is tried
_V, _M, _T = float64[::1], float64[:, ::1], float64[:, :, ::1]


@helper
def unresolved(values: Array, cosines: Array, sines: Array) -> float:
    """Return the largest spectrum of values in the highest eighth of the frequencies, relative to the mass."""
    size, mass, found = values.size, np.sum(values), 0.0
    for k in range(size // 2, 7 * (size // 2) // 8 - 1, -max(1, size // 64)):
        real, imag, at = 0.0, 0.0, 0
        for j in range(size):
            real, imag = real + cosines[at] * values[j], imag + sines[at] * values[j]
            at += k
            at -= size if at >= size else 0
        found = max(found, real * real + imag * imag)
    return np.sqrt(found) / abs(mass)


@helper
def gathered(values: Array, at: Array, found: Array) -> None:
    """Write the values at indices of a grid times the matrix of interpolation from its points (N,)."""
    for j in range(found.size):
        found[j] = 0.0
    for i in range(values.size):
        near = np.floor(at[i] + 0.5)
        part = np.sin(np.pi * (at[i] - near)) / np.pi * values[i]
        if abs(at[i] - near) < 1e-12:
            if 0 <= near < found.size:
                found[int(near)] += values[i] * (1.0 if near % 2 == 0 else -1.0)
            continue
        part = part if near % 2 == 0 else -part
        for j in range(found.size):
            found[j] += part / (at[i] - j)
    for j in range(1, found.size, 2):
        found[j] = -found[j]


@kernel(
    types.UniTuple(float64, 2)(  # type: ignore[no-untyped-call]
        _V, _V, boolean, _V, _V, _V, float64, int64, int64, _V
    )
)
def carried(
    now: Array, at: Array, same: bool, scale: Array, modes: Array, rates: Array, tau: float, first: int, last: int, moved: Array
) -> tuple[float, float]:  # fmt: skip
    """Write the density (N,) of the coarse grid after an interval; return its rounding error and that of the scale.

    Args:
        now: the density (n,) before.
        at: its points as indices of the coarse grid.
        same: whether these are the points of the coarse grid.
        scale: log s (T,) at the points of rows.
        modes, rates: the rows of U' and lambda.
        tau: the length of the interval.
        first, last: the points of the coarse grid between which the density is kept.
        moved: receives the density.
    """
    top, weights = highest_of(now), np.empty(8)
    inner, logs, unsure, total = np.zeros(now.size), np.empty(now.size), 0.0, 0.0
    reference = weighed(scale, weigh(at[top] * PER, scale.size, 1, weights), 1, weights)
    for i in range(now.size):
        logs[i] = 0.0
        if now[i] > CUT * now[top]:
            own = weighed(scale, weigh(at[i] * PER, scale.size, 1, weights), 1, weights)
            rough = weighed(scale, weigh(at[i] * PER, scale.size, 2, weights), 2, weights)
            logs[i], unsure, total = reference - own, unsure + now[i] * abs(own - rough), total + now[i]
    exponentiate(logs)
    for i in range(now.size):
        inner[i] = now[i] * logs[i] if now[i] > CUT * now[top] else 0.0
    if same:
        coefficients = inner.copy()
    else:
        coefficients = np.empty(moved.size)
        gathered(inner, at, coefficients)
        for j in range(first):  # the waves that R' leaves everywhere; where they end abruptly, the derivatives spread that
            fall = 0.5 * erfc(_FALL * (2.0 * (first - j) / first - 1.0))
            coefficients[j] *= fall
            coefficients[coefficients.size - 1 - j] *= fall
    reach = np.sqrt(np.sum(coefficients * coefficients))
    decay = decayed(rates, tau)
    propagate(modes, decay, coefficients)
    after, most, largest = np.empty(moved.size), 0.0, 0.0
    for j in range(moved.size):
        after[j] = scale[PER * j] - reference
    exponentiate(after)
    for j in range(moved.size):
        moved[j] = after[j] * coefficients[j] if first <= j <= last else 0.0
        if first <= j <= last:
            most, largest = max(most, after[j]), max(largest, moved[j])
    noise = 4e-16 * reach * max(1.0, decay[0]) * most
    return (noise / largest if largest > 0.0 else np.inf), unsure / total


@kernel(
    types.UniTuple(int64, 2)(  # type: ignore[no-untyped-call]
        _V, float64, float64, float64, _M, _V, _M, _M, int64, boolean, boolean, int64, _M, _V, _T, _V, float64, float64, float64,
        _M, _M, _M, _M, _M
    )
)  # fmt: skip
def sharpened(
    values: Array, centre: float, spacing: float, unit: float, profile: Array, known: Array, index: Array, special: Array,
    owner: int, general: bool, own: bool, begin: int, observed: Array, lengths: Array, precisions: Array, constants: Array,
    error: float, negligible: float, allowed: float, cosines: Array, sines: Array, densities: Array, places: Array, out: Array,
) -> tuple[int, int]:  # fmt: skip
    """Return the number of steps, and why the loop ended.

    The last row of `places` receives the answer: the centre, the spacing and the size of the coarse grid that is needed.

    Args:
        values, centre, spacing: the density (n,) and its grid, relative to the origin; `unit` is the scale of spacings.
        profile: as in `outlook`.
        known, index: coarse grids one after the other, and the centre, spacing, size and first number of each (G, 4).  There are
            lambda (N,), U' (N, N), a cosine and a sine (N,) of the lowest frequency, log s and h (1 + m, T) at PER points in a
            spacing.
        special, owner: h or the log-likelihood of the first interval (., T) on one of the grids, -1 where that of `known` holds.
        general: whether there are log-likelihoods in place of h.
        own: whether the first step is taken on the grid of the density.
        begin: the first interval.
        observed: what is observed (K, m).
        lengths, precisions, constants: as in `line_segment.Steps`.
        error: the estimate of the relative error of `values`.
        negligible, allowed: the spectrum that need not be resolved, and the largest error.
        cosines, sines: `waves` of the size of fine grids.
        densities, places, out: receive the densities (K, n), the centres, the spacings and which coarse grid was
            taken (K + 1, 3), and the reports.
    """
    now, n, answer = values.copy(), densities.shape[1], places[-1]
    for i in range(observed.shape[0]):
        k, row = begin + i, out[i]
        tau, alone = lengths[k], own and i == 0
        begins, ends = support(now, CUT)
        low, high = centre + spacing * (begins - now.size // 2), centre + spacing * (ends - now.size // 2)
        coarse, left, right, beyond = outlook(low, high, tau, unit, profile)
        margin = 0.0 if alone else beyond
        if alone:
            coarse = spacing
        elif not coarse >= 0.999 * spacing:
            return i, BROAD
        answer[0], answer[1], answer[2] = centre, spacing, now.size
        # The transition.
        for attempt in range(_ATTEMPTS):
            if not alone:
                wanted(left, right, coarse, margin, answer)
            place = place_of(index, answer)
            if place < 0:
                return i, GRID if answer[2] <= LARGEST else FAILED
            size, offset = int(index[place, 2]), int(index[place, 3])
            begin_at, length = index[place, 0] - coarse * (size // 2), PER * (size - 1) + 1
            rates, offset = known[offset : offset + size], offset + size
            modes, offset = known[offset : offset + size * size], offset + size * size
            cosine, sine, offset = known[offset : offset + size], known[offset + size : offset + 2 * size], offset + 2 * size
            scale, offset = known[offset : offset + length], offset + length
            at, moved, inset = np.empty(now.size), np.empty(size), int(np.ceil(margin / coarse))
            for j in range(now.size):
                at[j] = (centre + spacing * (j - now.size // 2) - begin_at) / coarse
            first, last = inset, size - 1 - inset
            rounding, unsure = carried(now, at, alone, scale, modes, rates, tau, first, last, moved)
            aliasing, top = unresolved(moved, cosine, sine), moved[highest_of(moved)]
            on_left, on_right = max(abs(moved[first]), abs(moved[first + 1])), max(abs(moved[last]), abs(moved[last - 1]))
            edge, bound = max(on_left, on_right) / top, max(_EDGE, 4.0 * aliasing)
            if not (aliasing < np.inf and rounding <= max(1e-11, 1e-5 * allowed)):
                return i, FAILED
            if edge <= bound and aliasing <= max(30.0 * negligible, 1e-5 * allowed):
                break
            if attempt == _ATTEMPTS - 1:
                return i, FAILED
            alone, margin = False, beyond
            left -= (last - first) * coarse / 3.0 if on_left > bound * top else 0.0
            right += (last - first) * coarse / 3.0 if on_right > bound * top else 0.0
            if edge <= bound:  # the spectrum of a Gaussian falls as exp(-c k^2)
                short = np.log(negligible) / np.log(min(max(aliasing, negligible), 0.3))
                coarse *= 2.0 ** (-0.5 * min(max(np.ceil(np.log2(short)), 1.0), 4.0))
        mass, negative, begins, ends = 0.0, 0.0, last, first
        for j in range(first, last + 1):
            negative -= min(moved[j], 0.0)
            moved[j] = max(moved[j], 0.0)
            mass += moved[j]
            if moved[j] > CUT * top:
                begins, ends = min(begins, j), j
        if not (abs(mass - 1.0) < 1e-3):
            return i, FAILED
        for j in range(size):
            moved[j] /= mass
        predicted, before = moments(moved)[2] * coarse**2, moments(now)[2] * spacing**2
        floor = np.exp(LOG_NOISE) + aliasing + edge + rounding
        # The sample.
        if owner >= -1:
            if place != owner:
                return i, GRID
            rows = special
        else:
            rows = np.empty((observed.shape[1], length))
            for r in range(rows.shape[0]):
                for j in range(length):
                    rows[r, j] = known[offset + r * length + j]
        now, b = np.empty(n), np.empty(n)
        centre, spacing, constant, more, enough = sampled(
            moved, max(begins - 1, first), min(ends + 1, last), rows, general, precisions[k], observed[i], begin_at, coarse, unit,
            now, b,
        )  # fmt: skip
        if not enough:
            return i, SIZE
        for j in range(n):
            now[j] *= spacing / coarse
        deeper = np.log(moved[highest_of(moved)] * spacing / coarse) - np.log(now[highest_of(now)])
        added, growth, below = product(now, b)
        on_left, on_right, _, _, _, unsampled, _, _, _ = spectrum(now, CUT, negligible, cosines, sines, False)
        if not (unsampled <= 30.0 * negligible):
            return i, SIZE if unsampled < np.inf else FAILED
        growth, below = min(growth * np.exp(min(deeper, 300.0)), 1e80), below + deeper
        aliasing, unsure, edge = max(aliasing, unsampled), unsure + more, max(edge, on_left, on_right)
        row[1], row[2] = moments(now)[1:]
        made = 2.0 * aliasing + 10.0 * (edge + negative) + rounding + unsure + min(floor * growth, 1.0)
        if not (max(on_left, on_right) < 1e-10 and made <= allowed):
            return i, FAILED
        ratio = min(max(np.sqrt(before * row[2]) * spacing / predicted, 0.3), 1.0)
        error = max(made + error * (1.0 if separated(now) else ratio), RELIABLE * allowed)
        row[0], row[3], row[4] = np.log(mass) + constants[k] + constant + added, aliasing, edge
        row[5], row[6], row[7] = negative, rounding + unsure, below / max(np.log(allowed) - np.log(floor), 2.3)
        row[8], row[9], row[10], row[11], row[12] = growth, made, error, min(LOG_NOISE + max(below - 1.0, 0.0), 0.0), 0.0
        places[i, 0], places[i, 1], places[i, 2] = centre, spacing, place
        for j in range(n):
            densities[i, j] = now[j]
    return observed.shape[0], DONE
