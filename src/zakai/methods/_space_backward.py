"""The backward pass for two to four states: what the observations after t say of the state at t, on a grid.

The message b = psi / g moves as `_space_reversed` says, by the steps of the filter, on grids that follow psi.  The smoothed
density is the filter's density times psi / g.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from zakai.densities.grid import GridDensity
from zakai.errors import InputError
from zakai.methods import _space_kolmogorov as base
from zakai.methods._protocol import Backward, Info
from zakai.methods._space import State
from zakai.methods._space_cross import CrossSystem, cross_formulas, potential_of
from zakai.methods._space_observed import MOST_PANELS
from zakai.methods._space_reversed import Gauge, Path, Reversed, ReversedStepper, gauge_of, path_of
from zakai.methods._space_short import motion_of, predicted_on
from zakai.methods._space_system import moments_of
from zakai.numerics.space_advance import Control, advance
from zakai.numerics.space_field import NOTHING, Field, Report, positive
from zakai.numerics.space_fixed import fits, refitted
from zakai.numerics.space_grid import Grid, filtered, rounded_size
from zakai.numerics.space_spline import gather, relative_index, resampled
from zakai.numerics.space_update import Update, updated
from zakai.numerics.space_window import Bounds, fitted_grid

Array = Any
SPARE = 10.0  # by how much psi may grow at the ends of its grid when g changes
FINEST = 1e-4  # tolerance to which a method that is more accurate than splines is smoothed
FIGURES = (
    "error_estimate", "tolerance_ratio", "splitting_error", "tail_depth", "edge_mass", "negative_mass", "std_in_spacings",
)  # fmt: skip
COARSE = 2.0  # spacings of the message's grid in one of the filter's, above which that is refined
SUMMED = 1e-3  # tail of the spectrum of a product of which sums are wanted; their error is its fourth power
NOISE = 1e-9  # values of an interpolated psi, relative to its maximum, that may be rounding


class Message(NamedTuple):
    """b = psi / g, with psi a `field`.

    The control of substeps, the estimate of the relative error, and what the grids since the last time showed.
    """

    field: Field
    gauge: Gauge
    control: Control
    error: float
    report: Report

    @property
    def lost(self) -> bool:
        """Whether nothing is left of psi."""
        return not (np.isfinite(self.field.values).all() and self.field.values.max() > 0)

    def log(self, periodic: tuple[bool, ...]) -> Callable[[Grid], Array]:
        """Return log b (J,), but for the scale, as a function of a grid; it is -inf where psi is rounding."""
        values, own = self.field.values, self.field.grid
        coefficients = filtered(values, np.zeros((own.n, own.n)), spline=True)
        least = NOISE * values.max()

        def log(grid: Grid) -> Array:
            found = gather(coefficients, relative_index(grid, own, periodic), own)
            known = found > least
            return np.where(known, np.log(np.where(known, found, 1.0)) - self.gauge.log(grid.points), -np.inf)

        return log


@lru_cache(maxsize=8)
def _general(prepared: base.Prepared) -> base.Prepared:
    """Return what the Kolmogorov equation needs, for any method on these grids."""
    if type(prepared) is not base.Prepared:
        prepared = base.prepare(prepared.model, prepared.schedule, prepared.theta, tolerance=max(prepared.tolerance, FINEST))
    return replace(prepared, bounds=prepared.bounds._replace(edge=prepared.bounds.edge / SPARE))


def _moments(general: base.Prepared, own: Field) -> tuple[Array, Array]:
    return moments_of(own.values.real, own.grid, general.bounds.periodic)


def message(prepared: base.Prepared, state: State) -> Message:
    """Return the message one at the last time.

    Raises:
        InputError: splitting="lie", whose filter solves another equation, or cross_noise with a diffusion that depends on x.
    """
    if prepared.correlated and cross_formulas(prepared.model).state_dependent:
        raise InputError(
            f"{prepared.model.source}: smooth: several states have no backward pass with cross_noise and a diffusion that "
            "depends on the state; take one of them out"
        )
    if prepared.lie:
        source = prepared.model.source
        raise InputError(f'{source}: smooth: splitting="lie" has no backward pass for several states; take "strang"')
    general, own, n = _general(prepared), prepared.density(state), prepared.model.n
    gauge = gauge_of(*_moments(general, own), general.bounds.periodic)
    grid = fitted_grid(np.zeros((1, n)), np.zeros(1), gauge.mean, gauge.cov, np.ones(n), general.bounds, own.grid)
    psi = np.exp(gauge.log(grid.points)).reshape(grid.sizes)
    return Message(Field(psi, grid, 0.0), gauge, Control(np.inf, 0.0, 0), 0.0, NOTHING)


def _product(prepared: base.Prepared, state: State, later: Message, tail: float) -> Update:
    """Return the filter's density times the message, on a grid that leaves a tail of the spectrum."""
    bounds = _general(prepared).bounds
    bounds, own = bounds._replace(tail=max(bounds.tail, tail)), prepared.density(state)
    own = _refined(Field(own.values.real, own.grid, own.log_scale), later.field.grid, bounds)
    tails = float(own.survey(bounds).tails.max())
    return updated(own, later.log(bounds.periodic), bounds, tails)


def _refined(own: Field, other: Grid, bounds: Bounds) -> Field:
    """Return a density, on a grid as fine as another one and not wider where its own has far larger spacings."""
    grid, circle = own.grid, np.array(own.grid.closed)
    ratios = np.where(circle, 1.0, np.maximum(np.abs(other.inverse @ grid.basis).max(axis=0), 1.0))
    if ratios.max() <= COARSE:
        return own
    half = 0.5 * np.array(grid.sizes)
    apart = other.centre - grid.centre
    apart = np.where(bounds.periodic, (apart + np.pi) % (2 * np.pi) - np.pi, apart)
    middle = grid.inverse @ apart
    reach = 0.5 * np.abs(grid.inverse @ other.basis) @ np.array(other.sizes) + 1.0
    low, high = np.maximum(middle - reach, -half), np.minimum(middle + reach, half)
    whole = circle | np.array(bounds.periodic) | (high <= low)
    low, high = np.where(whole, -half, low), np.where(whole, half, high)
    sizes = tuple(
        size if closed else rounded_size((b - a) * ratio, 8, 2 * bounds.most)
        for size, closed, a, b, ratio in zip(grid.sizes, grid.closed, low, high, ratios, strict=True)
    )
    finer = Grid(grid.centre + grid.basis @ (0.5 * (low + high)), grid.basis * ((high - low) / sizes), sizes, grid.closed)
    return Field(resampled(own.values, grid, finer, bounds.periodic), finer, own.log_scale)


def smoothed(prepared: base.Prepared, state: State, later: Message) -> tuple[Message, Info]:
    """Return the message, normalised so that its product with the state has mass one, and the report of the product."""
    if later.lost:
        nothing = np.full((prepared.model.n,) * 2, np.nan)
        return later, Info(np.nan, nothing[0], nothing, dict.fromkeys(FIGURES, np.inf))
    update, bounds = _product(prepared, state, later, SUMMED), _general(prepared).bounds
    found = positive(update.field, bounds)
    mean, cov = moments_of(found.values, found.grid, prepared.angles)
    log_mass = float(np.log(found.values.sum() * found.grid.cell) + found.log_scale + later.field.log_scale)
    edge, tails = max(update.edges, later.report.edges), max(update.tails**4, later.report.tails)
    tolerance = _general(prepared).tolerance
    error = 1.0 if update.truncated or not np.isfinite(log_mass) else later.error
    spacings = np.sqrt(np.maximum(np.diagonal(found.grid.inverse @ cov @ found.grid.inverse.T), 0.0))
    figures = (
        float(state.error) + error,
        float(max(error / tolerance, edge / (100 * SPARE * bounds.edge), tails / tolerance)),
        later.report.splitting,
        update.depth / base.ACCURATE_DEPTH,
        edge,
        later.report.negative,
        float(spacings.min()),
    )
    health = dict(zip(FIGURES, figures, strict=True))
    kept = later.field._replace(log_scale=later.field.log_scale - log_mass)
    return later._replace(field=kept), Info(log_mass, mean, cov, health)


def step(prepared: base.Prepared, k: int, later: Message, values: np.ndarray, state: State) -> Message:
    """Return the message at the start of interval k from that at its end; `state` is the filter's at the start."""
    if later.lost:
        return later
    general = _general(prepared)
    observations, bounds = general.observations, general.bounds
    factor, constant = observations.factor(k, observations.inside[k], values)
    update, tails = Update(later.field, 0.0, 0.0, 0.0, False), later.report.tails
    if factor is not None:
        update = updated(later.field, factor, bounds, tails)
    now = positive(update.field, bounds)
    now = now._replace(log_scale=now.log_scale + float(np.real(constant)))
    gauge, control, report = later.gauge, later.control, NOTHING
    if observations.lengths[k] > 0:
        path = path_of(observations, k, *_moments(general, prepared.density(state)), bounds.periodic, gauge)
        if path.begin is not gauge:
            other = _regauged(now, gauge, path.begin, bounds, tails)
            if other is not None:
                now, path = other, path._replace(end=path.begin)
        try:
            now, report, control = _moved(general, k, now, values, path, control, general.allowed(state))
        except (ValueError, np.linalg.LinAlgError):  # of a psi that is zero or not finite
            now = now._replace(values=np.zeros_like(now.values))
        gauge = path.begin
    # As for the filter: what is new, and what the interval leaves of the last error.
    made = report.splitting + report.interpolation + bounds.reach**2 * max(report.edges, update.edges) * 0.1
    made, left = made + max(report.tails, update.tails) + float(update.truncated), state.kept * later.error
    error = float(np.sqrt(left**2 + 2 * base.ALIKE * left * made + made**2))
    return Message(now, gauge, control, error, report)


def _regauged(now: Field, old: Gauge, new: Gauge, bounds: Bounds, tails: float) -> Field | None:
    """Return psi with another g; None where it would not decrease to the ends of its grid, beyond which it is unknown."""
    values, grid = now.values, now.grid
    logs = (new.log(grid.points) - old.log(grid.points)).reshape(grid.sizes)
    with np.errstate(divide="ignore"):
        logs = logs + np.log(values)
    top, inner = float(logs.max()), tuple(slice(None) if closed else slice(1, -1) for closed in grid.closed)
    border = np.ones(grid.sizes, bool)
    border[inner] = False
    if logs.max(where=border, initial=-np.inf) - top > np.log(SPARE * bounds.edge):
        return None
    return updated(now, lambda one: new.log(one.points) - old.log(one.points), bounds, tails).field


def _moved(
    general: base.Prepared, k: int, now: Field, values: Array, path: Path, control: Control, allowed: float
) -> tuple[Field, Report, Control]:
    """Return psi at the start of interval k."""
    observations, report = general.observations, NOTHING
    inside, rates = observations.inside[k], values / max(float(observations.lengths[k]), 1e-300)
    parts = observations.parts(k)
    for start, length in reversed(parts):
        if length == 0:
            continue
        part, ahead = observations.over(start, length), None
        if inside.any() and general.correlated:
            part = replace(part, system=CrossSystem(part, inside, rates, start, start + length))
            ahead = potential_of(part, start, length)
        elif inside.any():
            ahead = part.potential(inside, rates * length, start, length)
        backward, system = Reversed(part, path), part.system
        if len(parts) == 1 and path.begin is path.end and not (system.varies or system.state_dependent or general.correlated):
            view: Any = replace(general, observations=backward, motions=path.end.motions)  # type: ignore[arg-type]
            quick = _stayed(view, now, control, allowed, length, ahead)
            if quick is not None:
                return quick
        least = path.substeps
        if system.varies:
            mean, cov = _moments(general, now)
            points = mean + np.concatenate([np.zeros((1, len(mean))), np.diag(np.sqrt(np.diagonal(cov)))])
            least = max(least, part.least(points, start, length, inside))
        if len(parts) > 1 or general.correlated:
            control = Control(np.inf, 0.0, 0)
        stepper, potential = ReversedStepper(backward, general.bounds, general.tolerance), backward.potential(ahead)
        now, more, control = advance(stepper, now, -start - length, length, potential, control, allowed / len(parts), least)
        if least >= MOST_PANELS:
            more = more._replace(splitting=max(more.splitting, 1.0))
        report = report.worst(more)
    return positive(now, general.bounds), report, control


def _stayed(
    view: base.Prepared, now: Field, control: Control, allowed: float, length: float, potential: Any
) -> tuple[Field, Report, Control] | None:
    """Return psi after a short interval on a grid that stays, where it can."""
    bounds = view.bounds
    if bounds.periodic != now.grid.closed or motion_of(view, now.grid, length).longest < length:
        return None
    quick = predicted_on(view, now, control, allowed, length, potential)
    if quick is None:  # a grid with a margin may do
        quick = predicted_on(view, positive(refitted(now, bounds), bounds), control, allowed, length, potential)
    if quick is None:
        return None
    result, report, control, found = quick
    return result if fits(found, result.grid, bounds) else positive(refitted(result, bounds), bounds), report, control


def density(prepared: base.Prepared, state: State, later: Message) -> GridDensity:
    """Return the smoothed density."""
    found = positive(_product(prepared, state, later, 0.0).field, _general(prepared).bounds)
    with np.errstate(divide="ignore"):
        logs = np.log(found.values)
    return GridDensity(logs, found.grid.centre, found.grid.basis, prepared.model.state, prepared.angles)


def accuracy(prepared: base.Prepared) -> float:
    """Return the error of the evidence of an interval that the tolerance allows."""
    return max(_general(prepared).tolerance, 1e-6)


BACKWARD: Backward[Any, State, Message] = Backward(message, step, smoothed, density, accuracy=accuracy)
