"""The filter of Wei and Norman for a finite estimation algebra, in one to three states.

    sigma(t) = exp(r_d(t) E_d) ... exp(r_1(t) E_1) exp(t L_0) sigma_0

The observations enter only through the statistics r, which obey ordinary differential equations that follow from the structure
constants; exp(t L_0) sigma_0 knows no observation and is computed on a lattice.  Statistics grow exponentially in time, and the
multiplier that they make amplifies what rounding left of the tails; before it is large the density is formed and both begin anew.

Wei and Norman (1964); for their bases Yau (1993), Theorem 6, corrected, and Dong, Chen and Yau (2021), Theorem 4.1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from zakai import _float64  # noqa: F401
from zakai.algebra.estimation_algebra import estimation_algebra
from zakai.algebra.exponentials import wei_norman_filter as theorem
from zakai.densities import GridDensity
from zakai.errors import ConditionError, InputError
from zakai.filters import _lattice_choice as choice
from zakai.filters._exponentials import STEP, System, system_of
from zakai.filters._protocol import Info, Method, Schedule
from zakai.filters.observations import Data, FactorRule, Factors, factor_rule, noise_at
from zakai.kolmogorov import spectral
from zakai.kolmogorov.resolution import resolution_of
from zakai.kolmogorov.spectral import Field, Generator
from zakai.models.compile import jax_field
from zakai.models.model import Model
from zakai.models.prior import DensityPrior

POINTS = {1: 128, 2: 80, 3: 56}
_RESTART = 3.0  # nats over which the multiplier may range where the density matters, before the statistics begin anew
_SHIFT = 0.1  # how far the product may shift the density, as a share of the lattice
_DRIVE = 2.0  # nats that one part of an interval may add
_MATTERS = 1e-10  # of the maximum
_MOST_PARTS = 2048
_RUNS = {1: 256, 2: 32, 3: 4}


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["field", "statistics", "log_scale", "mean", "driven", "theta"],
    meta_fields=["system", "parts"],
)
@dataclass(frozen=True)
class State:
    """v = exp(t L_0) sigma_0 since the last beginning, on a lattice, and the `statistics` (d,).

    The density of mass one is exp(`log_scale`) times their product, and has this `mean` (n,); `driven` (n,) is by how many
    deviations the observations drove it, of late, to where the tails may have been cut.  An interval has at most `parts`.
    """

    field: Field
    statistics: Any
    log_scale: Any
    mean: Any
    driven: Any
    theta: Any
    system: System
    parts: int

    @property
    def run_length(self) -> int:
        """How many steps are taken at once."""
        return _RUNS[self.system.n]

    @property
    def possible(self) -> bool:
        """Whether a state that somebody tells of can be one of ours."""
        return 0 < self.parts <= _MOST_PARTS


class Interval(NamedTuple):
    """One interval: its length, whether all coordinates are observed in it, the inverse (m, m) of the block of S of those that
    are, and the parameters."""

    length: Any
    whole: Any
    precision: Any
    theta: Any


@dataclass(frozen=True, eq=False)
class Prepared:
    """What is known without data."""

    model: Model
    schedule: Schedule
    system: System
    sizes: tuple[int, ...]
    theta: Any
    intervals: Interval


def prepare(model: Model, schedule: Schedule, *, points: int | None = None) -> Prepared:
    """The equations and, of every interval, its L_0.

    `points` is the size of each axis of the lattice.  Raises InputError for one that is not a whole number from 16.
    """
    if points is not None and (isinstance(points, bool) or not isinstance(points, int) or not 16 <= points <= 4096):
        raise InputError(f"option points: {points!r} must be a whole number from 16 to 4096")
    sizes = (points or POINTS[model.n],) * model.n
    theta = model.theta()
    return Prepared(model, schedule, system_of(model), sizes, theta, _intervals(model, schedule, theta))


def with_parameters(prepared: Prepared, theta: Any) -> Prepared:
    """The same for other values of the parameters; traced by JAX."""
    model = prepared.model
    said = estimation_algebra(model).parameters
    if said and not said.startswith("the same for general values"):
        raise ConditionError(f"{model.source}: wei-norman has no gradient here: its algebra is known {said}")
    return replace(prepared, theta=theta, intervals=_intervals(model, prepared.schedule, theta))


def _intervals(model: Model, schedule: Schedule, theta: Any) -> Interval:
    xp = np if isinstance(theta, np.ndarray) else jnp
    count, m = schedule.inside.shape
    both = schedule.inside[:, :, None] & schedule.inside[:, None, :]
    noise = xp.where(both, noise_at(model, schedule.stops, theta), 0.0) + np.eye(m) * ~schedule.inside[:, None, :]
    return Interval(
        schedule.stops - schedule.starts,
        schedule.inside.all(axis=1),
        xp.where(both, xp.linalg.inv(noise), 0.0),
        xp.broadcast_to(theta, (count, len(theta))),
    )


def observations(prepared: Prepared, data: Data) -> Factors:
    """What `step` is given for each interval: y runs linearly inside of it, and what cannot is a factor at its end."""
    return rule(prepared, data)(data.filled)


def rule(prepared: Prepared, data: Data) -> FactorRule:
    """The same but for the values."""
    return factor_rule(
        prepared.model, data, prepared.schedule, rates=True, splitting="strang", remove=False, theta=prepared.theta
    )


def init(prepared: Prepared, prior: Any) -> State:
    """The prior on a lattice."""
    model, system = prepared.model, prepared.system
    with jax.ensure_compile_time_eval(), np.errstate(all="ignore"):
        first, _ = choice.first_lattice(model, prior, None)
        logs = np.asarray(first.log_values)
        if min(logs.shape) == 1:
            raise InputError(f"{model.source}: prior: a variance is zero; wei-norman needs a density in every coordinate")
        held = np.asarray(first.points())[logs > logs.max() + np.log(spectral.SUPPORT)]
        field = spectral.laid_around(choice.log_prior(model, prior), held.min(axis=0), held.max(axis=0), prepared.sizes)
        points = field.points()
    if isinstance(prior, DensityPrior) and not isinstance(prepared.theta, np.ndarray):
        # Where there is no density a formula may not exist; a point where it does stands in.
        there, top = field.values > 0, np.unravel_index(np.argmax(field.values), field.values.shape)
        safe = jnp.where(there[..., None], points, points[top])
        traced = jax_field([prior.log_density], model)(safe, model.start, prepared.theta)[0]
        field = field._replace(values=jnp.where(there, jnp.exp(traced - lax.stop_gradient(jnp.max(traced))), 0.0))
    field = jax.tree.map(jnp.asarray, field)
    log_mass, mean, _ = spectral.moments(field)
    still = lax.stop_gradient(mean)
    return State(field, jnp.zeros(system.count), -log_mass, still, jnp.zeros_like(still), jnp.asarray(prepared.theta), system, 4)


def correct(prepared: Prepared, prior: Any, observation: Factors) -> tuple[State, Info]:
    """Only samples are read at the start, and for samples the theorem does not hold."""
    raise ConditionError(f"{prepared.model.source}: wei-norman does not hold for samples")


class _Health(NamedTuple):
    """The worst over the parts of an interval, and how many there were."""

    aliasing: Any
    exponent: Any
    edge: Any
    surprise: Any
    parts: Any


def step(interval: Interval, state: State, observation: Factors) -> tuple[State, Info]:
    """One interval in parts, then readings at its end, and the moments."""
    system, theta = state.system, interval.theta
    state = replace(state, theta=theta)
    # Where a coordinate is missing L_0 and the algebra are others: what is known of the observation acts inside, on the density.
    state = lax.cond(interval.whole, lambda: state, lambda: _formed(state))
    zero = jnp.zeros(())
    health = _Health(resolution_of(state.field.values).aliasing, zero, zero, zero, zero)
    coefficients, directions = system.numbers(theta)
    rates = observation.inputs[1:]

    @jax.checkpoint
    def moved(state: State, left: jax.Array, health: _Health, *_: Any) -> tuple[State, jax.Array, _Health, jax.Array, jax.Array]:
        field = spectral.fitted(state.field)
        points = field.points()
        generator, drive, level = _generator(system, interval, rates, field, points)
        tau = jnp.minimum(left, spectral.STABLE / generator.size(field.cell))
        tau = jnp.minimum(tau, _DRIVE / jnp.maximum(drive, 1e-300))
        tau = lax.stop_gradient(jnp.minimum(tau, STEP / jnp.maximum(system.speed(coefficients), 1e-300)))
        field, scale, noise = spectral.cleaned(spectral.exponential(generator, field, tau))
        r = jnp.where(interval.whole, system.advanced(coefficients, state.statistics, rates, tau), state.statistics)
        state = replace(state, field=field, statistics=r, log_scale=state.log_scale + scale - level * tau)
        shift, logs = system.product(directions, r, points, theta)
        ranging, exponent, density = _reach(field.values, logs)
        state = _driven(state, generator, density, shift, tau)
        far = jnp.max(jnp.abs(shift) / (field.cell * np.array(field.values.shape))) > _SHIFT
        resolved = resolution_of(density)
        health = _Health(
            jnp.maximum(health.aliasing, jnp.maximum(noise, resolved.aliasing)),
            jnp.maximum(health.exponent, exponent),
            jnp.maximum(health.edge, resolved.edge_mass),
            jnp.maximum(health.surprise, jnp.max(jnp.abs(state.driven))),
            health.parts + 1,
        )
        again = (ranging > _RESTART) | far
        state = jax.tree.map(partial(jnp.where, again), _as_one(state, shift, logs), state)
        return state, left - tau, health, jnp.where(again, 0.0, shift), jnp.where(again, 0.0, logs)

    def part(carry: Any, _: None) -> tuple[Any, None]:
        return lax.cond(carry[1] > 0, lambda: moved(*carry), lambda: carry), None

    none = jnp.zeros_like(state.field.low), jnp.zeros_like(state.field.values)
    carry = state, jnp.asarray(interval.length, float), health, *none
    (state, left, health, shift, logs), _ = lax.scan(part, carry, length=state.parts)
    if observation.energy is not None:
        state, health = _read(_as_one(state, shift, logs), observation, health)
        shift, logs = none
    top = lax.stop_gradient(jnp.max(logs))
    density = state.field._replace(values=state.field.values * jnp.exp(logs - top), low=state.field.low - shift)
    log_mass, mean, cov = spectral.moments(density)
    log_mass = log_mass + top + state.log_scale
    health, left = lax.stop_gradient((health, left))
    done = jnp.maximum(1 - left / interval.length, 1e-3)
    told = {
        "aliasing": health.aliasing,
        "edge_mass": health.edge,
        "exponent": health.exponent,
        "surprise": health.surprise,
        "unfinished": left / interval.length,
    }
    return replace(state, log_scale=state.log_scale - log_mass), Info(log_mass, mean, cov, told, health.parts / done)


def _generator(system, interval, rates, field, points):
    """L_0 on the lattice without the `level` of its potential; and how fast the observation drives the density, in nats."""
    h = system.observed(points, 0.0, interval.theta)
    weights = interval.precision @ rates
    drive = sum((weights[i] * h_i for i, h_i in enumerate(h)), start=jnp.zeros(points.shape[:-1]))
    potential = 0.5 * sum(interval.precision[i, j] * a * b for i, a in enumerate(h) for j, b in enumerate(h))
    potential = potential - jnp.where(interval.whole, 0.0, 1.0) * drive
    level = lax.stop_gradient(jnp.min(potential))
    drift = system.drift(points, 0.0, interval.theta)
    covariance = system.covariance(jnp.zeros(points.shape[-1]), 0.0, interval.theta)
    matters = field.values > _MATTERS
    ranging = jnp.max(jnp.where(matters, drive, -jnp.inf)) - jnp.min(jnp.where(matters, drive, jnp.inf))
    return Generator(covariance, drift, potential - level), ranging, level


def _driven(state, generator, density, shift, tau):
    """The state with the mean of its density, and by how much more of its deviation this moved than the drift did.

    Diffusion makes the tails anew, in the time in which it makes the deviation.
    """
    field = lax.stop_gradient(state.field._replace(values=density, low=state.field.low - shift))
    _, mean, cov = spectral.moments(field)
    variance = jnp.diagonal(cov)
    drift = jnp.stack([jnp.sum(field.values * f) for f in generator.drift]) / jnp.sum(field.values)
    moved = (mean - state.mean - tau * drift) / jnp.sqrt(variance)
    kept = jnp.exp(-tau * jnp.diagonal(generator.covariance) / variance)
    return replace(state, mean=mean, driven=lax.stop_gradient(kept * state.driven + moved))


def _reach(values, logs):
    """Over how much the logarithm of a multiplier ranges where the density matters; by how much it amplifies what rounding left
    of the tails, relative to the density's maximum; and that density, but for a factor."""
    top = lax.stop_gradient(jnp.max(jnp.where(values > 0, logs, -jnp.inf)))
    density = values * jnp.exp(jnp.minimum(logs - top, 0.0))
    highest = jnp.max(density)
    matters = density > _MATTERS * highest
    ranging = jnp.max(jnp.where(matters, logs, -jnp.inf)) - jnp.min(jnp.where(matters, logs, jnp.inf))
    return ranging, -jnp.log(highest), density


def _formed(state: State) -> State:
    """The same density with statistics of zero."""
    _, directions = state.system.numbers(state.theta)
    return _as_one(state, *state.system.product(directions, state.statistics, state.field.points(), state.theta))


def _as_one(state: State, shift: jax.Array, logs: jax.Array) -> State:
    """The product of the multiplier and v on a lattice that is shifted, as the v of new statistics."""
    field, top = state.field, lax.stop_gradient(jnp.max(logs))
    field, scale, _ = spectral.cleaned(field._replace(values=field.values * jnp.exp(logs - top), low=field.low - shift))
    return replace(state, field=field, statistics=jnp.zeros_like(state.statistics), log_scale=state.log_scale + top + scale)


def _read(state: State, observation: Factors, health: _Health) -> tuple[State, _Health]:
    """The factor of the readings at the end of an interval, for statistics of zero."""
    h = state.system.observed(state.field.points(), 0.0, state.theta)
    logs = sum((observation.after[i] * a for i, a in enumerate(h)), start=jnp.zeros(state.field.values.shape))
    logs = logs - 0.5 * sum(observation.energy[i, j] * a * b for i, a in enumerate(h) for j, b in enumerate(h))
    _, exponent, density = _reach(state.field.values, logs)
    _, before, cov = lax.stop_gradient(spectral.moments(state.field))
    state = _as_one(state, jnp.zeros(state.field.low.shape), logs + observation.constant)
    mean = lax.stop_gradient(spectral.moments(state.field)[1])
    driven = state.driven + (mean - before) / jnp.sqrt(jnp.diagonal(cov))
    health = health._replace(
        aliasing=jnp.maximum(health.aliasing, resolution_of(density).aliasing),
        exponent=jnp.maximum(health.exponent, exponent),
        surprise=jnp.maximum(health.surprise, jnp.max(jnp.abs(driven))),
    )
    return replace(state, mean=mean, driven=driven), health


def adapt(prepared: Prepared, state: State, rows: slice, info: Info | None) -> State | None:
    """The state with as many parts to an interval as its lattices need; also of many records."""
    if info is None:
        return state
    need = np.asarray(info.need)
    most = need[np.isfinite(need)].max(initial=0.0)
    if not np.any(info.health["unfinished"] > 0) or state.parts >= _MOST_PARTS:
        return None
    parts = state.parts * 2
    while parts < most and parts < 8 * state.parts:
        parts *= 2
    return replace(state, parts=min(parts, _MOST_PARTS))


def _fits(state: State, info: Info) -> Any:
    """Whether the parts of an interval were enough."""
    return info.health["unfinished"] <= 0


def resume(prepared: Prepared, state: State, rows: slice, begin: State) -> State:
    """The traced `state` with as many parts as `begin`."""
    return replace(state, parts=begin.parts)


def density(prepared: Prepared, state: State) -> GridDensity:
    """The posterior on its lattice; zero where rounding leaves nothing of it."""
    field = _formed(jax.tree.map(jnp.asarray, state)).field
    values, cell = np.asarray(field.values), np.asarray(field.cell)
    with np.errstate(divide="ignore"):
        logs = np.log(np.maximum(values, 0.0))
    centre = np.asarray(field.low) + cell * (np.array(values.shape) // 2)
    names = prepared.model.state
    return GridDensity(logs, centre, np.diag(cell), names, (False,) * len(names))


METHOD = Method(
    name="wei-norman",
    source="Wei and Norman 1964; Yau 1993, Theorem 6, corrected; Dong, Chen and Yau 2021, Theorem 4.1",
    exactness="exact for y that is linear between readings, up to the lattice of exp(t L_0), whose error health figures watch",
    theorem=theorem,
    options={"points": None},
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
    adapt_many=adapt,
    bounds={
        "aliasing": (1e-8, "share of the density at the highest frequency of the lattice; set points to more"),
        "edge_mass": (1e-9, "probability in the outermost cells of the lattice"),
        "surprise": (3.0, "deviations by which the observations drove the density into its tails, of which rounding leaves 7"),
        "exponent": (12.0, "nats by which a multiplier amplified what rounding left of the tails; take shorter intervals"),
        "unfinished": (0.0, "share of an interval that was left out: so fine a lattice needs more parts than there may be"),
    },
)
