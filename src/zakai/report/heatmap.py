"""The posterior density over time as an array: what both the HTML report and the static pictures draw.

Each density is evaluated on its own window around its mean, fine enough for the mass that is there, and then
binned: a cell of the common grid holds the *average* density over the cell. So a density that is narrower
than a cell keeps its mass, where sampling it at the cell's centre would miss it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from zakai.densities._values import wrap
from zakai.errors import InputError

BAND = 0.95
_NORMAL_QUANTILE = 1.959963984540054
_WINDOW = 5.5  # standard deviations on each side of the mean
_POINTS = 281  # evaluations of one density: 25 to a standard deviation
_ROWS = 280


@dataclass(frozen=True)
class Profile:
    """One marginal density on its own window: p(centre + deviation), normalised on the window."""

    centre: float
    deviation: np.ndarray  # (points,)
    density: np.ndarray  # (points,)

    @property
    def cumulative(self) -> np.ndarray:
        """The distribution function at the points of the window."""
        steps = 0.5 * (self.density[1:] + self.density[:-1]) * np.diff(self.deviation)
        total = np.concatenate([[0.0], np.cumsum(steps)])
        return total / total[-1]

    def quantile(self, q: float) -> float:
        """The deviation from the centre below which the mass q lies."""
        return float(np.interp(q, self.cumulative, self.deviation))


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
    profiles: tuple[Profile, ...]  # the marginal densities that were binned; none if they were not kept

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

    @property
    def coverage(self) -> float | None:
        """The share of the times with a known truth at which the band holds it; None without any."""
        if self.truth is None or not np.isfinite(self.truth).any():
            return None
        from_lower, width = self.truth - self.lower, self.upper - self.lower
        if self.periodic:
            from_lower, width = np.mod(from_lower, 2 * np.pi), 2 * np.pi - np.mod(-width, 2 * np.pi)
        known = np.isfinite(self.truth)
        return float(np.mean((0 <= from_lower[known]) & (from_lower[known] <= width[known])))


def density_over_time(
    result: Any,
    state: int = 0,
    truth: np.ndarray | None = None,
    start: int = 0,
    stop: int | None = None,
    columns: int = 600,
    extra: tuple[int, ...] = (),
) -> DensityOverTime:
    """Evaluate the marginal posterior of one state over the times `start <= k < stop`.

    At most about `columns` times are taken, evenly spaced over the record, and the times `extra` with them.
    `truth` has shape (K+1, n), nan where it is not known.
    """
    index = chosen_times(len(result.times), start, stop, columns, extra)
    periodic = is_periodic(result, state)
    mean = np.asarray(result.mean, dtype=float)[index, state]
    truth_here = None if truth is None else np.array(truth[index, state], dtype=float)
    kept = bool(result.has_densities)
    profiles: tuple[Profile, ...] = ()
    if kept:
        profiles = tuple(profile(result, int(k), state) for k in index)
        low = np.array([p.quantile((1 - BAND) / 2) for p in profiles])
        high = np.array([p.quantile((1 + BAND) / 2) for p in profiles])
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
    for column in range(len(index)):
        turns = (-2 * np.pi, 0.0, 2 * np.pi) if periodic else (0.0,)
        for turn in turns:
            deviation = edges + turn - centre[column]
            if kept:
                here = profiles[column]
                mass = np.diff(np.interp(deviation, here.deviation, here.cumulative))
                density[:, column] += mass / np.diff(edges)
            else:
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
        profiles,
    )


def profile(result: Any, k: int, state: int) -> Profile:
    """The marginal density of one state at time k on a window that holds its mass, the circle at most."""
    mean = float(np.asarray(result.mean)[k, state])
    spread = float(np.sqrt(np.asarray(result.variance)[k, state]))
    certain = not spread > 0  # a state that is known exactly, or a run that was lost, has no density to ask for
    if certain:
        spread = 1e-9 * max(1.0, abs(mean))
    periodic = is_periodic(result, state)
    width = min(_WINDOW * spread, np.pi) if periodic else _WINDOW * spread
    deviation = np.linspace(-width, width, _POINTS)
    if certain:
        logarithm = -0.5 * (deviation / spread) ** 2
    else:
        points = wrap(mean + deviation) if periodic else mean + deviation
        marginal = result.density(k).marginal(state)
        logarithm = np.asarray(marginal.log_density(points[:, None]), dtype=float).reshape(-1)
    logarithm = np.where(np.isfinite(logarithm), logarithm, -np.inf)
    shape = np.exp(logarithm - max(float(np.max(logarithm)), -1e300))
    mass = np.trapezoid(shape, deviation)
    return Profile(mean, deviation, shape / mass if mass > 0 else np.full_like(shape, np.nan))


def chosen_times(
    count: int, start: int = 0, stop: int | None = None, columns: int = 600, extra: tuple[int, ...] = ()
) -> np.ndarray:
    """Return the positions of at most `columns` evenly spaced times in [start, stop), and of the `extra` times in it."""
    inside = np.arange(count)[start:stop]
    if inside.size == 0:
        raise InputError(f"start={start}, stop={stop}: no time of the result lies there (it has {count})")
    if inside.size > columns:
        inside = inside[np.unique(np.round(np.linspace(0, inside.size - 1, columns)).astype(int))]
    return np.union1d(inside, [k for k in extra if inside[0] <= k <= inside[-1]]).astype(int)


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
