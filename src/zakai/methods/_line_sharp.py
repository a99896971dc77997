"""Steps of densities that are much narrower than the noise of an interval (`numerics/line_sharp.py`), for `_line_loop`."""

from __future__ import annotations

from threading import Lock
from typing import Any, NamedTuple

import numpy as np

from zakai.methods._line_system import Prepared, State
from zakai.methods._line_tables import covariance_at, profile_of, spectral
from zakai.methods._line_update import factor_at_end
from zakai.numerics import line_outlook as outlook
from zakai.numerics import line_sharp as ls
from zakai.numerics import line_window as lw
from zakai.numerics.line_density import waves
from zakai.numerics.line_panels import GAUSS_NODES, GAUSS_WEIGHTS
from zakai.numerics.line_place import PER
from zakai.numerics.line_posterior import General
from zakai.numerics.line_segment import COLUMNS, FACTOR

Array = Any

NEW = 12  # coarse grids and rows that are made for one step
SIZES = (80, 160, 384, 1024)  # points of fine grids
NUMBERS = 2**21  # of the coarse grids that are known together


class Sharp(NamedTuple):
    """Steps of which each has a grid of its own: densities (K, n), centres and spacings (K,), and reports (K, .).

    The transitions were those of `coarse` grids, with centres, spacings and sizes (K, 3).
    """

    densities: Array
    centres: Array
    spacings: Array
    reports: Array
    coarse: Array


class Coarse:
    """Coarse grids as the loop reads them.

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


def is_sharp(prepared: Prepared, k: int, state: State) -> bool:
    """Return whether interval k makes a density so wide that its grid does not serve."""
    if prepared.kinds[k] != FACTOR or prepared.gaussian or state.closed:
        return False
    values, profile = np.ascontiguousarray(state.values), profile_of(prepared, state.window)
    interval = state.unit, float(prepared.lengths[k]), profile
    return bool(outlook.is_sharp(values, float(state.centre), float(state.spacing), *interval))


def advanced(prepared: Prepared, k: int, stop: int, state: State, observed: np.ndarray, own: bool) -> Sharp | None:
    """Return the first steps of some intervals; None where the first one fails.

    Args:
        prepared: a system with samples whose operator has a decomposition.
        k, stop: the intervals.
        state: the state before them.
        observed: what is observed (K, m).
        own: whether the first step is taken on the grid of the state.
    """
    system, window, steps = prepared.system, state.window, prepared.steps
    special = system.general or not system.steady_observation
    values, limits = np.ascontiguousarray(state.values), (prepared.negligible, prepared.promised)
    key, profile = ("coarse grids", window.origin, window.unit), profile_of(prepared, window)
    coarse, rows, at = prepared.once(key, Coarse), np.empty((0, 0)), 0
    owner, count = (-1, 1) if special else (-2, stop - k)
    for _ in range(NEW):
        n = SIZES[at]
        densities, places, out = np.empty((count, n)), np.empty((count + 1, 3)), np.zeros((count, len(COLUMNS)))
        done, why = ls.sharpened(
            values, float(state.centre), float(state.spacing), window.unit, profile, coarse.numbers, coarse.index, rows, owner,
            system.general, own, k, observed[:count], steps.lengths, steps.precisions[:, 0], steps.constants,
            float(state.error), *limits, *waves(n), densities, places, out,
        )  # fmt: skip
        if done:
            taken = coarse.index[places[:done, 2].astype(int), :3]
            return Sharp(densities[:done], places[:done, 0], places[:done, 1], out[:done], taken)
        if why == ls.SIZE and at + 1 < len(SIZES):
            at, count = at + 1, 1
        elif why == ls.GRID:
            centre, spacing, size = places[-1].tolist()
            grid = window._replace(centre=centre, spacing=spacing, size=int(size))
            places_of = np.flatnonzero((coarse.index[:, :3] == places[-1]).all(axis=1))
            if len(places_of):  # what is missing is what is observed
                owner, rows = int(places_of[0]), _rows(prepared, k, grid, observed[0])
                if np.isnan(rows).any():
                    return None
                continue
            parts = _parts(prepared, grid)
            if parts is None:
                return None
            if not coarse.add(grid, parts):  # the others are left to threads that read them
                prepared.kept.pop(key, None)
                coarse = prepared.once(key, Coarse)
                coarse.add(grid, parts)
        else:
            return None
    return None


def _parts(prepared: Prepared, grid: lw.Window) -> list[Array] | None:
    """Return what is known of a coarse grid, None where its operator has no decomposition or a formula no value."""
    decomposed = spectral(prepared, grid)
    if decomposed is None:
        return None
    system, start, theta, x = prepared.system, prepared.model.start, prepared.theta, _points(grid)
    nodes = (x[:-1, None] + grid.spacing / PER * GAUSS_NODES).reshape(-1)
    slopes = system.drift(nodes[:, None], start, theta)[:, 0] / covariance_at(system, nodes, start, theta)
    scale = np.append(0.0, np.cumsum(grid.spacing / PER * (slopes.reshape(len(x) - 1, -1) @ GAUSS_WEIGHTS)))
    if system.state_dependent:
        scale = scale - 0.5 * np.log(covariance_at(system, x, start, theta))
    rows = np.zeros((system.m, len(x)))
    if not system.general and system.steady_observation:
        rows = system.observation(x[:, None], start, theta).T
    angle = 2.0 * np.pi / grid.size * np.arange(grid.size)
    return [decomposed.rates, np.ascontiguousarray(decomposed.modes.T), np.cos(angle), np.sin(angle), scale, rows]


def _rows(prepared: Prepared, k: int, grid: lw.Window, observed: np.ndarray) -> Array:
    """Return h, or the log-likelihood of what is observed, at PER points in a spacing of a grid, for interval k; NaN for none."""
    seen, x = prepared.schedule.seen[k], _points(grid)
    if not prepared.system.general:
        found = prepared.system.observation(x[:, None], float(prepared.schedule.stops[k]), prepared.theta).T
    elif seen.any():
        likelihood = factor_at_end(prepared, k, seen, observed, None)
        assert isinstance(likelihood, General)
        found = likelihood.log_density(x)[None]
    else:
        found = np.zeros((1, len(x)))
    return np.array(found, float, order="C")


def _points(grid: lw.Window) -> Array:
    """Return the points at which rows are known."""
    first = grid.origin + grid.centre - grid.spacing * (grid.size // 2)
    return first + grid.spacing / PER * np.arange(PER * (grid.size - 1) + 1.0)
