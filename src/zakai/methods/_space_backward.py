"""The backward pass for two to four states: what the observations after t say of the state at t, on a grid.

    b(x) = p(observations after t | x),      -b_t = f . grad b + G : Hess b / 2 + V b

It goes back through the substeps of the filter by their adjoints, on grids of the product of b with the filter's density, which
is the smoothed density.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from zakai.densities.grid import GridDensity
from zakai.errors import InputError
from zakai.methods import _space_kolmogorov as base
from zakai.methods._protocol import Backward, Info
from zakai.methods._space import State
from zakai.methods._space_short import predicted_on
from zakai.methods._space_system import moments_of
from zakai.numerics.space_adjoint import interpolated, pulled_back
from zakai.numerics.space_advance import Control
from zakai.numerics.space_field import NOTHING, Field, Report, extrapolated, grid_report, positive
from zakai.numerics.space_grid import Grid, rounded_size
from zakai.numerics.space_step import Stepper, Substep
from zakai.numerics.space_transport import Dynamics
from zakai.numerics.space_update import Update, updated
from zakai.numerics.space_window import LEAST, Bounds

Array = Any
FINEST = 1e-4  # tolerance to which a method that is more accurate than splines is smoothed
TAIL = 2 / 3  # power of the bound on tails of a density for those of a product with the message, which is smoother
SMOOTHER = 1 / 8  # error of the interpolation of a message as wide as a density, to that of their product
SPARE = 2  # points of a grid beyond those that a product uses
HIGHEST = 25.0  # nats by which the message may be above its value where the product is largest
FIGURES = (
    "error_estimate", "tolerance_ratio", "splitting_error", "tail_depth", "edge_mass", "negative_mass", "std_in_spacings",
)  # fmt: skip


class Message(NamedTuple):
    """b, a `function` on the grid of its `product` with the filter's density at the same time.

    The estimate of its relative error, and what the grids since the last time showed.
    """

    function: Field
    product: Update
    error: float
    report: Report


@lru_cache(maxsize=8)
def _general(prepared: base.Prepared) -> base.Prepared:
    """Return what the Kolmogorov equation needs, for any method on these grids."""
    if type(prepared) is base.Prepared:
        return prepared
    return base.prepare(prepared.model, prepared.schedule, prepared.theta, tolerance=max(prepared.tolerance, FINEST))


def message(prepared: base.Prepared, state: State) -> Message:
    """Return the message one at the last time.

    Raises:
        InputError: splitting="lie", whose filter solves another equation.
    """
    if prepared.lie:
        source = prepared.model.source
        raise InputError(f'{source}: smooth: splitting="lie" has no backward pass for several states; take "strang"')
    density = _density(prepared, state)
    product = Update(density, 0.0, 0.0, 0.0, False)
    return Message(density._replace(values=np.ones(density.grid.sizes)), product, 0.0, NOTHING)


def _density(prepared: base.Prepared, state: State) -> Field:
    found = prepared.density(state)
    return positive(found._replace(values=found.values.real), _general(prepared).bounds)


def smoothed(prepared: base.Prepared, state: State, later: Message) -> tuple[Message, Info]:
    """Return the message, normalised so that its product with the state has mass one, and the report of the product."""
    general, update = _general(prepared), later.product
    found, bounds, tolerance = update.field, general.bounds, general.tolerance
    with np.errstate(all="ignore"):
        mean, cov = moments_of(found.values, found.grid, prepared.angles)
        log_mass = float(found.log_mass)
        spacings = np.sqrt(np.maximum(np.diagonal(found.grid.inverse @ cov @ found.grid.inverse.T), 0.0))
    edge, tails = max(update.edges, later.report.edges), max(update.tails, later.report.tails) ** 4
    error = later.error if np.isfinite(log_mass) else np.inf
    figures = (
        float(state.error) + error,
        float(max(error / tolerance, edge / (100 * bounds.edge), tails / tolerance)),
        later.report.splitting,
        update.depth / base.ACCURATE_DEPTH,
        edge,
        later.report.negative,
        float(spacings.min()),
    )
    kept = later.function._replace(log_scale=later.function.log_scale - log_mass)
    product = update._replace(field=found._replace(log_scale=found.log_scale - log_mass))
    return later._replace(function=kept, product=product), Info(log_mass, mean, cov, dict(zip(FIGURES, figures, strict=True)))


def step(prepared: base.Prepared, k: int, later: Message, values: np.ndarray, state: State) -> Message:
    """Return the message at the start of interval k from that at its end; `state` is the filter's at the start."""
    general, begin = _general(prepared), _density(prepared, state)
    observations, bounds = general.observations, general.bounds._replace(tail=general.bounds.tail**TAIL)
    function, product, report = later.function, later.product, NOTHING
    factor, constant = observations.factor(k, observations.inside[k], values)
    if factor is not None:
        logs = np.log(np.maximum(function.values, 1e-300)) + factor(function.grid).real.reshape(function.grid.sizes)
        function = _rescaled(logs, function.grid, function.log_scale + float(np.real(constant)), product.field)
    if observations.lengths[k] == 0:
        function, product = _back(begin, bounds, function, lambda grid: (interpolated(function, grid, bounds.periodic), 0.0))
    else:
        for dynamics, group in reversed(_substeps(general, k, begin, state, values)):
            function, product, more = _through(dynamics, group, function, bounds)
            report = report.worst(more)
    made = report.splitting + report.interpolation + bounds.reach**2 * report.edges * 0.1 + float(product.truncated)
    left = state.kept * later.error
    error = float(np.sqrt(left**2 + 2 * base.ALIKE * left * made + made**2))
    return Message(function, product, error, report)


def _substeps(
    general: base.Prepared, k: int, begin: Field, state: State, values: Array
) -> list[tuple[Dynamics, tuple[Substep, ...]]]:
    """Return the substeps by which the filter predicts over interval k, the two halves of an extrapolated one together."""
    observations, inside, parts = general.observations, general.observations.inside[k], general.observations.parts(k)
    length, allowed = float(observations.lengths[k]), general.allowed(state)
    if not (general.correlated and inside.any()):
        control = _control(state)
        last = observations.over(*parts[-1])
        potential = last.potential(inside, values, *parts[-1]) if inside.any() else None
        if not (control.fixed and control.known(length, allowed)):
            quick = predicted_on(general, begin, control, allowed, length, potential)
            control = Control(np.inf, 0.0, 0) if quick is None else quick[2]
        if control.fixed:
            stepper = Stepper(observations.dynamics, general.bounds, general.tolerance)
            singles, pairs = control.parts(length, allowed)
            extrapolated = singles > 3 * pairs
            times = np.linspace(0.0, length, 1 + (2 * pairs if extrapolated else singles))
            stepper.equal(begin, times, potential, extrapolated)
            return [(stepper.dynamics, group) for group in stepper.taken]
    steppers: list[Stepper] = []
    rates = values / max(length, 1e-300)
    general.predicted(begin, parts, inside, rates, _control(state), allowed, general.bounds, steppers)
    return [(stepper.dynamics, group) for stepper in steppers for group in stepper.taken]


def _control(state: State) -> Control:
    return Control(state.rate, state.measured, state.age, state.fixed)


def _rescaled(logs: Array, grid: Grid, log_scale: float, product: Field) -> Field:
    """Return a function with these logarithms, one where a product with it is largest, without much larger values elsewhere."""
    logs = np.where(np.isnan(logs), -np.inf, logs)
    top = float(logs.flat[np.argmax(product.values)])
    if not np.isfinite(top):
        top = float(logs.max()) if np.isfinite(logs.max()) else 0.0
    return Field(np.exp(np.minimum(logs - top, HIGHEST)), grid, log_scale + top)


def _back(
    density: Field, bounds: Bounds, function: Field, evaluate: Callable[[Grid], tuple[Array, float]]
) -> tuple[Field, Update]:
    """Return the function that is evaluated on grids, on the grid of its product with a density, and that product."""
    found: list[tuple[Grid, Array]] = []

    def log_factor(grid: Grid) -> Array:
        values, top = evaluate(grid)
        with np.errstate(divide="ignore", invalid="ignore"):
            found.append((grid, np.where(values > 0, np.log(values) + top, -np.inf)))
        return found[-1][1].reshape(-1)

    update = updated(density, log_factor, bounds, 0.0, shrink=False)
    grid, logs = next((grid, logs) for grid, logs in found if grid is update.field.grid)
    product = update.field._replace(log_scale=update.field.log_scale + function.log_scale)
    part, grid = _used(product, bounds)
    product = product._replace(values=np.ascontiguousarray(product.values[part]), grid=grid)
    return _rescaled(logs[part], grid, function.log_scale, product), update._replace(field=product)


def _used(product: Field, bounds: Bounds) -> tuple[tuple[slice, ...], Grid]:
    """Return the part of a grid that a product uses, as slices and as a grid."""
    grid, used, parts, first = product.grid, product.survey(bounds).used.tolist(), [], []
    for d, (low, high) in enumerate(used):
        old = grid.sizes[d]
        size = min(rounded_size(high - low + 1 + 2 * SPARE, LEAST[grid.n], old), old)
        start = 0 if grid.closed[d] or size == old else min(max((low + high - size) // 2, 0), old - size)
        parts.append(slice(start, old if grid.closed[d] else start + size))
        first.append(start)
    sizes = tuple(part.stop - part.start for part in parts)
    shift = np.array(first) + np.array(sizes) // 2 - grid.shape // 2
    return tuple(parts), Grid(grid.centre + grid.basis @ shift, grid.basis, sizes, grid.closed)


def _through(
    dynamics: Dynamics, group: tuple[Substep, ...], later: Field, bounds: Bounds
) -> tuple[Field, Update, Report]:
    """Return the function before a substep, its product with the density there, and the errors."""
    function = later
    for substep in reversed(group):

        def evaluate(grid: Grid, substep: Substep = substep, after: Field = function) -> tuple[Array, float]:
            return pulled_back(
                after, grid, substep.linear, substep.times, substep.steps, dynamics, substep.potential, bounds.periodic
            )

        begin = substep.begin._replace(log_scale=0.0)
        function, product = _back(begin, bounds, function, evaluate)
    difference = 0.0
    if len(group) == 2:
        one, two = group
        times, linear, grid = (one.times[0], two.times[1]), one.linear.then(two.linear), function.grid
        values, top = pulled_back(later, grid, linear, times, 2 * one.steps, dynamics, one.potential, bounds.periodic)
        ratio = later.log_scale + top - function.log_scale
        better, _ = extrapolated(function.values, np.maximum(values, 0.0), ratio)
        share = better / np.where(function.values > 0, function.values, 1.0)
        field = product.field._replace(values=product.field.values * share)
        difference = float(3 * np.abs(field.values - product.field.values).sum() / field.values.sum())
        function, product = function._replace(values=better), product._replace(field=field)
    shown = grid_report(product.field.survey(bounds))
    shown = shown._replace(splitting=difference ** (5 / 3), interpolation=SMOOTHER * shown.interpolation)
    return function, product, shown


def density(prepared: base.Prepared, state: State, later: Message) -> GridDensity:
    """Return the smoothed density."""
    found = later.product.field
    with np.errstate(divide="ignore"):
        logs = np.log(np.maximum(found.values, 0.0))
    return GridDensity(logs, found.grid.centre, found.grid.basis, prepared.model.state, prepared.angles)


def accuracy(prepared: base.Prepared) -> float:
    """Return the error of the evidence of an interval that the tolerance allows."""
    return max(_general(prepared).tolerance, 1e-6)


BACKWARD: Backward[Any, State, Message] = Backward(message, step, smoothed, density, accuracy=accuracy)
