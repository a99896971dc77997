"""The shared part of the two filters with one Gaussian: dynamax' predict and condition, over an interval and at its end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from zakai.densities import GaussianMixture
from zakai.methods._protocol import Info
from zakai.methods.system.prior_moments import prior_moments, wrapped
from zakai.models.angles import ONE_IMAGE
from zakai.models.model import Model
from zakai.peers import _float64  # noqa: F401
from zakai.peers._translation import (
    DIVERGED,
    DOUBTFUL,
    Innovations,
    Interval,
    Observation,
    Prepared,
    System,
    compiled,
    image_health,
    in_deviations,
    innovations,
    seen_from,
    system_of,
)
from zakai.records.schedule import Schedule

import jax  # isort: skip
import jax.numpy as jnp  # isort: skip
from tensorflow_probability.substrates.jax.distributions import MultivariateNormalFullCovariance  # isort: skip

BOUNDS = {
    "indefinite_cov": (1e-9, "the covariance has a negative eigenvalue (its share of the largest), or is not finite"),
    "innovation_excess": (DOUBTFUL, DIVERGED),
    "other_image": ONE_IMAGE,
}
FIRST_ORDER = (
    "of first order in the interval for increments, and in a substep of second (midpoint) or first (euler, or where noise "
    "depends on the state)"
)


class Rule(NamedTuple):
    """How the library moves a Gaussian.

    `predict(mean, cov, function, noise)` is the Gaussian of function(x) + N(0, noise); `condition(mean, cov, function, value)`
    that of x given value = function(x) + N(0, I).
    """

    predict: Callable[..., tuple[Any, Any]]
    condition: Callable[..., tuple[Any, Any]]


class State(NamedTuple):
    """The Gaussian, `mean` (n,) and `cov` (n, n), and the running sums of its innovations."""

    mean: Any
    cov: Any
    sums: Innovations


def prepared_by(rule: Rule, model: Model, schedule: Schedule, theta: np.ndarray, scheme: str, substeps: int) -> Prepared:
    """Return the intervals with their static settings."""
    return Prepared.of(model, system_of(model, scheme, substeps, rule), schedule, theta)


def init(prepared: Prepared, prior: Any) -> State:
    """Return the prior's mean and covariance."""
    return State(*prior_moments(prepared.model, prior, prepared.theta), Innovations())


def _advanced(system: System, interval: Interval, state: State, observation: Observation) -> tuple[State, Info]:
    """Advance a state over an interval, substep by substep, and condition it on what is observed at the end."""
    length, theta = interval.length / system.substeps, interval.theta
    predict = system.rule.predict

    def substep(index: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
        t = interval.start + index * length
        zero, when = jnp.zeros((system.n, system.n)), system.noise_time(t, length)
        G = system.covariance(jnp.zeros(system.n), when, theta) if system.diffusion is None else zero
        before = carry
        carry = predict(*carry, lambda x: system.before_noise(x, t, length, theta), length * G)
        if system.diffusion is not None:
            at = before if system.scheme == "euler" else carry
            carry = carry[0], carry[1] + length * _expected(system, *at, lambda x: system.covariance(x, when, theta))
        if system.scheme == "euler":
            return carry
        return predict(*carry, lambda x: system.after_noise(x, t, length, theta), zero)

    count = jnp.where(interval.length > 0, system.substeps, 0)
    mean, cov = jax.lax.fori_loop(0, count, substep, (state.mean, state.cov))
    return _conditioned(system, mean, cov, state.sums, observation, interval.stop, theta)


def _expected(system: System, mean: Any, cov: Any, matrix: Callable[[Any], Any]) -> Any:
    """Return the expected value of a matrix that depends on the state, as the library takes expectations."""
    shape = matrix(mean).shape
    noise = jnp.zeros((shape[0] * shape[1],) * 2)
    return system.rule.predict(mean, cov, lambda x: matrix(x).ravel(), noise)[0].reshape(shape)


def _conditioned(
    system: System, mean: Any, cov: Any, sums: Innovations, observation: Observation, t: Any, theta: Any
) -> tuple[State, Info]:
    """Return the Gaussian given the observation, the evidence and the size of the innovation."""
    observation, h = seen_from(system, observation, mean, t, theta)
    unit, zero = jnp.eye(system.m), jnp.zeros(system.m)
    expected, spread = system.rule.predict(mean, cov, h, unit)
    evidence = MultivariateNormalFullCovariance(expected, spread).log_prob(observation.values)
    evidence = evidence - MultivariateNormalFullCovariance(zero, unit).log_prob(observation.values) + observation.constant
    mean, cov = system.rule.condition(mean, cov, h, observation.values)
    if system.angles:
        periodic = np.isin(np.arange(system.n), system.angles)
        mean = jnp.where(periodic, jnp.pi - jnp.mod(jnp.pi - mean, 2 * jnp.pi), mean)
    sums = innovations(sums, observation, expected, spread)
    values = cov[0] if system.n == 1 else jnp.linalg.eigvalsh(cov)
    size = jnp.max(jnp.abs(values))
    indefinite = jnp.where(size > 0, jnp.maximum(-jnp.min(values), 0.0) / size, 0.0)
    lost = jnp.where(jnp.isfinite(size) & jnp.all(jnp.isfinite(mean)), indefinite, jnp.inf)
    health = {"indefinite_cov": lost, "smallest_eigenvalue": jnp.min(values), "innovation_excess": in_deviations(sums)}
    health |= image_health(system, observation, expected, spread)
    return State(mean, cov, sums), Info(evidence, mean, cov, health)


step, segment = compiled(_advanced, 64)


def density(prepared: Prepared, state: State) -> GaussianMixture:
    """Return the Gaussian, wrapped where a coordinate is an angle."""
    model = prepared.model
    periodic = tuple(name in model.periodic for name in model.state)
    return GaussianMixture.gaussian(wrapped(model, state.mean), state.cov, model.state, periodic)


def valid(prepared: Prepared, state: State) -> bool:
    """Return whether the arrays of a state fit the model."""
    n = prepared.model.n
    return state.mean.shape == (n,) and state.cov.shape == (n, n)

