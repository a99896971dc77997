"""A density of one state as a column of a picture: its averages over cells of a window that holds its mass.

A cell holds an average, so a density that is narrower than a cell keeps its mass.  Each column has its own window, so a density is
resolved whatever the others are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from zakai.densities import Density
from zakai.densities._density import wrap
from zakai.densities.gaussian import GaussianMixture
from zakai.densities.grid import GridDensity
from zakai.densities.points import PointMasses
from zakai.numerics.cells import grid_cells, mixture_cells

ROWS = 256  # 25 or more cells for a standard deviation of a Gaussian
_TAIL = 1e-6  # probability of a component, or beyond either end, that is not drawn
_REACH = 5.5  # standard deviations of a Gaussian in its window
_SHOWN = 1e-5  # of the largest cell: a window is narrowed to the cells above
_FINEST = 64  # points of a cell
_POINT = 1e-9  # half a window of a state that is known exactly, relative to its size


@dataclass(frozen=True)
class Column:
    """The average density in each of R cells of equal size from `low` to `high`; of an angle both may be beyond pi."""

    low: float
    high: float
    density: np.ndarray  # (R,), NaN where the density is not finite

    @property
    def cell(self) -> float:
        """The size of a cell."""
        return (self.high - self.low) / len(self.density)

    @property
    def edges(self) -> np.ndarray:
        """The ends of the cells (R + 1,)."""
        return np.linspace(self.low, self.high, len(self.density) + 1)

    @property
    def middles(self) -> np.ndarray:
        """The middles of the cells (R,)."""
        return self.low + self.cell * (np.arange(len(self.density)) + 0.5)

    @property
    def cumulative(self) -> np.ndarray:
        """The distribution function at the ends of the cells (R + 1,)."""
        total = np.concatenate([[0.0], np.cumsum(self.density)])
        return total / total[-1]

    def quantile(self, q: Any) -> np.ndarray:
        """Return the values below which the probabilities q lie."""
        total = self.cumulative
        if not np.isfinite(total[-1]):
            return np.full(np.shape(q), np.nan)
        rising = np.concatenate([[True], np.diff(total) > 0])
        return np.interp(q, total[rising], self.edges[rising])


def column_of(density: Density, rows: int = ROWS) -> Column:
    """Return the column of a density of one state."""
    if isinstance(density, PointMasses):
        if not np.ptp(density.points) > 0:
            return point(float(density.points[0, 0]), rows)
        density = density.smoothed
    if isinstance(density, GridDensity):
        return _of_grid(density, rows)
    if isinstance(density, GaussianMixture):
        return _of_mixture(density, rows)
    return _of_any(density, rows)


def point(value: float, rows: int = ROWS) -> Column:
    """Return the column of a state that is known exactly, or, for NaN, of one that was lost."""
    half = _POINT * max(1.0, abs(value)) if np.isfinite(value) else np.nan
    return Column(value - half, value + half, np.full(rows, 0.5 / half))


def _of_grid(density: GridDensity, rows: int) -> Column:
    logs, spacing, closed = density.log_values, float(density.basis[0, 0]), density._closed[0]
    low, high, values = grid_cells(logs, closed, rows)
    place = float(density.centre[0]) - spacing * (len(logs) // 2)
    ends = place + spacing * low, place + spacing * high
    return _normalised(*ends, values) if spacing > 0 else _normalised(*ends[::-1], values[::-1])


def _of_mixture(density: GaussianMixture, rows: int) -> Column:
    seen = np.abs(density.weights) > _TAIL * np.abs(density.weights).max()
    weights, means, deviations = density.weights[seen], density.means[seen, 0], np.sqrt(density.covs[seen, 0, 0])
    centre = float(density.mean()[0])
    if not (np.isfinite(centre) and np.isfinite(deviations).all()):
        return point(np.nan, rows)
    if not deviations.max() > 0:
        return point(centre, rows)
    deviations = np.maximum(deviations, 1e-9 * deviations.max())
    if density.periodic[0]:
        means = centre + wrap(means - centre)
        turns = math.ceil((np.pi + _REACH * deviations.max()) / (2 * np.pi))
        shifts = 2 * np.pi * np.arange(-turns, turns + 1)
        means, weights, deviations = (np.concatenate([part + shift for shift in shifts]) if part is means
                                      else np.tile(part, len(shifts)) for part in (means, weights, deviations))  # fmt: skip
    low, high = float((means - _REACH * deviations).min()), float((means + _REACH * deviations).max())
    if density.periodic[0]:
        low, high = max(low, centre - np.pi), min(high, centre + np.pi)
    column = _mixture_between(weights, means, deviations, low, high, rows)
    shown = np.flatnonzero(column.density > _SHOWN * column.density.max(initial=0.0))
    if 0 < 2 * len(shown) and 2 * (shown[-1] - shown[0] + 1) < rows:
        edges = column.edges
        column = _mixture_between(weights, means, deviations, float(edges[shown[0]]), float(edges[shown[-1] + 1]), rows)
    return column


def _mixture_between(
    weights: np.ndarray, means: np.ndarray, deviations: np.ndarray, low: float, high: float, rows: int
) -> Column:
    values, cell = np.empty(rows), (high - low) / rows
    within = min(_FINEST, max(1, math.ceil(2.0 * cell / float(deviations.min()))))
    parts = (np.ascontiguousarray(part, dtype=float) for part in (weights, means, deviations))
    mixture_cells(*parts, low, cell, within, values)
    return _normalised(low, high, np.maximum(values, 0.0))


def _of_any(density: Density, rows: int) -> Column:
    points, weights = getattr(density, "points", None), getattr(density, "weights", None)
    if points is not None and weights is not None:
        order = np.argsort(points[:, 0])
        places, total = points[order, 0], np.cumsum(weights[order])
        first, last = np.searchsorted(total, [_TAIL * total[-1], (1 - _TAIL) * total[-1]])
        low, high = float(places[max(first - 1, 0)]), float(places[min(last + 1, len(places) - 1)])
    else:
        low, high = (float(end) for end in density.quantile([_TAIL, 1 - _TAIL])[:, 0])
    if not high > low:
        return point(low, rows)
    cell = (high - low) / rows
    middles = low + cell * (np.arange(rows) + 0.5)
    at = wrap(middles) if density.periodic[0] else middles
    logs = np.asarray(density.log_density(at[:, None]), dtype=float).reshape(-1)
    logs = np.where(np.isfinite(logs), logs, -np.inf)
    return _normalised(low, high, np.exp(logs - max(float(logs.max()), -1e300)))


def _normalised(low: float, high: float, values: np.ndarray) -> Column:
    total = float(values.sum()) * (high - low) / len(values)
    return Column(low, high, values / total if total > 0 and np.isfinite(total) else np.full(len(values), np.nan))
