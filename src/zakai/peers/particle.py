"""The bootstrap particle filter of cuthbert.

    resample     if the effective sample size 1 / sum w_i^2 is below `ess_threshold` N
    propagate    x_i ~ the law of the discretised system after the interval, from x_i
    weight       log w_i += z . h(x_i) - |h(x_i)|^2 / 2 for a white observation z = h + N(0, I)

(Gordon, Salmond and Smith 1993; Chopin and Papaspiliopoulos 2020, algorithm 10.1, as in cuthbert.smc.particle_filter.)  The
estimate is that of the weighted particles, before the next resampling.  The estimate of the likelihood is unbiased, that of its
logarithm is not.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.algebra.theorems import smooth_system as theorem
from zakai.densities import PointMasses
from zakai.methods._options import one_of, real_number, whole_number
from zakai.methods._protocol import Info, Method
from zakai.models.model import Model
from zakai.peers import _float64  # noqa: F401
from zakai.peers._sampling import draws, first_key, moments, moved, prepared_by
from zakai.peers._translation import (
    DIVERGED,
    DOUBTFUL,
    Innovations,
    Interval,
    Observation,
    Prepared,
    System,
    compiled,
    in_deviations,
    innovations,
    log_density,
    seen_from,
)
from zakai.records.schedule import Schedule

import jax  # isort: skip
import jax.numpy as jnp  # isort: skip
from cuthbert.smc.particle_filter import ParticleFilterState, build_filter  # isort: skip
from cuthbertlib.resampling import ess_decorator, killing, multinomial, systematic  # isort: skip
from cuthbertlib.smc.ess import log_ess  # isort: skip

RESAMPLING = {"systematic": systematic, "multinomial": multinomial, "killing": killing}


class State(NamedTuple):
    """The weighted particles.

    `key` of the next draws, `particles` (N, n), `log_weights` (N,), the running sums of the innovations, and `family` (N,): where
    nothing but the start is random, the first particle from which each descends, else None.
    """

    key: Any
    particles: Any
    log_weights: Any
    sums: Innovations
    family: Any


class Rule(NamedTuple):
    """The static settings: the number of particles, and how and when they are resampled."""

    particles: int
    resampling: str
    ess_threshold: float


def prepare(
    model: Model,
    schedule: Schedule,
    theta: np.ndarray,
    *,
    particles: int = 1000,
    seed: int = 0,
    resampling: str = "systematic",
    ess_threshold: float = 0.5,
    scheme: str = "midpoint",
    substeps: int = 1,
) -> Prepared:
    """Return what is known of the intervals without data.

    Args:
        model: the system.
        schedule: its K intervals.
        theta: values of the parameters (p,).
        particles: number of particles.
        seed: of the draws.
        resampling: "systematic", "multinomial" or "killing".
        ess_threshold: resample where the effective sample size is below this share of the particles.
        scheme: "midpoint" or "euler".
        substeps: equal parts of each interval.

    Raises:
        InputError: another value of an option.
    """
    one_of("resampling", resampling, RESAMPLING)
    share = real_number("ess_threshold", ess_threshold, "a share between 0 and 1", lambda value: 0 <= value <= 1)
    rule = Rule(whole_number("particles", particles, 2), resampling, share)
    notes: tuple[str, ...] = ()
    if model.covariance.is_zero_matrix is True:
        notes = ("the system has no process noise: resampled particles stay copies of each other, whose number only falls",)
    return prepared_by(rule, model, schedule, theta, scheme, substeps, seed, notes)


def init(prepared: Prepared, prior: Any) -> State:
    """Return draws of the prior, with equal weights."""
    count = prepared.system.rule.particles
    first = draws(prepared, prior, count)
    family = np.arange(count) if prepared.system.noiseless else None
    return State(first_key(prepared), first, np.full(count, -np.log(count)), Innovations(), family)


def _advanced(system: System, interval: Interval, state: State, observation: Observation) -> tuple[State, Info]:
    """Advance the particles over an interval: cuthbert's resampling, propagation and weights, and their health."""
    rule = system.rule
    own, following = jax.random.split(jax.random.wrap_key_data(state.key))

    def log_potential(before: Any, x: Any, inputs: Any) -> Any:
        return log_density(system, observation, x, interval.stop, interval.theta)

    # cuthbert asks the first function for nothing but the shape of a particle.
    built = build_filter(
        lambda key: jnp.zeros(system.n),
        lambda key, x, inputs: moved(system, interval, key, x),
        log_potential,
        rule.particles,
        ess_decorator(RESAMPLING[rule.resampling].resampling, rule.ess_threshold),
    )
    inputs = jnp.zeros(())
    before = ParticleFilterState(
        own, state.particles, state.log_weights, jnp.arange(rule.particles), inputs, jnp.array(0.0)
    )
    after = built.filter_combine(before, built.filter_prepare(inputs, key=following))

    log_weights = after.log_weights - jax.nn.logsumexp(after.log_weights)
    share = jnp.exp(log_weights)
    mean, cov = moments(share, after.particles, system.angles)
    potentials = jax.vmap(lambda x: log_density(system, observation, x, interval.stop, interval.theta))(after.particles)
    predicted = jax.nn.softmax(after.log_weights - potentials)
    centre = moments(predicted, after.particles, system.angles)[0]
    white, h = seen_from(system, observation, centre, interval.stop, interval.theta)
    expected, spread = moments(predicted, jax.vmap(h)(after.particles), ())
    sums = innovations(state.sums, white, expected, spread + jnp.eye(system.m))
    family, parts = None, share
    if state.family is not None:
        family = state.family[after.ancestor_indices]
        parts = jnp.zeros(rule.particles).at[family].add(share)
    effective = 1.0 / jnp.sum(parts**2)
    health = {
        "effective_sample_size": effective,
        "monte_carlo_error": 1.0 / jnp.sqrt(effective),
        "resampled": (log_ess(state.log_weights) < jnp.log(rule.ess_threshold * rule.particles)).astype(float),
        "innovation_excess": in_deviations(sums),
    }
    evidence = after.log_normalizing_constant + observation.constant
    return State(jax.random.key_data(after.key), after.particles, log_weights, sums, family), Info(evidence, mean, cov, health)


step, segment = compiled(_advanced, 8)


def density(prepared: Prepared, state: State) -> PointMasses:
    """Return the weighted particles."""
    model = prepared.model
    weights = np.exp(state.log_weights)
    periodic = tuple(name in model.periodic for name in model.state)
    return PointMasses(weights / weights.sum(), state.particles, model.state, periodic)


def valid(prepared: Prepared, state: State) -> bool:
    """Return whether the arrays of a state fit the model and the options."""
    count = prepared.system.rule.particles
    if state.family is None or not prepared.system.noiseless:
        family = state.family is None and not prepared.system.noiseless
    else:
        family = state.family.shape == (count,) and bool(np.all((state.family >= 0) & (state.family < count)))
    shapes = state.key.shape, state.particles.shape, state.log_weights.shape
    return family and shapes == (first_key(prepared).shape, (count, prepared.model.n), (count,))


METHOD: Method[Prepared, State] = Method(
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
    step=step,
    segment=segment,
    density=density,
    state=State,
    bounds={
        "monte_carlo_error": (
            0.3,
            "few particles carry the weight: the mean is uncertain by this share of a standard deviation; take more particles",
        ),
        "innovation_excess": (DOUBTFUL, DIVERGED),
    },
    differentiable=False,
    valid=valid,
)  # fmt: skip
