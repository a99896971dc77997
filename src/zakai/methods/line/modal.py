"""Steps by the modes of the operator (`numerics/line/modes_loop.py`), for `line/loop.py`, and by those of a coarse grid.

After an interval tau no wave shorter than the standard deviation of the noise is left, (tau G)^(1/2) where the drift does not
contract it.  The modes of the operator on a coarse grid that resolves this deviation carry the density,

    u(tau) = s U exp(-tau lambda) U' R' (u / s),

with the values of u / s on its own fine grid and R the interpolation from the coarse grid to the fine one (its transpose gives
the integrals of modes times density).  The compiled steps do that for samples; `coarsened` does it for an interval that is
filtered alone: with kinks or jumps of a likelihood, and for complex densities.
"""

from __future__ import annotations

from threading import Lock
from typing import NamedTuple

import numpy as np

from zakai.methods.line.cache import CacheKey, Derived
from zakai.methods.line.coefficients import covariance_at, gauge_at, profile_of, sensor_at_nodes, spectral
from zakai.methods.line.prepared import INTERVALS_TOGETHER, SHARED, Prepared, State
from zakai.methods.line.update import factor_at_end, grid_check
from zakai.numerics.arrays import Array
from zakai.numerics.line import modes_loop as lm
from zakai.numerics.line import window as lw
from zakai.numerics.line.density import circular_rows, waves
from zakai.numerics.line.grid_choice import PER, REACH, SPACING, coarse_grid
from zakai.numerics.line.modes import KnownGrids, Start, gathered
from zakai.numerics.line.product import General, weaken
from zakai.numerics.line.resolution import TRIALS, edge_bound, rounding_bound, spectrum_bound
from zakai.numerics.line.steps import FIGURES, STATUSES, Status

FINE_SIZES = (80, 160, 384, 1024)  # points of fine grids
NUMBERS = 2**21  # of the grids that are known together


class Advanced(NamedTuple):
    """Steps on grids of their own: densities (K, n), centres and spacings (K,), and reports (K, .).

    The transitions were those of `coarse` grids, with centres, spacings, sizes and the numbers of points at either end at which
    there is no density (K, 4), or of the grid on which all steps have stayed.  `status` is why the loop ended, and `answer` the
    range of the grid that it needs and its spacing.
    """

    densities: Array
    centres: Array
    spacings: Array
    reports: Array
    coarse: Array | None
    status: Status
    answer: Array


class Coarse:
    """Grids and their modes as the loop reads them.

    Grids are only added, so that other threads may read those that are there.
    """

    def __init__(self) -> None:
        """Begin without grids."""
        self.numbers, self.used, self.index, self.lock = np.empty(NUMBERS), 0, np.empty((0, 4)), Lock()

    def add(self, grid: lw.Window, parts: list[Array]) -> bool:
        """Add a grid, and return whether it fits beside the others."""
        with self.lock:
            stop = self.used + sum(part.size for part in parts)
            if stop <= len(self.numbers):
                self.numbers[self.used : stop] = np.concatenate([part.reshape(-1) for part in parts])
                self.index = np.concatenate([self.index, [[grid.centre, grid.spacing, grid.size, self.used]]])
                self.used = stop
            return bool(stop <= len(self.numbers))


def advanced(prepared: Prepared, k: int, stop: int, state: State, observed: np.ndarray, placement: int) -> Advanced:
    """Return the first steps of some intervals.

    Args:
        prepared: a system with samples whose operator has a decomposition.
        k, stop: the intervals.
        observed: what is observed (K, m).
        placement: whether the steps stay on the grid of the state, see `numerics/line/modes_loop.py`.
    """
    system, window, steps, stays = prepared.system, state.window, prepared.steps, placement == lm.STAY
    general, special = system.general or prepared.weak, system.general or not system.steady_observation or prepared.weak
    key, profile = (window.origin, window.unit, window.closed), profile_of(prepared, window)
    coarse, rows, at = prepared.once(Derived.COARSE_GRIDS, key, Coarse), np.empty((0, 0, 0)), 0
    start = Start(np.ascontiguousarray(state.values), float(state.centre), float(state.spacing), float(state.error))
    frame = lm.Frame(window.unit, window.closed, profile)
    owner, count = (-2, stop - k) if not special else (-1, min(INTERVALS_TOGETHER, stop - k) if stays else 1)
    for _ in range(TRIALS):
        n = window.size if stays else FINE_SIZES[at]
        cosines, sines = waves(n)
        densities, places, out = np.empty((count, n)), np.empty((count + 1, 4)), np.zeros((count, FIGURES))
        samples = lm.Samples(k, observed[:count], steps.lengths, steps.precisions[:, 0], steps.constants)
        done, number = lm.advance(
            start, frame, KnownGrids(coarse.numbers, coarse.index), lm.Special(rows, owner, general), placement, samples,
            prepared.limits, lm.Results(cosines, sines, densities, places, out),
        )  # fmt: skip
        if window.closed:
            circular_rows(densities[:done], cosines, sines, out)
        grids = coarse.index[places[:done, 2].astype(int), :3]
        completed = None if stays else np.column_stack([grids, places[:done, 3]])
        centres, spacings, status = places[:done, 0], places[:done, 1], STATUSES[number]
        result = Advanced(densities[:done], centres, spacings, out[:done], completed, status, places[-1, :3])
        if done or result.status not in (Status.SIZE, Status.GRID):
            return result
        if result.status == Status.SIZE:
            at, count = at + 1, 1
            if at < len(FINE_SIZES):
                continue
        else:
            centre, spacing, size = result.answer.tolist()
            grid = window._replace(centre=centre, spacing=spacing, size=int(size))
            places_of = np.flatnonzero((coarse.index[:, :3] == result.answer).all(axis=1))
            if len(places_of):  # what is missing is what is observed
                here = range(k, k + count)
                owner, rows = int(places_of[0]), np.stack([_rows(prepared, i, grid, observed[i - k], stays) for i in here])
                count = int(np.argmax(np.append(np.isnan(rows).any(axis=(1, 2)), True)))
                if count:
                    continue
            # The decomposition of a large grid takes longer than steps on a coarser one.
            elif not stays or grid.size <= SHARED or grid.closed or prepared.kinked:
                parts = _parts(prepared, grid)
                if parts is not None and not coarse.add(grid, parts):  # the others are left to threads that read them
                    prepared.grid_cache.pop(CacheKey(Derived.COARSE_GRIDS, key), None)
                    coarse = prepared.once(Derived.COARSE_GRIDS, key, Coarse)
                    coarse.add(grid, parts)
                if parts is not None:
                    continue
        break
    return result._replace(status=Status.FAILED)


def _parts(prepared: Prepared, grid: lw.Window) -> list[Array] | None:
    """Return what is known of a coarse grid, None where its operator has no decomposition or a formula no value."""
    decomposed = spectral(prepared, grid)
    if decomposed is None:
        return None
    system, start, theta, x = prepared.system, prepared.model.start, prepared.theta, _points(grid)
    scale = gauge_at(prepared, x, 4 if system.rough else 1)
    if system.state_dependent:
        scale = scale - 0.5 * np.log(covariance_at(system, x, start, theta))
    rows = np.zeros((system.m, len(x)))
    if not system.general and system.steady_observation:
        rows = system.observation(x[:, None], start, theta).T
    angle = 2.0 * np.pi / grid.size * np.arange(grid.size)
    result = [decomposed.rates, np.ascontiguousarray(decomposed.modes.T), np.cos(angle), np.sin(angle), scale, rows]
    return result if all(np.isfinite(part).all() for part in result) else None


def _rows(prepared: Prepared, k: int, grid: lw.Window, observed: np.ndarray, stays: bool) -> Array:
    """Return h, or the log-likelihood of what is observed, at PER points in a spacing of a grid, for interval k; NaN for none.

    For steps that stay on the grid they are at its points only; of an h with kinks in the weak sense, with their change.
    """
    seen, x = prepared.schedule.seen[k], grid.points if stays else _points(grid)
    if prepared.weak:
        return _weak_rows(prepared, k, grid, observed)
    if not prepared.system.general:
        result = prepared.system.observation(x[:, None], float(prepared.schedule.stops[k]), prepared.theta).T
    elif seen.any():
        likelihood = factor_at_end(prepared, k, seen, observed, None)
        assert isinstance(likelihood, General)
        result = likelihood.log_density(x)[None]
    else:
        result = np.zeros((1, len(x)))
    return np.array(result, float, order="C")


def _weak_rows(prepared: Prepared, k: int, grid: lw.Window, observed: np.ndarray) -> Array:
    fine = prepared.once(Derived.FINE, grid, lambda: sensor_at_nodes(prepared, grid.points, grid.spacing))
    middle = grid.points[grid.size // 2, None][None]
    centre = np.ascontiguousarray(prepared.system.observation(middle, prepared.model.start, prepared.theta)[0])
    result, precision = np.full((2, grid.size), [[-1e150], [1.0]]), np.ascontiguousarray(prepared.steps.precisions[k, 0])
    weaken(fine, 0, precision, observed, centre, result[0], result[1])
    result[0] -= 0.5 * (observed - centre) @ precision @ (observed - centre)
    return result if prepared.schedule.seen[k].any() else np.zeros_like(result)


def _points(grid: lw.Window) -> Array:
    """Return the points at which rows are known."""
    first = grid.origin + grid.centre - grid.spacing * (grid.size // 2)
    return first + grid.spacing / PER * np.arange(PER * (grid.size - 1) + 1.0)


SHARP = 2.0  # how much finer a grid is at least


def coarsened(prepared: Prepared, values: Array, window: lw.Window, length: float) -> tuple[Array, lw.Window, float] | None:
    """Return the density after an interval without observations inside, its grid and its error; None where no coarse grid serves.

    Args:
        prepared: a system without coefficients in time.
        values: probabilities (N,) of the points of `window`.
        window: the fine grid on the line.
        length: tau.
    """
    check = grid_check(prepared, values, window) if prepared.kinked else lw.grid_check(values, window.closed, prepared.negligible)
    inner = slice(check.first, check.last + 1)
    points, retained = window.points[inner], values[inner]
    covariance = covariance_at(prepared.system, points, prepared.model.start, prepared.theta)
    deviation = float(np.sqrt(max(np.min(covariance.real), 0.0) * _remembered(prepared, points, length)))
    if window.closed or SPACING * deviation < SHARP * window.spacing:
        return None
    spacing = window.unit * 2.0 ** np.floor(np.log2(SPACING * deviation / window.unit) + 1e-9)
    wide = float(np.sqrt(np.max(covariance.real) * length))
    low, high = window.offsets[check.first] - REACH * wide, window.offsets[check.last] + REACH * wide
    for _ in range(TRIALS):
        centre, spacing, size = coarse_grid(low, high, spacing, REACH * wide)
        if not size <= lw.LARGEST or spacing < SHARP * window.spacing:
            return None
        coarse = window._replace(centre=float(centre), spacing=float(spacing), size=int(size))
        decomposed = spectral(prepared, coarse)
        if decomposed is None:
            return None
        with np.errstate(all="ignore"):
            scale = np.exp(_gauge(prepared, coarse, points) - decomposed.top)
            if np.ndim(covariance):
                scale = scale / np.sqrt(covariance)
            result, error = decomposed.carried(gathered(retained / scale, window.offsets[inner], coarse), length)
        trusted = (coarse.offsets >= low) & (coarse.offsets <= high)
        ends = np.flatnonzero(trusted)[[0, 1, -2, -1]]
        result = np.where(trusted, result, 0.0)
        after = lw.grid_check(result, False, prepared.negligible)
        bound = edge_bound(after.aliasing)
        left, right = np.max(np.abs(result[ends]).reshape(2, 2), axis=1) > bound * np.max(result.real)
        if left or right:
            third = (high - low) / 3.0
            low, high = low - third * left, high + third * right
        elif after.aliasing > spectrum_bound(prepared.negligible, prepared.tolerance):
            spacing *= 0.5
        elif error > rounding_bound(prepared.tolerance):
            return None
        else:
            return result, coarse, error
    return None


def _remembered(prepared: Prepared, points: Array, length: float) -> float:
    """Return the time for which noise at the end of an interval has not been contracted by the drift at points (J,)."""
    slope = prepared.system.slope
    if slope is None:
        return length
    rate = -2.0 * float(np.min(slope(points[:, None], prepared.model.start, prepared.theta).real))
    return float(-np.expm1(-rate * length) / rate) if rate > 0.0 else length


def _gauge(prepared: Prepared, coarse: lw.Window, points: Array) -> Array:
    """Return int f / G from the first point of the coarse grid to points in it (J,)."""
    ends = np.sort(np.concatenate([coarse.points, points]))
    total = gauge_at(prepared, ends)
    return np.asarray(total[np.searchsorted(ends, points)] - total[np.searchsorted(ends, coarse.points[0])])
