"""The general direct method: a Gaussian sum for time-varying Yau systems with any h, in any dimension.

The survey of Chen and Dong, Algorithm 4 (Algorithm 2 where nothing depends on time), corrected.  For f = L x + l + G grad phi
and a quadratic q the gauge u = e^phi v makes the Kolmogorov equation linear-quadratic, and a Gaussian stays one, exactly
(`zakai.kolmogorov.flow`).  What is approximate is the observation's factor of a nonlinear h: each component is replaced by the
Gaussian with its moments.  Components are split where h bends over them and put together where that costs least.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.algebra.theorems import general_direct as theorem
from zakai.algebra.theorems import yau_system
from zakai.densities import GaussianMixture
from zakai.densities.components import Components, moments, padded, shares, wrapped
from zakai.densities.peaks import fit_dictionary, fit_peaks
from zakai.densities.quadrature import Refitted, curvature, refit, refit_affine
from zakai.densities.reduction import Exchanged, condensed, exchange, make_room
from zakai.errors import InputError
from zakai.filters import _gaussian_start as start
from zakai.filters._directions import directions_of
from zakai.filters._formulas import Formulas, formulas
from zakai.filters._protocol import Info, Method, Schedule
from zakai.filters._sum_gauge import SumGauge
from zakai.filters._yau_flow import FlowPlan, System, plan_flows, planned_flows, system_of
from zakai.filters.observations import Data, FactorRule, Factors, factor_rule, noise_at
from zakai.kolmogorov.flow import Flow, move_gaussian
from zakai.models.model import Model
from zakai.models.prior import GaussianPrior, MixturePrior

# Slots by the number of directions in which the components must be narrow.
SLOTS = {0: 1, 1: 20, 2: 64, 3: 128}
MOST_DIRECTIONS = 5
# Up to so many directions the start of an affine h, which is exact from there on, stays as it was cut.
MOST_WHOLE = 2
TOLERANCE = 1e-3
# How often components are split for a reading that comes all at once, and how many slots more there are while it does.
ROUNDS = 5
_EXTRA = 2
# The loss that a component is meant to have at most; a transition that widens it beyond needs more than one round.
_FINE = 0.1
# The ways to keep the sum small, and up to which n.
_REDUCTIONS: dict[str, float] = {"split-merge": np.inf, "nnls": 2, "algorithm-1": 1}


class Sum:
    """What is static: the system, its gauge, and how the sum is kept."""

    def __init__(
        self, model: Model, splitting: str, slots: int | None, reduction: str, tolerance: float, alpha: float, rounds: int
    ):
        yau = yau_system(model)
        assert yau is not None
        self.system: System = system_of(formulas(model), splitting == "strang", splitting)
        self.gauge = SumGauge(yau.form.potential, model)
        self.angles = tuple(model.state.index(name) for name in model.periodic)
        self.affine = yau.slope is not None
        self.directions = np.zeros((model.n, 0)) if self.affine else directions_of(list(model.observation), model)
        narrow = np.hstack([self.directions, self.gauge.directions])
        self.start_directions = _span(narrow)
        k = self.start_directions.shape[1]
        if max(k, self.directions.shape[1]) > MOST_DIRECTIONS:
            raise InputError(
                f"{model.source}: h and phi vary in {k} directions of the state; quadrature takes {MOST_DIRECTIONS} at most"
            )
        self.asked, self.slots = slots, SLOTS.get(k, 192) if slots is None else slots
        self.reduction, self.tolerance, self.alpha = reduction, tolerance, alpha
        self.rounds = rounds
        self.sampled = model.observation_kind == "samples"
        # The last factor of an interval makes up for what both halves lose; other reductions may have negative parts.
        self.products = 1 + bool(self.system.halves) if reduction == "split-merge" else 0
        # Whether components are split before each reading rather than after it.
        self.roomy = self.sampled and bool(self.directions.shape[1]) and reduction == "split-merge"

    def limits(self, count: int) -> tuple[int, int]:
        """How many slots the sum and its companion may use, for a prior that was cut into `count` Gaussians."""
        k = self.start_directions.shape[1]
        if k == 0 or self.affine and self.asked is None and k <= MOST_WHOLE:
            # Nothing is put together.
            used = count if self.affine else self.slots
            return used, used
        used = min(self.slots, count) if self.affine else self.slots
        return used, round(0.7 * used) if used >= 8 else used + 4


def _span(directions: np.ndarray) -> np.ndarray:
    """An orthonormal basis of the columns' span; coordinates where they are coordinates."""
    if directions.shape[1] == 0:
        return directions
    left, values, _ = np.linalg.svd(directions, full_matrices=False)
    left = left[:, values > 1e-9]
    used = np.flatnonzero(np.abs(left).max(axis=1) > 1e-12)
    return np.eye(len(directions))[:, used] if len(used) == left.shape[1] else left


@lru_cache(maxsize=32)
def _sum(of: Formulas, splitting: str, slots: int | None, reduction: str, tolerance: float, alpha: float, rounds: int) -> Sum:
    return Sum(of.model, splitting, slots, reduction, tolerance, alpha, rounds)


class Kept(NamedTuple):
    """What a density is made of: the normalised Gaussian sum in gauge, at its time; u = e^phi v has mass one."""

    sum: Components
    time: Any


class State(NamedTuple):
    """Two normalised sums side by side (2, K, ...), the slots (2,) they may use, which (K,) are the outermost of the start,
    how far the first was from the prior there, and the difference of their log-likelihoods.

    The first is the result; the second has another number of slots, and how far it stands from the first tells how far the
    first may stand from the density.
    """

    pair: Components
    slots: Any
    edge: Any
    off: Any
    apart: Any
    time: Any

    @property
    def kept(self) -> Kept:
        return Kept(jax.tree.map(lambda a: a[0], self.pair), self.time)


@partial(
    jax.tree_util.register_dataclass, data_fields=["start", "stop", "flow", "precision", "theta"], meta_fields=["static"]
)
@dataclass(frozen=True)
class Interval:
    """One interval: its ends, its flow in equal parts (parts, ...), the observation's S^-1 (m, m) at its end, the parameters."""

    start: Any
    stop: Any
    flow: Flow
    precision: Any
    theta: Any
    static: Sum


@dataclass(frozen=True, eq=False)
class Prepared:
    """Everything that is known without data; `theta` (p,) are the parameters, `intervals` has a leading axis of K."""

    model: Model
    static: Sum
    schedule: Schedule
    splitting: str
    plan: FlowPlan
    theta: Any
    intervals: Interval

    @property
    def notes(self) -> tuple[str, ...]:
        """Where the method is not exact in its class, for the warnings of a result."""
        gaps = not self.schedule.inside.all() and not self.static.sampled
        plain = self.static.reduction
        said = self.plan.substeps.notes
        if plain != "split-merge":
            said = (*said, f'the reduction "{plain}" has no error figures: its error is not known')
        if self.static.system.bare or not gaps:
            return said
        return (
            *said,
            "where readings are missing the transition without the observation's potential is not linear-quadratic: its "
            "potential is kept inside and taken out again at the end, which is exact only as the intervals shrink",
        )


def prepare(
    model: Model,
    schedule: Schedule,
    *,
    components: int | None = None,
    splitting: str = "strang",
    reduction: str = "split-merge",
    tolerance: float = TOLERANCE,
    alpha: float = 0.01,
) -> Prepared:
    """The flow of every interval, offline.

    `components` is the number of slots, `splitting` "strang" or "lie", `reduction` "split-merge", "nnls" or "algorithm-1",
    `tolerance` the loss below which components are left alone, `alpha` the threshold of Algorithm 1.  Raises InputError for
    another word or number.
    """
    if reduction not in _REDUCTIONS:
        listed = ", ".join(f'"{name}"' for name in _REDUCTIONS)
        raise InputError(f'option reduction: "{reduction}" is none of {listed}')
    if model.n > _REDUCTIONS[reduction]:
        most = _REDUCTIONS[reduction]
        raise InputError(f'option reduction: "{reduction}" is for n <= {most}, here n = {model.n}; use "split-merge"')
    if reduction != "split-merge" and model.periodic:
        raise InputError(f'option reduction: "{reduction}" knows no angles; use "split-merge"')
    if isinstance(alpha, bool) or not isinstance(alpha, int | float) or not 0 < alpha < 1:
        raise InputError(f"option alpha: {alpha!r} must lie between 0 and 1")
    if splitting not in ("strang", "lie"):
        raise InputError(f'option splitting: "{splitting}" is neither "strang" nor "lie"')
    if components is not None and (isinstance(components, bool) or not isinstance(components, int) or components < 1):
        raise InputError(f"option components: {components!r} must be a whole number from 1")
    if not isinstance(tolerance, int | float) or not 0 < tolerance < 1:
        raise InputError(f"option tolerance: {tolerance!r} must lie between 0 and 1")
    arguments = (formulas(model), splitting, components, reduction, float(tolerance), float(alpha))
    static = _sum(*arguments, 1)
    plan = plan_flows(static.system, model, schedule)
    if static.directions.shape[1]:
        static = _sum(*arguments, _rounds(static, model, planned_flows(static.system, plan, model.theta())))
    prepared = Prepared(model, static, schedule, splitting, plan, model.theta(), None)  # type: ignore[arg-type]
    return with_parameters(prepared, prepared.theta)


def _rounds(static: Sum, model: Model, flow: Flow) -> int:
    """How many rounds of splitting an interval asks for: four for each halving that its own spread makes necessary."""
    prior = model.prior
    known = isinstance(prior, GaussianPrior | MixturePrior)
    mean, cov = (prior.mean, prior.cov) if known else (np.zeros(model.n), np.eye(model.n))  # type: ignore[union-attr]
    probes = np.random.default_rng(0).multivariate_normal(mean, cov, 32, method="eigh")
    spreads = np.einsum("kpij,kpjl,kpml->kpim", flow.map, flow.spread, flow.map).sum(axis=1)
    widest = spreads[np.argmax(np.trace(spreads, axis1=1, axis2=2))]
    precision = np.linalg.inv(noise_at(model, np.array([model.start]), model.theta()))[0]
    sum_ = Components(jnp.zeros(32), jnp.asarray(probes), jnp.broadcast_to(widest, (32, *widest.shape)), jnp.ones(32))
    loss = _losses(static, sum_, jnp.full(32, 1 / 32), precision, model.start, model.theta())[0]
    typical = float(jnp.mean(loss))
    return int(np.clip(round(4 * np.log2(1 + typical / _FINE)), 1, 12)) if np.isfinite(typical) else 1


def with_parameters(prepared: Prepared, theta: Any) -> Prepared:
    """The same intervals for other parameters (p,); traceable."""
    xp = np if isinstance(theta, np.ndarray) else jnp
    schedule, count = prepared.schedule, len(prepared.schedule.starts)
    precision = xp.linalg.inv(noise_at(prepared.model, schedule.stops, theta))
    flow = planned_flows(prepared.static.system, prepared.plan, theta)
    thetas = xp.broadcast_to(theta, (count, len(theta)))
    intervals = Interval(schedule.starts, schedule.stops, flow, precision, thetas, prepared.static)
    return replace(prepared, theta=theta, intervals=intervals)


def observations(prepared: Prepared, data: Data) -> Factors:
    """What `step` is given for each interval."""
    return rule(prepared, data)(data.filled)


def rule(prepared: Prepared, data: Data) -> FactorRule:
    """The same but for the values."""
    system = prepared.static.system
    return factor_rule(
        prepared.model,
        data,
        prepared.schedule,
        rates=system.rates,
        splitting=prepared.splitting,
        remove=not system.bare,
        theta=prepared.theta,
    )


def init(prepared: Prepared, prior: Any) -> State:
    """The prior, cut into Gaussians and divided by e^phi."""
    static, model = prepared.static, prepared.model
    own, t = model.theta(), model.start

    def cut(theta):
        doubt = None if static.gauge.none else lambda u: static.gauge.doubt(u, t, own)
        far = static.affine and static.asked is None
        u, edge = start.cut_prior(model, prior, static.start_directions, theta, doubt, far)
        return u, static.gauge.divide(u, t, theta), edge

    u, narrow, edge = cut(prepared.theta)
    with jax.ensure_compile_time_eval():
        host = narrow if isinstance(prepared.theta, np.ndarray) else cut(own)[1]
        weights = np.asarray(_share_of_u(static, host, model.start, own)[0])
        loss = np.zeros(len(weights))
        if static.directions.shape[1]:
            precision = np.linalg.inv(noise_at(model, np.array([model.start]), own))[0]
            loss = np.asarray(_losses(static, host, weights, precision, model.start, own)[0])
    used, second = static.limits(len(weights))
    # Before the first reading there is as much room as while one comes.
    more = 1 + _EXTRA if static.roomy else 1
    pair = [
        start.fitted(narrow, host, weights, loss, more * most, more * max(used, second), static.angles) for most in (used, second)
    ]
    both = jax.tree.map(lambda *a: jnp.stack(a), *pair)
    off = start.difference(static.gauge.lift(pair[0], t, prepared.theta), start.given(model, prior), static.angles)
    if not static.gauge.none:
        off = jnp.maximum(off, jnp.max(static.gauge.doubt(u, t, prepared.theta)))
    both = jax.vmap(lambda v: _normalised(static, v, t, prepared.theta)[0])(both)
    # Once components are traded or put together, none of them is the outermost for good.
    edge = jnp.asarray(edge if static.affine and len(edge) <= used else np.zeros(both.log_weights.shape[1]))
    return State(both, jnp.array([used, second]), edge, off, jnp.zeros(()), jnp.asarray(t, float))


@partial(jax.jit, static_argnums=0)
def _share_of_u(static: Sum, v: Components, t: Any, theta: Any) -> tuple[jax.Array, jax.Array]:
    """The share in u of each component of v (K,), and the logarithm of the mass of u."""
    share, log_mass = shares(static.gauge.lift(v, t, theta))
    return share.reshape(len(v.log_weights), -1).sum(axis=1), log_mass


@partial(jax.jit, static_argnums=0)
def _normalised(static: Sum, v: Components, t: Any, theta: Any) -> tuple[Components, jax.Array, Components, jax.Array]:
    """v so that u = e^phi v has mass one; the logarithm of its mass; u, and the shares of its components."""
    u = static.gauge.lift(v, t, theta)
    share, log_mass = shares(u)
    return v._replace(log_weights=v.log_weights - log_mass), log_mass, u, share


def correct(prepared: Prepared, prior: Any, observation: Factors) -> tuple[State, Info]:
    """The prior after an observation at the start itself."""
    state = init(prepared, prior)
    model = prepared.model
    first = jax.tree.map(lambda a: a[0], observation)
    precision = noise_at(model, np.array([model.start]), prepared.theta)
    precision = jnp.linalg.inv(jnp.asarray(precision))[0]
    static, theta = prepared.static, prepared.theta
    told = jax.vmap(lambda v, slots: _observe(static, v, slots, state.edge, first.after, first, precision, model.start, theta))
    return _told(static, state, told(state.pair, state.slots), model.start)


def step(interval: Interval, state: State, observation: Factors) -> tuple[State, Info]:
    """One interval of both sums: half factor, transition, half factor, reduction; normalise."""
    static, theta = interval.static, interval.theta

    def one(v, slots):
        if static.system.halves:
            v = _multiply(static, v, observation.before, None, interval.start, theta).sum
        v = _move(interval.flow, v, observation.inputs)
        if static.angles:
            v = v._replace(means=wrapped(v.means, static.angles))
        return _observe(static, v, slots, state.edge, observation.after, observation, interval.precision, interval.stop, theta)

    return _told(static, state, jax.vmap(one)(state.pair, state.slots), interval.stop)


def _told(static: Sum, state: State, observed: tuple[Components, Info], t: Any) -> tuple[State, Info]:
    """The next state, and what the first of the two sums says, with its distance from the second."""
    pair, both = observed
    info, other = jax.tree.map(lambda a: a[0], both), jax.tree.map(lambda a: a[1], both)
    apart = state.apart + jax.lax.stop_gradient(info.log_likelihood_increment - other.log_likelihood_increment)
    deviation, second = (jnp.sqrt(jnp.maximum(jnp.diagonal(one.cov), 1e-300)) for one in (info, other))
    distance = jnp.abs(wrapped(info.mean - other.mean, static.angles)) / deviation
    known = static.reduction == "split-merge"
    info.health.update(
        mean_error=jnp.max(distance) if known else jnp.nan * apart,
        deviation_error=jnp.max(jnp.abs(second / deviation - 1.0)) if known else jnp.nan * apart,
        evidence_error=jnp.abs(apart) if known else jnp.nan * apart,
        start_error=state.off,
    )
    return State(pair, state.slots, state.edge, state.off, apart, jnp.asarray(t, float)), info


def _move(flow: Flow, v: Components, inputs: jax.Array) -> Components:
    """Every component along the flow of the interval, part by part."""

    def part(v, flow):
        mean, cov, log_mass = jax.vmap(lambda m, P: move_gaussian(flow, m, P, inputs))(v.means, v.covs)
        return Components(v.log_weights + log_mass, mean, cov, v.signs), None

    if flow.map.shape[0] == 1:
        return part(v, jax.tree.map(lambda a: a[0], flow))[0]
    return jax.lax.scan(part, v, flow)[0]


def _observe(static: Sum, v: Components, slots, edge, after, factor: Factors, precision, t, theta) -> tuple[Components, Info]:
    """The factor at the end of an interval, and what the step tells."""
    pruned = together = jnp.zeros(())
    bent = bool(static.directions.shape[1])
    at_once = static.sampled or factor.energy is not None
    room = bent and at_once and static.reduction == "split-merge"
    size = max(static.limits(len(v.log_weights)))
    if room:
        # A reading that may say much at once finds a longer sum, split by what would be left of it that is no Gaussian.
        def split(v, _):
            tried = _multiply(static, v, after, factor, t, theta)
            share, _ = _share_of_u(static, tried.sum, t, theta)
            axis = _losses(static, v, share, precision, t, theta)[1]
            return make_room(v, share, tried.loss, axis, static.tolerance**2, (1 + _EXTRA) * slots)

        v, dropped = jax.lax.scan(split, padded(v, (1 + _EXTRA) * size), None, length=ROUNDS)
        pruned = jnp.sum(dropped)
    product = _multiply(static, v, after, factor, t, theta, static.products)
    v = product.sum
    share, log_mass = _share_of_u(static, v, t, theta)
    moved, nonlinearity, doubt = (jnp.sum(jnp.where(share > 0, share * a, 0.0)) for a in product[1:])
    if room:
        v, together = condensed(v, share, slots, size, static.angles)
    if bent and not static.roomy:

        def trade(v, _):
            share = _share_of_u(static, v, t, theta)[0]
            return _exchange(static, v, share, slots, precision, t, theta)

        v, done = jax.lax.scan(trade, v, None, length=static.rounds if static.reduction == "split-merge" else 1)
        pruned, together = pruned + jnp.sum(done.pruned), together + jnp.sum(done.together)
    v, _, u, parts = _normalised(static, v, t, theta)
    share = parts.reshape(len(v.log_weights), -1).sum(axis=1)
    mean, cov = moments(parts, u.means, u.covs, static.angles)
    health = {
        "nonlinearity": nonlinearity,
        "quadrature": doubt,
        "pruned": pruned,
        "merged": together,
        "components": 1.0 / jnp.sum(share**2),
        "surprise": moved / 5.0,
        "edge_weight": jnp.sum(share * edge) if static.affine else jnp.zeros(()),
    }
    return v, Info(log_mass, mean, cov, health)


def _losses(static: Sum, v: Components, share, precision, t, theta):
    """How badly one Gaussian serves each component (K,), and along which axis it would be split."""
    residual, linear, axis = curvature(v, lambda x: static.system.observe(x, t, theta), precision, static.directions)
    typical = jnp.sum(jnp.where(share > 0, share * linear, 0.0))
    return residual / (typical + 1e-300), axis


def _exchange(static: Sum, v: Components, share, slots, precision, t, theta):
    """One round of trades between readings that say little each."""
    if static.reduction != "split-merge":
        nothing = Exchanged(jnp.zeros(()), jnp.zeros(()))
        # Both fit v, of which u = e^phi v; neither says what it loses.
        return fit_peaks(v, static.alpha) if static.reduction == "algorithm-1" else fit_dictionary(v, share), nothing
    loss, axis = _losses(static, v, share, precision, t, theta)
    return exchange(v, share, loss, axis, static.tolerance, slots, static.angles)


def _multiply(static: Sum, v: Components, linear, factor: Factors | None, t, theta, products: int = 0) -> Refitted:
    """v exp(linear.h - h'(energy) h / 2 + constant), with energy and constant of `factor`; `products` is that of `refit`."""
    energy = None if factor is None else factor.energy
    constant = 0.0 if factor is None else factor.constant
    if static.affine:
        zero = jnp.zeros(len(v.signs))
        return Refitted(_multiply_affine(static, v, linear, energy, constant, t, theta), zero, zero, zero)

    def log_factor(x):
        h = static.system.observe(x, t, theta)
        value = sum((linear[i] * values for i, values in enumerate(h)), start=jnp.zeros(())) + constant
        if energy is None:
            return value
        return value - 0.5 * sum(energy[i, j] * a * b for i, a in enumerate(h) for j, b in enumerate(h))

    told = refit(v, log_factor, static.directions, energy is not None, products)
    # Where nothing was read, nothing is summed again.
    same = Refitted(v._replace(log_weights=v.log_weights + constant), *[jnp.zeros(len(v.signs))] * 3)
    read = jnp.any(linear != 0) if energy is None else jnp.any(linear != 0) | jnp.any(energy != 0)
    return jax.tree.map(lambda a, b: jnp.where(read, a, b), told, same)


def _multiply_affine(static: Sum, v: Components, linear, energy, constant, t, theta) -> Components:
    """The same for h = C x + c, exactly."""
    if energy is None and static.system.rates:
        return v._replace(log_weights=v.log_weights + constant)
    n = v.means.shape[1]
    c = jnp.stack(static.system.observe(jnp.zeros((1, n)), t, theta), -1)[0]
    C = jnp.stack(static.system.observe(jnp.eye(n), t, theta), 0) - c[:, None]
    told = refit_affine(v, C, c, linear, jnp.zeros((len(c), len(c))) if energy is None else energy)
    return told._replace(log_weights=told.log_weights + constant)


def density(prepared: Prepared, state: State | Kept) -> GaussianMixture:
    """The posterior u = e^phi v as a `GaussianMixture`."""
    model = prepared.model
    state = state.kept if isinstance(state, State) else state
    u = prepared.static.gauge.lift(state.sum, state.time, prepared.theta)
    share = np.asarray(shares(u)[0])
    kept = share != 0
    periodic = tuple(name in model.periodic for name in model.state)
    return GaussianMixture(share[kept], np.asarray(u.means)[kept], np.asarray(u.covs)[kept], model.state, periodic)


METHOD = Method(
    name="general-direct",
    source="Chen and Dong, A survey of direct methods for Yau filtering systems, Theorems 6 and 7, Algorithm 4, corrected",
    exactness="exact between observations; a Gaussian sum of the posterior where h is nonlinear, whose error health tells",
    theorem=theorem,
    options={"components": None, "splitting": "strang", "reduction": "split-merge", "tolerance": TOLERANCE, "alpha": 0.01},
    prepare=prepare,
    init=init,
    correct=correct,
    observations=observations,
    rule=rule,
    step=step,
    density=density,
    with_parameters=with_parameters,
    bounds={
        "mean_error": (0.04, "distance of the mean from that of a second sum with other slots, in standard deviations"),
        "deviation_error": (0.1, "relative distance of a standard deviation from that of the second sum"),
        "evidence_error": (0.04, "distance of the log-likelihood so far from that of the second sum"),
        "start_error": (0.01, "distance of the first sum, or of a part of it, from the prior in mass, mean or variance"),
        "nonlinearity": (0.1, "relative entropy lost in one step by keeping one Gaussian where an observation made none"),
        "quadrature": (1e-2, "relative error of the masses of components, by two rules of quadrature"),
        "pruned": (1e-3, "weight of components that were dropped in one step"),
        "merged": (0.1, "loss by putting components together for lack of room"),
        "edge_weight": (1e-6, "weight of the outermost Gaussians of the start: the posterior is in tails that it has not"),
        "surprise": (1.0, "how far the observation drives the density into the tails of single Gaussians"),
    },
)
