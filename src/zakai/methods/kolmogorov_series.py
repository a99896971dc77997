"""The filter with the explicit series of the Kolmogorov equation's kernel, for one state and any smooth drift without time.

    p_t = G p'' / 2 - (f p)',        p(t + d) = K(r) K(c)^m p(t),      d = r + m c

with K the logarithmic form of the series up to t^N (`zakai.methods._heat_series`), positive everywhere, on a uniform grid.  The
powers K(c)^(2^i) are made once for a grid, so that every interval costs the remainder and a few products, whatever its length.
An observation multiplies the density by its likelihood, a part before the transition and a part after, in the logarithm.

All grids are x = origin + unit 2^-level i.  Each transition is compared with that of kernels of twice the length, which estimates
its error; a step whose grid is too coarse, too narrow or whose kernels are too long is repeated on a better grid.

Yau (1993), Theorems 10 to 12; Yau and Yau's on-and-offline algorithm.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from zakai.algebra.theorems import kolmogorov_series as theorem
from zakai.densities import GridDensity
from zakai.errors import InputError
from zakai.methods._heat_series import FORMS, heat_series
from zakai.methods._protocol import Info, Method
from zakai.methods._residuals import Factor, Sensors
from zakai.methods._space_system import prior_on_grid
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.numerics.composed_kernels import SHORTEST, Kernels
from zakai.numerics.dyadic_grid import SUPPORT, Field, Grid, edge_masses, quadrature_error
from zakai.records.schedule import Schedule

MOST_POINTS = 16384  # of a grid
MOST_REFINED = 2048  # of a grid that is refined for the sake of the series
MOST_SUBSTEPS = 1024
KEPT = 24  # grids whose kernels are kept
CELLS = 2.5  # grid spacings in the smallest standard deviation, on a new grid
FEW = 1.8  # the same, at least
ACCURATE = 1e-6  # the estimated error of an interval to which kernels are shortened
EDGE = 1e-10  # probability near an edge from which a grid is enlarged
ATTEMPTS = 16
Array = np.ndarray


class State(NamedTuple):
    """The logarithm `logs` (N,) of the normalised density on a grid; `fineness` is the least level that the kernels need."""

    logs: Array
    origin: float
    unit: float
    level: int
    first: int
    fineness: int

    @property
    def grid(self) -> Grid:
        """The grid."""
        return Grid(self.origin, self.unit, self.level, self.first, len(self.logs))


class System:
    """The functions of a model at one theta, and the kernels of the last grids."""

    def __init__(self, model: Model, theta: Array, order: int, form: str):
        self.model, self.theta, self.order, self.form = model, theta, order, form
        self.sensors = Sensors.of(model)
        self.drift = numpy_function(model.drift, model)
        self.G = float(numpy_function(model.covariance, model, (1, 1))(np.zeros(1), model.start, theta)[0, 0].real)
        self._kernels: OrderedDict[Grid, Kernels] = OrderedDict()

    def kernels(self, grid: Grid) -> Kernels:
        """Return the kernels on a grid, which depend on it alone."""
        kernels = self._kernels.get(grid)
        if kernels is None:
            with np.errstate(all="ignore"):
                heat = heat_series(self.model, grid.points, self.order, theta=self.theta, potential=False)
            kernels = self._kernels[grid] = Kernels(heat, grid, self.form)
            while len(self._kernels) > KEPT:
                self._kernels.popitem(last=False)
        return kernels


@lru_cache(maxsize=8)
def _system(model: Model, theta: bytes, dtype: str, order: int, form: str) -> System:
    return System(model, np.frombuffer(theta, dtype), order, form)


@dataclass(frozen=True, eq=False)
class Prepared:
    """The functions, the intervals and the options; no data."""

    system: System
    schedule: Schedule
    lengths: Array
    substeps: int | None
    lie: bool
    notes: tuple[str, ...] = ()


def prepare(
    model: Model,
    schedule: Schedule,
    theta: Array,
    *,
    order: int = 2,
    substeps: int | None = None,
    form: str = "log",
    splitting: str = "strang",
) -> Prepared:
    """Return the functions of the model and the intervals.

    Args:
        model: a model of one state.
        schedule: the K intervals.
        theta: (p,) the parameters, real or complex.
        order: N, that of the series.
        substeps: the number of kernels that make the transition of an interval; None for as many as needed.
        form: "log" or "sum".
        splitting: "strang" or "lie".

    Raises:
        InputError: an option has another value.
    """
    for name, value, most in (("order", order, 6), ("substeps", 1 if substeps is None else substeps, MOST_SUBSTEPS)):
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
            raise InputError(f"option {name}: {value!r} is not a whole number from 1 to {most}")
    if form not in FORMS:
        raise InputError(f'option form: "{form}" is neither "log" nor "sum"')
    if splitting not in ("strang", "lie"):
        raise InputError(f'option splitting: "{splitting}" is neither "strang" nor "lie"')
    theta = np.asarray(theta)
    system = _system(model, theta.tobytes(), theta.dtype.str, order, form)
    return Prepared(system, schedule, schedule.lengths, substeps, splitting == "lie")


def init(prepared: Prepared, prior: Any) -> State:
    """Return the prior on a grid."""
    found = prior_on_grid(prepared.system.model, prior, prepared.system.theta, 1e-12, (False,))
    logs = found.log_values
    size = len(logs)
    return State(logs - found.log_mass, float(found.centre[0]), float(found.basis[0, 0]), 0, -(size // 2), -60)


def _times(system: System, field: Field, factor: Factor | None) -> Field:
    """Multiply by a factor, on a finer grid where the product needs it."""
    source = field  # interpolate the whole field only: a part of it ends abruptly
    while factor is not None and factor.roots.size:
        grid = field.grid
        residuals = factor.residuals(system.sensors.observed, grid.points[:, None], system.theta)
        product = Field(grid, field.logs - 0.5 * np.sum(residuals * residuals, axis=0))
        e = residuals.real
        # Upper bound of the factor between two points: a residual that changes its sign is zero there.
        least = np.where(e[:, 1:] * e[:, :-1] <= 0, 0.0, np.minimum(np.abs(e[:, 1:]), np.abs(e[:, :-1])))
        logs = field.logs.real
        upper = np.maximum(logs[1:], logs[:-1]) - 0.5 * np.sum(least * least, axis=0)
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


def _grid_for(prepared: Prepared, field: Field, t: float, attempt: Attempt) -> tuple[Grid, int]:
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


def _transition(prepared: Prepared, field: Field, length: float, attempt: Attempt) -> list[Prediction]:
    """Return the density after each part of an interval; a narrow density passes through successively coarser grids."""
    system, left, part, predictions = prepared.system, length, 0.0, []
    while left > 0:
        t = left
        grid, needed = _grid_for(prepared, field, t, attempt)
        if needed > 320 and prepared.substeps is None:
            width = field.grid.spacing * field.cells
            part = max(30 * width**2 / system.G, 4 * part)
            if part < 0.6 * left:
                t = part
                grid, needed = _grid_for(prepared, field, t, attempt)
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


def step(prepared: Prepared, k: int, state: State, values: Array) -> tuple[State, Info]:
    """Advance one interval: the factor at its start, the transition, the factor at its end; repeat it on better grids."""
    system, schedule, length = prepared.system, prepared.schedule, float(prepared.lengths[k])
    before: Factor | None = None
    start, in_time = Field(state.grid, state.logs), 0.0
    seen, inside = schedule.seen[k], schedule.inside[k]
    within = bool(seen.any()) and np.array_equal(seen, inside)
    if within:
        first, last = start.support
        probe = start.grid.points[np.linspace(first, last, 17).astype(int), None]
        before, after, in_time = system.sensors.inside(schedule, k, values, system.theta, probe)
        if prepared.lie:
            times, roots = np.concatenate([before.times, after.times]), np.concatenate([before.roots, after.roots])
            before, after = None, after._replace(times=times, roots=roots)
    else:
        after = system.sensors.at_end(schedule, k, values, system.theta, seen)
    start = _times(system, start, before)
    attempt, predictions = Attempt((1.0, 1.0), state.fineness), []
    for trial in range(ATTEMPTS):
        predictions = _transition(prepared, start, length, attempt) if length > 0 else []
        final = _times(system, predictions[-1].field if predictions else start, after)
        if not predictions:
            break
        better = _better(prepared, attempt, predictions, final)
        if better is None or better == attempt or trial == ATTEMPTS - 1:
            break
        attempt = better
    split = _splitting_error(prepared, state, before, after, length, final) if within and predictions else 0.0
    return _reported(prepared, attempt, start, predictions, final, after.constant, in_time, split)


def _better(prepared: Prepared, attempt: Attempt, predictions: list[Prediction], final: Field) -> Attempt | None:
    """Return the next attempt, or None if the step is within its bounds or cannot be improved."""
    order, level = prepared.system.order, predictions[-1].field.grid.level
    free = prepared.substeps is None and prepared.system.form == "log"
    truncation = sum(part.truncation for part in predictions)
    fields = [part.field for part in predictions]
    finite = np.isfinite(truncation) and all(np.isfinite(np.max(f.logs.real)) for f in (*fields, final))
    if not finite:
        wider = (1.5 * attempt.wider[0], 1.5 * attempt.wider[1])
        return Attempt(wider, level + 1) if free and max(f.grid.size for f in fields) < MOST_REFINED else None
    left, right = np.max([edge_masses(f.logs) for f in (*fields, final)], axis=0)
    small = max(f.grid.size for f in fields) < MOST_REFINED
    # Kernels that are too long for the series put mass anywhere: shorten them before the grid is widened.
    if max(left, right) > EDGE and small and not (free and truncation - sum(part.lost for part in predictions) > 1e-3):
        a, b = attempt.wider
        return attempt._replace(wider=(1.5 * a if left > EDGE else a, 1.5 * b if right > EDGE else b))
    if any(f.cells < FEW for f in fields) and small:
        return attempt._replace(fineness=level + 1)
    worst = max(truncation, 0.01 * _weighted(predictions[-1], final))
    if free and worst > ACCURATE and small:
        return attempt._replace(fineness=level + int(np.clip(np.ceil(np.log2(worst / ACCURATE) / (2 * order + 2)), 1, 3)))
    return None


def _weighted(prediction: Prediction, final: Field) -> float:
    """Return the relative error of a transition, averaged over the posterior."""
    weights = np.exp((final.logs - np.max(final.logs.real)).real)
    return float(weights @ np.interp(final.grid.offsets, prediction.field.grid.offsets, prediction.error) / weights.sum())


def _splitting_error(
    prepared: Prepared, state: State, before: Factor | None, after: Factor, length: float, final: Field
) -> float:
    """Return the error of the splitting, in deviations of the mean or nats, by comparison with the interval divided in two."""
    system, start = prepared.system, Field(state.grid, state.logs)
    try:
        grid, needed = _grid_for(prepared, start, 0.5 * length, Attempt((1.0, 1.0), final.grid.level))
    except InputError:
        return np.inf
    if needed > MOST_POINTS:
        return np.inf
    early, late = (
        np.zeros(grid.size) if factor is None else -0.5 * np.sum(
            factor.residuals(system.sensors.observed, grid.points[:, None], system.theta).real ** 2, axis=0
        ) for factor in (before, after)
    )  # fmt: skip
    if before is None:
        early = late = 0.5 * late
    logs = start.on(grid).logs.real
    for g in (0.5 * early, 0.5 * (early + late)):
        logs = logs + g
        top = np.max(logs)
        with np.errstate(divide="ignore", invalid="ignore"):
            predicted = system.kernels(grid).moved(np.exp(logs - top), 0.5 * length, prepared.substeps)[0].real
            logs = np.log(np.maximum(predicted, 0.0)) + top
    (mass, mean, deviation), (other, mean_of_halves, _) = (
        Field(f.grid, f.logs.real).moments for f in (final, Field(grid, logs + 0.5 * late))
    )  # fmt: skip
    error = max(abs(mean - mean_of_halves) / deviation, abs(mass - other))
    return float(error if before is None else 4 / 3 * error)


def _reported(
    prepared: Prepared, attempt: Attempt, start: Field, predictions: list[Prediction], final: Field, constant: Any,
    in_time: float, splitting: float,
) -> tuple[State, Info]:
    """Return the normalised state and the moments and health of the step."""
    grid = final.grid
    log_mass, mean, deviation = final.moments
    logs = final.logs - log_mass
    weights = np.exp(logs.real) * grid.spacing
    cells = min(start.cells, final.cells)
    truncation = depth = 0.0
    if predictions:
        predicted = predictions[-1].field.on(grid).logs.real
        truncation = _weighted(predictions[-1], final) + sum(part.truncation for part in predictions[:-1])
        known = weights > 0
        depth = float(np.sum(weights[known] * (np.max(predictions[-1].field.logs.real) - predicted[known])))
    health = {
        "edge_mass": max(sum(edge_masses(f.logs)) for f in (final, *(part.field for part in predictions))),
        "quadrature_error": quadrature_error(cells),
        "truncation": truncation,
        "mass_defect": sum(part.defect for part in predictions),
        "negative_mass": max((part.negative for part in predictions), default=0.0),
        "tail_depth": depth,
        "time_quadrature_error": in_time,
        "splitting_error": splitting,
    }
    fineness = attempt.fineness
    if predictions and sum(part.truncation for part in predictions) < ACCURATE / 8.0 / 4.0 ** (prepared.system.order + 1):
        fineness = max(min(fineness, grid.level) - 1, -60)
    state = State(logs, grid.origin, grid.unit, grid.level, grid.first, fineness)
    return state, Info(log_mass + constant, np.array([grid.origin + mean]), np.array([[deviation**2]]), health)


def density(prepared: Prepared, state: State) -> GridDensity:
    """Return the posterior on its grid."""
    grid = state.grid
    centre, basis = grid.points[grid.size // 2 : grid.size // 2 + 1], np.array([[grid.spacing]])
    return GridDensity(state.logs.real, centre, basis, prepared.system.model.state, (False,))


def valid(prepared: Prepared, state: State) -> bool:
    """Say whether a state that was read from a file is a density on a grid."""
    numbers = np.array([state.origin, state.unit], float)
    fits = state.logs.ndim == 1 and 8 <= len(state.logs) <= 4 * MOST_POINTS
    return fits and bool(np.isfinite(numbers).all()) and state.unit > 0


METHOD = Method(
    name="kolmogorov-series",
    source="Yau 1993, Theorems 10 to 12, in the logarithmic form; the likelihood online",
    exactness="convergent: order `order` + 1 in the length of a kernel, an interval over `substeps`; second order in the "
    "interval for continuous observations, by a symmetric splitting",
    theorem=theorem,
    options={"order": 2, "substeps": None, "form": "log", "splitting": "strang"},
    prepare=prepare,
    init=init,
    step=step,
    density=density,
    state=State,
    bounds={
        "edge_mass": (1e-9, "probability in the outermost points of the grid"),
        "quadrature_error": (1e-9, "the grid is too coarse for the density"),
        "truncation": (1e-4, "the estimated error of the composed series over one interval; set substeps to more, or to None"),
        "negative_mass": (1e-12, 'share of the density that became negative and was cut; set form to "log"'),
        "tail_depth": (18.0, "nats below its maximum at which the density lies after an observation: the series is cut there"),
        "time_quadrature_error": (1e-5, "nats: coefficients vary too fast within an interval to be integrated"),
        "splitting_error": (0.02, "deviations of the mean, or nats, by which the splitting is off; give shorter intervals"),
    },
    shorter="set order to 3 or give shorter records",
    valid=valid,
)
