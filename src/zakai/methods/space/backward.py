"""The backward pass for two to four states: what the observations after t say of the state at t, on a grid.

    b(x) = p(observations after t | x),      -b_t = f . grad b + G : Hess b / 2 + V b

It goes back through the substeps of the filter by their adjoints, on grids of the product of b with the filter's density, which
is the smoothed density.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from zakai.densities import Density
from zakai.errors import InputError
from zakai.methods._protocol import Backward, Info
from zakai.methods.space import kolmogorov as base
from zakai.methods.space.cross import cross_formulas
from zakai.methods.space.filter import State
from zakai.methods.space.paths import drawn
from zakai.methods.space.short import predicted_on
from zakai.numerics.space.adjoint import Adjoint
from zakai.numerics.space.advance import Control
from zakai.numerics.space.field import NOTHING, Field, Report, grid_report, positive
from zakai.numerics.space.function import Function, function_of, interpolated
from zakai.numerics.space.grid import Grid, rounded_size
from zakai.numerics.space.step import Stepper, Substep
from zakai.numerics.space.survey import survey
from zakai.numerics.space.transport import Dynamics, Linearisation
from zakai.numerics.space.update import Update, updated
from zakai.numerics.space.window import LEAST, Bounds, Points, fitted_grid

Array = Any
FINEST = 1e-4  # tolerance to which a method that is more accurate than splines is smoothed
TAIL = 2 / 3  # power of the bound on tails of a density for those of a product with the message, which is smoother
SMOOTHER = 1 / 8  # error of the interpolation of a message as wide as a density, to that of their product
TRIES = 3  # of the substeps of an interval
FINER = 2.0  # ratio of spacings above which the axes of a product need not be those of the density
AROUND, SPARE = 3, 2  # points beyond those that a product uses, of a grid for it and of its grid
LARGEST = 0.5  # nats by which extrapolation may change the message
FIGURES = (
    "error_estimate", "tolerance_ratio", "splitting_error", "tail_depth", "edge_mass", "negative_mass", "std_in_spacings",
)  # fmt: skip


class Message(NamedTuple):
    """b, a `function` on the grid of its `product` with the filter's density at the same time.

    The estimate of its relative error, and what the grids since the last time showed.
    """

    function: Function
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
    prepared = prepared.of(state)
    if prepared.lie:
        source = prepared.model.source
        raise InputError(f'{source}: smooth: splitting="lie" has no backward pass for several states; take "strang"')
    density = _density(prepared, state)
    product = Update(density, 0.0, 0.0, 0.0, False)
    one = function_of(np.zeros(density.grid.sizes), density.grid, density.values, False)
    return Message(one, product, 0.0, NOTHING)


def _density(prepared: base.Prepared, state: State) -> Field:
    found = prepared.density(state)
    return positive(found._replace(values=found.values.real), _general(prepared).bounds)


def smoothed(prepared: base.Prepared, state: State, later: Message) -> tuple[Message, Info]:
    """Return the message, normalised so that its product with the state has mass one, and the report of the product."""
    prepared = prepared.of(state)
    general, update = _general(prepared), later.product
    found, bounds, tolerance = update.field, general.bounds, general.tolerance
    with np.errstate(all="ignore"):
        mean, cov, cut = general.moments(found)
        log_mass = float(found.log_mass)
        spread = found.survey(bounds).cov
        spacings = np.sqrt(np.maximum(np.diagonal(found.grid.inverse @ spread @ found.grid.inverse.T), 0.0))
    edge, tails = max(update.edges, later.report.edges, cut), max(update.tails, later.report.tails) ** 4
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
    prepared = prepared.of(state)
    if not state.error < base.LOST:  # of the filter nothing is known here
        return message(prepared, state)._replace(error=1.0)
    general, begin = _general(prepared), _density(prepared, state)
    observations, bounds = general.observations, general.bounds._replace(tail=general.bounds.tail**TAIL)
    function, product, report = later.function, later.product, NOTHING
    tilted = not observations.system.state_dependent
    tilted = tilted and not (general.correlated and cross_formulas(general.model).state_dependent)
    factor, constant = observations.factor(k, observations.inside[k], values)
    if factor is not None:
        logs = function.logs() + factor(function.grid).real.reshape(function.grid.sizes) + float(np.real(constant))
        function = function_of(logs, function.grid, product.field.values, tilted)
    if observations.lengths[k] == 0:
        before = partial(interpolated, function, periodic=bounds.periodic)
        function, product = _back(begin, bounds, tilted, before, before)
    else:
        control = _control(prepared, state)
        ahead, bound, fewest = function, base.SHARE * general.tolerance, 1
        for _ in range(TRIES if later.error < base.LOST else 1):
            function, report = ahead, NOTHING
            for stepper, group in reversed(_substeps(general, k, begin, control, values, general.allowed(state), fewest)):
                function, product, more = _through(stepper.dynamics, group, function, bounds)
                report = report.worst(more)
            if not bound < report.splitting < np.inf:
                break
            # The message may be sharper than the density.
            fewest = fewest * math.ceil((report.splitting / bound) ** 0.25)
    made = report.splitting + report.interpolation + bounds.reach**2 * report.edges * 0.1 + float(product.truncated)
    left = state.kept * later.error
    error = float(np.sqrt(left**2 + 2 * base.ALIKE * left * made + made**2))
    return Message(function, product, error, report)


def _control(prepared: base.Prepared, state: State) -> Control:
    """Return the error of a substep that the filter measured; one of another method measured that of another splitting."""
    if _general(prepared) is not prepared:
        return Control(np.inf, 0.0, 0)
    return Control(state.rate, state.measured, state.age, state.fixed)


def _substeps(
    general: base.Prepared, k: int, begin: Field, control: Control, values: Array, allowed: float, fewest: int
) -> list[tuple[Stepper, tuple[Substep, ...]]]:
    """Return the substeps by which the filter predicts over interval k, the two halves of an extrapolated one together.

    If more than one, at least `fewest` extrapolated ones are taken.
    """
    observations, inside, parts = general.observations, general.observations.inside[k], general.observations.parts(k)
    length = float(observations.lengths[k])
    if not (general.correlated and inside.any()):
        last = observations.over(*parts[-1])
        potential = last.potential(inside, values, *parts[-1]) if inside.any() else None
        quick = predicted_on(general, begin, control, allowed, length, potential)
        if quick is not None:
            fixed = quick[2]
            stepper = Stepper(observations.dynamics, general.bounds, general.tolerance)
            singles, pairs = fixed.parts(length, allowed)
            extrapolated, pairs = singles > 3 * pairs or fewest > 1, max(pairs, fewest)
            times = np.linspace(0.0, length, 1 + (2 * pairs if extrapolated else singles))
            stepper.equal(begin, times, potential, extrapolated)
            return [(stepper, group) for group in stepper.taken]
    steppers: list[Stepper] = []
    increments = base.Increments(inside, values / max(length, 1e-300))
    general.predicted(begin, parts, increments, control, allowed, general.bounds, steppers, fewest)
    return [(stepper, group) for stepper in steppers for group in stepper.taken]


def _back(
    density: Field, bounds: Bounds, tilted: bool, evaluate: Callable[[Grid], Array], rough: Callable[[Grid], Array]
) -> tuple[Function, Update]:
    """Return the function whose logarithm is evaluated on grids, on that of its product with a density, and that product.

    `rough` evaluates it approximately, on every second point along each axis, which shows where the product is.
    """
    found: list[tuple[Grid, Array]] = []

    def log_factor(grid: Grid) -> Array:
        found.append((grid, evaluate(grid)))
        return found[-1][1].reshape(-1)

    update = updated(density, log_factor, bounds, 0.0, _start(density, bounds, rough))
    grid, logs = next((grid, logs) for grid, logs in found if grid is update.field.grid)
    used, grid = _used(update.field, bounds)
    product = update.field._replace(values=np.ascontiguousarray(update.field.values[used]), grid=grid)
    return function_of(logs[used], grid, product.values, tilted), update._replace(field=product)


def _start(density: Field, bounds: Bounds, rough: Callable[[Grid], Array]) -> Grid:
    """Return a grid for the product of a density with a function: a part of that of the density, or a finer one."""
    grid = density.grid
    values = density.values[tuple(slice(size // 2 % 2, None, 2) for size in grid.sizes)]
    coarse = Grid(grid.centre, 2 * grid.basis, values.shape, grid.closed)
    with np.errstate(divide="ignore"):
        levels = np.log(values) + rough(coarse)
    if not np.isfinite(levels.max()):
        return grid
    levels -= levels.max()
    found = survey(np.exp(levels), coarse, bounds.edge)
    finer = np.where(grid.circles, 1.0, np.maximum(bounds.spacings / (2 * found.conditional), 1.0))
    if finer.max() > FINER:
        noise, narrow = 0.25 * grid.basis @ grid.basis.T, np.ones(grid.n)
        least = float(np.log(bounds.edge))
        return fitted_grid(Points(coarse.offsets, levels.reshape(-1), grid.centre, least), noise, narrow, bounds, grid)
    low, high = 2 * (found.used.T - coarse.shape // 2) + np.array([[-AROUND], [AROUND]])
    sizes = tuple(
        rounded_size((b - a + 1) * ratio, LEAST[grid.n], 2 * bounds.most)
        for a, b, ratio in zip(low.tolist(), high.tolist(), finer.tolist(), strict=True)
    )
    sizes = tuple(old if closed else new for old, new, closed in zip(grid.sizes, sizes, grid.closed, strict=True))
    middle = np.where(grid.circles, 0.0, np.round(0.5 * (low + high)))
    return Grid(grid.centre + grid.basis @ middle, grid.basis / finer, sizes, grid.closed)


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
    dynamics: Dynamics, group: tuple[Substep, ...], later: Function, bounds: Bounds
) -> tuple[Function, Update, Report]:
    """Return the function before a substep, its product with the density there, and the errors."""
    function, tilted = later, dynamics.diffusion is None

    def adjoint(function: Function, linear: Linearisation, times: tuple[float, float], steps: int) -> Adjoint:
        return Adjoint(function, linear, times, steps, dynamics, group[0].potential, bounds.periodic)

    for one in reversed(group):
        before = adjoint(function, one.linear, one.times, one.steps)
        function, product = _back(one.begin._replace(log_scale=0.0), bounds, tilted, before.logs, before.rough)
    difference = 0.0
    if len(group) == 2:
        one, two = group
        times, grid, logs = (one.times[0], two.times[1]), function.grid, function.logs()
        with np.errstate(invalid="ignore"):
            gained = (logs - adjoint(later, one.linear.then(two.linear), times, 2 * one.steps).logs(grid)) / 3
        gained = np.where(np.abs(gained) < LARGEST, gained, 0.0)
        field = product.field._replace(values=product.field.values * np.exp(gained))
        difference = float(3 * np.abs(field.values - product.field.values).sum() / field.values.sum())
        function, product = function_of(logs + gained, grid, field.values, tilted), product._replace(field=field)
    shown = grid_report(product.field.survey(bounds))
    shown = shown._replace(splitting=difference ** (5 / 3), interpolation=SMOOTHER * shown.interpolation)
    return function, product, shown


def density(prepared: base.Prepared, state: State, later: Message) -> Density:
    """Return the smoothed density, on a grid that resolves it as those of the filter do."""
    prepared = prepared.of(state)
    bounds = _general(prepared).bounds

    def log_factor(grid: Grid) -> Array:
        return interpolated(later.function, grid, bounds.periodic).reshape(-1)

    return prepared.posterior(updated(_density(prepared, state), log_factor, bounds, 0.0, later.function.grid).field)


@np.errstate(all="ignore")
def draw(prepared: base.Prepared, k: int, later: Array, values: Array, state: State, rng: Any) -> tuple[Array, float]:
    """Return draws (P, n) of the state at the start of interval k given those at its end, and how far the law is from normal."""
    prepared = prepared.of(state)
    general, begin = _general(prepared), _density(prepared, state)
    if general.observations.lengths[k] == 0:
        return later, 0.0
    chosen = list(general.logarithms)
    taken = _substeps(general, k, begin, _control(prepared, state), values, general.allowed(state), 1)
    if any(chosen):
        later = np.log(later, where=chosen, out=later.copy())
    found, departure = drawn([(stepper, one) for stepper, group in taken for one in group], begin, later, rng)
    return np.exp(found, where=chosen, out=found.copy()) if any(chosen) else found, departure


def accuracy(prepared: base.Prepared) -> float:
    """Return the error of the evidence of an interval that the tolerance allows."""
    return max(_general(prepared).tolerance, 1e-6)


BACKWARD: Backward[Any, State, Message] = Backward(message, step, smoothed, density, None, draw, accuracy)
