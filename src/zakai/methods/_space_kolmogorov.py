"""`yau-yau` in two to four states: any smooth f and h, singular G, angles in any coordinate, coefficients that vary in time.

Inside an interval the density obeys the Kolmogorov equation, with -h'S^-1 h / 2 + h'S^-1 dy/dt for increments; samples and
increments over more than the interval multiply it at the end.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from zakai.errors import InputError
from zakai.methods._options import tolerance_of
from zakai.methods._protocol import Info
from zakai.methods._space import State
from zakai.methods._space_observed import MOST_PANELS, Observations
from zakai.methods._space_system import System, grid_of, moments_of, prior_on_grid, system_of, valid_noise
from zakai.models.model import Model
from zakai.numerics.complex_step import is_complex
from zakai.numerics.space_grid import Grid
from zakai.numerics.space_short import PLAIN, motion, rate_of, short_step, splitting_error
from zakai.numerics.space_step import CHECKED, NOTHING, Control, Field, Report, Stepper, advance, grid_report, positive
from zakai.numerics.space_survey import Survey, deviations_in_spacings, survey
from zakai.numerics.space_update import Update, updated
from zakai.numerics.space_window import MOST, Bounds
from zakai.records.schedule import Schedule

Array = Any
DEFAULT_TOLERANCE = 1e-3
OUTLIER_EDGE = 1e-15
ACCURATE_DEPTH = 27.0  # nats below the maximum that rounding leaves accurate
ALIKE = 0.5  # how much the errors of different intervals have in common
SHARE = 0.2  # of the tolerance, for the error in time of one interval
KEPT = 0.98  # largest share of an error that an interval is taken to leave
WIDER = 1.1  # growth of the deviations after which the error of a substep is measured again
MOST_TABLES = 64  # grids whose motion is kept


@dataclass(frozen=True, eq=False)
class Prepared:
    """A model, a schedule and parameters, with the bounds that follow from the tolerance."""

    model: Model
    schedule: Schedule
    theta: np.ndarray
    system: System
    tolerance: float
    bounds: Bounds
    observations: Observations
    notes: tuple[str, ...] = ()
    moves: dict[Any, Any] = field(default_factory=dict)
    motions: dict[Any, Any] = field(default_factory=dict)

    def init(self, prior: Any) -> State:
        """Return the prior on a grid."""
        tolerance = min(self.bounds.edge, self.bounds.tail)
        found = prior_on_grid(self.model, prior, self.theta, tolerance, self.bounds.periodic)
        values = np.exp(found.log_values - np.max(found.log_values.real))
        error = found.error if found.error > 1e-6 else 0.0
        grid = Grid(found.centre, found.basis, values.shape, found.closed)
        return self._state(positive(Field(values, grid, 0.0)), Control(np.inf, 0.0, 0), np.zeros(self.model.n), error, 0.9)

    @property
    def angles(self) -> tuple[bool, ...]:
        """Which coordinates are angles."""
        return tuple(name in self.model.periodic for name in self.model.state)

    def density(self, state: State) -> Field:
        """Return the posterior on a grid."""
        return Field(state.values, grid_of(state, self.bounds.periodic), 0.0)

    def allowed(self, state: State) -> float:
        """Return the error in time that one interval may make: errors of earlier intervals add to it."""
        return SHARE * self.tolerance * float(np.sqrt(1 - min(state.kept, KEPT) ** 2))

    def step(self, k: int, state: State, values: np.ndarray) -> tuple[State, Info]:
        """Return the state after interval k and its observation, and what the step reports."""
        observations = self.observations
        begin = Field(state.values, grid_of(state, self.bounds.periodic), 0.0)
        length, inside = float(observations.lengths[k]), observations.inside[k]
        control, allowed = Control(state.rate, state.measured, state.age), self.allowed(state)
        parts = observations.parts(k)
        last = observations.over(*parts[-1])
        potential = last.potential(inside, values, *parts[-1]) if inside.any() and length > 0 else None
        factor, constant = last.factor(k, inside, values)
        quick, found = self._short(begin, control, allowed, length, potential), None
        bounds, rates = self.bounds, values / max(length, 1e-300)
        for _ in range(3):
            if quick is not None:
                (predicted, report, after), found, quick = quick[:3], quick[3] if factor is None else None, None
            else:
                predicted, report, after = self._predicted(begin, parts, inside, rates, control, allowed, bounds)
            update = Update(predicted, report.edges, report.tails, 0.0, False)
            if factor is not None:
                update = updated(predicted, factor, bounds)
            if not update.truncated or length == 0 or bounds.edge <= OUTLIER_EDGE:
                break
            # The observation is where the prediction was cut off; so wide a grid leaves rounding, which no substep makes smaller.
            bounds, allowed = bounds._replace(edge=max(bounds.edge**2, OUTLIER_EDGE)), 10 * self.tolerance
        kept = state.kept if factor is None and after.age else self._kept(begin, predicted, update.field)
        new, info = self._reported(state, update, report, after, constant, kept, found)
        health = dict(info.health)
        if self.system.general:
            lawless = False if factor is None else np.isnan(factor(predicted.grid).real).reshape(predicted.grid.sizes)
            health["without_law"] = float(np.sum(predicted.values.real, where=lawless) / predicted.values.real.sum())
        if self.system.tables:
            stop = float(self.schedule.stops[k])
            beyond = self.system.outside(update.field.grid.points, stop, self.theta, observations.inputs_at(stop))
            health["outside_tables"] = float(new.values.real.reshape(-1)[beyond].sum() / new.values.real.sum())
        return new, info._replace(health=health)

    def _predicted(
        self, begin: Field, parts: list[tuple[float, float]], inside: Array, rates: Array, control: Control, allowed: float,
        bounds: Bounds,
    ) -> tuple[Field, Report, Control]:
        """Return the density at the end of an interval, advanced over its parts one after the other."""
        cache = self.moves if not self.system.drift_varies and not is_complex(self.theta) else None
        result, report = begin, NOTHING
        for start, length in parts:
            observations = self.observations.over(start, length)
            if self.schedule.inputs is not None:
                control = Control(np.inf, 0.0, 0)  # other inputs make another error
            potential = observations.potential(inside, rates * length, start, length) if inside.any() and length > 0 else None
            least = 1
            if self.system.varies and length > 0:
                mean, cov = moments_of(result.values.real, result.grid, bounds.periodic)
                points = mean + np.concatenate([np.zeros((1, len(mean))), np.diag(np.sqrt(np.diagonal(cov)))])
                least = observations.least(points, start, length, inside)
            stepper = Stepper(observations.dynamics, bounds, self.tolerance, cache)
            result, more, control = advance(stepper, result, start, length, potential, control, allowed / len(parts), least)
            unresolved = least >= MOST_PANELS
            if self.system.state_dependent:
                valid = valid_noise(observations.system.covariance(result.grid.points, start + length, self.theta))
                invalid = np.sum(result.values.real, where=~valid.reshape(result.grid.sizes)) / result.values.real.sum()
                unresolved = unresolved or float(invalid) > 1e-2 * self.tolerance
            if unresolved:
                more = more._replace(splitting=max(more.splitting, 1.0))
            report = report.worst(more)
        return result, report, control

    def _short(
        self, begin: Field, control: Control, allowed: float, length: float, potential: Any
    ) -> tuple[Field, Report, Control, Survey] | None:
        """Return the prediction of a short interval in which the grid can stay, and its survey, or None.

        What is prepared depends on the grid and the length alone; whether an interval is short depends on the state and on the
        interval.
        """
        made, grid = control.rate * length**3, begin.grid
        if self.system.varies or self.system.state_dependent or length == 0 or control.age == 0:
            return None
        if not (control.known(length, allowed) and made <= allowed):
            return None
        dynamics = self.observations.dynamics
        unit = np.ceil(np.log2(length))
        key = (grid.centre.tobytes(), grid.basis.tobytes(), grid.sizes, unit)
        kept = self.motions.get(key)
        if kept is None:
            rate = rate_of(dynamics, grid)
            kept = (motion(dynamics, grid, length) if rate * length <= PLAIN else None, rate)
            if len(self.motions) >= MOST_TABLES:
                self.motions.clear()
            if not is_complex(self.theta):
                self.motions[key] = kept
        moved, rate = kept
        G = dynamics.noise(0.0, length)[0]
        if moved is None or rate * length > PLAIN:
            return None
        made += splitting_error(grid, length, rate, G)
        if made > allowed:
            return None
        top: Any = 0.0
        factors = None
        if potential is not None:
            b = potential(grid, 0.0, length, True)
            top = float(np.max(b.log.real, where=begin.values.real > 1e-14 * begin.values.real.max(), initial=-1e300))
            outer = np.exp(np.where(b.log.real - top > 30.0, 30.0, b.log - top) / 6)
            factors = outer, outer * outer * np.exp(b.correction)
        values = short_step(begin.values, grid, moved, length, G, factors)
        result = Field(values, grid, top)
        found = survey(values, grid, self.bounds.edge)
        report = grid_report(found, values.real)
        if not (report.edges <= 3 * self.bounds.edge and report.tails <= self.bounds.accepted):
            return None
        return positive(result), report._replace(splitting=made), control._replace(age=control.age + 1), found

    def _reported(
        self, state: State, update: Update, report: Report, control: Control, constant: Any, kept: float, found: Survey | None
    ) -> tuple[State, Info]:
        result = positive(update.field) if found is None else update.field
        mean, cov = moments_of(result.values.real, result.grid, self.angles, found)
        gained = result.log_mass + constant
        edge, tails = max(report.edges, update.edges), max(report.tails, update.tails)
        made = (report.splitting + report.interpolation) * (1 + update.depth) + 1e-15 * np.exp(min(update.depth, 40.0))
        made = made + self.bounds.reach**2 * edge * 0.1 + tails
        left = kept * state.error
        error = float(np.sqrt(left**2 + 2 * ALIKE * left * made + made**2))
        if update.truncated or not np.isfinite(gained):
            error = max(error, 1.0)
        health = {
            "error_estimate": error,
            "tolerance_ratio": float(max(error / self.tolerance, edge / (100 * self.bounds.edge), tails / self.tolerance)),
            "splitting_error": report.splitting,
            "tail_depth": float(update.depth) / ACCURATE_DEPTH,
            "edge_mass": edge,
            "negative_mass": report.negative,
            "std_in_spacings": float(deviations_in_spacings(np.array(tails))),
        }
        # The error of a substep grows steeply with the deviations.
        deviations = np.sqrt(np.maximum(np.diagonal(cov).real, 0.0))
        measured = deviations if control.age == 0 else state.deviations
        if np.any((deviations > WIDER * measured) | (deviations < measured / WIDER**3)):
            control = control._replace(age=CHECKED)
        return self._state(result, control, measured, min(error, 1e3), kept), Info(gained, mean, cov, health)

    def _state(self, found: Field, control: Control, deviations: Array, error: float, kept: float) -> State:
        values = found.values / (found.values.sum() * abs(np.linalg.det(found.grid.basis)))
        return State(
            values, found.grid.centre, found.grid.basis, float(control.rate), float(control.measured), int(control.age),
            deviations, float(error), float(kept),
        )  # fmt: skip

    def _kept(self, begin: Field, predicted: Field, result: Field) -> float:
        """Return the share of an error of the mean, in deviations, that an interval leaves."""
        before, between, after = (
            max(float(np.linalg.det(survey(f.values, f.grid).cov)), 1e-300) for f in (begin, predicted, result)
        )
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
    n = model.n
    if n > 4:
        raise InputError(f"{model.source}: a density grid is for at most four states, and there are {n}")
    periodic = tuple(name in model.periodic for name in model.state)
    bounds = Bounds(1e-3 * tolerance, 1e-5 * tolerance, min(tolerance**2, 1e-3 * tolerance), MOST[n], periodic)
    system, theta = system_of(model), np.asarray(theta)
    tables, moves, motions = ({}, {}, {}) if is_complex(theta) else system.caches(theta)
    observations = Observations(model, schedule, system, theta, tables)
    return Prepared(model, schedule, theta, system, tolerance, bounds, observations, (), moves, motions)
