"""The direct method for time-varying Yau systems, on a lattice.

Chen, Luo and Yau (2017), Theorems 1 to 3, corrected and freed of Assumption 2: for f = L x + l + G grad phi and a quadratic
q the gauge u = e^phi v makes the Kolmogorov equation linear-quadratic, and its kernel is applied exactly by the affine
Hamiltonian flow (`zakai.kolmogorov.flow`).  What remains is a sum over a lattice, whose error is watched and kept below 1e-11.

Affine h with increments: y runs linearly between readings and the step is exact.  Nonlinear h: half of the observation's
factor, the transition with -h'S^-1 h / 2 inside, the other half.  Samples: exact for every h.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.algebra.theorems import limited_direct as theorem
from zakai.algebra.theorems import yau_system
from zakai.densities import GridDensity
from zakai.errors import InputError
from zakai.filters import _lattice_choice as choice
from zakai.filters._formulas import formulas
from zakai.filters._protocol import Info, Method, Schedule
from zakai.filters._yau_flow import System, distinct, parts_of, system_of
from zakai.filters.observations import Data, Factors, factors
from zakai.kolmogorov import lattice as lat
from zakai.kolmogorov.flow import Flow, flows
from zakai.kolmogorov.lattice import Lattice
from zakai.kolmogorov.power_series import TaylorData, power_series_kernels, taylor_data
from zakai.kolmogorov.series_flow import flow_of_kernel
from zakai.models.model import Model

# How deep, in units of the logarithm, the tails are kept: where they are cut at 1e-13, and where only rounding ends them.
_HELD_CUT, _HELD = 28.0, 60.0


@partial(
    jax.tree_util.register_dataclass, data_fields=["lattice", "observed", "cells", "middle"], meta_fields=["plan"]
)
@dataclass(frozen=True)
class State:
    """The normalised density on a lattice, and the static plan by which the next steps move it.

    What the last step computed and the next one needs again is carried: h at the points, `observed`, an array for each
    coordinate, the narrowest feature in `cells` (n,), and the `middle` of the support (n,), an index from the centre.
    """

    lattice: Lattice
    observed: Any
    cells: Any
    middle: Any
    plan: choice.Plan

    @property
    def kept(self) -> State:
        """What a result keeps of the state."""
        return replace(self, observed=None)

    @property
    def run_length(self) -> int:
        """How many steps to take before the lattice is looked at again."""
        return self.plan.run


@dataclass(frozen=True, eq=False)
class Prepared:
    """Everything that is known without data: `intervals`, a pytree with a leading axis, and what is static."""

    model: Model
    system: System
    schedule: Schedule
    splitting: str
    intervals: Interval

    @property
    def notes(self) -> tuple[str, ...]:
        """Where the method is not exact in its class, for the warnings of a result."""
        gaps = not self.schedule.inside.all() and self.model.observation_kind != "samples"
        if self.system.bare or not gaps:
            return ()
        return (
            "where readings are missing the transition without the observation's potential is not linear-quadratic: its "
            "potential is kept inside and taken out again at the end, which is exact only as the intervals shrink",
        )


@partial(jax.tree_util.register_dataclass, data_fields=["start", "stop", "flow", "theta"], meta_fields=["system"])
@dataclass(frozen=True)
class Interval:
    """One interval: its ends, its flow in equal parts (parts, ...), the parameters, and the static system."""

    start: Any
    stop: Any
    flow: Flow
    theta: Any
    system: System


def prepare(
    model: Model, schedule: Schedule, *, kernel: str = "flow", splitting: str = "strang", order: int | None = None
) -> Prepared:
    """The flow of every interval, offline.

    `kernel` is "flow" or "power-series" (the papers' series in z-coordinates, of the given `order` or chosen
    automatically); `splitting` is "strang" or "lie".  Raises InputError for another word.
    """
    if kernel not in ("flow", "power-series"):
        raise InputError(f'option kernel: "{kernel}" is neither "flow" nor "power-series"')
    if splitting not in ("strang", "lie"):
        raise InputError(f'option splitting: "{splitting}" is neither "strang" nor "lie"')
    series = kernel == "power-series"
    if order is not None and (isinstance(order, bool) or not isinstance(order, int) or order < 1 or not series):
        raise InputError(f'option order: {order!r} must be a whole number from 1, and needs kernel="power-series"')
    # The series knows no inputs, and the papers' order of the factors has none.
    system = system_of(formulas(model), not series and splitting == "strang", splitting)
    which, first = distinct(system, schedule)
    starts, stops, inside = schedule.starts[first], schedule.stops[first], schedule.inside[first].astype(float)
    parts = parts_of(system, model, starts, stops, inside)
    edges = starts[:, None] + (stops - starts)[:, None] * np.arange(parts + 1) / parts
    theta = np.tile(model.theta(), (len(starts) * parts, 1))
    argument = (theta, np.repeat(inside, parts, axis=0))
    if series:
        flow = _series_flows(model, edges[:, :-1].ravel(), edges[:, 1:].ravel(), argument[1].min(axis=1) > 0, order)
    else:
        flow = flows(system.coefficients, edges[:, :-1].ravel(), edges[:, 1:].ravel(), argument)
    flow = jax.tree.map(lambda a: np.asarray(a).reshape(len(starts), parts, *a.shape[1:])[which], flow)
    intervals = Interval(
        schedule.starts, schedule.stops, flow, np.tile(model.theta(), (len(which), 1)), system
    )
    return Prepared(model, system, schedule, splitting, intervals)


def _series_flows(model: Model, starts: np.ndarray, stops: np.ndarray, whole: np.ndarray, order: int | None) -> Flow:
    """The flows by the papers' power series; `whole` (K,) says where the observation's energy is inside."""
    yau = yau_system(model)
    assert yau is not None
    values = dict(zip(model.parameter_symbols, model.theta(), strict=True))
    parts = []
    for inside, quadratic in ((True, yau.full or yau.bare), (False, yau.bare or yau.full)):
        rows = np.flatnonzero(whole == inside)
        if not len(rows) or quadratic is None:
            continue
        # The series is written for q itself, the flow for -q/2.
        q = (-2 * quadratic.matrix, -2 * quadratic.linear, -2 * quadratic.constant)

        def expand(points: np.ndarray, terms: int, q=q) -> TaylorData:
            form = yau.form
            matrix, linear, constant = q
            return taylor_data(
                model.t, model.covariance, form.matrix, form.offset, matrix, linear, constant, points, terms, values
            )

        parts.append((rows, flow_of_kernel(power_series_kernels(expand, starts[rows], stops[rows], order))))
    back = np.argsort(np.concatenate([rows for rows, _ in parts]))
    return jax.tree.map(lambda *arrays: np.concatenate(arrays)[back], *[flow for _, flow in parts])


def observations(prepared: Prepared, data: Data) -> Factors:
    """What `step` is given for each interval."""
    system = prepared.system
    return factors(
        prepared.model,
        data,
        prepared.schedule,
        rates=system.rates,
        splitting=prepared.splitting,
        remove=not system.bare,
    )


def init(prepared: Prepared, prior: Any) -> State:
    """The prior on a lattice that fits it and the first interval."""
    return _start(prepared, prior, None)[0]


def correct(prepared: Prepared, prior: Any, observation: Factors) -> tuple[State, Info]:
    """The prior after an observation at the start itself."""
    state, log_mass = _start(prepared, prior, observation)
    summary = lat.summary(state.lattice, state.plan.angles)
    zero = jnp.array(0.0)
    health = {
        "edge_mass": summary.edge_mass,
        "resolution": jnp.min(state.cells),
        "quadrature_error": zero,
        "exponent": zero,
        "surprise": zero,
    }
    return state, Info(log_mass, summary.mean, summary.cov, health, np.append(choice.CELLS / state.cells, 1.0))


def _start(prepared, prior, observation):
    system, model = prepared.system, prepared.model

    def log_factor(x):
        factor = jax.tree.map(lambda a: a[0], observation)
        return np.asarray(_log_factor(system.observe(x, model.start, model.theta()), factor))

    # An interval of no length, before a sample at the start itself, asks for no cell.
    spreads = prepared.intervals.flow.spread
    moving = np.flatnonzero(np.linalg.det(spreads[:, 0]) > 0)
    spread = spreads[moving[0], 0] if len(moving) else None
    lattice, log_mass = choice.first_lattice(model, prior, log_factor if observation is not None else None, spread)
    if observation is not None:
        # A density prior need not be normalised; the evidence is that of the reading alone.
        log_mass = log_mass - choice.first_lattice(model, prior, None)[1]
    return _looked_at(prepared, lattice, choice.first_plan(model), model.start), log_mass


def _looked_at(prepared: Prepared, lattice: Lattice, plan: choice.Plan, time: float) -> State:
    """A state from a lattice that was chosen outside of a step."""
    system = prepared.system
    return State(
        lattice,
        _observed_at(system, lattice, time, prepared.model.theta()) if system.halves else None,
        choice.features(np.asarray(lattice.log_values)),
        choice.middle(np.asarray(lattice.log_values)),
        plan,
    )


@partial(jax.jit, static_argnums=0)
def _observed_at(system, lattice, time, theta):
    return system.observe(lattice.points(), time, theta)


def _linear(weights: Any, h: Sequence[jax.Array]) -> Any:
    """weights . h, an elementwise sum that is fused with what follows."""
    return sum((weights[i] * values for i, values in enumerate(h)), start=jnp.zeros(()))


def _log_factor(h: Sequence[jax.Array] | None, factor: Factors) -> Any:
    """log factor(x) = after . h - h'(energy) h / 2 + constant, with h an array for each coordinate of the observation."""
    if h is None:
        return factor.constant
    value = _linear(factor.after, h) + factor.constant
    if factor.energy is None:
        return value
    return value - 0.5 * sum(_linear(factor.energy[i], h) * values for i, values in enumerate(h))


def adapt(prepared: Prepared, state: State, rows: slice, info: Info | None) -> State | None:
    """The state to begin the intervals `rows` with: the window, the cell and the way to convolve."""
    lattice, plan = choice.adapted(
        prepared.model,
        state.lattice,
        state.plan,
        prepared.intervals.flow.spread[rows],
        prepared.intervals.flow.map[rows],
        info,
    )
    if plan is None:
        return None
    if lattice is state.lattice:
        return replace(state, plan=plan)
    return _looked_at(prepared, lattice, plan, prepared.schedule.starts[rows.start])


def step(interval: Interval, state: State, observation: Factors) -> tuple[State, Info]:
    """One interval: gauge, half factor, transition, half factor, gauge, normalise."""
    system, plan = interval.system, state.plan
    lattice, observed, cells = state.lattice, state.observed, state.cells
    if plan.banded:
        shift = jnp.clip(jnp.rint(state.middle[0]).astype(int), -(plan.sizes[0] // 4), plan.sizes[0] // 4)
        lattice = Lattice(
            lat.slid(lattice.log_values, shift, -jnp.inf), lattice.centre + lattice.basis[:, 0] * shift, lattice.basis
        )
        observed = jax.tree.map(lambda h: lat.slid(h, shift, 0.0), observed)
    parts = interval.flow.map.shape[0]
    times = interval.start + (interval.stop - interval.start) * jnp.arange(parts + 1) / parts
    slices = (interval.flow, times[:-1], times[1:])
    zero, n = jnp.array(0.0), len(lattice.sizes)
    worst = _Worst(zero, jnp.array(jnp.inf), jnp.ones(n), jnp.zeros(n), zero, jnp.ones(()))
    carry = (lattice, cells, observed, zero, worst)

    def inner(carry, slices):
        return _part(system, plan, interval.theta, observation, carry, slices, False, False)[0], None

    def at(k):
        return jax.tree.map(lambda a: a[k], slices)

    carry, summary = _part(system, plan, interval.theta, observation, carry, at(0), True, parts == 1)
    if parts > 2:
        carry, _ = jax.lax.scan(inner, carry, jax.tree.map(lambda a: a[1:-1], slices))
    if parts > 1:
        carry, summary = _part(system, plan, interval.theta, observation, carry, at(parts - 1), False, True)
    lattice, cells, observed, log_mass, worst = carry
    # A feature that the first look, over everything that could be reached, may have stepped over counts as unresolved.
    resolution = cells * jnp.minimum(1.0, 4.0 / worst.first_look)
    health = {
        # What found no room is lost beyond the edge.
        "edge_mass": jnp.where(worst.room > plan.room, 1.0, summary.edge_mass),
        "resolution": jnp.min(resolution),
        "quadrature_error": 2 * jnp.exp(-2 * jnp.pi**2 * worst.joint**2),
        "exponent": worst.exponent,
        "surprise": worst.surprise,
    }
    need = jnp.append(jnp.maximum(worst.need, plan.needed / resolution), worst.room)
    kept = observed if system.halves else None
    return State(lattice, kept, cells, summary.middle, plan), Info(log_mass, summary.mean, summary.cov, health, need)


class _Worst(NamedTuple):
    """The worst cases over the parts of an interval: see the health figures of `METHOD.bounds`."""

    exponent: jax.Array
    joint: jax.Array
    first_look: jax.Array
    need: jax.Array
    surprise: jax.Array
    room: jax.Array


def _part(system, plan, theta, observation, carry, slices, first: bool, last: bool):
    """One part of an interval; the halves of the observation's factor stand at the `first` and the `last`."""
    lattice, cells, observed, log_mass, worst = carry
    flow, start, stop = slices
    # Readings that act as rates leave nothing to multiply with at the end.
    needs_h = last and (system.halves or not system.rates or observation.energy is not None)

    def observe(x):
        return system.observe(x, stop, theta) if needs_h else None

    def factor(x, h):
        value = _potential(system, x, stop, theta) if system.gauged else jnp.zeros(x.shape[:-1])
        return value + _log_factor(h, observation) if last else value

    before = jnp.zeros(lattice.sizes)
    if first and observed is not None:
        before = _linear(observation.before, observed)
    exponent = worst.exponent
    if system.gauged:
        before = before - _potential(system, lattice.points(), start, theta)
        exponent = jnp.maximum(exponent, lat.exponent_range(lattice.log_values, lattice.log_values + before))
    joint, need = _joint_cells(lattice, cells, flow, plan.sharpen, worst.joint, worst.need)
    first_look, room, held = worst.first_look, worst.room, _HELD_CUT
    if plan.banded:
        lattice, spread = lat.move_banded(lattice, before, flow, observation.inputs, plan.taps)
        points = lattice.points()
        observed = observe(points)
        lattice = lattice._replace(log_values=lattice.log_values + factor(points, observed))
    else:
        lattice, coarseness, spread, taken = lat.move_dense(
            lattice,
            before,
            flow,
            observation.inputs,
            lambda x: factor(x, observe(x)),
            plan.sizes,
            plan.angles,
            plan.images,
            plan.sharpen,
            plan.room,
        )
        first_look, room = jnp.maximum(first_look, coarseness), jnp.maximum(room, taken)
        observed = observe(lattice.points()) if system.halves and last else None
        held = _HELD_CUT if plan.sharpen else _HELD
    surprise = jnp.maximum(worst.surprise, lat.reach(lattice, spread) / held)
    summary = lat.summary(lattice, plan.angles)
    lattice = lattice._replace(log_values=lattice.log_values - summary.log_mass)
    worst = _Worst(exponent, joint, first_look, need, surprise, room)
    return (lattice, lat.features(lattice), observed, log_mass + summary.log_mass, worst), summary


def _potential(system, x, t, theta):
    return system.potential(x, t, theta)[0]


def _joint_cells(lattice: Lattice, own: jax.Array, flow: Flow, sharpen: bool, joint, need):
    """The standard deviation, in cells, of the narrowest product of the density, `own` (n,), and the kernel; and what is needed.

    Both are worst cases over the parts of an interval.
    """
    kernel = jnp.sum(lattice.basis * (lat.inverse(flow.spread) @ lattice.basis), axis=0)
    if sharpen:
        extra = lat.added_variance(lattice, flow)
        own = jnp.sqrt(jnp.maximum(own**2 - extra, 1e-12))
        kernel = 1.0 / (1.0 / kernel + extra)
    # An axis of one point holds a mass without width, for which there is nothing to resolve.
    cells = jnp.where(jnp.array(lattice.sizes) > 1, jax.lax.rsqrt(1.0 / own**2 + kernel), jnp.inf)
    return jnp.minimum(joint, jnp.min(cells)), jnp.maximum(need, choice.JOINT / cells)


def density(prepared: Prepared, state: State) -> GridDensity:
    """The posterior as a `GridDensity`."""
    model = prepared.model
    lattice = state.lattice
    return GridDensity(
        np.asarray(lattice.log_values),
        np.asarray(lattice.centre),
        np.asarray(lattice.basis),
        model.state,
        tuple(name in model.periodic for name in model.state),
    )


METHOD = Method(
    name="limited-direct",
    source="Chen, Luo and Yau 2017, Theorems 1-3, corrected; x-coordinate form",
    exactness="exact between observations for every h in the class; for increments of nonlinear h, second order in the "
    "interval for smooth paths (Strang splitting)",
    theorem=theorem,
    options={"kernel": "flow", "splitting": "strang", "order": None},
    prepare=prepare,
    init=init,
    correct=correct,
    observations=observations,
    step=step,
    density=density,
    adapt=adapt,
    bounds={
        "edge_mass": (1e-9, "probability in the outermost cells of the window"),
        "quadrature_error": (1e-9, "error of a lattice sum that replaces an integral"),
        "exponent": (600.0, "largest exponent of the gauge over the window; beyond 700 mass would be lost"),
        "surprise": (1.0, "how far into its tails the observation drives the density, as a share of the tails that were kept"),
    },
)
