"""What the two peers with one Gaussian have in common: dynamax' predict and condition, over an interval and at its end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tensorflow_probability.substrates.jax.distributions import MultivariateNormalFullCovariance

from zakai import _float64  # noqa: F401
from zakai.densities import GaussianMixture
from zakai.densities._density import wrap
from zakai.filters._moments import prior_moments
from zakai.filters._protocol import Info, Schedule
from zakai.filters.observations import Data
from zakai.models.model import Model
from zakai.peers._translation import (
    DIVERGED,
    DOUBTFUL,
    Innovations,
    Interval,
    Prepared,
    Reading,
    System,
    in_deviations,
    innovations,
    readings,
    system_of,
)

BOUNDS = {
    "indefinite_cov": (1e-9, "the covariance has a negative eigenvalue (its share of the largest), or is not finite"),
    "innovation_excess": (DOUBTFUL, DIVERGED),
}
FIRST_ORDER = "of first order in the interval for increments, and in a substep of second (midpoint) or first (euler)"


class Rule(NamedTuple):
    """How the library moves a Gaussian: `predict(mean, cov, function, noise)` is that of function(x) + N(0, noise),
    `condition(mean, cov, function, value)` that of x given value = function(x) + N(0, I)."""

    predict: Callable[..., tuple[Any, Any]]
    condition: Callable[..., tuple[Any, Any]]


class State(NamedTuple):
    """The Gaussian, `mean` (n,) and `cov` (n, n), and the running sums of its innovations."""

    mean: Any
    cov: Any
    sums: Innovations


def prepared_by(rule: Rule, model: Model, schedule: Schedule, scheme: str, substeps: int) -> Prepared:
    """The intervals with their static settings."""
    system = system_of(model, scheme, substeps, rule)
    theta = np.tile(model.theta(), (len(schedule.starts), 1))
    return Prepared(
        model, system, schedule, model.theta(), Interval(schedule.starts, schedule.stops, theta, None, system)
    )


def with_parameters(prepared: Prepared, theta: Any) -> Prepared:
    """The same intervals with other values of the parameters."""
    intervals = replace(prepared.intervals, theta=jnp.tile(theta, (len(prepared.schedule.starts), 1)))
    return replace(prepared, theta=theta, intervals=intervals)


def observations(prepared: Prepared, data: Data) -> Reading:
    """The white readings of all intervals."""
    return readings(prepared, data)


def init(prepared: Prepared, prior: Any) -> State:
    """The prior's mean and covariance."""
    return State(*prior_moments(prepared.model, prior, prepared.theta), Innovations())


def correct(prepared: Prepared, prior: Any, observation: Reading) -> tuple[State, Info]:
    """The prior after a sample at the start itself."""
    reading = jax.tree.map(lambda a: a[0], observation)
    return _conditioned(prepared.system, init(prepared, prior), reading, prepared.model.start, prepared.theta)


def step(interval: Interval, state: State, observation: Reading) -> tuple[State, Info]:
    """One interval, substep by substep, and then what is read at its end."""
    system, theta = interval.system, interval.theta
    length = (interval.stop - interval.start) / system.substeps
    predict = system.rule.predict

    def part(index: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
        t = interval.start + index * length
        G = system.covariance(jnp.zeros(system.n), system.noise_time(t, length), theta)
        carry = predict(*carry, lambda x: system.before_noise(x, t, length, theta), length * G)
        if system.scheme == "euler":
            return carry
        return predict(*carry, lambda x: system.after_noise(x, t, length, theta), jnp.zeros_like(G))

    moments = (jnp.asarray(state.mean, float), jnp.asarray(state.cov, float))
    mean, cov = jax.lax.fori_loop(0, system.substeps, part, moments)
    return _conditioned(system, State(mean, cov, state.sums), observation, interval.stop, theta)


def _conditioned(system: System, state: State, reading: Reading, t: Any, theta: Any) -> tuple[State, Info]:
    """The Gaussian given what is read, with the evidence and the size of the innovation."""

    def h(x: Any) -> Any:
        return reading.whiten @ system.observation(x, t, theta)

    unit, nothing = jnp.eye(system.m), jnp.zeros(system.m)
    expected, spread = system.rule.predict(state.mean, state.cov, h, unit)
    evidence = MultivariateNormalFullCovariance(expected, spread).log_prob(reading.values)
    evidence = evidence - MultivariateNormalFullCovariance(nothing, unit).log_prob(reading.values) + reading.constant
    mean, cov = system.rule.condition(state.mean, state.cov, h, reading.values)
    if system.angles:
        turning = np.isin(np.arange(system.n), system.angles)
        mean = jnp.where(turning, jnp.pi - jnp.mod(jnp.pi - mean, 2 * jnp.pi), mean)
    sums = innovations(state.sums, reading, expected, spread)
    values = cov[0] if system.n == 1 else jnp.linalg.eigvalsh(cov)
    size = jnp.max(jnp.abs(values))
    indefinite = jnp.where(size > 0, jnp.maximum(-jnp.min(values), 0.0) / size, 0.0)
    lost = jnp.where(jnp.isfinite(size) & jnp.all(jnp.isfinite(mean)), indefinite, jnp.inf)
    health = {"indefinite_cov": lost, "smallest_eigenvalue": jnp.min(values), "innovation_excess": in_deviations(sums)}
    return State(mean, cov, sums), Info(evidence, mean, cov, health)


def density(prepared: Prepared, state: State) -> GaussianMixture:
    """The Gaussian, wrapped where a coordinate is an angle."""
    model = prepared.model
    periodic = tuple(name in model.periodic for name in model.state)
    mean = np.asarray(state.mean)
    return GaussianMixture.gaussian(np.where(periodic, wrap(mean), mean), np.asarray(state.cov), model.state, periodic)
