"""The direct method for time-varying Yau systems, on a lattice.

Chen, Luo and Yau (2017), Theorems 1 to 3, corrected and freed of Assumption 2: for f = L x + l + G grad phi and a quadratic
q the gauge u = e^phi v makes the Kolmogorov equation linear-quadratic, and its kernel is applied exactly by the affine
Hamiltonian flow (`zakai.kolmogorov.flow`).  What remains is a sum over a lattice, whose error is watched and kept below 1e-11.

Affine h with increments: y runs linearly between readings and the step is exact.  Nonlinear h: half of the observation's
factor, the transition with -h'S^-1 h / 2 inside, the other half; with one state the errors of this splitting are undone, where
the lattice stands still up to the fourth order in the interval (`_splitting`).  Samples: exact for every h.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
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
from zakai.filters import _still_window
from zakai.filters._formulas import formulas
from zakai.filters._protocol import Info, Method, Schedule
from zakai.filters._splitting import made_up
from zakai.filters._yau_flow import FlowPlan, System, plan_flows, planned_flows, system_of
from zakai.filters.observations import Data, FactorRule, Factors, factor_rule
from zakai.kolmogorov import lattice as lat
from zakai.kolmogorov.flow import Flow
from zakai.kolmogorov.lattice import Lattice
from zakai.kolmogorov.power_series import TaylorData, power_series_kernels, taylor_data
from zakai.kolmogorov.series_flow import flow_of_kernel
from zakai.models.compile import jax_field
from zakai.models.model import Model
from zakai.models.prior import DensityPrior

# How deep, in units of the logarithm, the tails are kept: where they are cut at 1e-13, and where only rounding ends them.
_HELD_CUT, _HELD = _still_window.DEEP, 60.0
_SMOOTH = 1e-9  # of the mass of a prior, on every second point of its lattice


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["lattice", "observed", "cells", "middle", "cut", "table", "seen"],
    meta_fields=["plan"],
)
@dataclass(frozen=True)
class State:
    """The normalised density on a lattice, and the static plan by which the next steps move it.

    What the last step computed and the next one needs again is carried: h at the points, `observed`, an array for each
    coordinate, with one state its slopes behind, the narrowest feature in `cells` (n,), and the `middle` of the support (n,), an
    index from the centre. `cut` (2,) says how the first lattice of this run of steps was cut out of the last of the run before.
    Of a lattice that stands still `table` holds h and its derivatives, what is `seen` of it by the window is what it shows where
    that stands, if this is known, and nothing is `observed`.
    """

    LASTING = ("table", "seen")
    PLANNED = ("plan",)

    lattice: Lattice
    observed: Any
    cells: Any
    middle: Any
    cut: Any
    plan: choice.Plan
    table: _still_window.Table | None = None
    seen: Any = None

    @property
    def kept(self) -> State:
        """What a result keeps of the state."""
        return replace(self, observed=None, table=None, seen=None)

    @property
    def run_length(self) -> int:
        """How many steps to take before the lattice is looked at again."""
        return choice.STILL_RUN if self.plan.still else self.plan.run

    @property
    def look(self) -> int:
        """How many steps are taken before their health is looked at, where they are taken together."""
        return 1 if self.plan.wide else _still_window.LOOK

    @property
    def together(self) -> Callable[..., Any] | None:
        """What takes all steps of a run together, where they can be."""
        return _steps if self.plan.still else None

    def needed(self, intervals: Interval) -> Interval:
        """Of intervals what steps that are taken together ask for."""
        return replace(intervals, start=None, stop=None, flow=None, theta=None)

    @property
    def possible(self) -> bool:
        """Whether the narrowest features are about those of the density; of one record, outside of a compiled step."""
        expected = choice.features(np.asarray(self.lattice.log_values)[None])[0]
        about = (0.5 * expected < self.cells) & (self.cells < 2.0 * expected)
        return bool(np.all(about | np.isinf(expected)))

    @property
    def bare(self) -> State:
        """The state with nothing in its plan but what a step must know."""
        window = choice.WIDE if self.plan.wide else choice.Plan.window
        return replace(self, plan=replace(self.plan, window=window, cells=choice.Plan.cells, run=choice.Plan.run))

    @property
    def small(self) -> bool:
        """Whether a step is so short that one kernel had better take it."""
        return self.plan.still

    @property
    def settled(self) -> Callable[..., Any] | None:
        """What lays a window that stands still over the mass anew."""
        return _settled if self.plan.still else None


@dataclass(frozen=True, eq=False)
class Prepared:
    """Everything that is known without data: `intervals`, a pytree with a leading axis, what is static, and `theta`.

    `flow_plan` says how the flows are computed again for another theta, `spread` (n, n) is the covariance of the first kernel,
    `memory` what lattices may take, in bytes.
    """

    model: Model
    system: System
    schedule: Schedule
    splitting: str
    intervals: Interval
    theta: Any
    flow_plan: FlowPlan
    spread: np.ndarray | None
    memory: int
    # The first state of the last prior, which many records share, and what its lattice leaves of the mass.
    first: dict[int, tuple[Any, State, float]] = field(init=False, default_factory=dict)

    @property
    def at_once(self) -> bool:
        """Whether many records had better be filtered one after another, each for a run of steps."""
        return self.intervals.still is not None

    @property
    def notes(self) -> tuple[str, ...]:
        """Where the method is not exact in its class, for the warnings of a result."""
        said = [*self.flow_plan.substeps.notes]
        said += [
            f"prior: the density has kinks or jumps, and sums on its lattice are off by about {error:.1g}"
            for _, _, error in self.first.values()
            if error > _SMOOTH
        ]
        gaps = not self.schedule.inside.all() and self.model.observation_kind != "samples"
        if self.system.bare or not gaps:
            return tuple(said)
        return (
            *said,
            "where readings are missing the transition without the observation's potential is not linear-quadratic: its "
            "potential is kept inside and taken out again at the end, which is exact only as the intervals shrink",
        )


class Still(NamedTuple):
    """What a window that stands still is told of an interval: its kernel, by how much the gauge changes in it, (2,) in x and x^2,
    and by what share the first half of its factor is more than the second, (1,): where G grows, a path is longer near to where it
    began."""

    kernel: _still_window.Kernel
    turned: Any
    lean: Any


@partial(jax.tree_util.register_dataclass, data_fields=["start", "stop", "flow", "theta", "still"], meta_fields=["system"])
@dataclass(frozen=True)
class Interval:
    """One interval: its ends, its flow in equal parts (parts, ...), the parameters, for a window that can stand still what it is
    told, and the static system."""

    start: Any
    stop: Any
    flow: Any
    theta: Any
    still: Still | None
    system: System


def prepare(
    model: Model,
    schedule: Schedule,
    *,
    kernel: str = "flow",
    splitting: str = "strang",
    order: int | None = None,
    memory: float | None = None,
) -> Prepared:
    """The flow of every interval, offline.

    `kernel` is "flow" or "power-series" (the papers' series in z-coordinates, of the given `order` or chosen
    automatically); `splitting` is "strang" or "lie"; `memory` is how many MiB lattices of two and three states may
    take, by default half of what the machine has free.  Raises InputError for another word.
    """
    if kernel not in ("flow", "power-series"):
        raise InputError(f'option kernel: "{kernel}" is neither "flow" nor "power-series"')
    if splitting not in ("strang", "lie"):
        raise InputError(f'option splitting: "{splitting}" is neither "strang" nor "lie"')
    series = kernel == "power-series"
    if order is not None and (isinstance(order, bool) or not isinstance(order, int) or order < 1 or not series):
        raise InputError(f'option order: {order!r} must be a whole number from 1, and needs kernel="power-series"')
    if memory is not None and not (isinstance(memory, (int, float)) and not isinstance(memory, bool) and 0 < memory < np.inf):
        raise InputError(f"option memory: {memory!r} must be a positive number of MiB")
    # The series knows no inputs, and the papers' order of the factors has none.
    system = system_of(formulas(model), not series and splitting == "strang", splitting)
    theta = model.theta()
    plan = plan_flows(system, model, schedule)
    flow = _series_flows(model, plan, order) if series else planned_flows(system, plan, theta)
    # An interval of no length, before a sample at the start itself, asks for no cell.
    moving = np.flatnonzero(np.linalg.det(flow.spread[:, 0]) > 0)
    return Prepared(
        model,
        system,
        schedule,
        splitting,
        _intervals(system, schedule, flow, theta),
        theta,
        plan,
        flow.spread[moving[0], 0] if len(moving) else None,
        choice.free_memory() if memory is None else int(memory * 2**20),
    )


def _intervals(system: System, schedule: Schedule, flow: Flow, theta: Any) -> Interval:
    xp = np if isinstance(theta, np.ndarray) else jnp
    count = len(schedule.starts)
    thetas, still = xp.broadcast_to(theta, (count, len(theta))), None
    if system.still and flow.map.shape[1] == 1:
        still = _still(system, schedule.starts, schedule.stops, flow, thetas)
        still = jax.tree.map(np.asarray, still) if xp is np else still
    return Interval(schedule.starts, schedule.stops, flow, thetas, still, system)


@partial(jax.jit, static_argnums=0)
def _still(system: System, starts: Any, stops: Any, flow: Flow, theta: Any) -> Still:
    kernel = jax.vmap(_still_window.kernel_of)(jax.tree.map(lambda a: a[:, 0], flow))
    if not system.varying:
        return Still(kernel, jnp.zeros((len(starts), 2)), jnp.zeros((len(starts), 1)))

    def at(t: jax.Array, theta: jax.Array) -> tuple[jax.Array, jax.Array]:
        c = system.coefficients(t, (theta, jnp.ones(1)))
        return jnp.stack([c.offset[0, 0], 0.5 * c.matrix[0, 0]]) / c.covariance[0, 0], c.covariance[0]

    (start, first), (stop, last) = (jax.vmap(at)(times, theta) for times in (starts, stops))
    return Still(kernel, stop - start, (last - first) / (last + first) / 3)


def with_parameters(prepared: Prepared, theta: Any) -> Prepared:
    """The flows for other values of the parameters, in the steps that were chosen for the model's own."""
    flow = planned_flows(prepared.system, prepared.flow_plan, theta)
    return replace(prepared, theta=theta, intervals=_intervals(prepared.system, prepared.schedule, flow, theta))


def _series_flows(model: Model, plan: FlowPlan, order: int | None) -> Flow:
    """The flows by the papers' power series; the observation's energy is inside where all coordinates are."""
    starts, stops, whole = plan.starts, plan.stops, plan.inside.min(axis=1) > 0
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
    return jax.tree.map(
        lambda *arrays: np.concatenate(arrays)[back].reshape(-1, plan.parts, *arrays[0].shape[1:])[plan.which],
        *[flow for _, flow in parts],
    )


def observations(prepared: Prepared, data: Data) -> Any:
    """What `step` is given for each interval."""

    given = rule(prepared, data)(data.filled)
    # The lattice of a posterior at the start is chosen for the model's own parameters.
    at_start = not isinstance(prepared.theta, np.ndarray) and data.stops[0] == prepared.model.start
    return (given, rule(prepared, data, prepared.model.theta())(data.filled)) if at_start else given


def rule(prepared: Prepared, data: Data, theta: Any = None) -> FactorRule:
    """The same but for the values, for the parameters `theta`, by default those of `prepared`."""
    return factor_rule(
        prepared.model,
        data,
        prepared.schedule,
        rates=prepared.system.rates,
        splitting=prepared.splitting,
        remove=not prepared.system.bare,
        theta=prepared.theta if theta is None else theta,
    )


def init(prepared: Prepared, prior: Any) -> State:
    """The prior on a lattice that fits it and the first interval."""
    if not isinstance(prepared.theta, np.ndarray):
        return _start(prepared, prior, None)[0]
    known, state, _ = prepared.first.get(id(prior), (None, None, 0.0))
    if known is not prior or state is None:
        state = _start(prepared, prior, None)[0]
        prepared.first.clear()
        prepared.first[id(prior)] = prior, state, (
            _roughness(np.asarray(state.lattice.log_values)) if isinstance(prior, DensityPrior) else 0.0
        )
    return state


def _roughness(logs: np.ndarray) -> float:
    """How much of the mass differs on every second point: of a smooth density nothing, of kinks three errors."""
    values = np.exp(logs - logs.max())
    every = values[tuple(slice(None) if size < 4 else slice(size // 2 % 2, None, 2) for size in logs.shape)]
    return abs(every.sum() * 2 ** sum(size >= 4 for size in logs.shape) / values.sum() - 1.0)


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
        "splitting": zero,
        "surprise": zero,
    }
    return state, Info(log_mass, summary.mean, summary.cov, health, jnp.append(choice.CELLS / state.cells, 1.0))


def _start(prepared, prior, observation):
    """The first state, with an observation at the start if there is one, and the logarithm of the mass."""
    system, model = prepared.system, prepared.model
    traced = not isinstance(prepared.theta, np.ndarray)
    observation, own = observation if traced and observation is not None else (observation, observation)

    def log_factor(x, factor, theta):
        factor = jax.tree.map(lambda a: a[0], factor)
        return _log_factor(system.observe(x, model.start, theta), factor)

    def own_factor(x):
        return np.asarray(log_factor(x, own, model.theta()))

    with jax.ensure_compile_time_eval():
        # A density prior need not be normalised; the evidence is that of the reading alone.
        still = prepared.intervals.still is not None
        first, before = choice.first_lattice(model, prior, None, prepared.spread if observation is None else None, still)
        lattice, after = first, before
        if observation is not None:
            lattice, after = choice.first_lattice(model, prior, own_factor, prepared.spread, still)
    plan, own = choice.first_plan(model, still), lattice.log_values
    if not traced:
        return _looked_at_one(prepared, lattice, plan, model.start, choice.SAME, own), after - before
    prior_on = partial(_prior_again, prepared, prior)
    before = lat.summary(first._replace(log_values=prior_on(first))).log_mass
    logs = prior_on(lattice)
    if observation is not None:
        logs = logs + log_factor(lattice.points(), observation, prepared.theta)
    after = lat.summary(lattice._replace(log_values=logs)).log_mass
    lattice = lattice._replace(log_values=logs - after)
    return _looked_at_one(prepared, lattice, plan, model.start, choice.SAME, own), after - before


def _prior_again(prepared, prior, lattice):
    """The prior's logarithm on a lattice that was chosen for the model's own parameters, for traced ones."""
    model = prepared.model
    with jax.ensure_compile_time_eval():
        points = lattice.points()
        logs = choice.log_prior(model, prior)(np.asarray(points))
    if not isinstance(prior, DensityPrior):
        return jnp.asarray(logs)
    there = np.isfinite(logs)
    # Where there is no density a formula may not exist; a point where it does stands in.
    safe = jnp.where(there[..., None], points, points[np.unravel_index(np.argmax(logs), logs.shape)])
    return jnp.where(there, jax_field([prior.log_density], model)(safe, model.start, prepared.theta)[0], -jnp.inf)


def _looked_at(prepared: Prepared, lattice: Lattice, plan: choice.Plan, time: float, cut: Any, own: Any = None) -> State:
    """States from lattices, one a record, that were chosen outside of a step.

    `own` are the values for the model's own parameters.
    """
    system = prepared.system
    logs = np.asarray(lattice.log_values if own is None else own)
    observed = _observed_at(system, lattice, time, prepared.theta) if system.halves and not plan.still else None
    # A window that stands still is not led by the middle of what it shows.
    middle = np.zeros((len(logs), logs.ndim - 1)) if plan.still else choice.middle(logs)
    return State(lattice, observed, choice.features(logs), middle, cut, plan)


def _looked_at_one(prepared: Prepared, lattice: Lattice, plan: choice.Plan, time: float, cut: Any, own: Any) -> State:
    one = jax.tree.map(lambda a: a[None], (lattice, cut, np.asarray(own)))
    return jax.tree.map(lambda a: a[0], _looked_at(prepared, one[0], plan, time, *one[1:]))


@partial(jax.jit, static_argnums=0)
def _observed_at(system, lattice, time, theta):
    return jax.vmap(lambda one: system.observe_sloped(one.points(), time, theta))(lattice)


def _linear(weights: Any, h: Sequence[jax.Array]) -> Any:
    """weights . h, an elementwise sum that is fused with what follows; what stands behind h does not count."""
    return sum((weights[i] * values for i, values in enumerate(h[: len(weights)])), start=jnp.zeros(()))


def _log_factor(h: Sequence[jax.Array] | None, factor: Factors) -> Any:
    """log factor(x) = after . h - h'(energy) h / 2 + constant, with h an array for each coordinate of the observation."""
    if h is None:
        return factor.constant
    value = _linear(factor.after, h) + factor.constant
    if factor.energy is None:
        return value
    return value - 0.5 * sum(_linear(factor.energy[i], h) * values for i, values in enumerate(h[: len(factor.after)]))


def adapt(prepared: Prepared, state: State, rows: slice, info: Info | None, still: bool = True) -> State | None:
    """The state to begin the intervals `rows` with: the window, the cell and the way to convolve."""
    if info is not None and np.all(choice.healthy(info, state.plan)):
        return None
    one = jax.tree.map(lambda a: np.asarray(a)[None], (replace(state, table=None, seen=None), info))
    many = adapt_many(prepared, one[0], rows, one[1], still, state.table)
    if many is None:
        return None
    # To take a part of JAX's arrays takes longer than all the rest.
    return replace(jax.tree.map(lambda a: np.asarray(a)[0], replace(many, table=None)), table=many.table)


def adapt_many(
    prepared: Prepared,
    states: State,
    rows: slice,
    info: Info | None,
    still: bool = True,
    table: _still_window.Table | None = None,
) -> State | None:
    """`adapt` of states with a leading axis of records: one plan for all, the largest that any of them needs.

    With `still` the windows, which are of one lattice, stand still where they can: one kernel for every interval, factors at both
    ends, an h without time; their `table` may be known.
    """
    still = still and prepared.intervals.still is not None and bool(prepared.schedule.inside[rows].all())
    flow = prepared.intervals.flow
    own, cells = Lattice(*map(np.asarray, states.lattice)), np.asarray(states.cells)
    drift = None
    if still:
        assert prepared.intervals.still is not None
        drift = partial(_still_window.drift, jax.tree.map(lambda a: a[rows], prepared.intervals.still.kernel))
    lattice, plan, cut = choice.adapted(
        prepared.model, own, cells, states.plan, flow.spread[rows], flow.map[rows], info, prepared.memory, drift
    )
    if plan is None:
        return None
    if info is not None:
        cut = choice.composed(np.asarray(states.cut), cut, own.log_values.shape[1])
    start = prepared.schedule.starts[rows.start]
    if lattice is None:
        laid = replace(states, plan=plan, cut=cut)
        return replace(laid, table=_table(prepared, own, start, table)) if plan.still else laid
    laid = _looked_at(prepared, lattice, plan, start, cut)
    return replace(laid, table=_table(prepared, lattice, start, table)) if plan.still else laid


def _table(prepared: Prepared, lattice: Lattice, time: float, known: _still_window.Table | None = None) -> _still_window.Table:
    """That for the windows of some records, which stand on one lattice; the one that is `known`, where it serves."""
    centres, cell, size = lattice.centre.ravel(), lattice.basis.ravel()[0], lattice.log_values.shape[-1]
    if known is not None and float(known.cell) == cell and known.h.shape[-1] >= 3 * size:
        # In NumPy: one number on the device takes longer than all of this.
        if abs(round((centres[0] - float(known.home)) / cell)) <= size // 2:
            return known
    # With room for each to move, in few sizes.
    windows = 3 + 2 * np.abs(centres - centres[0]).max() / cell / size
    most = 2 ** int(np.ceil(np.log2(windows * size)))
    return _table_at(prepared.system, centres[0], cell, most, time, prepared.theta)


@partial(jax.jit, static_argnums=(0, 3))
def _table_at(system, centre, cell, size, time, theta):
    points = centre + cell * (np.arange(size) - size // 2)
    return _still_window.Table(centre, cell, system.observe_bent(points[:, None], time, theta))


def _fits(state: State, info: Info) -> Any:
    """Whether a step kept every bound that `adapt` looks at."""
    return choice.healthy(info, state.plan)


def _steps(
    state: State, intervals: Interval, observation: Factors, keep: bool, most: Any, strict: Any
) -> tuple[State, tuple[Info, Any], Any]:
    """The steps of a run on a window that stands still, but for those after the first `most`, and if it is `strict` for those
    from a look on that was not well; with `keep` the states of all; and how many were taken."""
    assert state.table is not None
    system, plan, lattice = intervals.system, state.plan, state.lattice
    assert intervals.still is not None
    kernel, turned, given = _still_factors(intervals.still, observation)

    def health(sums: jax.Array, cells: jax.Array, joint: jax.Array) -> dict[str, jax.Array]:
        return {
            "edge_mass": sums[:, 3] / sums[:, 0],
            "resolution": cells,
            "quadrature_error": 2 * jnp.exp(-2 * jnp.pi**2 * joint**2),
        }

    def well(growth: jax.Array, sums: jax.Array, cells: jax.Array, joint: jax.Array) -> jax.Array:
        return jnp.logical_not(strict) | choice.well(growth, health(sums, cells, joint), plan)

    (last, place, narrowest), taken, told = _still_window.moved(
        lattice, state.table, kernel, turned, given, state.cells[0], plan.taps, keep, system.even, plan.wide, most, well
    )
    mass, first, second, _ = told.sums.T
    cell, count = lattice.basis[0, 0], len(mass)
    first, second = cell * first / mass, cell**2 * second / mass
    centres = state.table.home + cell * told.place[:, None]
    cells, joint, depth = (jnp.repeat(a, count // len(a)) for a in (told.cells, told.joint, told.depth))
    mean, variance = centres + first[:, None], second - first**2
    rest = {
        "exponent": jnp.zeros(count),
        "splitting": _still_window.left_over(kernel, given, state.table, mean[:, 0]),
        "surprise": depth / _HELD_CUT,
    }
    growth = told.growth + observation.constant
    info = Info(
        growth, mean, variance[:, None, None], health(told.sums, cells, joint) | rest, jnp.ones((count, 2))
    )

    def laid(logs: jax.Array, mass: jax.Array, centre: jax.Array, cells: jax.Array) -> State:
        moved = Lattice(logs - jnp.log(cell * mass), centre, lattice.basis)
        return State(moved, None, cells[None], jnp.zeros(1), state.cut, plan)

    end = laid(lat.log(last), jnp.sum(last), (state.table.home + cell * place)[None], narrowest)
    kept = jax.vmap(laid)(told.logs, mass, centres, cells) if keep else None
    return replace(end, table=state.table), (info, kept), taken


def _stepped(interval: Interval, state: State, observation: Factors) -> tuple[State, Info]:
    """One step on a window that stands still."""
    assert state.table is not None and interval.still is not None
    system, plan, lattice, table = interval.system, state.plan, state.lattice, state.table
    kernel, turned, given = _still_factors(interval.still, observation)
    seen, cell = state.seen, lattice.basis[0, 0]
    if seen is None:
        seen = _still_window.seen(table, _still_window.place(table, lattice.centre[0]), lattice.log_values.size)
    new = _still_window.stepped(lattice, seen, kernel, turned, given, plan.taps, system.even)
    mass, first, second, outer, depth = new.sums
    mean, log_mass = first / mass, jnp.log(cell * mass)
    cells = lat.features(lattice._replace(log_values=new.logs), 0.0)
    joint = jax.lax.rsqrt(1.0 / jnp.minimum(state.cells[0], cells[0]) ** 2 + cell**2 / kernel.variance)
    health = {
        "edge_mass": jnp.maximum(outer / mass, _still_window.beyond(kernel, lattice.centre[0] + cell * mean, cell * plan.taps)),
        "resolution": cells[0],
        "quadrature_error": 2 * jnp.exp(-2 * jnp.pi**2 * joint**2),
        "exponent": jnp.zeros(()),
        "splitting": _still_window.left_over(kernel, given, table, lattice.centre[0] + cell * mean),
        "surprise": depth / mass / _HELD_CUT,
    }
    variance = cell**2 * (second / mass - mean**2)
    growth = new.small + log_mass + observation.constant
    info = Info(growth, lattice.centre + cell * mean, variance[None, None], health, jnp.ones(2))
    moved = lattice._replace(log_values=new.logs - log_mass)
    return replace(state, lattice=moved, cells=cells), info


def _settled(state: State) -> State:
    assert state.table is not None
    lattice, table = state.lattice, state.table
    logs, at = _still_window.laid_anew(lattice.log_values, _still_window.place(table, lattice.centre[0]), table)
    lattice = lattice._replace(log_values=logs, centre=(table.home + table.cell * at)[None])
    return replace(state, lattice=lattice, seen=_still_window.seen(table, at, logs.size))


def _still_factors(still: Still, given: Factors) -> tuple[_still_window.Kernel, Any, Factors]:
    """The kernel of one interval or many, the change of its gauge, and its halves of the factor."""
    kernel, turned, lean = still
    return kernel, turned, given._replace(before=(1 + lean) * given.before, after=(1 - lean) * given.after)


def resume(prepared: Prepared, state: State, rows: slice, begin: State) -> State:
    """The traced `state` on a lattice cut out of its own as that of `begin` was, with the same plan."""
    cut, start = np.asarray(begin.cut), prepared.schedule.starts[rows.start]
    if np.array_equal(cut, choice.SAME):
        laid = replace(state, plan=begin.plan, cut=cut)
        return replace(laid, table=_table(prepared, state.lattice, start)) if begin.plan.still else laid
    own = begin.lattice.log_values
    lattice = choice.cut_out(state.lattice, cut, own.size)
    laid = _looked_at_one(prepared, lattice, begin.plan, start, cut, own)
    return replace(laid, table=_table(prepared, lattice, start)) if begin.plan.still else laid


def step(interval: Interval, state: State, observation: Factors) -> tuple[State, Info]:
    """One interval: gauge, half factor, transition, half factor, gauge, normalise."""
    system, plan = interval.system, state.plan
    if plan.still:
        return _stepped(interval, state, observation)
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
    width = jnp.sum(interval.flow.spread[:, 0, 0])

    def inner(carry, slices):
        return _part(system, plan, interval.theta, observation, width, carry, slices, False, False)[0], None

    def at(k):
        return jax.tree.map(lambda a: a[k], slices)

    carry, summary = _part(system, plan, interval.theta, observation, width, carry, at(0), True, parts == 1)
    if parts > 2:
        carry, _ = jax.lax.scan(inner, carry, jax.tree.map(lambda a: a[1:-1], slices))
    if parts > 1:
        carry, summary = _part(system, plan, interval.theta, observation, width, carry, at(parts - 1), False, True)
    lattice, cells, observed, log_mass, worst = carry
    # A feature that the first look, over everything that could be reached, may have stepped over counts as unresolved.
    resolution = cells * jnp.minimum(1.0, 4.0 / worst.first_look)
    health = {
        # What found no room is lost beyond the edge.
        "edge_mass": jnp.where(worst.room > plan.room, 1.0, summary.edge_mass),
        "resolution": jnp.min(resolution),
        "quadrature_error": 2 * jnp.exp(-2 * jnp.pi**2 * worst.joint**2),
        "exponent": worst.exponent,
        "splitting": _left_over(interval, observation, state.lattice, state.cells) if system.halves else zero,
        "surprise": worst.surprise,
    }
    need = jnp.append(jnp.maximum(worst.need, plan.needed / resolution), worst.room)
    kept = observed if system.halves else None
    new = State(lattice, kept, cells, summary.middle, state.cut, plan)
    return new, Info(log_mass, summary.mean, summary.cov, health, need)


def _left_over(interval: Interval, observation: Factors, lattice: Lattice, cells: jax.Array) -> jax.Array:
    """By how much the exponent of an increment's likelihood, that of the mean of h on the way of the flow, is off where the ends
    of the way stand for it: at most, of the centre and of the points one standard deviation from it."""
    # Of a figure of health nothing is differentiated, least of all where h may not exist.
    interval, observation, lattice = jax.lax.stop_gradient((interval, observation, lattice))
    apart = jnp.where(jnp.array(lattice.sizes) > 1, cells, 0.0) * lattice.basis
    first = lattice.centre + jnp.concatenate([jnp.zeros((1, len(cells))), apart.T, -apart.T])
    weights = observation.before + observation.after

    def carried(x: jax.Array, of: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        return x @ of[0].T + of[1] @ observation.inputs, None

    def exponent(x: jax.Array, t: jax.Array) -> Any:
        return _linear(weights, interval.system.observe(x, t, interval.theta))

    last, _ = jax.lax.scan(carried, first, (interval.flow.map, interval.flow.shift))
    ends = 0.5 * (exponent(first, interval.start) + exponent(last, interval.stop))
    middle = exponent(0.5 * (first + last), 0.5 * (interval.start + interval.stop))
    return jnp.max(jnp.abs(middle - ends)) * 2 / 3  # by Simpson's rule


class _Worst(NamedTuple):
    """The worst cases over the parts of an interval: see the health figures of `METHOD.bounds`."""

    exponent: jax.Array
    joint: jax.Array
    first_look: jax.Array
    need: jax.Array
    surprise: jax.Array
    room: jax.Array


def _part(system, plan, theta, observation, width, carry, slices, first: bool, last: bool):
    """One part of an interval; the halves of the observation's factor stand at the `first` and the `last`.

    `width` is the variance by which the whole interval spreads one state.
    """
    lattice, cells, observed, log_mass, worst = carry
    flow, start, stop = slices
    still = jax.lax.stop_gradient  # of health nothing is differentiated
    # Readings that act as rates leave nothing to multiply with at the end.
    needs_h = last and (system.halves or not system.rates or observation.energy is not None)

    def observe(x):
        if not needs_h:
            return None
        return system.observe_sloped(x, stop, theta) if system.halves else system.observe(x, stop, theta)

    def half(logs, h):
        """Half of the observation's factor; with one state, made up for the first error of the splitting."""
        slopes = h[len(h) // 2 :] if system.halves and system.n == 1 else None
        return logs if slopes is None else made_up(logs, width * _linear(observation.before, slopes) ** 2)

    def factor(x, h):
        value = _potential(system, x, stop, theta) if system.gauged else jnp.zeros(x.shape[:-1])
        return value + half(_log_factor(h, observation), h) if last else value

    before = jnp.zeros(lattice.sizes)
    if first and observed is not None:
        before = half(_linear(observation.before, observed), observed)
    exponent = worst.exponent
    if system.gauged:
        before = before - _potential(system, lattice.points(), start, theta)
        logs = still(lattice.log_values)
        exponent = jnp.maximum(exponent, lat.exponent_range(logs, logs + still(before)))
    joint, need = _joint_cells(*still((lattice, cells, flow)), plan.sharpen, worst.joint, worst.need)
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
        first_look, room = jnp.maximum(first_look, still(coarseness)), jnp.maximum(room, still(taken))
        observed = observe(lattice.points()) if system.halves and last else None
        held = _HELD_CUT if plan.sharpen else _HELD
    surprise = jnp.maximum(worst.surprise, lat.reach(*still((lattice, spread))) / held)
    summary = lat.summary(lattice, plan.angles)
    lattice = lattice._replace(log_values=lattice.log_values - summary.log_mass)
    worst = _Worst(exponent, joint, first_look, need, surprise, room)
    return (lattice, lat.features(still(lattice)), observed, log_mass + summary.log_mass, worst), summary


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
    "interval for smooth paths (Strang's splitting); fourth order with one state on a lattice that stands still",
    theorem=theorem,
    options={"kernel": "flow", "splitting": "strang", "order": None, "memory": None},
    prepare=prepare,
    init=init,
    correct=correct,
    observations=observations,
    rule=rule,
    fits=_fits,
    step=step,
    density=density,
    adapt=adapt,
    with_parameters=with_parameters,
    resume=resume,
    adapt_many=adapt_many,
    bounds={
        "edge_mass": (1e-9, "probability in the outermost cells of the window"),
        "quadrature_error": (1e-9, "error of a lattice sum that replaces an integral"),
        "exponent": (600.0, "largest exponent of the gauge over the window; beyond 700 mass would be lost"),
        "splitting": (1e-3, "how far the ends of an interval are from telling what was seen between them, as a logarithm"),
        "surprise": (1.0, "how far into its tails the observation drives the density, as a share of the tails that were kept"),
    },
)
