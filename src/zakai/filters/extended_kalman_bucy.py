"""The extended Kalman-Bucy filter: a Gaussian that follows the linearised system, to compare with.

With F and H the Jacobians of f and h at the mean m,

    dm = f dt + P H'S^-1 (dy - h dt),    dP/dt = F P + P F' + G - P H'S^-1 H P                              (1)

(Jazwinski 1970, theorem 8.1).  `riccati="euler"` steps (1) as it stands by Euler's explicit method and blows up when the last
term outruns P: in one dimension as soon as P H'S^-1 H dt > 1.  `riccati="stable"` halves the observation's factor around the
prediction, each half a Kalman update (Joseph's form) with noise 2 S / dt, and predicts by the exact flow of the system
linearised in the middle of the step; P stays positive semidefinite whatever the step, and the error is of second order in it.

A Gaussian prior enters as it is, a mixture or a density by its first two moments.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve, solve_triangular

from zakai import _float64  # noqa: F401
from zakai.algebra.theorems import smooth_system as theorem
from zakai.densities import GaussianMixture
from zakai.errors import InputError
from zakai.filters._formulas import Formulas, formulas
from zakai.filters._linear_flow import linear_flow
from zakai.filters._moments import prior_moments
from zakai.filters._protocol import Info, Method, Schedule
from zakai.filters.observations import Data
from zakai.models.compile import compile_model
from zakai.models.model import Model


class State(NamedTuple):
    """The Gaussian: `mean` (n,) and `cov` (n, n)."""

    mean: Any
    cov: Any


class Reading(NamedTuple):
    """Readings z = h + noise of covariance `scale` * S: `values` (m,), zero where not `seen` (m,), and `scale` (m, m)."""

    values: Any
    seen: Any
    scale: Any


class Observation(NamedTuple):
    """What is read during the interval, as a rate, and what at its end; None where a record has no such reading."""

    inside: Reading | None
    at_end: Reading | None


class System:
    """The formulas of a model compiled for this method, with the static options."""

    def __init__(self, model: Model, riccati: str, substeps: int):
        self.riccati, self.substeps = riccati, substeps
        compiled = compile_model(model)
        self.drift, self.observe = compiled.drift, compiled.observation
        self.covariance, self.noise = compiled.covariance, compiled.observation_noise
        self.drift_slope = jax.jacfwd(compiled.drift, argnums=(0, 1))
        self.observe_slope = jax.jacfwd(compiled.observation)
        self.sampled = model.observation_kind == "samples"
        self.angles = np.array([name in model.periodic for name in model.state])


@lru_cache(maxsize=32)
def _system(of: Formulas, riccati: str, substeps: int) -> System:
    return System(of.model, riccati, substeps)


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
    """The intervals; nothing else is known without data."""

    model: Model
    system: System
    schedule: Schedule
    theta: Any
    intervals: Interval


def prepare(model: Model, schedule: Schedule, *, riccati: str = "stable", substeps: int = 1) -> Prepared:
    """The intervals with their static options.

    `riccati` is "stable" or "euler"; each interval is stepped in `substeps` equal parts. Raises InputError for another value.
    """
    if riccati not in ("stable", "euler"):
        raise InputError(f'option riccati: "{riccati}" is neither "stable" nor "euler"')
    if isinstance(substeps, bool) or not isinstance(substeps, int) or substeps < 1:
        raise InputError(f"option substeps: {substeps!r} is not a whole number from 1")
    system = _system(formulas(model), riccati, substeps)
    theta = np.tile(model.theta(), (len(schedule.starts), 1))
    return Prepared(model, system, schedule, model.theta(), Interval(schedule.starts, schedule.stops, theta, system))


def with_parameters(prepared: Prepared, theta: Any) -> Prepared:
    """The same intervals with other values of the parameters."""
    intervals = replace(prepared.intervals, theta=jnp.tile(theta, (len(prepared.schedule.starts), 1)))
    return replace(prepared, theta=theta, intervals=intervals)


def observations(prepared: Prepared, data: Data) -> Observation:
    """What `step` is given for each interval.

    Readings that were all gathered over just the interval act inside of it; otherwise all act at its end, where increments
    share the noise of the time that they have in common.
    """
    return rule(prepared, data)(data.filled)


class ReadingRule(NamedTuple):
    """What a Reading is but for the values, each of which is divided by its `spans` (m,)."""

    spans: Any
    seen: Any
    scale: Any

    def __call__(self, values: Any) -> Reading:
        return Reading(values / self.spans, self.seen, self.scale)


class Rule(NamedTuple):
    """What an Observation is but for the values."""

    inside: ReadingRule | None
    at_end: ReadingRule | None

    def __call__(self, values: Any) -> Observation:
        return Observation(*(None if part is None else part(values) for part in self))


def rule(prepared: Prepared, data: Data) -> Rule:
    """What `observations` gives but for the values."""
    seen = ~np.isnan(data.values)
    if prepared.system.sampled:
        ones = np.ones((*seen.shape, seen.shape[1]))
        return Rule(None, ReadingRule(np.where(seen, 1.0, np.inf), seen.astype(float), ones))
    spans = np.where(seen, data.elapsed, 1.0)
    scale = np.minimum(spans[:, :, None], spans[:, None, :]) / (spans[:, :, None] * spans[:, None, :])
    inside = seen & np.all(prepared.schedule.inside == seen, axis=1, keepdims=True)
    at_end = seen & ~inside

    def part(which: np.ndarray) -> ReadingRule | None:
        return ReadingRule(np.where(which, spans, np.inf), which.astype(float), scale) if which.any() else None

    return Rule(part(inside), part(at_end))


def init(prepared: Prepared, prior: Any) -> State:
    """The prior's mean and covariance."""
    return State(*prior_moments(prepared.model, prior, prepared.theta))


def correct(prepared: Prepared, prior: Any, observation: Observation) -> tuple[State, Info]:
    """The prior after an observation at the start itself."""
    model = prepared.model
    reading = jax.tree.map(lambda a: a[0], observation.at_end)
    state, log_factor = _update(prepared.system, init(prepared, prior), reading, 1.0, model.start, prepared.theta)
    return state, _info(state, log_factor)


def step(interval: Interval, state: State, observation: Observation) -> tuple[State, Info]:
    """One interval, in equal parts, and then what is read at its end."""
    system, theta = interval.system, interval.theta
    length = (interval.stop - interval.start) / system.substeps
    one = _euler if system.riccati == "euler" else _stable

    def part(index, carry):
        now, log_factor = carry
        now, more = one(system, now, observation.inside, interval.start + index * length, length, theta)
        return now, log_factor + more

    state, log_factor = jax.lax.fori_loop(0, system.substeps, part, (State(*map(jnp.asarray, state)), jnp.array(0.0)))
    if observation.at_end is not None:
        state, more = _update(system, state, observation.at_end, 1.0, interval.stop, theta)
        log_factor = log_factor + more
    return state, _info(state, log_factor)


def _stable(system, state, reading, start, length, theta):
    """Half of the observation's factor, the prediction, the other half."""
    halves = 2.0 * system.substeps
    first = second = 0.0
    if reading is not None:
        state, first = _update(system, state, reading, halves, start, theta)
    # The mean in the middle, to second order, is where the system is linearised.
    middle, _, _ = _linearised(system, state.mean, state.mean, start, start, length / 2, theta)
    mean, map_, spread = _linearised(system, state.mean, middle, start, start + length / 2, length, theta)
    state = State(_wrapped(system, mean), map_ @ state.cov @ map_.T + spread)
    if reading is not None:
        state, second = _update(system, state, reading, halves, start + length, theta)
    return state, first + second


def _linearised(system, mean, centre, start, clock, length, theta):
    """The mean after `length`, dx/dx0 and the noise gathered, for the system linearised at (centre, clock)."""
    slope, change = system.drift_slope(centre, jnp.asarray(clock, float), theta)
    map_, drifted, spread = linear_flow(
        slope, change, system.drift(centre, clock, theta), system.covariance(centre, clock, theta), length, start - clock
    )
    return centre + map_ @ (mean - centre) + drifted, map_, spread


def _euler(system, state, reading, start, length, theta):
    """One explicit Euler step of equation (1)."""
    mean, cov = state
    slope = jax.jacfwd(system.drift)(mean, start, theta)
    growth = slope @ cov + cov @ slope.T + system.covariance(mean, start, theta)
    moved = mean + system.drift(mean, start, theta) * length
    log_factor = 0.0
    if reading is not None:
        _, log_factor = _update(system, state, reading, system.substeps, start, theta)
        H = reading.seen[:, None] * system.observe_slope(mean, start, theta)
        missing = jnp.diag(1.0 - reading.seen)
        noise = jnp.outer(reading.seen, reading.seen) * system.noise(mean, start, theta) + missing
        gain = cov @ cho_solve((jnp.linalg.cholesky(noise), True), H).T
        residual = reading.values - reading.seen * system.observe(mean, start, theta)
        moved = moved + gain @ residual * length
        growth = growth - gain @ H @ cov
    new = cov + growth * length
    return State(_wrapped(system, moved), 0.5 * (new + new.T)), log_factor


def _update(system, state, reading, share, t, theta):
    """The Kalman update with z = h(x) + noise of covariance `share` * scale * S, and the logarithm of its evidence.

    Only the observed rows count: the others get H = 0 and a unit noise of their own.  For increments the evidence is relative to
    pure noise.
    """
    mean, cov = state
    both = jnp.outer(reading.seen, reading.seen)
    noise = both * share * reading.scale * system.noise(mean, t, theta) + jnp.diag(1.0 - reading.seen)
    H = reading.seen[:, None] * system.observe_slope(mean, t, theta)
    residual = reading.values - reading.seen * system.observe(mean, t, theta)
    factor = jnp.linalg.cholesky(H @ cov @ H.T + noise)
    gain = cho_solve((factor, True), H @ cov).T
    keep = jnp.eye(len(mean)) - gain @ H
    log_factor = _log_normal(residual, factor)
    if system.sampled:
        log_factor = log_factor - 0.5 * jnp.log(2 * jnp.pi) * jnp.sum(reading.seen)
    else:
        log_factor = log_factor - _log_normal(reading.values, jnp.linalg.cholesky(noise))
    new = keep @ cov @ keep.T + gain @ noise @ gain.T
    return State(_wrapped(system, mean + gain @ residual), new), log_factor


def _log_normal(residual, factor):
    """log N(residual; 0, 2 pi C) with C = factor factor'; not a number where C was indefinite."""
    white = solve_triangular(factor, residual, lower=True)
    return -0.5 * white @ white - jnp.sum(jnp.log(jnp.diag(factor)))


def _wrapped(system, mean):
    return jnp.where(system.angles, jnp.pi - jnp.mod(jnp.pi - mean, 2 * jnp.pi), mean) if system.angles.any() else mean


def _info(state: State, log_factor: Any) -> Info:
    mean, cov = state
    values = cov[0] if len(mean) == 1 else jnp.linalg.eigvalsh(cov)
    size = jnp.max(jnp.abs(values))
    indefinite = jnp.where(size > 0, jnp.maximum(-jnp.min(values), 0.0) / size, 0.0)
    lost = jnp.where(jnp.isfinite(size) & jnp.all(jnp.isfinite(mean)), indefinite, jnp.inf)
    return Info(jnp.asarray(log_factor), mean, cov, {"indefinite_cov": lost, "smallest_eigenvalue": jnp.min(values)})


def density(prepared: Prepared, state: State) -> GaussianMixture:
    """The Gaussian, wrapped where a coordinate is an angle."""
    model = prepared.model
    periodic = tuple(name in model.periodic for name in model.state)
    return GaussianMixture.gaussian(np.asarray(state.mean), np.asarray(state.cov), model.state, periodic)


METHOD = Method(
    name="extended-kalman-bucy",
    source="Jazwinski 1970, theorem 8.1 and its continuous-discrete form; explicit Euler as in Chen, Luo and Yau 2017, section V",
    exactness="approximate: the system is linearised at the mean; for a linear system second order in the interval "
    "(increments), exact for samples and constant coefficients",
    theorem=theorem,
    options={"riccati": "stable", "substeps": 1},
    prepare=prepare,
    init=init,
    correct=correct,
    observations=observations,
    rule=rule,
    step=step,
    density=density,
    with_parameters=with_parameters,
    bounds={"indefinite_cov": (1e-9, "the covariance has a negative eigenvalue (its share of the largest), or is not finite")},
)
