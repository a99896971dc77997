"""The bootstrap particle filter of cuthbert.

    resample     if the effective sample size 1 / sum w_i^2 is below `ess_threshold` N
    propagate    x_i ~ the law of the discretised system after the interval, from x_i
    weigh        log w_i += z . h(x_i) - |h(x_i)|^2 / 2 for what is read, white: z = h + N(0, I)

(Gordon, Salmond and Smith 1993; Chopin and Papaspiliopoulos 2020, algorithm 10.1, as in cuthbert.smc.particle_filter.)  The
estimate is that of the weighted particles, before the next resampling.  The estimate of the likelihood is unbiased, that of its
logarithm is not.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from cuthbert.smc.particle_filter import ParticleFilterState, build_filter
from cuthbertlib.resampling import ess_decorator, killing, multinomial, systematic
from cuthbertlib.smc.ess import log_ess

from zakai import _float64  # noqa: F401
from zakai.algebra.theorems import smooth_system as theorem
from zakai.densities import PointMasses
from zakai.errors import InputError
from zakai.filters._protocol import Info, Method, Schedule
from zakai.models.model import Model
from zakai.peers._sampling import draws, moments, moved, observations, prepared_by, start_interval
from zakai.peers._translation import (
    DIVERGED,
    DOUBTFUL,
    Innovations,
    Interval,
    Prepared,
    Reading,
    in_deviations,
    innovations,
    real_number,
    whole_number,
)

RESAMPLING = {"systematic": systematic, "multinomial": multinomial, "killing": killing}


class State(NamedTuple):
    """The `key` of the draws to come, `particles` (N, n), `log_weights` (N,), the running sums of the innovations, and, where
    nothing but the start is random, which of the first particles each descends from."""

    key: Any
    particles: Any
    log_weights: Any
    sums: Innovations
    family: Any

    @property
    def kept(self) -> Kept:
        """What is kept of each step."""
        return Kept(self.particles, self.log_weights)


class Kept(NamedTuple):
    """The weighted particles."""

    particles: Any
    log_weights: Any


class Rule(NamedTuple):
    """The static settings: how many particles, resampled how and when."""

    particles: int
    resampling: str
    ess_threshold: float


def _propagate(key: Any, x: Any, inputs: tuple[Interval, Reading]) -> Any:
    return moved(inputs[0], key, x)


def _white(inputs: tuple[Interval, Reading], x: Any) -> Any:
    """The white observation (m,) of a state at the end of the interval."""
    interval, reading = inputs
    return reading.whiten @ interval.system.observation(x, interval.stop, interval.theta)


def _log_potential(before: Any, x: Any, inputs: tuple[Interval, Reading]) -> Any:
    h = _white(inputs, x)
    return inputs[1].values @ h - 0.5 * h @ h


@lru_cache(maxsize=32)
def _filter(rule: Rule, n: int) -> Any:
    """cuthbert's filter; it asks `init_sample` for nothing but the shape of a particle."""
    resample = ess_decorator(RESAMPLING[rule.resampling].resampling, rule.ess_threshold)
    return build_filter(lambda key: jnp.zeros(n), _propagate, _log_potential, rule.particles, resample)


def prepare(
    model: Model,
    schedule: Schedule,
    *,
    particles: int = 1000,
    seed: int = 0,
    resampling: str = "systematic",
    ess_threshold: float = 0.5,
    scheme: str = "midpoint",
    substeps: int = 1,
) -> Prepared:
    """The intervals with the noise of each substep.

    `particles` are drawn from `seed` on; `resampling` is "systematic", "multinomial" or "killing", done where the effective
    sample size is below the share `ess_threshold` of them; each interval is cut into `substeps` equal parts by `scheme`,
    "midpoint" or "euler". Raises InputError for another value.
    """
    if resampling not in RESAMPLING:
        raise InputError(f'option resampling: "{resampling}" is none of {", ".join(RESAMPLING)}')
    share = real_number("ess_threshold", ess_threshold, "a share between 0 and 1", lambda value: 0 <= value <= 1)
    rule = Rule(whole_number("particles", particles, 2), resampling, share)
    notes: tuple[str, ...] = ()
    if model.covariance.is_zero_matrix is True:
        notes = (
            "the system has no process noise: particles that are resampled stay copies of each other, whose number only falls",
        )
    return prepared_by(rule, model, schedule, scheme, substeps, seed, notes)


def init(prepared: Prepared, prior: Any) -> State:
    """Draws of the prior, all of one weight."""
    rule = prepared.system.rule
    first = draws(prepared.model, prior, prepared.seed, rule.particles)
    family = np.arange(rule.particles) if prepared.system.noiseless else None
    key = np.asarray(jax.random.key_data(jax.random.key(prepared.seed)))
    return State(key, first, np.full(rule.particles, -np.log(rule.particles)), Innovations(), family)


def correct(prepared: Prepared, prior: Any, observation: Reading) -> tuple[State, Info]:
    """The prior after a sample at the start itself."""
    return step(start_interval(prepared), init(prepared, prior), jax.tree.map(lambda a: a[0], observation))


def step(interval: Interval, state: State, observation: Reading) -> tuple[State, Info]:
    """One interval: cuthbert's resampling, propagation and weights; and the health of them."""
    system = interval.system
    rule, inputs = system.rule, (interval, observation)
    own, following = jax.random.split(jax.random.wrap_key_data(jnp.asarray(state.key)))
    weights, particles = jnp.asarray(state.log_weights), jnp.asarray(state.particles)
    peer = _filter(rule, system.n)
    before = ParticleFilterState(own, particles, weights, jnp.arange(rule.particles), None, jnp.array(0.0))
    after = peer.filter_combine(before, peer.filter_prepare(inputs, key=following))

    log_weights = after.log_weights - jax.nn.logsumexp(after.log_weights)
    share = jnp.exp(log_weights)
    mean, cov = moments(share, after.particles, system.angles)
    h = jax.vmap(_white, (None, 0))(inputs, after.particles)
    predicted = jax.nn.softmax(after.log_weights - h @ observation.values + 0.5 * jnp.sum(h**2, axis=1))
    expected, spread = moments(predicted, h, ())
    sums = innovations(state.sums, observation, expected, spread + jnp.eye(system.m))
    family, parts = None, share
    if state.family is not None:
        family = jnp.asarray(state.family)[after.ancestor_indices]
        parts = jnp.zeros(rule.particles).at[family].add(share)
    effective = 1.0 / jnp.sum(parts**2)
    health = {
        "effective_sample_size": effective,
        "monte_carlo_error": 1.0 / jnp.sqrt(effective),
        "resampled": (log_ess(weights) < jnp.log(rule.ess_threshold * rule.particles)).astype(float),
        "innovation_excess": in_deviations(sums),
    }
    key = jax.random.key_data(after.key)
    evidence = after.log_normalizing_constant + observation.constant
    return State(key, after.particles, log_weights, sums, family), Info(evidence, mean, cov, health)


def density(prepared: Prepared, state: State | Kept) -> PointMasses:
    """The weighted particles."""
    model = prepared.model
    weights = np.exp(np.asarray(state.log_weights))
    return PointMasses(
        weights / weights.sum(), np.asarray(state.particles), model.state, tuple(name in model.periodic for name in model.state)
    )


METHOD = Method(
    name="particle",
    source="cuthbert, particle filter (Gordon, Salmond and Smith 1993; Chopin and Papaspiliopoulos 2020, algorithm 10.1)",
    exactness="convergent: in 1 / sqrt(particles), up to an error of first order in the interval for increments, and in a "
    "substep of second (midpoint) or first (euler)",
    theorem=theorem,
    options={
        "particles": 1000, "seed": 0, "resampling": "systematic", "ess_threshold": 0.5, "scheme": "midpoint", "substeps": 1,
    },
    prepare=prepare,
    init=init,
    correct=correct,
    observations=observations,
    step=step,
    density=density,
    bounds={
        "monte_carlo_error": (
            0.3,
            "few particles carry the weight: the mean is uncertain by this share of a standard deviation; take more particles",
        ),
        "innovation_excess": (DOUBTFUL, DIVERGED),
    },
)  # fmt: skip
