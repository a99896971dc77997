"""The filter with the explicit series of the Kolmogorov equation's kernel, for one state and any smooth drift without time.

    p_t = G p'' / 2 - (f p)',        p(t + d) = K(r) K(c)^m p(t),      d = r + m c

with K the logarithmic form of the series up to t^N (`zakai.methods.series.heat`), positive everywhere, on a uniform grid.  The
powers K(c)^(2^i) are made once for a grid, so that every interval costs the remainder and a few products, whatever its length.
An observation multiplies the density by its likelihood, a part before the transition and a part after, in the logarithm.

All grids are x = origin + unit 2^-level i.  Each transition is compared with that of kernels of twice the length, which estimates
its error; a step whose grid is too coarse, too narrow or whose kernels are too long is repeated on a better grid.

Yau (1993), Theorems 10 to 12; Yau and Yau's on-and-offline algorithm.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.algebra.theorems import kolmogorov_series as theorem
from zakai.densities import GridDensity
from zakai.errors import InputError
from zakai.methods._options import one_of, whole_number
from zakai.methods._protocol import Info, Method
from zakai.methods.grid import yau_yau
from zakai.methods.series.borrowed_backward import OF_MESSAGE, borrowed
from zakai.methods.series.heat import FORMS
from zakai.methods.series.transition import (
    FEW,
    MOST_POINTS,
    MOST_REFINED,
    Attempt,
    Law,
    Prediction,
    Prepared,
    System,
    factor_at_end,
    grid_for,
    times_factor,
    transition,
    without_law,
)
from zakai.methods.space.system import prior_on_grid
from zakai.methods.system.residuals import Factor
from zakai.models import features
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.numerics.series.dyadic_grid import Field, Grid, edge_masses, quadrature_error
from zakai.records.schedule import Schedule

MOST_SUBSTEPS = 1024
KEPT = 8  # values of the parameters and options for which a model's system is kept
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
    whole_number("order", order, 1, 6)
    if substeps is not None:
        whole_number("substeps", substeps, 1, MOST_SUBSTEPS)
    one_of("form", form, FORMS)
    one_of("splitting", splitting, ("strang", "lie"))
    theta = np.asarray(theta)
    key = theta.tobytes(), theta.dtype.str, order, form
    system = kept(model, System, lambda: System(model, theta, order, form), key, KEPT)
    return Prepared(system, schedule, schedule.lengths, substeps, splitting == "lie")


def init(prepared: Prepared, prior: Any) -> State:
    """Return the prior on a grid."""
    found = prior_on_grid(prepared.system.model, prior, prepared.system.theta, 1e-12, (False,))
    logs = found.log_values
    size = len(logs)
    return State(logs - found.log_mass, float(found.centre[0]), float(found.basis[0, 0]), 0, -(size // 2), -60)


def step(prepared: Prepared, k: int, state: State, values: Array) -> tuple[State, Info]:
    """Advance one interval: the factor at its start, the transition, the factor at its end; repeat it on better grids."""
    system, schedule, length = prepared.system, prepared.schedule, float(prepared.lengths[k])
    before: Factor | None = None
    after: Any
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
        after = factor_at_end(prepared, k, values)
    start = times_factor(system, start, before)
    attempt, predictions = Attempt((1.0, 1.0), state.fineness), []
    for trial in range(ATTEMPTS):
        predictions = transition(prepared, start, length, attempt) if length > 0 else []
        final = times_factor(system, predictions[-1].field if predictions else start, after)
        if not predictions:
            break
        better = _better(prepared, attempt, predictions, final)
        if better is None or better == attempt or trial == ATTEMPTS - 1:
            break
        attempt = better
    split = _splitting_error(prepared, state, before, after, length, final) if within and predictions else 0.0
    new, info = _reported(prepared, attempt, start, predictions, final, after.constant, in_time, split)
    if isinstance(after, Law):
        lawless = without_law(predictions[-1].field if predictions else start, after)
        info = info._replace(health={**info.health, "without_law": lawless})
    return new, info


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
    prepared: Prepared, state: State, before: Factor | None, after: Any, length: float, final: Field
) -> float:
    """Return the error of the splitting, in deviations of the mean or nats, by comparison with the interval divided in two."""
    system, start = prepared.system, Field(state.grid, state.logs)
    try:
        grid, needed = grid_for(prepared, start, 0.5 * length, Attempt((1.0, 1.0), final.grid.level))
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
    """Return whether a state that was read from a file is a density on a grid."""
    numbers = np.array([state.origin, state.unit], float)
    fits = state.logs.ndim == 1 and 8 <= len(state.logs) <= 4 * MOST_POINTS
    return fits and bool(np.isfinite(numbers).all()) and state.unit > 0


BOUNDS = {
    "edge_mass": (1e-9, "probability in the outermost points of the grid"),
    "quadrature_error": (1e-9, "the grid is too coarse for the density"),
    "truncation": (1e-4, "the estimated error of the composed series over one interval; set substeps to more, or to None"),
    "negative_mass": (1e-12, 'share of the density that became negative and was cut; set form to "log"'),
    "tail_depth": (18.0, "nats below its maximum at which the density lies after an observation: the series is cut there"),
    "without_law": yau_yau.BOUNDS["without_law"],
    "time_quadrature_error": (1e-5, "nats: coefficients vary too fast within an interval to be integrated"),
    "splitting_error": (0.02, "deviations of the mean, or nats, by which the splitting is off; give shorter intervals"),
}


def accuracy(prepared: Prepared) -> float:
    """Return the error of the evidence that one interval may leave."""
    sampled = prepared.system.model.observation_kind == "samples"
    return BOUNDS["truncation" if sampled else "splitting_error"][0]


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
    bounds={**BOUNDS, **OF_MESSAGE},
    shorter="set order to 3 or give shorter records",
    valid=valid,
    handles=features.OF_OBSERVATION | {features.INPUTS, features.SINC},
    backward=borrowed(density, accuracy),
)
