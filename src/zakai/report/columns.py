"""Densities of one state as columns of a picture: averages over cells of a window that holds the mass.

A cell holds an average, so a density that is narrower than a cell keeps its mass.  Each column has its own window, so a density
is resolved whatever the others are.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from zakai.densities import Density
from zakai.densities._values import wrap
from zakai.densities.conditional import ConditionalParticleDensity
from zakai.densities.gaussian import GaussianMixture
from zakai.densities.grid import GridDensity
from zakai.densities.points import PointMasses
from zakai.numerics.cells import grid_cells, mixture_cells

ROWS = 256  # more than 20 cells for a standard deviation of a Gaussian
_TAIL = 1e-6  # probability of a component, or beyond either end, that is not drawn
_REACH = 5.5  # standard deviations of a Gaussian in its window
_SHOWN = 1e-5  # of the largest cell: a window is narrowed to the cells above
_FINEST = 64  # points of a cell
_BIN = 1 / 8  # standard deviations of kernels that are drawn together
_POINT = 1e-9  # half a window of a state that is known exactly, relative to its size

_Column = tuple[float, float, np.ndarray]  # the ends of the window, and the values in its cells, up to a factor


@dataclass(frozen=True)
class Columns:
    """Densities p_c, c = 0, ..., C - 1, by their averages `density` (C, R) in R cells of equal size from `low` to `high` (C,).

    A window of an angle may go beyond pi.  NaN where a density is not finite.
    """

    low: np.ndarray
    high: np.ndarray
    density: np.ndarray

    @property
    def cell(self) -> np.ndarray:
        """The sizes of the cells (C,)."""
        return (self.high - self.low) / self.density.shape[1]

    @property
    def edges(self) -> np.ndarray:
        """The ends of the cells (C, R + 1)."""
        return self.low[:, None] + self.cell[:, None] * np.arange(self.density.shape[1] + 1)

    @property
    def middles(self) -> np.ndarray:
        """The middles of the cells (C, R)."""
        return self.low[:, None] + self.cell[:, None] * (np.arange(self.density.shape[1]) + 0.5)

    @property
    def cumulative(self) -> np.ndarray:
        """The distribution functions at the ends of the cells (C, R + 1)."""
        total = np.zeros((len(self.low), self.density.shape[1] + 1))
        np.cumsum(self.density, axis=1, out=total[:, 1:])
        return total / total[:, -1:]

    def quantile(self, q: Sequence[float]) -> np.ndarray:
        """Return the values below which the probabilities q lie (len(q), C)."""
        total, every = self.cumulative, np.arange(len(self.low))
        found = np.empty((len(q), len(self.low)))
        for row, wanted in enumerate(q):
            at = np.argmax(total[:, 1:] >= wanted, axis=1)  # the cell in which the distribution function reaches it
            before, after = total[every, at], total[every, at + 1]
            with np.errstate(invalid="ignore"):
                found[row] = self.low + self.cell * (at + (wanted - before) / (after - before))
        return found


def columns_at(result: Any, index: Iterable[int], state: int, rows: int = ROWS) -> Columns:
    """Return the columns of one state at some times of a result."""
    means, variances = np.asarray(result.mean), np.asarray(result.variance)
    found = []
    for k in index:
        if variances[k, state] > 0:
            found.append(_column(result.density(int(k)).marginal(state), rows))
        else:  # a state that is known exactly, or a run that was lost, has no density to ask for
            found.append(_point(float(means[k, state]) if variances[k, state] == 0 else np.nan, rows))
    low, high = (np.array([column[i] for column in found]) for i in (0, 1))
    density = np.stack([column[2] for column in found])
    with np.errstate(invalid="ignore", divide="ignore"):
        density /= density.sum(axis=1, keepdims=True) * ((high - low) / rows)[:, None]
    density[~np.isfinite(density).all(axis=1)] = np.nan
    return Columns(low, high, density)


def _column(density: Density, rows: int) -> _Column:
    low, high, values = _window(density, rows)
    turn = 2 * np.pi * np.rint((low + high) / (4 * np.pi)) if density.periodic[0] and np.isfinite(low) else 0.0
    return low - turn, high - turn, values


def _window(density: Density, rows: int) -> _Column:
    if isinstance(density, PointMasses):
        if not np.ptp(density.points) > 0:
            return _point(float(density.points[0, 0]), rows)
        density = density.smoothed
    if isinstance(density, ConditionalParticleDensity):
        density = density.smoothed
    if isinstance(density, GridDensity):
        return _of_grid(density, rows)
    if isinstance(density, GaussianMixture):
        return _of_mixture(density, rows)
    return _of_any(density, rows)


def _point(value: float, rows: int) -> _Column:
    half = _POINT * max(1.0, abs(value)) if np.isfinite(value) else np.nan
    return value - half, value + half, np.full(rows, half)


def _of_grid(density: GridDensity, rows: int) -> _Column:
    logs, spacing, closed = density.log_values, float(density.basis[0, 0]), density._closed[0]
    if not np.max(logs) > -np.inf:
        return _point(np.nan, rows)
    low, high, values = grid_cells(logs, closed, rows)
    place = float(density.centre[0]) - spacing * (len(logs) // 2)
    ends = place + spacing * low, place + spacing * high
    return (*ends, values) if spacing > 0 else (ends[1], ends[0], values[::-1])


def _of_mixture(density: GaussianMixture, rows: int) -> _Column:
    weights, means, deviations = density.weights, density.means[:, 0], np.sqrt(density.covs[:, 0, 0])
    angle, half = density.periodic[0], _REACH * float(deviations[0])
    if len(weights) == 1 and (not angle or half <= np.pi):
        if not half > 0:
            return _point(float(means[0]), rows)
        z = _REACH * ((2 * np.arange(rows) + 1.0) / rows - 1.0)
        return float(means[0]) - half, float(means[0]) + half, np.exp(-0.5 * z**2)
    centre = float(density.mean()[0])
    if not (np.isfinite(centre) and np.isfinite(deviations).all()):
        return _point(np.nan, rows)
    seen = np.abs(weights) > _TAIL * np.abs(weights).max()
    weights, means, deviations = weights[seen], means[seen], deviations[seen]
    deviations = np.maximum(deviations, _POINT * max(1.0, abs(centre)))
    if angle:
        turns = math.ceil((np.pi + _REACH * deviations.max()) / (2 * np.pi))
        shifts = 2 * np.pi * np.arange(-turns, turns + 1)
        means = (centre + wrap(means - centre) + shifts[:, None]).ravel()
        weights, deviations = np.tile(weights, len(shifts)), np.tile(deviations, len(shifts))
    low, high = float((means - _REACH * deviations).min()), float((means + _REACH * deviations).max())
    if angle:
        low, high = max(low, centre - np.pi), min(high, centre + np.pi)
    values = _mixture_between(weights, means, deviations, low, high, rows)
    shown = np.flatnonzero(values > _SHOWN * values.max())
    if len(shown) and 2 * (shown[-1] - shown[0] + 1) < rows:
        cell = (high - low) / rows
        low, high = low + cell * float(shown[0]), low + cell * float(shown[-1] + 1)
        values = _mixture_between(weights, means, deviations, low, high, rows)
    return low, high, values


def _mixture_between(
    weights: np.ndarray, means: np.ndarray, deviations: np.ndarray, low: float, high: float, rows: int
) -> np.ndarray:
    if len(means) > 2 * rows and (deviations == deviations[0]).all():
        # Kernels of one width: their means are moved to the middles of bins, which adds (1 / 8)^2 / 12 to the variance 1.
        width = _BIN * float(deviations[0])
        bins = np.floor((means - low) / width).astype(int)
        weights = np.bincount(bins - bins.min(), weights)
        means = low + width * (bins.min() + np.arange(len(weights)) + 0.5)
        deviations = np.full(len(weights), deviations[0])
    values, cell = np.empty(rows), (high - low) / rows
    within = min(_FINEST, max(1, math.ceil(2.0 * cell / float(deviations.min()))))
    parts = (np.ascontiguousarray(part, dtype=float) for part in (weights, means, deviations))
    mixture_cells(*parts, low, cell, within, values)
    return np.maximum(values, 0.0)


def _of_any(density: Density, rows: int) -> _Column:
    points, weights = getattr(density, "points", None), getattr(density, "weights", None)
    if points is not None and weights is not None:
        order = np.argsort(points[:, 0])
        places, total = points[order, 0], np.cumsum(weights[order])
        first, last = np.searchsorted(total, [_TAIL * total[-1], (1 - _TAIL) * total[-1]])
        low, high = float(places[max(first - 1, 0)]), float(places[min(last + 1, len(places) - 1)])
    else:
        low, high = (float(end) for end in density.quantile([_TAIL, 1 - _TAIL])[:, 0])
    if not high > low:
        return _point(low, rows)
    middles = low + (high - low) * (np.arange(rows) + 0.5) / rows
    at = wrap(middles) if density.periodic[0] else middles
    logs = np.asarray(density.log_density(at[:, None]), dtype=float).reshape(-1)
    logs = np.where(np.isfinite(logs), logs, -np.inf)
    return low, high, np.exp(logs - max(float(logs.max()), -1e300))
