"""`limited-direct` in two and three states: the transition of a time-varying Yau system is Gaussian in the gauge u = e^phi v.

    v(t1, c1 + A xi) = exp(kappa + tilt.xi + xi'B xi) (N(0, Sigma) * v(t0, c0 + .))(xi)

The density is kept on an affine grid that A moves: spreading is exact in frequency, the rest is pointwise.  Increments of a
nonlinear h whose energy is quadratic act in substeps around the transition, extrapolated until the tolerance is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from zakai.methods._options import tolerance_of
from zakai.methods._protocol import Info
from zakai.methods.gaussian.affine_system import precision_of
from zakai.methods.space import kolmogorov as base
from zakai.methods.space.filter import State
from zakai.methods.space.flow import Stepper, regridded
from zakai.methods.space.observed import Observations
from zakai.methods.space.system import grid_of, moments_of, prior_on_grid, system_of
from zakai.methods.yau.kernel import PowerSeries
from zakai.methods.yau.system import YauSystem, power_series_of, yau_of
from zakai.models.model import Model
from zakai.models.prior import DensityPrior
from zakai.numerics.complex_step import is_complex
from zakai.numerics.space.advance import Control, advance
from zakai.numerics.space.field import Field, positive
from zakai.numerics.space.grid import Grid
from zakai.numerics.space.unrolled import MOST as MOST_WIDE
from zakai.numerics.space.unrolled import folded, opened, widths, wrapped
from zakai.numerics.space.update import Update, updated
from zakai.numerics.space.window import MOST, Bounds
from zakai.records.schedule import Schedule

Array = Any
DEFAULT_TOLERANCE = 1e-5  # of the splitting of increments of a nonlinear h
EDGE, TAIL = 1e-12, 1e-12


@dataclass(frozen=True, eq=False)
class Prepared(base.Prepared):
    """A model, a schedule and parameters, with the equation of its gauge."""

    yau: YauSystem = field(default=None)  # type: ignore[assignment]
    series: PowerSeries | None = None

    def init(self, prior: Any) -> State:
        """Return the prior on a grid; an angle with a Gaussian or a mixture is not wrapped."""
        tolerance = min(self.bounds.edge, self.bounds.tail)
        periodic = self.angles if isinstance(prior, DensityPrior) else self.bounds.periodic
        found = prior_on_grid(self.model, prior, self.theta, tolerance, periodic)
        values = np.exp(found.log_values - np.max(found.log_values.real))
        values, grid = opened(values, Grid(found.centre, found.basis, values.shape, found.closed))
        error = found.error if found.error > 1e-6 else 0.0
        return self.started(positive(self._folded(Field(values, grid, 0.0)), self.bounds), error)

    def density(self, state: State) -> Field:
        """Return the posterior on a grid, folded onto the circle where it is wide."""
        field = super().density(state)
        if not any(self.angles) or not np.any(widths(field.grid)[np.array(self.angles)] > 2 * np.pi):
            return field
        return Field(*wrapped(field.values, field.grid, self.angles), field.log_scale)

    def _folded(self, source: Field) -> Field:
        """Return a density on the line that spreads over at most three turns in an angle, and one peak only once."""
        if not any(self.angles):
            return source
        angle = np.array(self.angles)
        width = widths(source.grid)[angle]
        mean, cov = moments_of(source.values.real, source.grid, self.angles)
        deviation = np.sqrt(np.diagonal(cov)[angle])
        narrow = bool(np.all(self.bounds.reach * deviation < 0.8 * np.pi))
        if not np.any(width > (2 * np.pi if narrow else MOST_WIDE)):
            return source
        values, grid = folded(source.values, source.grid, self.angles, mean, narrow)
        return Field(values, grid, source.log_scale)

    def step(self, k: int, state: State, values: np.ndarray) -> tuple[State, Info]:
        """Return the state after interval k and its observation, and what the step reports."""
        self.check_escape(k, state)
        schedule, yau, bounds = self.schedule, self.yau, self.bounds
        begin, observations = Field(state.values, grid_of(state, bounds.periodic), 0.0), self.observations
        start, length = float(schedule.starts[k]), float(observations.lengths[k])
        inside = observations.inside[k]
        linear = yau.affine and not self.lie and self.series is None  # the series has no inputs
        full = (bool(inside.all()) and not linear and yau.full) or not yau.unobserved
        inputs = np.ones(1)
        potential, extra = None, None
        if linear and inside.any() and length > 0:
            inputs = np.concatenate([inputs, np.where(inside, values, 0.0) / length])
        elif self.lie and inside.any():
            extra = self._whole(k, inside, values, full)
        elif length > 0 and (inside.any() or full):
            potential = self._remaining(inside, values, start, length, full)
        acting = inside if linear else np.zeros(self.model.m, bool)
        stepper = Stepper(yau, self.theta, bounds, begin.grid.centre, acting, inputs, full, self.series)
        control = Control(state.rate, state.measured, state.age) if potential is not None else Control(0.0, np.inf, 0)
        allowed = self.allowed(state)
        predicted, report, after = advance(stepper, begin, start, length, potential, control, allowed)  # type: ignore[arg-type]
        factor, constant = observations.factor(k, inside, values)
        factors = [one for one in (factor, extra) if one is not None]
        update = Update(predicted, report.edges, report.tails, 0.0, False)
        if factors:
            update = updated(predicted, lambda grid: sum(one(grid) for one in factors), bounds, report.tails)
        update = update._replace(field=regridded(self._folded(update.field), bounds, stepper.lifted))
        if potential is None:
            after = Control(state.rate, state.measured, state.age)
        noise = 1e-15 * float(np.exp(min(stepper.exponent, 50.0))) + max(stepper.error, 0.0)
        noise += 0.1 * bounds.reach**2 * min(stepper.rounding, 1.0)
        report = report._replace(interpolation=noise)
        kept = self._kept(begin, predicted, update.field)
        new, info = self._reported(state, update, report, after, constant, kept, None)
        health = {**info.health, "gauge_exponent": stepper.exponent}
        return new, info._replace(health=health)

    def _whole(self, k: int, inside: Array, values: Array, full: bool) -> Any:
        """Return the factor exp(h'S^-1 dy) at the end; with -h'S^-1 h dt / 2 where the transition does not hold it."""
        stop, length = float(self.schedule.stops[k]), float(self.observations.lengths[k])
        S = self.system.noise(np.zeros(self.model.n), stop, self.theta)
        precision = precision_of(S[None], inside[None])[0]

        def log_factor(grid: Grid) -> Array:
            h = self.observations.observed(grid, stop)
            energy = 0.0 if full and inside.all() else 0.5 * length
            return (h * ((values - energy * h) @ precision)).sum(axis=1)

        return log_factor

    def _remaining(self, inside: Array, values: Array, start: float, length: float, full: bool) -> Any:
        """Return the factor of what the transition does not hold: rates, and the energy where it is not that of `inside`."""
        whole = np.ones(self.model.m, bool)
        acting = self.observations.potential(inside, values, start, length) if inside.any() else None
        energy = self.observations.potential(whole, np.zeros(self.model.m), start, length) if full else None

        def potential(grid: Grid, a: float, b: float, end: bool) -> Any:
            first = None if acting is None else acting(grid, a, b, end)
            if energy is None:
                return first
            held = energy(grid, a, b, end)
            log = -held.log if first is None else first.log - held.log
            return held._replace(log=log)

        return potential


def prepare(
    model: Model,
    schedule: Schedule,
    theta: np.ndarray,
    *,
    splitting: str = "strang",
    tolerance: float | None = None,
    kernel: str = "flow",
    **_: Any,
) -> base.Prepared:
    """Return what is known without data."""
    tolerance = tolerance_of(tolerance, DEFAULT_TOLERANCE)
    bounds = Bounds(EDGE, TAIL, MOST[model.n], (False,) * model.n, band_limited=True)
    theta = np.asarray(theta)
    yau = yau_of(model)
    series = power_series_of(model) if kernel == "power-series" else None
    lie = splitting == "lie"
    system = system_of(model)
    observations = Observations(model, schedule, system, theta, {} if is_complex(theta) else system.caches(theta)[0])
    return Prepared(model, schedule, theta, system, tolerance, bounds, observations, lie=lie, yau=yau, series=series)
