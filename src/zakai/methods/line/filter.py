"""One state on a grid: what `yau-yau` and `limited-direct` share.

Inside an interval the density obeys the DMZ equation with y linear between observations,

    u_t = G u'' / 2 - (f u)' + (h'S^-1 dy/dt - h'S^-1 h / 2) u,

for the coordinates whose increment belongs to just this interval; samples, and increments gathered over more than the interval,
are factors at its end.  The equation is solved on a grid that follows the density (`numerics/line/window.py`): spectrally
accurate in x, and in time by the exponential of the operator, which is exact where no coefficient depends on t, and by
Magnus' series of fourth order in adaptive substeps elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from zakai.densities import Density, GridDensity, MappedDensity
from zakai.methods._protocol import Info, Infos, joined, stacked
from zakai.methods._states import Joined
from zakai.methods.line import loop
from zakai.methods.line.choice import predicted
from zakai.methods.line.domain import check_ends, check_escape, on_the_line, variable_of
from zakai.methods.line.model import system_of
from zakai.methods.line.parts import parts_of_step, segment_of_parts
from zakai.methods.line.prepared import Parts, Prepared, State
from zakai.methods.line.report import Report
from zakai.methods.line.update import (
    acting_inside,
    edge_of_moments,
    error_remainder,
    factor_of,
    grid_check,
    on_fitting_grid,
    outside_tables,
    sampled_weakly,
    spread,
    state_moments,
)
from zakai.methods.line.update import init as init
from zakai.models.model import Model
from zakai.numerics.arrays import Array, Number
from zakai.numerics.line import window as lw
from zakai.numerics.line.density import separated
from zakai.numerics.line.product import General, Likelihood, Product, multiplied
from zakai.numerics.line.resolution import NOISE, noise_bound
from zakai.records.schedule import Schedule

SLOW = 1e-2  # of the tolerance: the spectrum that need not be resolved where f has kinks
PILED = 0.5  # density at an end of the grid, relative to the maximum, of a product that is cut off there


def prepare(model: Model, schedule: Schedule, theta: np.ndarray, tolerance: float, pieces: bool = False) -> Prepared:
    """Return what `step` needs for the intervals of a schedule; `pieces` is whether that is the one of `reflecting/filter.py`."""
    check_ends(model, theta, None if schedule.inputs is None else schedule.inputs.values)
    system = system_of(on_the_line(model)).given(schedule.inputs)
    # A sample may lead deep into the tails, where a small error counts; increments do not.
    negligible = 1e-13 if system.samples else float(np.clip(1e-6 * tolerance, 1e-13, 1e-10))
    if system.kinked_drift and not pieces:  # the spectrum of a density falls slowly
        negligible = max(negligible, SLOW * tolerance)
    return Prepared(model, schedule, theta, system, tolerance, negligible, tolerance, pieces=pieces)


def for_interval(prepared: Prepared, schedule: Schedule) -> Prepared:
    """Return what is prepared for one interval, from that of another one with the same sensors."""
    return prepared.for_interval(schedule)


def step(prepared: Prepared, k: int, state: State, observed: np.ndarray) -> tuple[State, Info]:
    """Return the state after interval k and the observation at its stop, and the report."""
    if prepared.parts is not None:
        return _of_parts(prepared.parts, k, state, observed)
    if prepared.fast[k]:
        product = loop.one(prepared, k, state, observed)
        if product is not None:
            return product
    # A substep that overflows is repeated in shorter ones.
    with np.errstate(all="ignore"):
        stepped = single(prepared, k, state, observed)
    return stepped.state, stepped.info


def _of_parts(parts: Parts, k: int, state: State, observed: np.ndarray) -> tuple[State, Info]:
    states, infos = segment_of_parts(parts, slice(k, k + 1), state, observed[None], segment_of_whole)
    health = {name: float(values[0]) for name, values in infos.health.items()}
    return states[0], Info(infos.log_likelihood_increment[0], infos.mean[0], infos.cov[0], health)


def segment(prepared: Prepared, rows: slice, state: State, observed: np.ndarray) -> tuple[Sequence[State], Infos]:
    """Return the states after the intervals of a slice, and their reports."""
    if prepared.parts is not None:
        return segment_of_parts(prepared.parts, rows, state, observed, segment_of_whole)
    return segment_of_whole(prepared, rows, state, observed)


class SingleStep(NamedTuple):
    """The state after an interval that the compiled loop does not take, its report, and its parts if it was cut."""

    state: State
    info: Info
    parts: Parts | None = None


FilteredSteps = list[loop.Piece] | SingleStep


def segment_of_whole(
    prepared: Prepared,
    rows: slice,
    state: State,
    observed: np.ndarray,
    noted: Callable[[int, State, FilteredSteps], None] | None = None,
) -> tuple[Sequence[State], Infos]:
    """Return the same of intervals that are not cut into parts.

    `noted` receives the steps as they are taken: the first interval, the state before it, and the pieces of the compiled loop or
    the single step.
    """
    states: Joined[State] = Joined()
    parts: list[Infos] = []
    k = rows.start
    while k < rows.stop:
        last, before = k, state
        while last < rows.stop and prepared.fast[last]:
            last += 1
        values = observed[k - rows.start : last - rows.start]
        pieces = loop.compiled_steps(prepared, slice(k, last), state, values) if last > k else []
        if pieces:
            filtered: FilteredSteps = pieces
            states.append(Joined([piece.states for piece in pieces]))
            parts.append(loop.infos_of(prepared, pieces))
        else:
            with np.errstate(all="ignore"):
                filtered = single(prepared, k, state, observed[k - rows.start])
            states.append([filtered.state])
            parts.append(stacked([filtered.info]))
        if noted is not None:
            noted(k, before, filtered)
        k, state = rows.start + len(states), states[-1]
    return states, joined(parts)


def single(prepared: Prepared, k: int, state: State, observed: np.ndarray) -> SingleStep:
    """Return the step over interval k by the first mechanism that is accurate, and the observation at its stop."""
    schedule, length = prepared.schedule, float(prepared.lengths[k])
    values, window, report, check = np.asarray(state.values), state.window, Report(), None
    check_escape(prepared, k, window.points, values)
    inside = acting_inside(prepared, k)
    parts = parts_of_step(prepared, k, values, window)
    if parts is not None:
        state, info = _of_parts(parts, 0, state, observed)
        return SingleStep(state, info, parts)
    _, before = lw.moments(values, window)  # the variance
    contraction = 1.0
    gained: Number = 0.0
    if length > 0:
        prediction, contraction = predicted(prepared, values, window, prepared.interval(k, inside, observed), report)
        values, window, gained, check = prediction
    _, between = lw.moments(values, window)
    log_floor = float(state.log_floor)
    if report.positive:
        # A positive kernel fills the tails again.
        wider = between.real / max(contraction**2 * before.real, 1e-300)
        log_floor = max(log_floor * float(np.clip(wider, 1.0, 20.0)), float(np.log(prepared.cut)))
        floor = float(np.exp(log_floor)) + report.edge
    else:
        log_floor = float(np.log(NOISE))
        floor = NOISE + report.aliasing + report.edge + report.noise
    likelihood = factor_of(prepared, k, observed, window)
    if likelihood is not None:
        if isinstance(likelihood, General):
            report.lawless = float(np.sum(values.real[np.isnan(likelihood.log_density(window.points).real)]))
        if prepared.weak and not np.iscomplexobj(values):
            product, check = sampled_weakly(prepared, k, values, window, observed)
        else:
            product, check = _multiplied(prepared, values, window, likelihood, prepared.deepest(floor))
        values, window, gained = product.values, product.window, gained + product.log_mass
        report.depth, report.growth = product.depth, product.growth
        report.density(check)
    elif check is None or prepared.kinked:
        check = grid_check(prepared, values, window)
    new_values, new, coarse = on_fitting_grid(prepared, values, window, check, prepared.generous)
    if new != window and not prepared.weak:  # the largest grid may be too coarse for all that the density has
        report.aliasing = max(report.aliasing, coarse)
    mean, variance = lw.moments(values, window)
    report.edge = max(report.edge, edge_of_moments(prepared, values, window))
    retained = error_remainder(before, between, variance, spread(prepared, k, length, window.origin + mean.real))
    error_before = state.error * (1.0 if separated(np.ascontiguousarray(values.real)) else retained)
    spacings = float(np.sqrt(max(variance.real, 0.0))) / window.spacing
    error, health = report.figures(prepared, floor, error_before, spacings)
    if prepared.system.tabulated:
        health["outside_tables"] = outside_tables(prepared, values, window, float(schedule.stops[k]))
    mean, variance = state_moments(prepared, values, window, mean, variance)
    log_floor = min(log_floor + max(report.depth - 1.0, 0.0), 0.0)
    info = Info(gained, np.array([mean]), np.array([[variance]]), health)
    return SingleStep(State.of(new_values, new, error, log_floor), info)


def _multiplied(
    prepared: Prepared, values: Array, window: lw.Window, likelihood: Likelihood, deepest: float
) -> tuple[Product, lw.GridCheck]:
    """Return the product with a likelihood and its check; the prediction where it lies `deepest` in the tails and at an end."""
    product = multiplied(values, window, likelihood, noise_bound(prepared.tolerance))
    ends = lw.grid_check(product.values, product.window.closed)
    if max(ends.left, ends.right) > PILED and product.depth > deepest:
        # No state within reach explains the observation: it counts in the evidence alone.
        product = product._replace(values=values, window=window, depth=np.inf)
    return product, grid_check(prepared, product.values, product.window)


def valid(prepared: Prepared, state: State) -> bool:
    """Return whether the parts of a state fit together."""
    values = np.asarray(state.values)
    numbers = np.array([state.origin, state.centre, state.spacing, state.unit, state.error, state.log_floor], float)
    if values.ndim != 1 or not 8 <= len(values) <= lw.SIZES[-1] or not np.isfinite(numbers).all():
        return False
    if bool(state.closed) != bool(prepared.model.periodic) or not (state.spacing > 0 and state.unit > 0):
        return False
    return bool(np.isfinite(values).all() and values.real.sum() > 0)


def density(prepared: Prepared, state: State) -> Density:
    """Return the density of a state."""
    with np.errstate(divide="ignore"):
        logs = np.log(np.maximum(np.asarray(state.values).real, 0.0))
    window = state.window
    names, variable = prepared.model.state, variable_of(prepared.model)
    product = GridDensity(logs, np.array([window.origin + window.centre]), np.array([[window.spacing]]), names, (window.closed,))
    return product if variable is None else MappedDensity(product, variable)
