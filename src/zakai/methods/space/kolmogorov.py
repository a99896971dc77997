"""`yau-yau` in two to four states: any smooth f and h, singular G, angles in any coordinate, coefficients that vary in time.

Inside an interval the density obeys the Kolmogorov equation, with -h'S^-1 h / 2 + h'S^-1 dy/dt for increments; samples and
increments over more than the interval multiply it at the end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from zakai.densities import Density, GridDensity, LogarithmicDensity
from zakai.errors import InputError
from zakai.methods._options import tolerance_of
from zakai.methods._protocol import Info
from zakai.methods.space.cross import CrossSystem, potential_of
from zakai.methods.space.filter import State
from zakai.methods.space.logarithms import is_formula, mass_outside, prior_of_logarithms, with_logarithms
from zakai.methods.space.observed import MOST_PANELS, Observations
from zakai.methods.space.short import predicted_on
from zakai.methods.space.system import System, grid_of, moments_of, moments_of_exponentials, prior_on_grid, system_of, valid_noise
from zakai.methods.system.escape_of_states import check_escape
from zakai.methods.system.notes import OMITTED
from zakai.models.features import CROSS_NOISE
from zakai.models.model import Model
from zakai.numerics.complex_step import is_complex
from zakai.numerics.prior_grid import PriorGrid, mixture_grid
from zakai.numerics.space.advance import CHECKED, Control, advance
from zakai.numerics.space.field import NOTHING, Field, Report, positive, spline_error
from zakai.numerics.space.grid import Grid
from zakai.numerics.space.rough import checked, for_rough
from zakai.numerics.space.step import Stepper
from zakai.numerics.space.survey import Survey
from zakai.numerics.space.update import Update, updated
from zakai.numerics.space.window import MOST, Bounds
from zakai.records.schedule import Schedule

Array = Any
DEFAULT_TOLERANCE = 1e-3
OUTLIER_EDGE = 1e-15
ACCURATE_DEPTH = 27.0  # nats below the maximum that rounding leaves accurate
ALIKE = 0.5  # how much the errors of different intervals have in common
OF_SPLINES = 0.01  # of the tolerance, for the interpolation along one axis in a substep
POINTWISE = 5.0  # times the error of splines in the moments of a density, for that in the moments of its product
FINER = 2.0  # ratio of the spacings of a grid to those of its splines, where the product reaches the end of the prediction
SHARE = 0.2  # of the tolerance, for the error in time of one interval
LOST = 0.5  # error of a density relative to itself
KEPT = 0.98  # largest share of an error that an interval is taken to leave
OF_FIELDS = 3.0  # work where the noise depends on the state, in that of others (measured: 2 to 9)
MOST_OUTSIDE = 0.05  # of the tolerance: mass of a prior where a logarithm has no value
WIDER = 1.1  # growth of the deviations after which the error of a substep is measured again


class Increments(NamedTuple):
    """Which coordinates (m,) act `inside` an interval, and at which `rates` (m,)."""

    inside: Array
    rates: Array


@dataclass(frozen=True, eq=False)
class Prepared:
    """A model, a schedule and parameters, with the bounds that follow from the tolerance.

    `lie` tells whether the filter splits an interval at its end only, which has no backward pass.  An interval that needs more
    than `most_work`, in grid points, raises ExhaustedError.  With `logarithms` (n,) the model is that of the logarithms of some
    states; `mapped` is what is prepared for that model, for a prior in which these states are positive.
    """

    model: Model
    schedule: Schedule
    theta: np.ndarray
    system: System
    tolerance: float
    bounds: Bounds
    observations: Observations
    notes: tuple[str, ...] = ()
    motions: dict[Any, Any] = field(default_factory=dict)
    lie: bool = False
    most_work: float = math.inf
    logarithms: tuple[bool, ...] = ()
    mapped: Prepared | None = None

    def of(self, state: State) -> Prepared:
        """Return what is prepared for the coordinates of a state."""
        return self.mapped if state.logarithmic and self.mapped is not None else self

    def init(self, prior: Any) -> State:
        """Return the prior on a grid, of logarithms where these states are positive."""
        tolerance, mapped = min(self.bounds.edge, self.bounds.tail), self.mapped
        known = None
        if mapped is None or is_formula(prior):
            known = prior_on_grid(self.model, prior, self.theta, tolerance, self.bounds.periodic)
        if mapped is not None:
            outside, error = mass_outside(prior, mapped.logarithms, known)
            if outside < MOST_OUTSIDE * self.tolerance:
                of_w = mapped.model, prior, self.theta, tolerance, self.bounds.periodic, mapped.logarithms, known
                return mapped.began(prior_of_logarithms(*of_w), error)
        return self.began(known or prior_on_grid(self.model, prior, self.theta, tolerance, self.bounds.periodic), 0.0)

    def began(self, found: PriorGrid, error: float) -> State:
        """Return the state of a prior on a grid, with an error that it has already."""
        values = np.exp(found.log_values - np.max(found.log_values.real))
        error += found.error if found.error > 1e-6 else 0.0
        grid = Grid(found.centre, found.basis, values.shape, found.closed)
        return self.started(positive(Field(values, grid, 0.0), self.bounds), error)

    def started(self, field: Field, error: float) -> State:
        """Return the state of a prior."""
        mass, control = field.values.sum() * field.grid.cell, Control(np.inf, 0.0, 0)
        return self._state(field, mass, control, np.zeros(self.model.n), error, 0.9)

    def bounded(self, points: float) -> Prepared:
        """Return the same with a bound on the work in an interval."""
        mapped = None if self.mapped is None else self.mapped.bounded(points)
        return replace(self, most_work=points, mapped=mapped)

    @property
    def correlated(self) -> bool:
        """Whether dv and dw are correlated."""
        return CROSS_NOISE in self.model.features

    @property
    def angles(self) -> tuple[bool, ...]:
        """Which coordinates are angles."""
        return tuple(name in self.model.periodic for name in self.model.state)

    def density(self, state: State) -> Field:
        """Return the posterior on a grid."""
        return Field(state.values, grid_of(state, self.bounds.periodic), 0.0)

    def posterior(self, field: Field) -> Density:
        """Return a density on a grid as one of the states."""
        with np.errstate(divide="ignore"):
            logs = np.log(np.maximum(field.values.real, 0.0))
        found = GridDensity(logs, field.grid.centre, field.grid.basis, self.model.state, self.angles)
        return LogarithmicDensity(found, self.logarithms) if self.logarithms else found

    def moments(self, field: Field) -> tuple[Array, Array, float]:
        """Return the mean (n,) and covariance (n, n) of the states, and how much of a second moment may be off the grid."""
        if not self.logarithms:
            return *moments_of(field.values.real, field.grid, self.angles, field.survey(self.bounds)), 0.0
        return moments_of_exponentials(field, self.angles, self.logarithms)

    def check_escape(self, k: int, state: State) -> None:
        """Raise InputError where paths escape from a density in interval k."""
        values, grid = np.maximum(np.asarray(state.values).real, 0.0), grid_of(state, self.bounds.periodic)
        check_escape(self, k, lambda: moments_of(values, grid, self.angles))

    def allowed(self, state: State) -> float:
        """Return the error in time that one interval may make: errors of earlier intervals add to it."""
        return SHARE * self.tolerance * float(np.sqrt(1 - min(state.kept, KEPT) ** 2))

    def step(self, k: int, state: State, values: np.ndarray) -> tuple[State, Info]:
        """Return the state after interval k and its observation, and what the step reports."""
        self.check_escape(k, state)
        observations = self.observations
        begin = Field(state.values, grid_of(state, self.bounds.periodic), 0.0)
        length, inside = float(observations.lengths[k]), observations.inside[k]
        control, allowed = Control(state.rate, state.measured, state.age, state.fixed), self.allowed(state)
        parts = observations.parts(k)
        last = observations.over(*parts[-1])
        potential = last.potential(inside, values, *parts[-1]) if inside.any() and length > 0 else None
        factor, constant = last.factor(k, inside, values)
        quick, bounds = None, self.bounds
        if not (self.correlated and inside.any()) and bounds.finer == 1.0:
            quick = predicted_on(self, begin, control, allowed, length, potential)
        increments = Increments(inside, values / max(length, 1e-300))
        before: tuple[Field, Report, Control, Update] | None = None
        for _ in range(4):
            found: Survey | None = None  # of this prediction: a repetition is on another grid
            if quick is not None:
                (predicted, report, after), found, quick = quick[:3], quick[3] if factor is None else None, None
            else:
                predicted, report, after = self.predicted(begin, parts, increments, control, allowed, bounds)
            if potential is None:  # what is not observed has no evidence
                predicted = predicted._replace(log_scale=-np.log(predicted.values.sum() * predicted.grid.cell))
            update = Update(predicted, report.edges, report.tails, 0.0, False)
            if factor is not None:
                wider = partial(observations.wider, begin, predicted, parts, self.bounds)
                rough = self.system.rough
                update = updated(predicted, factor, for_rough(bounds) if rough else bounds, report.tails, wider=wider)
                if rough:
                    update = checked(predicted, update, factor, bounds)
                report = report._replace(interpolation=POINTWISE * report.interpolation)
            if before is not None and not report.splitting + report.of_grid(bounds.reach) < LOST:
                (predicted, report, after, update), found = before, None
                break
            before = predicted, report, after, update
            if update.truncated and length > 0 and bounds.finer == self.bounds.finer:
                # The error of waves is as large in the tails as elsewhere.
                noise = float(begin.survey(bounds).tails.max()) * np.exp(min(update.depth, 40.0))
                if noise < report.interpolation * update.growth:
                    bounds = bounds._replace(finer=FINER * bounds.finer)
                    continue
            if not update.truncated or length == 0 or bounds.edge <= OUTLIER_EDGE:
                break
            # The observation is where the prediction was cut off; so wide a grid leaves rounding, which no substep makes smaller.
            bounds, allowed = bounds._replace(edge=max(bounds.edge**2, OUTLIER_EDGE)), 10 * self.tolerance
        if potential is not None:
            end, first = found or predicted.survey(self.bounds), begin.survey(self.bounds)
            moved = predicted.grid.centre + end.mean - begin.grid.centre - first.mean
            cut = last.cut_off(begin, moved, potential, *parts[-1], self.bounds)
            update = update._replace(interpolation=update.interpolation + cut)
        kept = state.kept if factor is None and after.age else self._kept(begin, predicted, update.field)
        new, info = self._reported(state, update, report, after, constant, kept, found)
        health = dict(info.health)
        if self.system.general:
            health["without_law"] = 0.0
            if factor is not None:
                lawless = np.isnan(factor(predicted.grid).real).reshape(predicted.grid.sizes)
                near = lawless.copy()
                for d in range(lawless.ndim):  # the border lies between two points
                    near |= np.roll(lawless, 1, d) | np.roll(lawless, -1, d)
                real = predicted.values.real
                health["without_law"] = float(0.5 * (real.sum(where=lawless) + real.sum(where=near)) / real.sum())
        if self.system.tables:
            stop = float(self.schedule.stops[k])
            points = grid_of(new, self.bounds.periodic).points
            beyond = self.system.outside(points, stop, self.theta, observations.inputs_at(stop))
            health["outside_tables"] = float(new.values.real.reshape(-1)[beyond].sum() / new.values.real.sum())
        return new, info._replace(health=health)

    def predicted(
        self,
        begin: Field,
        parts: list[tuple[float, float]],
        increments: Increments,
        control: Control,
        allowed: float,
        bounds: Bounds,
        steppers: list[Stepper] | None = None,
        fewest: int = 1,
    ) -> tuple[Field, Report, Control]:
        """Return the density at the end of an interval, advanced over its parts by `steppers` in at least `fewest` substeps."""
        result, report, (inside, rates) = begin, NOTHING, increments
        for start, length in parts:
            observations = self.observations.over(start, length)
            acts, correlated = inside.any() and length > 0, self.correlated and inside.any()
            if self.schedule.inputs is not None or correlated:
                control = Control(np.inf, 0.0, 0)  # other inputs and other increments make another error
            potential = None
            if acts and correlated:
                cross = CrossSystem(observations, inside, rates, start, start + length)
                observations = replace(observations, system=cross)
                potential = potential_of(observations, start, length)
            elif acts:
                potential = observations.potential(inside, rates * length, start, length)
            least = fewest
            if observations.system.varies and length > 0:
                mean, cov = moments_of(result.values.real, result.grid, bounds.periodic)
                points = mean + np.concatenate([np.zeros((1, len(mean))), np.diag(np.sqrt(np.diagonal(cov)))])
                least = max(fewest, observations.least(points, start, length, inside))
            most_work = self.most_work / (OF_FIELDS if observations.system.state_dependent else 1.0)
            stepper = Stepper(observations.dynamics, bounds, self.tolerance, most_work, self.system.rough)
            if steppers is not None:
                steppers.append(stepper)
            result, more, control = advance(stepper, result, start, length, potential, control, allowed / len(parts), least)
            if least >= MOST_PANELS:
                more = more._replace(splitting=max(more.splitting, 1.0))
            if observations.system.state_dependent:  # mass where the noise has no value may be anywhere on the grid
                valid = valid_noise(observations.system.covariance(result.grid.points, start + length, self.theta))
                invalid = np.sum(result.values.real, where=~valid.reshape(result.grid.sizes)) / result.values.real.sum()
                more = more._replace(splitting=more.splitting + bounds.reach**2 * float(invalid))
            report = report.worst(more)
        return result, report, control

    def _reported(
        self, state: State, update: Update, report: Report, control: Control, constant: Any, kept: float, found: Survey | None
    ) -> tuple[State, Info]:
        result = positive(update.field, self.bounds) if found is None else update.field
        mean, cov = moments_of(result.values.real, result.grid, self.angles, found or result.survey(self.bounds))
        deviations = np.sqrt(np.maximum(cov.diagonal(), 0.0))
        mass = result.values.sum() * result.grid.cell
        gained = np.log(mass) + (result.log_scale + constant)
        if not report.splitting + report.of_grid(self.bounds.reach) < LOST and np.isfinite(update.depth):
            result, mass = self._gaussian(result, mean, cov), 1.0
        cut = 0.0
        if self.logarithms:
            mean, cov, cut = self.moments(result)
        edge, tails = max(report.edges, update.edges), max(report.tails, update.tails)
        made = (report.splitting + report.interpolation) * update.growth + update.interpolation + min(update.cut, 1.0)
        made = made + 1e-15 * np.exp(min(update.depth, 40.0)) + self.bounds.reach**2 * max(edge, cut) * 0.1 + tails
        made = made + math.hypot(report.removed, update.removed, 0.0 if found is not None else result.removed)
        left = kept * state.error
        error = float(np.sqrt(left**2 + 2 * ALIKE * left * made + made**2))
        if update.truncated or not np.isfinite(gained):
            error = max(error, 1.0)
        health = {
            "error_estimate": error,
            "tolerance_ratio": float(max(error / self.tolerance, edge / (0.1 * self.tolerance), tails / self.tolerance)),
            "splitting_error": report.splitting,
            "tail_depth": float(update.depth) / ACCURATE_DEPTH,
            "edge_mass": edge,
            "negative_mass": report.negative,
            "std_in_spacings": math.sqrt(-2 * math.log(min(max(tails, 1e-15), 0.9))) / math.pi,
        }
        # The error of a substep grows steeply with the deviations.
        measured = deviations if control.age == 0 else state.deviations
        if any(not new / WIDER <= old <= WIDER**3 * new for new, old in zip(deviations.tolist(), measured.tolist(), strict=True)):
            control = control._replace(age=CHECKED)
        return self._state(result, mass, control, measured, min(error, 1e3), kept), Info(gained, mean, cov, health)

    def _gaussian(self, lost: Field, mean: Array, cov: Array) -> Field:
        """Return the Gaussian with the moments of a density that its grid does not hold, where they exist."""
        if not (np.isfinite(mean).all() and np.isfinite(cov).all() and np.linalg.eigvalsh(cov).min() > 0):
            return lost
        bounds, one = self.bounds, np.ones(1)
        try:
            found = mixture_grid(
                one, mean[None], cov[None], bounds.periodic, tolerance=min(bounds.edge, bounds.tail), aligned=any(self.angles)
            )
        except InputError:  # a variance is too small
            return lost
        values = np.exp(found.log_values)
        grid = Grid(found.centre, found.basis, values.shape, found.closed)
        return Field(values / (values.sum() * grid.cell), grid, 0.0)

    def _state(self, found: Field, mass: Any, control: Control, deviations: Array, error: float, kept: float) -> State:
        return State(
            found.values / mass, found.grid.centre, found.grid.basis, float(control.rate), float(control.measured),
            int(control.age), control.fixed, deviations, float(error), float(kept), bool(self.logarithms),
        )  # fmt: skip

    def _kept(self, begin: Field, predicted: Field, result: Field) -> float:
        """Return the share of an error of the mean, in deviations, that an interval leaves."""
        volumes = np.linalg.det(np.stack([f.survey(self.bounds).cov for f in (begin, predicted, result)]))
        before, between, after = np.maximum(volumes, 1e-300).tolist()
        contracted = (min(before, between) / between * min(after, between) / between) ** (0.5 / self.model.n)
        return float(np.clip(contracted, 0.0, KEPT))


def prepare(model: Model, schedule: Schedule, theta: np.ndarray, *, tolerance: float | None = None) -> Prepared:
    """Return what is known without data.

    Args:
        model: two to four states.
        schedule: the intervals.
        theta: parameters (p,).
        tolerance: bound on the relative error of the density; 1e-3 by default.
    """
    tolerance = tolerance_of(tolerance, DEFAULT_TOLERANCE)
    if model.n > 4:
        raise InputError(f"{model.source}: a density grid is for at most four states, and there are {model.n}")
    prepared = _prepared(model, schedule, np.asarray(theta), tolerance)
    found = with_logarithms(model)
    if found is None:
        return prepared
    mapped = _prepared(found[0], schedule, np.asarray(theta), tolerance)
    return replace(prepared, mapped=replace(mapped, logarithms=found[1]))


def _prepared(model: Model, schedule: Schedule, theta: np.ndarray, tolerance: float) -> Prepared:
    periodic = tuple(name in model.periodic for name in model.state)
    tail = min(tolerance**2, 1e-3 * tolerance)
    finer = max(spline_error(tail) / (OF_SPLINES * tolerance), 1.0) ** (1 / 6)
    bounds = Bounds(1e-3 * tolerance, tail, MOST[model.n], periodic, finer=finer)
    system = system_of(model)
    tables, motions = ({}, {}) if is_complex(theta) else system.caches(theta)
    observations = Observations(model, schedule, system, theta, tables)
    gathered = CROSS_NOISE in model.features and bool((schedule.seen & ~schedule.inside).any())
    notes = (OMITTED,) if gathered else ()
    return Prepared(model, schedule, theta, system, tolerance, bounds, observations, notes, motions)
