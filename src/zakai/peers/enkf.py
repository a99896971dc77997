"""The stochastic ensemble Kalman filter of cuthbert.

    forecast    each member x_i through the discretised system with noise of its own; deviations times 1 + `inflation`
    analysis    x_i -> x_i + C_xh (C_hh + R)^-1 (z + e_i - h(x_i)),   e_i ~ N(0, R),   C: covariances of the ensemble

(Evensen 1994; Burgers, van Leeuwen and Evensen 1998; Sanz-Alonso, Stuart and Taeb 2018, algorithm 10.2, as in
cuthbert.ensemble_kalman.)  The evidence is that of a Gaussian with the ensemble's moments of h.  cuthbert can leave the
observations unperturbed; the ensemble then loses more variance than Bayes' rule takes, and this is not offered.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from cuthbert.ensemble_kalman.ensemble_kalman_filter import EnKFState, build_filter

from zakai import _float64  # noqa: F401
from zakai.algebra.theorems import smooth_system as theorem
from zakai.densities import PointMasses
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


class State(NamedTuple):
    """The `key` of the draws to come, the `members` (N, n) and the running sums of the innovations."""

    key: Any
    members: Any
    sums: Innovations

    @property
    def kept(self) -> Kept:
        """What is kept of each step."""
        return Kept(self.members)


class Kept(NamedTuple):
    """The members (N, n)."""

    members: Any


class Rule(NamedTuple):
    """The static settings: how many members, and by how much deviations are stretched."""

    members: int
    inflation: float


def _dynamics(inputs: tuple[Interval, Reading]) -> Any:
    return lambda x, key: moved(inputs[0], key, x)


def _observation(inputs: tuple[Interval, Reading]) -> Any:
    interval, reading = inputs

    def h(x: Any) -> Any:
        return reading.whiten @ interval.system.observation(x, interval.stop, interval.theta)

    return h, jnp.eye(interval.system.m), reading.values


@lru_cache(maxsize=32)
def _filter(rule: Rule, n: int) -> Any:
    """cuthbert's filter; it asks `init_sample` for nothing but the shape of a member."""
    return build_filter(
        lambda key: jnp.zeros(n), _dynamics, _observation, rule.members, rule.inflation, store_predicted_ensemble=True
    )


def prepare(
    model: Model,
    schedule: Schedule,
    *,
    members: int = 100,
    seed: int = 0,
    inflation: float = 0.0,
    scheme: str = "midpoint",
    substeps: int = 1,
) -> Prepared:
    """The intervals with the noise of each substep.

    `members` are drawn from `seed` on; `inflation` stretches deviations from the mean by 1 + `inflation` at each forecast;
    each interval is cut into `substeps` equal parts by `scheme`, "midpoint" or "euler". Raises InputError for another value.
    """
    inflation = real_number("inflation", inflation, "a number from 0", lambda value: 0 <= value < np.inf)
    rule = Rule(whole_number("members", members, 2), inflation)
    return prepared_by(rule, model, schedule, scheme, substeps, seed)


def init(prepared: Prepared, prior: Any) -> State:
    """Draws of the prior."""
    rule = prepared.system.rule
    key = np.asarray(jax.random.key_data(jax.random.key(prepared.seed)))
    return State(key, draws(prepared.model, prior, prepared.seed, rule.members), Innovations())


def correct(prepared: Prepared, prior: Any, observation: Reading) -> tuple[State, Info]:
    """The prior after a sample at the start itself."""
    return step(start_interval(prepared), init(prepared, prior), jax.tree.map(lambda a: a[0], observation))


def step(interval: Interval, state: State, observation: Reading) -> tuple[State, Info]:
    """One interval: cuthbert's forecast and analysis; and the health of them."""
    system = interval.system
    rule, inputs = system.rule, (interval, observation)
    key = jax.random.wrap_key_data(jnp.asarray(state.key))
    peer = _filter(rule, system.n)
    members = jnp.asarray(state.members)
    before = EnKFState(key, members, None, jnp.array(0.0), members)
    after = peer.filter_combine(before, peer.filter_prepare(inputs, key=key))

    equal = jnp.full(rule.members, 1.0 / rule.members)
    mean, cov = moments(equal, after.ensemble, system.angles)
    expected, spread = moments(equal, jax.vmap(_observation(inputs)[0])(after.predicted_ensemble), ())
    sums = innovations(state.sums, observation, expected, spread * rule.members / (rule.members - 1) + jnp.eye(system.m))
    pure_noise = -0.5 * jnp.sum(observation.values**2) - 0.5 * system.m * jnp.log(2 * jnp.pi)
    evidence = after.log_normalizing_constant - pure_noise + observation.constant
    health = {
        "smallest_deviation": jnp.sqrt(jnp.min(jnp.diag(cov))),
        "innovation_excess": in_deviations(sums),
    }
    return State(jax.random.key_data(after.key), after.ensemble, sums), Info(evidence, mean, cov, health)


def density(prepared: Prepared, state: State | Kept) -> PointMasses:
    """The members, all of one weight."""
    model, points = prepared.model, np.asarray(state.members)
    periodic = tuple(name in model.periodic for name in model.state)
    return PointMasses(np.full(len(points), 1.0 / len(points)), points, model.state, periodic)


METHOD = Method(
    name="enkf",
    source="cuthbert, ensemble Kalman filter (Evensen 1994; Sanz-Alonso, Stuart and Taeb 2018, algorithm 10.2)",
    exactness="approximate: the posterior is taken for an affine function of the forecast; for a linear system convergent in "
    "1 / sqrt(members), up to an error of first order in the interval for increments, and in a substep of second (midpoint) or "
    "first (euler)",
    theorem=theorem,
    options={"members": 100, "seed": 0, "inflation": 0.0, "scheme": "midpoint", "substeps": 1},
    prepare=prepare,
    init=init,
    correct=correct,
    observations=observations,
    step=step,
    density=density,
    bounds={"innovation_excess": (DOUBTFUL, DIVERGED)},
)
