"""The on-and-offline filter of Yau and Yau for any smooth system, in one to four states.

Between readings the density obeys the Kolmogorov forward equation, which knows no data; a reading multiplies it by its
likelihood, all of it online:

    u <- exp(h'S^-1 dy - h'S^-1 h dt / 2) u        for increments;        u <- N(z; h, S) u        for a sample

An increment acts in two halves around the transition (Strang's splitting, its first error undone) or, where that leaves more
than the tolerance allows, in three parts around two transitions (Chin's, of fourth order), in as many parts of the interval as
it takes.  The transition is that of `zakai.kolmogorov.comoving`, spectrally accurate on a lattice that follows the mass.
S.-T. Yau and S.S.-T. Yau (2008); the likelihood is not inside the operator, so that no large factor is undone by another.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.algebra.theorems import any_smooth_system as theorem
from zakai.densities import GridDensity
from zakai.errors import InputError
from zakai.filters import _lattice_choice as choice
from zakai.filters import _splitting as splitting
from zakai.filters import _tabled as tabled
from zakai.filters import _window as window
from zakai.filters._formulas import Formulas, formulas
from zakai.filters._protocol import Info, Method, Schedule
from zakai.filters._window import Plan, Room, Shape
from zakai.filters.observations import Data, Whole, WholeRule, whole_rule
from zakai.kolmogorov import characteristics, comoving, finite_volume
from zakai.kolmogorov.comoving import Field
from zakai.kolmogorov.reductions import highest, summed
from zakai.kolmogorov.resolution import resolution_of
from zakai.models.compile import jax_field, jax_function
from zakai.models.model import Model
from zakai.models.numeric import numpy_function


class System:
    """The formulas of a model as functions of many points at once."""

    def __init__(self, model: Model):
        self.n = model.n
        self.drift = jax_field(model.drift, model)
        self.observe = jax_field(model.observation, model)
        self.continuous = model.observation_kind != "samples"
        self.covariance = jax_function(model.covariance, model, (model.n, model.n))
        self.tables = tabled.Tables(model) if tabled.serves(model) else None


@lru_cache(maxsize=64)
def _system(of: Formulas) -> System:
    return System(of.model)


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["field", "observed", "cut", "room", "error", "coarser", "table"],
    meta_fields=["shape"],
)
@dataclass(frozen=True)
class State:
    """The probabilities of the cells of a lattice, the plan in two parts, and h at the points, an array for each coordinate.

    `error` estimates how far the density is from that of the equation, relative to itself; `coarser` is the most that the error
    of splitting would have come to in this run of steps with the next fewer transitions.

    `observed` is None where the lattice is laid anew in every step, and where it stands still with a `table`.  `cut` (2, n) says
    how the first lattice of this run of steps was cut out of the last of the run before.
    """

    field: Field
    observed: Any
    cut: Any
    room: Room
    shape: Shape
    error: Any = 0.0
    coarser: Any = 0.0
    table: Any = None

    LASTING = ("table",)
    PLANNED = ("cut", "room")

    @property
    def plan(self) -> Plan:
        """The two parts of the plan together; not inside of a compiled step."""
        return Plan.of(self.shape, self.room)

    @property
    def kept(self) -> State:
        """What a result keeps of the state."""
        return replace(self, observed=None, table=None)

    def tried(self, begin: State) -> State:
        """This state, which a run of steps was to begin with, with the plan and the cut of `begin`, with which it was tried.

        The next try is cut out of this one again: what a try has cut away is not there any more.
        """
        return replace(self, cut=begin.cut, room=begin.room, shape=begin.shape)

    @property
    def run_length(self) -> int:
        """How many steps to take before the lattice is looked at again."""
        return int(np.max(self.room.run))

    @property
    def worth_while(self) -> int:
        """After how many of them to look again anyway: the more parts an interval has, the sooner they may be too many."""
        return max(window.SHORTEST, int(self.run_length / (np.max(self.room.splits) * np.max(self.room.parts))))

    @property
    def some(self) -> Callable[..., Any] | None:
        """What takes several steps at once, where they can be."""
        return _tabled_steps if self.shape.tabled else None


@partial(jax.tree_util.register_dataclass, data_fields=["start", "stop", "theta"], meta_fields=["system"])
@dataclass(frozen=True)
class Interval:
    """One interval: its ends, the parameters, and the static system."""

    start: Any
    stop: Any
    theta: Any
    system: System


@dataclass(frozen=True, eq=False)
class Prepared:
    """What is known without data."""

    model: Model
    system: System
    schedule: Schedule
    plan: Plan
    theta: Any
    intervals: Interval
    memory: int
    # The first state of the last prior, which many records share.
    first: dict[int, tuple[Any, State]] = field(init=False, default_factory=dict)


def prepare(
    model: Model,
    schedule: Schedule,
    *,
    tolerance: float = 1e-4,
    operator: str = "spectral",
    substeps: int | None = None,
    memory: float | None = None,
) -> Prepared:
    """The intervals and the plan to begin with.

    `tolerance` is how far from the solution of the equation, relative to itself, a density may be after a step for each of three
    reasons, the window, the cells and the steps in time, and in the long run because an increment's likelihood is split from
    the transition.  `operator` is "spectral", "finite-volume", which is positive and conserves mass whatever the cells, and of
    second order in them, or "characteristics", which is for weak noise and long intervals.  `substeps` splits each interval,
    observation included, in equal parts by Strang's splitting; by default they are as many as the tolerance asks for, by Chin's
    where one by Strang's is not enough.  `memory` is how many MiB lattices may take, by default half of what the machine has.
    Raises InputError for another value.
    """
    if isinstance(tolerance, bool) or not isinstance(tolerance, (int, float)) or not 1e-9 <= tolerance <= 0.1:
        raise InputError(f"option tolerance: {tolerance!r} must be a number from 1e-9 to 0.1")
    if operator not in OPERATORS:
        raise InputError(f"option operator: {operator!r} is none of {', '.join(OPERATORS)}")
    if operator == "characteristics" and model.n > 3:
        raise InputError(f'option operator: "characteristics" is for one to three states, {model.source} has {model.n}')
    if substeps is not None and (isinstance(substeps, bool) or not isinstance(substeps, int) or substeps < 1):
        raise InputError(f"option substeps: {substeps!r} must be a whole number from 1")
    if memory is not None and not (isinstance(memory, (int, float)) and not isinstance(memory, bool) and 0 < memory < np.inf):
        raise InputError(f"option memory: {memory!r} must be a positive number of MiB")
    theta = model.theta()
    sizes = (window.LEAST[model.n],) * model.n
    follow = model.n > 1 and model.observation_kind == "samples" and operator == "spectral" or operator == "characteristics"
    allowed = 0.5 * tolerance if substeps is None and model.observation_kind != "samples" else np.inf
    plan = Plan(sizes, float(tolerance), substeps or 1, run=_most(model.n, operator), follow=follow, order=4)
    plan = replace(plan, operator=operator, splitting=allowed)
    system = _system(formulas(model))
    budget = choice.free_memory() if memory is None else int(memory * 2**20)
    return Prepared(model, system, schedule, plan, theta, _intervals(system, schedule, theta), budget)


def _most(n: int, operator: str) -> int:
    """How many steps a run has at most."""
    return window.BRIEF if operator == "characteristics" else window.RUNS[n]


def _intervals(system: System, schedule: Schedule, theta: Any) -> Interval:
    xp = np if isinstance(theta, np.ndarray) else jnp
    count = len(schedule.starts)
    return Interval(schedule.starts, schedule.stops, xp.broadcast_to(theta, (count, len(theta))), system)


def with_parameters(prepared: Prepared, theta: Any) -> Prepared:
    """The same for other values of the parameters; traced by JAX."""
    return replace(prepared, theta=theta, intervals=_intervals(prepared.system, prepared.schedule, theta))


def observations(prepared: Prepared, data: Data) -> Whole:
    """The whole likelihood of every interval's readings."""
    return rule(prepared, data)(data.filled)


def rule(prepared: Prepared, data: Data) -> WholeRule:
    """The same but for the values."""
    return whole_rule(prepared.model, data, prepared.theta)


def init(prepared: Prepared, prior: Any) -> State:
    """The prior on a lattice that fits it."""
    known, state = prepared.first.get(id(prior), (None, None))
    if known is not prior or state is None:
        with jax.ensure_compile_time_eval():
            first, plan, _ = window.first_field(prepared.model, prior, None, prepared.plan)
            state = _looked_at(prepared, first, plan, prepared.model.start)
        prepared.first.clear()
        prepared.first[id(prior)] = prior, state
    return state


def correct(prepared: Prepared, prior: Any, observation: Whole) -> tuple[State, Info]:
    """The prior after samples at the start itself."""
    model = prepared.model
    one = jax.tree.map(lambda a: np.asarray(a)[0], observation)
    with jax.ensure_compile_time_eval():

        def log_factor(x: np.ndarray) -> np.ndarray:
            return np.asarray(_log_factor(prepared.system.observe(x, model.start, prepared.theta), one, 1.0) + one.constant)

        _, _, before = window.first_field(model, prior, None, prepared.plan)
        first, plan, after = window.first_field(model, prior, log_factor, prepared.plan)
        state = _looked_at(prepared, first, plan, model.start)
        mean, cov = _moments(first)
    return state, Info(jnp.asarray(after - before), mean, cov, _no_health())


OPERATORS = "spectral", "finite-volume", "characteristics"
NEAR_EDGE = 10.0  # what mass counts for that stands in the sixteenth of a lattice on each side, and
OUTSIDE = window.REACH**2  # what mass in the outermost layers does: in the variance, so many deviations from the mean
HEALTH = ("aliasing", "edge_mass", "time_error", "lost", "splitting", "missed", "error_estimate")


def _no_health() -> dict[str, jax.Array]:
    return {name: jnp.zeros(()) for name in HEALTH}


def correct_again(prepared: Prepared, prior: Any, observation: Whole, begin: State) -> tuple[State, Info]:
    """`correct` for traced parameters, on the lattice of the state that an ordinary run began with."""
    model, plan, field = prepared.model, begin.plan, jax.tree.map(np.asarray, begin.field)
    _, _, before = window.first_field(model, prior, None, prepared.plan)
    points = (field.centre + _index(plan.sizes) @ field.basis.T).reshape(*plan.sizes, model.n)
    with np.errstate(all="ignore"):
        logs = choice.prior_box(model, prior)[1](points)
    one = jax.tree.map(lambda a: a[0], observation)
    factor = _log_factor(prepared.system.observe(points, model.start, prepared.theta), one, 1.0) + one.constant
    logs = np.where(np.isnan(logs), -np.inf, logs) + factor
    top = jax.lax.stop_gradient(jnp.max(logs))
    values = jnp.exp(logs - top)
    mass = jnp.sum(values)
    gained = top + jnp.log(mass) + np.log(abs(np.linalg.det(field.basis))) - before
    state = _looked_at(prepared, Field(values / mass, field.centre, field.basis), plan, model.start)
    mean, cov = _moments(state.field)
    return state, Info(gained, mean, cov, _no_health())


def _looked_at(prepared: Prepared, field: Field, plan: Plan, time: float) -> State:
    observed = None
    if not plan.follow:
        observed = prepared.system.observe(comoving.points_of(plan.sizes, field.centre, field.basis), time, prepared.theta)
    cut = jnp.asarray(_SAME(prepared.model.n))
    return State(jax.tree.map(jnp.asarray, field), observed, cut, plan.room, plan.shape, jnp.zeros(()), jnp.zeros(()))


def _moments(field: Field) -> tuple[jax.Array, jax.Array]:
    _, mean, cov = comoving.moments(field.values)
    return field.centre + field.basis @ mean, field.basis @ cov @ field.basis.T


def _log_factor(h: Sequence[jax.Array], factor: Whole, share: Any) -> jax.Array:
    """share (linear . h - h'(energy) h / 2)."""
    total = sum((factor.linear[i] * a for i, a in enumerate(h)), start=jnp.zeros(()))
    for i, a in enumerate(h):
        total = total - 0.5 * a * sum(factor.energy[i, j] * b for j, b in enumerate(h))
    return share * total


class _Worst(NamedTuple):
    """The worst over the parts of an interval: see `METHOD.bounds`."""

    aliasing: Any
    edge: Any
    error: Any
    lost: Any
    splitting: Any

    def over(self, other: _Worst) -> _Worst:
        return _Worst(*(jnp.maximum(a, b) for a, b in zip(self, other)))


def _weighted(values: jax.Array, most: Any, logs: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The values, of which `most` is the largest, times exp(logs - top), and top."""
    still = jax.lax.stop_gradient
    top = still(highest(jnp.where(values > comoving.LOST * most, logs, -jnp.inf)))
    # Where nothing of the density is left a factor may be as large as it likes.
    return values * jnp.exp(logs - top - still(jnp.maximum(logs - top, 0.0))), top


def _multiplied(values: jax.Array, logs: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The values times exp(logs), summing to one; the logarithm of what they summed to; and that of the factor by which what
    stood in the tails has grown, relative to the maximum."""
    most = highest(values)
    after, top = _weighted(values, most, logs)
    grown = jax.lax.stop_gradient(jnp.log(most / highest(after)))
    mass = summed(after)
    return after / mass, jnp.log(mass) + top, grown


def step(interval: Interval, state: State, observation: Whole) -> tuple[State, Info]:
    """One interval: parts of the likelihood with the transition between them, or all of it at the end."""
    if state.shape.tabled:
        one = jax.tree.map(lambda a: jnp.asarray(a)[None], (interval, observation))
        states, info = _tabled_steps(one[0], state, one[1])
        state, info = jax.tree.map(lambda a: a[0], (replace(states, table=None), info))
        return replace(state, table=states.table), info
    system, plan, theta = interval.system, state.shape, interval.theta
    splits, parts = plan.splits or state.room.splits, plan.parts or state.room.parts
    length, share = (interval.stop - interval.start) / splits, observation.inside / splits
    scheme = plan.scheme if system.continuous else splitting.STRANG
    between = length / (len(scheme.shares) - 1)
    zero, still = jnp.zeros(()), jax.lax.stop_gradient

    def drift(x: jax.Array, t: Any) -> Sequence[jax.Array]:
        return system.drift(x, t, theta)

    def covariance(t: Any) -> jax.Array:
        return system.covariance(jnp.zeros(system.n), t, theta)

    def spread(inverse: jax.Array, t: Any) -> jax.Array:
        return inverse @ covariance(t) @ inverse.T

    def ahead(x: jax.Array) -> jax.Array:
        """The sample at the end of the interval; increments are many, and none says much."""
        if system.continuous:
            return jnp.zeros(x.shape[:-1])
        return _log_factor(system.observe(x, interval.stop, theta), observation, 1.0 - observation.inside)

    def part(number: Any, time: Any, carry: Any, k: Any) -> Any:
        field, spent, cells = carry
        tau = between / parts
        time = time + k * tau
        if plan.operator == "characteristics":
            left = 0 if system.continuous else jnp.asarray((splits - number) * parts - k - 1, int)
            reach = window.NEARER * state.room.reach
            field, error, rough = characteristics.moved(field, drift, covariance, time, tau, reach, ahead, left)
            return field, spent + error, cells + rough
        if plan.operator == "finite-volume":
            field, error = finite_volume.moved(field, drift, covariance, time, tau, plan.order)
        else:
            field, error = comoving.moved(
                field, drift, covariance, time, tau, plan.order, plan.follow, plan.cross, plan.aligned, plan.quiet
            )
        return field, spent + error, cells

    def looked_at(values: jax.Array, noise: Any, error: Any, grown: Any, cells: Any = 0.0, tails: Any = 0.0) -> _Worst:
        # Noise is the same everywhere; what a formula of order four leaves is a polynomial of degree five times the density.
        lost = jnp.maximum(noise * jnp.exp(jnp.minimum(grown, 99.0)), tails)
        # The error of the characteristics is that of a logarithm, where the reading is going to put the mass.
        steep = 1.0 if plan.operator == "characteristics" else (1 + grown) ** 2.5
        aliasing, edge_mass = resolution_of(values)
        return _Worst(jnp.maximum(aliasing, cells), edge_mass, error * steep, lost, zero)

    def factor(field: Field, observed: Any, time: Any, share: Any, undone: Any) -> jax.Array:
        if not system.continuous:
            return jnp.zeros(plan.sizes)
        if isinstance(undone, float) and undone == 0:
            return share * logs(observed)
        inverse = comoving.inverse(field.basis)
        return splitting.corrected(logs(observed), spread(inverse, time), length, share, undone)

    def logs(observed: Any) -> jax.Array:
        return _log_factor(observed, observation, share)

    def split(carry: Any, k: Any) -> Any:
        field, observed, log_mass, before, error, coarser, worst = carry
        begin = interval.start + k * length
        shares, undone = np.array(scheme.factors).T
        values, gained, grown = _multiplied(field.values, factor(field, observed, begin, *scheme.factors[0]))
        worst = worst.over(looked_at(values, comoving.LOST, before, grown))

        def multiplied(carry: Any, j: Any) -> Any:
            """A part of the transition, then one of the likelihood."""
            field, _, log_mass, spent, made, worst = carry
            time = begin + j * between
            field, now, cells = tabled.repeated(partial(part, k, time), (field, spent, zero), plan.parts, parts)
            observed = system.observe(field.points(plan.aligned), time + between, theta)
            noise = comoving.noise(field.values)
            # Only here: to cut tails in every part would make kinks, and these more noise.
            values, tails = field.values, zero
            if plan.operator != "characteristics":
                values = jnp.where(values > noise * highest(values), values, 0.0)
                # The squared deviations, each a share of those of a Gaussian where its density is that of the noise.
                tails = jnp.abs(1.0 - summed(values) / summed(field.values)) * jnp.log(1.0 / noise) * 2 / system.n
            j = jnp.asarray(j, int)
            last = factor(field, observed, time + between, jnp.asarray(shares)[j + 1], jnp.asarray(undone)[j + 1])
            if plan.splits == 1:
                at_end = _log_factor(observed, observation, 1.0 - observation.inside)
                last = last + jnp.where(j == len(shares) - 2, 1.0, 0.0) * at_end
            values, more, grown = _multiplied(values, last)
            look = looked_at(values, noise, now, grown, cells, tails)
            made = jnp.maximum(made, look.aliasing + look.lost + OUTSIDE * look.edge)
            return field._replace(values=values), observed, log_mass + more, now, made, worst.over(look)

        carry = field._replace(values=values), observed, log_mass + gained, before, zero, worst
        count = len(shares) - 1
        field, observed, log_mass, spent, made, worst = tabled.repeated(multiplied, carry, count, count)
        thin, apart = splitting.thinned(plan.sizes)
        inverse, end = comoving.inverse(field.basis * apart), begin + length
        flow = list(jnp.tensordot(inverse, jnp.stack(drift(field.points(plan.aligned)[thin], end)), axes=1))
        log = logs([h[thin] for h in observed]) if system.continuous else None
        terms = splitting.terms(log, field.values[thin], flow, spread(inverse, end), scheme)
        left, apart, fewer = _split_error(plan, splits, terms, length)
        error = still(splitting.added(error, left + made + spent - before, terms.forgets, length))
        worst = worst._replace(splitting=still(jnp.maximum(worst.splitting, apart)))
        return field, observed, log_mass, spent, error, still(jnp.maximum(coarser, fewer)), worst

    field, observed = state.field, state.observed
    if observed is None:
        observed = system.observe(field.points(plan.aligned), interval.start, theta)
    carry = field, observed, observation.constant, zero, state.error, state.coarser, _Worst(zero, zero, zero, zero, zero)
    field, observed, log_mass, spent, error, coarser, worst = tabled.repeated(split, carry, plan.splits, splits)
    if plan.splits != 1:
        values, more, grown = _multiplied(field.values, _log_factor(observed, observation, 1.0 - observation.inside))
        field, log_mass = field._replace(values=values), log_mass + more
        worst = worst.over(looked_at(values, comoving.LOST, spent, grown))
    mean, cov = _moments(field)
    if plan.operator == "characteristics":
        observed = None
    elif plan.follow:
        field, observed = comoving.relaid(field, state.room.reach), None
    missed = jnp.max(jnp.stack([figure / most for figure, most in zip(worst, state.room.allowed, strict=True)]))
    health = still(dict(zip(HEALTH, (*worst, missed, error), strict=True)))
    return State(field, observed, state.cut, state.room, plan, error, coarser), Info(log_mass, mean, cov, health)


def _split_error(plan: Shape, splits: Any, terms: splitting.Terms, length: Any) -> tuple[Any, Any, Any]:
    """What the splitting leaves of one of `splits` parts of an interval, what that comes to in the long run, and what it would
    with the next fewer transitions."""

    def in_the_long_run(error: Any) -> Any:
        return splitting.expected(error, terms.forgets, length)

    error = splitting.error(plan.scheme, terms, length)
    apart = in_the_long_run(error)
    fewest = in_the_long_run(splitting.error(splitting.STRANG, terms, length)) if plan.chin else jnp.zeros(())
    return error, apart, jnp.where(splits > 1, 2**plan.scheme.order * apart, fewest)


def _tabled_steps(intervals: Interval, state: State, observations: Whole) -> tuple[State, Info]:
    """K steps of the same on a lattice that stands still, with its Table: the states and what is told, with a leading axis K.

    Only what a step must know of the one before is in a loop; all the rest is done for all steps at once.
    """
    plan, table, increments = state.shape, state.table, intervals.system.continuous
    splits = plan.splits or state.room.splits
    lengths = (intervals.stop - intervals.start) / splits
    share = observations.inside / splits
    whole = tabled.likelihood(table, observations, 1.0)
    b = tabled.Likelihood(*(share[:, None] * part for part in whole))
    scheme = plan.scheme if increments else splitting.STRANG
    nothing = jnp.zeros_like(b.log)
    factors = [tabled.corrected(b, lengths[:, None], *part) if increments else nothing for part in scheme.factors]
    ends = factors[-1] + (1.0 - observations.inside)[:, None] * whole.log
    passed = tabled.passed(table, state.field.values, factors, ends, splits, plan.splits)
    values, top = tabled.weighted(passed.after, ends)
    told = tabled.told(table, passed.before, values, b, scheme)
    lost, worst = passed.lost.T
    lost = jnp.maximum(lost / jnp.max(values, axis=1), worst)
    left, apart, fewer = _split_error(plan, splits, told.terms, lengths)
    made = told.aliasing + lost + NEAR_EDGE * told.edge
    grown = top + jnp.log(told.total)
    log_mass = observations.constant + passed.gained + jnp.diff(grown, prepend=0.0)
    error = splitting.added_up(state.error, left + made, told.terms.forgets, lengths, splits)
    coarser = jnp.maximum(state.coarser, jax.lax.cummax(fewer))
    zero = jnp.zeros_like(lost)
    health = told.aliasing, told.edge, zero, lost, apart
    missed = jnp.max(jnp.stack(health) / jnp.stack(state.room.allowed)[:, None], axis=0)
    centre, basis = state.field.centre, state.field.basis
    info = Info(
        log_mass,
        centre + basis[0] * told.mean[:, None],
        basis**2 * told.variance[:, None, None],
        dict(zip(HEALTH, (*health, missed, error), strict=True)),
    )
    every = jax.tree.map(lambda a: jnp.broadcast_to(a, (len(lost), *jnp.shape(a))), replace(state, table=None))
    field = every.field._replace(values=values / told.total[:, None])
    return replace(every, field=field, error=error, coarser=coarser, table=table), info


def adapt(prepared: Prepared, state: State, rows: slice, info: Info | None) -> State | None:
    """The state to begin the intervals `rows` with: its lattice and its plan."""
    one = jax.tree.map(lambda a: np.asarray(a)[None], replace(state, table=None))
    many = adapt_many(prepared, one, rows, info)
    if many is None:
        return None
    return replace(jax.tree.map(lambda a: np.asarray(a)[0], replace(many, table=None)), table=many.table)


def adapt_many(prepared: Prepared, states: State, rows: slice, info: Info | None) -> State | None:
    """`adapt` of states with a leading axis of records: one plan for all, the best that any of them needs, and one table."""
    model, plan, last = prepared.model, states.plan, np.asarray(states.cut)
    fields, none = jax.tree.map(np.asarray, states.field), np.zeros(len(last))
    if info is None:
        plan = window.relaxed(plan, _most(model.n, plan.operator), prepared.plan.follow, float(np.max(states.coarser)))
        last = np.tile(_SAME(model.n), (len(last), 1, 1))
    elif window.healthy(info).all():
        return None
    while True:
        if info is not None:
            better = window.more(plan, info)
            if better is None:
                return None
            plan = better
        cut, best, table = _lattice(prepared, fields, plan, rows, info)
        same = np.all(cut == last)
        if best == states.plan and same:
            return replace(states, cut=last, table=table, coarser=none) if info is None else None
        # Sizes are few: what asks for a little more may get the same.
        if info is None or not same or best.shape != states.plan.shape or best.room.counts != states.plan.room.counts:
            plan = best
            break
    fields, observed = _cut_out(fields, cut, plan), None
    if table is None and not plan.follow:
        # With NumPy, as the cutting out: nothing is compiled to look at a lattice.
        points = fields.centre[:, None] + _index(plan.sizes) @ np.swapaxes(fields.basis, 1, 2)
        h = numpy_function(model.observation, model)(points, float(prepared.schedule.starts[rows.start]), prepared.theta)
        observed = tuple(h[..., i].reshape(len(cut), *plan.sizes) for i in range(model.m))
    return State(fields, observed, cut, _room(plan, len(cut)), plan.shape, np.asarray(states.error), none, table)


def _lattice(prepared: Prepared, fields: Field, plan: Plan, rows: slice, info: Info | None) -> tuple[np.ndarray, Plan, Any]:
    """How to cut the lattices for the next run out of the fields' own, the plan for it and the Table, if it is taken with one."""
    model, measures = prepared.model, window.measured(fields, plan)
    found = None if measures is None else _table(prepared, fields, measures, plan, rows)
    if found is not None:
        return found
    plan = replace(plan, tabled=False)
    cut, _ = window.fitted(fields, measures, plan, lambda sizes: None)
    least = window.timed(model, plan, prepared.intervals, rows, fields, cut[:, 1])
    # What a try has shown counts for more than what the coefficients say.
    best = least if info is None else replace(least, order=max(plan.order, least.order), parts=max(plan.parts, least.parts))
    return *window.fitted(fields, measures, best, lambda sizes: window.check_memory(model, sizes, prepared.memory)), None


def _table(
    prepared: Prepared, fields: Field, measures: window.Extent, plan: Plan, rows: slice
) -> tuple[np.ndarray, Plan, tabled.Table] | None:
    """The same where a Table serves; None where it does not."""
    tables = prepared.system.tables
    if tables is None:
        return None
    tau = float(prepared.schedule.stops[rows.start] - prepared.schedule.starts[rows.start]) / plan.steps
    enough, theta = plan.tabled or rows.stop - rows.start >= tabled.FEWEST, prepared.theta
    if plan.operator != "spectral" or not enough or not _regular(prepared.schedule, rows):
        return None
    if tabled.crossed(fields, tables, theta, tau):
        return None
    place = tabled.placed(fields, measures, plan)
    table = None if place is None else tables.of(*place, tau, theta)
    if place is None or table is None:
        return None
    centre, cell, size = place
    old = fields.basis[:, 0, 0]
    cut = np.stack([(centre - fields.centre[:, 0]) / old, cell / old], axis=1)[:, :, None]
    plan = replace(plan, sizes=(size,), tabled=True, order=2, parts=1, cross=False)
    return cut, plan, table


def alone(prepared: Prepared) -> bool:
    """Whether steps are taken with tables: then records that share nothing else need not share a lattice."""
    spectral = prepared.plan.operator == "spectral"
    return prepared.system.tables is not None and spectral and _regular(prepared.schedule, slice(None))


def _regular(schedule: Schedule, rows: slice) -> bool:
    lengths = schedule.stops[rows] - schedule.starts[rows]
    return bool(np.ptp(lengths) <= 1e-9 * lengths[0])


def _index(sizes: tuple[int, ...]) -> np.ndarray:
    return np.stack(np.meshgrid(*comoving.axes_of(sizes), indexing="ij"), axis=-1).reshape(-1, len(sizes))


def _SAME(n: int) -> np.ndarray:
    return np.stack([np.zeros(n), np.ones(n)])


def _room(plan: Plan, count: int) -> Room:
    return Room(*(np.full(count, part) for part in plan.room))


def _cut_out(fields: Field, cut: np.ndarray, plan: Plan) -> Field:
    if np.array_equal(cut, np.broadcast_to(_SAME(1), cut.shape)) and plan.tabled and fields.values.shape[1:] == plan.sizes:
        return fields
    if plan.operator == "characteristics":
        # The step lays the lattice, also this one but for its sizes.
        return fields if fields.values.shape[1:] == plan.sizes else _laid(fields, plan.sizes, window.NEARER * plan.room.reach)
    fields = comoving.resampled(fields, cut[:, 0], cut[:, 1], plan.sizes)
    return _relaid(fields, plan.room.reach) if plan.follow else fields


@jax.jit
def _relaid(fields: Field, reach: Any) -> Field:
    return jax.vmap(lambda field: comoving.relaid(field, reach))(fields)


@partial(jax.jit, static_argnums=1)
def _laid(fields: Field, sizes: tuple[int, ...], reach: Any) -> Field:
    return jax.vmap(lambda field: characteristics.relaid(field, sizes, reach))(fields)


def resume(prepared: Prepared, state: State, rows: slice, begin: State) -> State:
    """The traced `state` on a lattice cut out of its own as that of `begin` was, with the same plan."""
    plan, cut = replace(begin.plan, fixed=True), np.asarray(begin.cut)
    if plan.tabled:
        # A table has no derivatives: the transition is that of a lattice that moves.
        own = jax.tree.map(lambda a: np.asarray(a)[None], begin.field)
        plan = window.timed(prepared.model, replace(plan, tabled=False), prepared.intervals, rows, own, np.ones((1, 1)))
    field = state.field
    if not np.array_equal(cut, _SAME(prepared.model.n)) or plan.sizes != state.shape.sizes or plan.follow:
        field = jax.tree.map(lambda a: a[0], _cut_out(jax.tree.map(lambda a: a[None], field), cut[None], plan))
    observed = None
    if not plan.follow:
        observed = prepared.system.observe(field.points(), float(prepared.schedule.starts[rows.start]), prepared.theta)
    return State(field, observed, cut, plan.room, plan.shape, state.error, state.coarser)


def density(prepared: Prepared, state: State) -> GridDensity:
    """The posterior on its lattice; zero where rounding leaves nothing of it."""
    field = jax.tree.map(np.asarray, state.field)
    with np.errstate(divide="ignore"):
        logs = np.log(np.maximum(field.values, 0.0))
    names = prepared.model.state
    return GridDensity(logs, field.centre, field.basis, names, (False,) * len(names))


METHOD = Method(
    name="yau-yau",
    source="S.-T. Yau and S.S.-T. Yau 2008; likelihood online",
    exactness="convergent: spectral in the lattice, of fourth order in the parts of a transition and in those of an interval for "
    "increments (Chin's splitting; with `substeps` Strang's with its first error undone, of second order)",
    theorem=theorem,
    options={"tolerance": 1e-4, "operator": "spectral", "substeps": None, "memory": None},
    prepare=prepare,
    init=init,
    correct=correct,
    correct_again=correct_again,
    observations=observations,
    rule=rule,
    step=step,
    density=density,
    adapt=adapt,
    with_parameters=with_parameters,
    resume=resume,
    adapt_many=adapt_many,
    alone=alone,
    healthy=window.healthy,
    bounds={
        "missed": (
            1.0,
            "by what factor the tolerance was missed: aliasing (a tenth of it is allowed), edge_mass (a hundredth), time_error "
            "(a tenth), lost, the share of the maximum below which tails were lost when an observation came to need them or of "
            "the variance that went with them, or "
            "splitting, what the splitting of increments from the transition comes to in the long run",
        ),
    },
)
