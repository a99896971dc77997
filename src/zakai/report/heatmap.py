"""The posterior density over time on one grid: what Matplotlib draws.

A cell of the grid that all times have in common holds the average density over the cell, from the columns of `columns.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from zakai.densities._values import wrap
from zakai.errors import InputError
from zakai.report.columns import columns_at

BAND = 0.95
_NORMAL_QUANTILE = 1.959963984540054
_ROWS = 280


@dataclass(frozen=True)
class DensityOverTime:
    """A marginal posterior on a grid common to all times.

    `density[r, c]` is the average density over cell r at time c (nan where it is not finite), and `lower`,
    `upper` bound the 95% equal-tailed band. For a periodic state all of them lie in (-pi, pi] and `lower >
    upper` where the band wraps. Where no densities were kept, `density` is 1 inside the band of a Gaussian
    with the filter's moments and 0 outside.
    """

    name: str
    index: np.ndarray  # (columns,) positions in the result's times
    times: np.ndarray  # (columns,)
    edges: np.ndarray  # (rows + 1,)
    density: np.ndarray  # (rows, columns)
    mean: np.ndarray  # (columns,)
    lower: np.ndarray  # (columns,)
    upper: np.ndarray  # (columns,)
    truth: np.ndarray | None  # (columns,)
    periodic: bool
    kept: bool

    @property
    def joined(self) -> bool:
        """Whether lines may join the columns: where times between them are left out, an angle may have gone either way round."""
        return not self.periodic or len(self.index) < 3 or float(np.median(np.diff(self.index))) <= 1

    @property
    def grid(self) -> np.ndarray:
        """The centres of the cells."""
        return 0.5 * (self.edges[1:] + self.edges[:-1])

    @property
    def relative(self) -> np.ndarray:
        """Return the density divided by its highest value at the same time, in [0, 1]: the shape at any spread."""
        if not self.kept:
            return 0.35 * self.density
        peak = np.max(self.density, axis=0, initial=0.0)
        return np.nan_to_num(self.density / np.where(peak > 0, peak, 1.0))


def density_over_time(
    result: Any,
    state: int = 0,
    truth: np.ndarray | None = None,
    start: int = 0,
    stop: int | None = None,
    columns: int = 600,
) -> DensityOverTime:
    """Evaluate the marginal posterior of one state over the times `start <= k < stop`.

    At most `columns` times are taken, evenly spaced over the record.  `truth` has shape (K+1, n), nan where it is not known.
    """
    index = chosen_times(len(result.times), start, stop, columns)
    periodic = is_periodic(result, state)
    mean = np.asarray(result.mean, dtype=float)[index, state]
    truth_here = None if truth is None else np.array(truth[index, state], dtype=float)
    kept = bool(result.has_densities)
    drawn = columns_at(result, index, state) if kept else None
    if drawn is not None:
        low, high = drawn.quantile([(1 - BAND) / 2, (1 + BAND) / 2]) - mean
    else:
        high = _NORMAL_QUANTILE * np.sqrt(np.asarray(result.variance, dtype=float)[index, state])
        high = np.minimum(high, np.pi) if periodic else high
        low = -high

    centre = mean
    if periodic:
        edges = np.linspace(-np.pi, np.pi, _ROWS + 1)
    else:
        edges = _edges(centre, centre + low, centre + high, truth_here, index)

    density = np.zeros((_ROWS, len(index)))
    own = None if drawn is None else (drawn.edges, drawn.cumulative)
    for column in range(len(index)):
        for turn in (-2 * np.pi, 0.0, 2 * np.pi) if periodic else (0.0,):
            if own is not None:
                mass = np.diff(np.interp(edges + turn, own[0][column], own[1][column]))
                density[:, column] += mass / np.diff(edges)
            else:
                deviation = edges + turn - centre[column]
                middle = 0.5 * (deviation[1:] + deviation[:-1])
                density[:, column] += (low[column] <= middle) & (middle <= high[column])

    lower, upper = centre + low, centre + high
    if periodic:
        lower, upper = wrap(lower), wrap(upper)
        truth_here = None if truth_here is None else wrap(truth_here)
    times = np.asarray(result.times, dtype=float)[index]
    return DensityOverTime(
        state_names(result)[state],
        index,
        times,
        edges,
        density,
        centre,
        lower,
        upper,
        truth_here,
        periodic,
        kept,
    )


def chosen_times(count: int, start: int = 0, stop: int | None = None, columns: int = 600) -> np.ndarray:
    """Return the positions of at most `columns` evenly spaced times in [start, stop)."""
    inside = np.arange(count)[start:stop]
    if inside.size == 0:
        raise InputError(f"start={start}, stop={stop}: no time of the result lies there (it has {count})")
    if inside.size > columns:
        inside = inside[np.unique(np.round(np.linspace(0, inside.size - 1, columns)).astype(int))]
    return inside


def is_periodic(result: Any, state: int) -> bool:
    """Whether this coordinate is an angle on the circle."""
    return result.model is not None and result.model.state[state] in result.model.periodic


def state_names(result: Any) -> tuple[str, ...]:
    """The names of the coordinates; a result that was read back without its model still has them."""
    return tuple(result.state if result.model is None else result.model.state)


def direct_observations(result: Any, state: int, first: float, last: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the times and values of samples of a state itself, h_j = x_i, from one time to another; None without any."""
    model, record = result.model, result.record
    if model is None or record is None or model.observation_kind != "samples" or getattr(model, "log_density", None) is not None:
        return None
    columns = [j for j, formula in enumerate(model.observation) if formula == model.x[state]]
    if not columns:
        return None
    rows = (record.times >= first) & (record.times <= last)
    values = record.values[rows][:, columns]
    times = np.broadcast_to(record.times[rows][:, None], values.shape)
    seen = np.isfinite(values)
    shown = wrap(values) if is_periodic(result, state) else values
    return (times[seen], shown[seen]) if seen.any() else None


def circle_line(times: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a line on the circle, cut where it passes +-pi: it leaves at one edge and comes back at the other.

    Between two points the shorter way round is taken. Returns (times, angles) with a nan at each cut.
    """
    step = np.diff(angle)
    crossing = np.flatnonzero(np.abs(step) > np.pi)
    edge = -np.sign(step[crossing]) * np.pi  # where the line leaves
    distance = 2 * np.pi - np.abs(step[crossing])
    part = np.abs(edge - angle[crossing]) / np.where(distance > 0, distance, 1.0)
    moment = times[crossing] + part * (times[crossing + 1] - times[crossing])
    where = np.repeat(crossing + 1, 3)
    cuts = np.column_stack([edge, np.full_like(edge, np.nan), -edge]).ravel()
    return np.insert(times, where, np.repeat(moment, 3)), np.insert(angle, where, cuts)


def true_states(truth: Any, result: Any) -> np.ndarray | None:
    """The true states at the result's times, (K+1, n), nan where unknown.

    `truth` is an array (K+1, n), one of shape (K, n) that begins at the first observation, or an object with
    `times` and `values` of which the times that the result also has are taken. Raises `InputError` for any
    other shape.
    """
    if truth is None:
        return None
    times = np.asarray(result.times, dtype=float)
    shape = np.asarray(result.mean).shape
    if hasattr(truth, "times") and hasattr(truth, "values"):
        given_times = np.asarray(truth.times, dtype=float)
        values = np.asarray(truth.values, dtype=float).reshape(given_times.size, -1)
        if values.shape[1] != shape[1]:
            raise InputError(f"truth has {values.shape[1]} columns, the model has {shape[1]} states")
        found = np.clip(np.searchsorted(given_times, times), 0, given_times.size - 1)
        before = np.maximum(found - 1, 0)
        nearer = np.abs(given_times[before] - times) < np.abs(given_times[found] - times)
        found = np.where(nearer, before, found)
        same = np.isclose(given_times[found], times, rtol=1e-9, atol=1e-12)
        return np.where(same[:, None], values[found], np.nan)
    values = np.asarray(truth, dtype=float)
    if values.ndim == 1 and shape[1] == 1:
        values = values[:, None]
    if values.shape == (shape[0] - 1, shape[1]):
        values = np.vstack([np.full((1, shape[1]), np.nan), values])
    if values.shape != shape:
        raise InputError(f"truth has shape {values.shape}; expected {shape}: a row for the start and one an observation")
    return values


def _edges(mean: np.ndarray, lower: np.ndarray, upper: np.ndarray, truth: np.ndarray | None, index: np.ndarray) -> np.ndarray:
    """Return the range of the common grid: it follows mean, band and truth, but not a wide prior or a few wide moments."""
    data = index > 0 if (index > 0).sum() > 1 else np.ones(len(index), dtype=bool)
    inside = [mean[data]] + ([] if truth is None else [truth])
    values = np.concatenate([v[np.isfinite(v)] for v in inside])
    band = np.concatenate([lower[data], upper[data]])
    band = band[np.isfinite(band)]
    if band.size:
        values = np.concatenate([values, np.percentile(band, [0.5, 99.5] if band.size > 100 else [0, 100])])
    low, high = (values.min(), values.max()) if values.size else (-1.0, 1.0)
    margin = 0.06 * (high - low) or max(1e-6, 1e-3 * abs(low))
    return np.linspace(low - margin, high + margin, _ROWS + 1)
