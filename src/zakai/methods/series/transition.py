"""The transition of a density by kernels of the Kolmogorov series, on the grid that it needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from zakai.errors import InputError
from zakai.methods.series.heat import heat_series
from zakai.methods.system.observation import log_likelihood
from zakai.methods.system.residuals import Factor, Sensors
from zakai.models import features
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.numerics.series.composed_kernels import SHORTEST, Kernels
from zakai.numerics.series.dyadic_grid import SUPPORT, Field, Grid
from zakai.records.schedule import Schedule

Array = np.ndarray
MOST_POINTS = 16384  # of a grid
MOST_REFINED = 2048  # of a grid that is refined for the sake of the series
KEPT = 24  # grids whose kernels are kept
CELLS = 2.5  # grid spacings in the smallest standard deviation, on a new grid
FEW = 1.8  # the same, at least


class System:
    """The functions of a model at one theta, and the kernels of the last grids."""

    def __init__(self, model: Model, theta: Array, order: int, form: str):
        self.model, self.theta, self.order, self.form = model, theta, order, form
        self.sensors = Sensors.of(model)
        self.drift = numpy_function(model.drift, model)
        self.G = float(numpy_function(model.covariance, model, (1, 1))(np.zeros(1), model.start, theta)[0, 0].real)
        self.kernels = lru_cache(KEPT)(self._kernels_on)

    def _kernels_on(self, grid: Grid) -> Kernels:
        """Return the kernels on a grid, which depend on it alone."""
        with np.errstate(all="ignore"):
            heat = heat_series(self.model, grid.points, self.order, theta=self.theta, potential=False)
        return Kernels(lambda t: heat.banded(grid.spacing, t, self.form), self.G, grid, self.form == "log")


@dataclass(frozen=True, eq=False)
class Prepared:
    """The functions, the intervals and the options; no data."""

    system: System
    schedule: Schedule
    lengths: Array
    substeps: int | None
    lie: bool
    notes: tuple[str, ...] = ()


class Law(NamedTuple):
    """The likelihood of a sample with a law of its own: `log_density` (N,) at points (N, 1), NaN where it has no value."""

    log_density: Callable[[Array], Array]
    constant: float = 0.0


def factor_at_end(prepared: Prepared, k: int, values: Array) -> Factor | Law:
    """Return the likelihood of what is observed at the stop of interval k."""
    system, schedule = prepared.system, prepared.schedule
    model, seen, stop = system.model, schedule.seen[k], float(schedule.stops[k])
    u = None if schedule.inputs is None else schedule.inputs.at(stop, model.input_hold)
    if (features.OF_OBSERVATION | {features.INPUTS}) & model.features.keys():
        return Law(lambda points: log_likelihood(model, values, seen, points, stop, system.theta, u))
    return system.sensors.at_end(schedule, k, values, system.theta, seen, u)


def without_law(field: Field, law: Law) -> float:
    """Return the share of the mass of a density where a law has no value."""
    weights = np.exp((field.logs - np.max(field.logs.real)).real)
    lawless = np.isnan(law.log_density(field.grid.points[:, None]).real)
    return float(weights[lawless].sum() / weights.sum())


def _logs_of(system: System, factor: Factor | Law, points: Array) -> tuple[Array, Array]:
    """Return the logarithm of a factor at points (N,), and upper bounds of it (N - 1,) between them."""
    if isinstance(factor, Law):
        logs = factor.log_density(points[:, None])
        logs = np.where(np.isnan(logs), -np.inf, logs)
        return logs, np.maximum(logs.real[1:], logs.real[:-1])
    residuals = factor.residuals(system.sensors.observed, points[:, None], system.theta)
    e = residuals.real
    # A residual that changes its sign is zero between the points.
    least = np.where(e[:, 1:] * e[:, :-1] <= 0, 0.0, np.minimum(np.abs(e[:, 1:]), np.abs(e[:, :-1])))
    return -0.5 * np.sum(residuals * residuals, axis=0), -0.5 * np.sum(least * least, axis=0)


def times_factor(system: System, field: Field, factor: Factor | Law | None) -> Field:
    """Multiply by a factor, on a finer grid where the product needs it."""
    source = field  # interpolate the whole field only: a part of it ends abruptly
    while factor is not None and (isinstance(factor, Law) or factor.roots.size):
        grid, logs = field.grid, field.logs.real
        own, bounds = _logs_of(system, factor, grid.points)
        product = Field(grid, field.logs + own)
        upper = np.maximum(logs[1:], logs[:-1]) + bounds
        place = int(np.argmax(product.logs.real))
        top = product.logs.real[place]
        if not 2 <= place < grid.size - 2 or not np.isfinite(product.logs[place - 2 : place + 3]).all():
            return product  # the maximum is at the edge or beyond the reach of the kernels
        cells = product.cells
        if cells >= FEW and np.max(upper) < top + 3.0:
            return product
        used = np.flatnonzero(upper > top - SUPPORT)
        first, last = max(used[0] - 4, 0), min(used[-1] + 5, grid.size - 1)
        finer = int(np.clip(np.ceil(np.log2(CELLS / cells)), 1, 4))
        size = (last - first << finer) + 1
        if size > MOST_POINTS:
            return product
        field = source.on(Grid(grid.origin, grid.unit, grid.level + finer, (grid.first + first) << finer, size))
    return field


class Attempt(NamedTuple):
    """One attempt of a step: the factor by which grids are wider on each side, and the least level of a grid."""

    wider: tuple[float, float]
    fineness: int


class Prediction(NamedTuple):
    """A density after a transition, its relative error, and figures."""

    field: Field
    error: Array
    truncation: float
    lost: float
    defect: float
    negative: float


def grid_for(prepared: Prepared, field: Field, t: float, attempt: Attempt) -> tuple[Grid, int]:
    """Return the grid for a transition over a time t, and the number of points that the density needs, which may be too large."""
    system, grid, spacing = prepared.system, field.grid, field.grid.spacing
    first, last = field.support
    weights = np.exp((field.logs - np.max(field.logs.real)).real)
    x = grid.offsets - grid.offsets[np.argmax(weights)]
    with np.errstate(all="ignore"):
        f = system.drift(grid.points[:, None], 0.0, system.theta)[:, 0].real
    weights = np.where(np.isfinite(f), weights, 0.0) / weights.sum()
    f = np.where(np.isfinite(f), f, 0.0)
    mean, speed = weights @ x, weights @ f
    variance = max(weights @ (x - mean) ** 2, spacing**2)
    # Forecast for a drift that is linear over the density; the mass at the edges shows where it is wrong.
    rate = np.clip(t * (weights @ ((x - mean) * (f - speed))) / variance, -30.0, 3.0)
    growth, share = np.exp(rate), np.expm1(rate) / rate if abs(rate) > 1e-9 else 1.0
    spread = 8.5 * np.sqrt(system.G * t * (np.expm1(2 * rate) / (2 * rate) if abs(rate) > 1e-9 else 1.0))
    shift = np.clip(speed * t * share, -3 * (x[last] - x[first] + spread), 3 * (x[last] - x[first] + spread))
    # The tails at its ends are at most as long as those of its smallest standard deviation.
    tail = 8.5 * growth * spacing * field.cells
    reach = np.hypot(tail, spread) - tail
    low = min(x[first], mean + shift - growth * (mean - x[first]) - reach) - 3 * spacing
    high = max(x[last], mean + shift + growth * (x[last] - mean) + reach) + 3 * spacing
    width = high - low
    low, high = low - (attempt.wider[0] - 1) * width, high + (attempt.wider[1] - 1) * width
    # The comparison with kernels of twice the length halves the shortest one.
    shortest = 0.5 * t / (prepared.substeps or 1)
    least, level = (int(np.ceil(np.log2(grid.unit / widest) - 1e-9)) for widest in (
        np.sqrt(system.G * shortest) / SHORTEST, spacing * field.cells / CELLS
    ))  # fmt: skip
    level = max(least, level, attempt.fineness)
    while level > least and high - low > MOST_REFINED * grid.unit * 2.0**-level:
        level -= 1
    new = grid.unit * 2.0**-level
    origin = grid.offsets[np.argmax(weights)]
    begin, end = int(np.floor((origin + low) / new)), int(np.ceil((origin + high) / new))
    needed = end - begin + 1
    held = grid.first <= begin * 2.0 ** (grid.level - level) and end * 2.0 ** (grid.level - level) <= grid.first + grid.size - 1
    if held and level <= grid.level <= level + 1 and grid.size <= 2.2 * needed:
        return grid, needed
    begin -= begin % 16
    return Grid(grid.origin, grid.unit, level, begin, -(-(end - begin + 1) // 32) * 32), needed


def transition(prepared: Prepared, field: Field, length: float, attempt: Attempt) -> list[Prediction]:
    """Return the density after each part of an interval; a narrow density passes through successively coarser grids."""
    system, left, part, predictions = prepared.system, length, 0.0, []
    while left > 0:
        t = left
        grid, needed = grid_for(prepared, field, t, attempt)
        if needed > 320 and prepared.substeps is None:
            width = field.grid.spacing * field.cells
            part = max(30 * width**2 / system.G, 4 * part)
            if part < 0.6 * left:
                t = part
                grid, needed = grid_for(prepared, field, t, attempt)
        if needed > MOST_POINTS:
            raise InputError(
                f"{system.model.source}: kolmogorov-series needs a grid of more than {MOST_POINTS} points: an interval of "
                f"{length:g} is too short for the width of the density; name another method"
            )
        start = field.on(grid)
        top = np.max(start.logs.real)
        values = np.exp(start.logs - top)
        fine, coarse, defect = system.kernels(grid).moved(values, t, prepared.substeps)
        positive = np.where(fine.real > 0, fine, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.where(fine.real > 0, np.log(np.where(fine.real > 0, fine, 1.0)) + top, -np.inf)
            error = np.where(fine.real > 0, np.abs((fine - coarse).real / np.where(fine.real > 0, fine.real, 1.0)), 0.0)
        share = 1.0 / (2.0 ** (system.order + 1) - 1.0)
        lost = abs(1.0 - float(fine.real.sum() / values.real.sum()))
        truncation = float(share * np.abs((fine - coarse).real).sum() / max(positive.real.sum(), 1e-300)) + lost
        negative = float(-np.minimum(fine.real, 0.0).sum() / max(np.abs(fine.real).sum(), 1e-300))
        field = Field(grid, logs)
        predictions.append(Prediction(field, share * error + lost, truncation, lost, defect, negative))
        left = left - t
        if not np.isfinite(truncation):
            break
    return predictions
