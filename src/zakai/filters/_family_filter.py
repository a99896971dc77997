"""The filter of a linear-quadratic system with affine observations: families of Gaussians, every step exact.

Kalman-Bucy, Benes and Hu-Yau are this filter for phi = 0, phi = log cosh and any phi that leaves q quadratic.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.densities import Density, GaussianMixture
from zakai.errors import InputError
from zakai.filters._affine_system import AffineSystem, Plan, affine_system_of
from zakai.filters._family_prior import prior_families
from zakai.filters._formulas import formulas
from zakai.filters._gauge import GaugeFunctions, Posterior, Tilts, gauge_of, posterior
from zakai.filters._gauged_density import GaugedDensity
from zakai.filters._protocol import Info, Schedule
from zakai.filters.observations import Data, FactorRule, Factors, factor_rule
from zakai.kolmogorov.families import Family, log_terms, move, read
from zakai.kolmogorov.flow import Flow
from zakai.kolmogorov.numpy_or_jax import numpy_or_jax
from zakai.models._definite import smallest_eigenvalue
from zakai.models.model import Model


class State(NamedTuple):
    """The families of v, or of e^S v (leading axis J), normalised so that u = e^phi v has mass one.

    With them the `time`, and for each node the logarithm of the error of the prior's representation and whether it is at
    the edge, (J, N).
    """

    families: Family
    log_error: Any
    edge: Any
    time: Any


@dataclass(frozen=True, eq=False)
class Prepared:
    """What is known without data, for the parameters `theta`; `plan` is what was decided for the model's own."""

    model: Model
    schedule: Schedule
    plan: Plan
    system: AffineSystem
    gauge: GaugeFunctions
    theta: Any
    intervals: Interval

    @property
    def notes(self) -> tuple[str, ...]:
        """What is to be said of the flows, for the warnings of a result."""
        return self.plan.substeps.notes


class Quadratic(NamedTuple):
    """S = -x'K x / 2 - k.x where the families are those of e^S v: `matrix` K (n, n), `slope` k (n,)."""

    matrix: Any
    slope: Any

    def times(self, families: Family, sign: float) -> Family:
        """The families times e^{sign S}."""
        n = len(self.slope)
        one = partial(
            read,
            slope=jnp.eye(n),
            intercept=jnp.zeros(n),
            after=-sign * self.slope,
            energy=sign * self.matrix,
            constant=jnp.zeros(()),
        )
        return jax.vmap(one)(families)


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["flow", "slope", "intercept", "tilts", "quadratic", "stop", "theta"],
    meta_fields=["gauge"],
)
@dataclass(frozen=True)
class Interval:
    """One interval: its flow in parts (parts, ...), C and c, the gauge, and S if there is one, at its end, the parameters."""

    flow: Flow
    slope: Any
    intercept: Any
    tilts: Tilts
    quadratic: Quadratic | None
    stop: Any
    theta: Any
    gauge: GaugeFunctions


def prepare(model: Model, schedule: Schedule, system: AffineSystem | None = None) -> Prepared:
    """The flow of every interval, offline; `system` is the equation of v by default."""
    system, gauge = system or affine_system_of(formulas(model)), gauge_of(formulas(model))
    plan = Plan(system, model, schedule)
    theta = model.theta()
    return Prepared(model, schedule, plan, system, gauge, theta, _intervals(plan, system, gauge, schedule, theta))


def with_parameters(prepared: Prepared, theta: Any) -> Prepared:
    """The same for other parameters, with the structure that was decided for the model's own; traced by JAX."""
    intervals = _intervals(prepared.plan, prepared.system, prepared.gauge, prepared.schedule, theta)
    return replace(prepared, theta=theta, intervals=intervals)


def _intervals(plan: Plan, system: AffineSystem, gauge: GaugeFunctions, schedule: Schedule, theta: Any) -> Interval:
    xp, stops = numpy_or_jax(theta), schedule.stops

    def at_stops(function):
        return function(stops, theta) if xp is np else jax.vmap(function, (0, None))(jnp.asarray(stops), theta)

    def repeated(array):
        return xp.broadcast_to(array, (len(stops), *np.shape(array)))

    slope, intercept = at_stops(system.observation)
    # S is there for constant coefficients only.
    quadratic = jax.tree.map(repeated, system.quadratic(schedule.starts[0], theta))
    return Interval(plan.flows(theta), slope, intercept, at_stops(gauge.at), quadratic, stops, repeated(theta), gauge)


def observations(prepared: Prepared, data: Data) -> Factors:
    """What `step` is given for each interval: y runs linearly inside of it, and what cannot is a factor at its end."""
    return rule(prepared, data)(data.filled)


def rule(prepared: Prepared, data: Data) -> FactorRule:
    """The same but for the values."""
    return factor_rule(
        prepared.model, data, prepared.schedule, rates=True, splitting="strang", remove=False, theta=prepared.theta
    )


def lasting(prepared: Prepared, interval: Interval, rule: FactorRule, length: float) -> tuple[Interval, FactorRule]:
    """The only interval that was prepared, and the rule of its readings, for a length that is no greater."""
    flow = prepared.plan.lasting(length, prepared.theta)
    spans = np.where(np.isfinite(rule.spans), length, np.inf)
    return replace(interval, flow=flow, stop=np.asarray(length)), rule._replace(spans=spans)


def init(prepared: Prepared, prior: Any) -> State:
    """The prior as families of Gaussians."""
    state, start, theta = _families(prepared, prior), prepared.model.start, prepared.theta
    quadratic, families = prepared.system.quadratic(start, theta), state.families
    bare = families if quadratic is None else quadratic.times(families, -1.0)
    found = posterior(prepared.gauge, prepared.gauge.at(start, theta), state.time, theta, bare)
    return state._replace(families=families._replace(log_mass=families.log_mass - found.log_mass))


def _families(prepared: Prepared, prior: Any) -> State:
    model = prepared.model
    found = prior_families(prepared.gauge, model, prior, prepared.theta)
    quadratic = prepared.system.quadratic(model.start, prepared.theta)
    families = found.families if quadratic is None else quadratic.times(found.families, 1.0)
    if quadratic is not None:
        check_normalisable(model, families.cov)
    return State(families, found.log_error, found.edge, np.asarray(model.start, float))


def check_normalisable(model: Model, covs: Any) -> None:
    """Refuse an e^S that outgrows the prior."""
    if isinstance(covs, jax.core.Tracer):
        return
    # Where e^S outgrows the prior just so, they are infinite.
    if not (np.isfinite(covs).all() and np.all(np.linalg.eigvalsh(np.asarray(covs)) >= 0)):
        raise InputError(
            f'{model.source}: option choice: with "theorem-6" e^S outgrows the prior, so that e^S v is no density; '
            'take choice="theorem-4" or a narrower prior'
        )


def correct(prepared: Prepared, prior: Any, observation: Factors) -> tuple[State, Info]:
    """The prior after a sample at the start itself."""
    state = init(prepared, prior)
    start, theta = prepared.model.start, prepared.theta
    slope, intercept = prepared.system.observation(start, theta)
    reading = jax.tree.map(lambda a: a[0], observation)
    read_state = state._replace(families=_read(state.families, slope, intercept, reading))
    tilts, quadratic = prepared.gauge.at(start, theta), prepared.system.quadratic(start, theta)
    return _looked_at(prepared.gauge, tilts, quadratic, start, theta, read_state)


def step(interval: Interval, state: State, observation: Factors) -> tuple[State, Info]:
    """One interval: the flow, with the rates of y inside; readings at its end; normalise."""
    families = state.families

    def part(now, flow):
        return jax.vmap(move, (0, None, None))(now, flow, observation.inputs), None

    if interval.flow.map.shape[0] == 1:
        families, _ = part(families, jax.tree.map(lambda a: a[0], interval.flow))
    else:
        families, _ = jax.lax.scan(part, families, interval.flow)
    families = _read(families, interval.slope, interval.intercept, observation)
    moved = state._replace(families=families, time=interval.stop)
    return _looked_at(interval.gauge, interval.tilts, interval.quadratic, interval.stop, interval.theta, moved)


def _read(families: Family, slope: Any, intercept: Any, reading: Factors) -> Family:
    if reading.energy is None:
        return families
    one = partial(read, slope=slope, intercept=intercept, after=reading.after, energy=reading.energy, constant=reading.constant)
    return jax.vmap(one)(families)


@partial(jax.jit, static_argnums=0)
def _looked_at(
    gauge: GaugeFunctions, tilts: Tilts, quadratic: Quadratic | None, time: Any, theta: Any, state: State
) -> tuple[State, Info]:
    """The normalised state, and what it tells."""
    bare = state.families if quadratic is None else quadratic.times(state.families, -1.0)
    found = posterior(gauge, tilts, time, theta, bare)
    families = state.families._replace(log_mass=state.families.log_mass - found.log_mass)
    health = health_of(state._replace(families=bare), found)
    return state._replace(families=families), Info(found.log_mass, found.mean, found.cov, health)


def health_of(state: State, found: Posterior) -> dict[str, Any]:
    """How far the posterior of a state that is not yet normalised is to be trusted; none of it is differentiated."""
    state, found = jax.lax.stop_gradient((state, found))
    families = state.families._replace(log_mass=state.families.log_mass - found.log_mass)
    variances = jnp.diagonal(found.cov)
    zero = jnp.zeros(())
    health = {
        "negative_variance": jnp.maximum(0.0, -jnp.min(variances)) / jnp.maximum(jnp.max(jnp.abs(variances)), 1e-300),
        "representation_error": zero,
        "edge_weight": zero,
        "gauge_error": zero,
    }
    if families.nodes.shape[-1] == 0:
        return health
    # What the posterior makes of an error of the prior's representation, wherever it was made.
    gained = jax.vmap(log_terms)(families._replace(log_weights=jnp.zeros_like(families.log_weights)))
    tilt = jnp.max(found.logs - jax.vmap(log_terms)(state.families)[:, :, None], axis=2)
    tilt = jnp.where(jnp.isfinite(tilt), tilt, -jnp.inf)
    shares = jnp.sum(jnp.exp(found.logs - found.log_mass), axis=2)
    return health | {
        "representation_error": jnp.sum(jnp.exp(state.log_error + gained + tilt)),
        "edge_weight": jnp.sum(shares * state.edge),
        "gauge_error": found.doubt,
    }


def density(prepared: Prepared, state: State) -> Density:
    """The posterior: a mixture of Gaussians where e^phi is a sum of exponentials, else by its formula."""
    families = jax.tree.map(jnp.asarray, state.families)
    quadratic = prepared.system.quadratic(state.time, prepared.theta)
    families = families if quadratic is None else quadratic.times(families, -1.0)
    return density_of(prepared.model, prepared.gauge, prepared.theta, state.time, families)


def density_of(model: Model, gauge: GaugeFunctions, theta: Any, time: Any, families: Family) -> Density:
    """e^phi times the families, normalised."""
    tilts = gauge.at(time, theta)
    found = posterior(gauge, tilts, time, theta, families)
    weights = np.asarray(found.signs * jnp.exp(found.logs - found.log_mass))
    moved = jnp.einsum("jnk,jmk->jmn", families.response, families.nodes)
    means = np.asarray(found.centres[:, None] + moved[:, :, None])
    # What has no width in some direction, as a start that is known, is on no lattice.
    if not gauge.exact and np.all(smallest_eigenvalue(np.asarray(families.cov)) > 1e-14):
        return _gauged(model, gauge, theta, time, families, found, np.abs(weights), means)
    covs = np.broadcast_to(np.asarray(found.covs)[:, None, None], (*weights.shape, model.n, model.n))
    used = weights != 0.0
    return GaussianMixture(weights[used], means[used], covs[used], model.state, (False,) * model.n)


def _gauged(
    model: Model, gauge: GaugeFunctions, theta: Any, time: Any, families: Family, found: Posterior, shares: Any, points: Any
) -> GaugedDensity:
    """e^phi v by its formula; `shares` (J, N, E) at `points` (J, N, E, n) are where its mass is."""
    logs = np.asarray(jax.vmap(log_terms)(families))
    weights = np.asarray(families.signs) * np.exp(logs - logs.max())
    means = np.asarray(families.mean[:, None] + jnp.einsum("jnk,jmk->jmn", families.response, families.nodes))
    covs = np.broadcast_to(np.asarray(families.cov)[:, None], (*weights.shape, model.n, model.n))
    used, mass = weights != 0.0, weights.sum()
    bare = GaussianMixture(weights[used] / mass, means[used], covs[used], model.state, (False,) * model.n)
    scale = logs.max() + np.log(mass) - float(found.log_mass)
    # A Gaussian is followed to ten deviations, where it is e^-50 of its maximum: its points end at nine.
    rest, own = (np.sqrt(np.maximum(np.diagonal(c, axis1=1, axis2=2), 0.0)) for c in (found.covs, families.cov))
    margins = np.broadcast_to((10.0 * rest + own)[:, None, None], points.shape)
    near = shares >= np.exp(-50.0) * shares.max()
    return GaugedDensity(
        bare,
        lambda x: np.asarray(gauge.potential(x, time, theta)) + scale,
        np.asarray(found.mean),
        np.asarray(found.cov),
        points[near],
        margins[near],
    )


BOUNDS: Mapping[str, tuple[float, str]] = {
    "negative_variance": (1e-9, "a variance below zero, as a share of the largest: rounding has eaten the smallest"),
    "representation_error": (1e-8, "error of the prior's nodes, as the posterior sees it"),
    "edge_weight": (1e-8, "weight of the outermost nodes: the posterior reaches beyond the prior's nodes"),
    "gauge_error": (1e-8, "error of the sums over the directions of the gauge"),
}
