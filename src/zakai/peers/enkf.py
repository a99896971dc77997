"""The stochastic ensemble Kalman filter of cuthbert.

    forecast    each member x_i through the discretised system with noise of its own; deviations times 1 + `inflation`
    analysis    x_i -> x_i + C_xh (C_hh + R)^-1 (z + e_i - h(x_i)),   e_i ~ N(0, R),   C: covariances of the ensemble

(Evensen 1994; Burgers, van Leeuwen and Evensen 1998; Sanz-Alonso, Stuart and Taeb 2018, algorithm 10.2, as in
cuthbert.ensemble_kalman.)  The evidence is that of a Gaussian with the ensemble's moments of h.  cuthbert can leave the
observations unperturbed; the ensemble then loses more variance than Bayes' rule takes, and this is not offered.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.algebra.theorems import smooth_system as theorem
from zakai.densities import PointMasses
from zakai.methods._options import real_number, whole_number
from zakai.methods._protocol import Info, Method
from zakai.models.angles import ONE_IMAGE
from zakai.models.model import Model
from zakai.peers import _float64  # noqa: F401
from zakai.peers._sampling import ahead, draws, first_key, moments, moved, prepared_by
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
)
from zakai.records.schedule import Schedule

import jax  # isort: skip
import jax.numpy as jnp  # isort: skip
from cuthbert.ensemble_kalman.ensemble_kalman_filter import EnKFState, build_filter  # isort: skip


class State(NamedTuple):
    """The `key` of the next draws, the `members` (N, n) and the running sums of the innovations."""

    key: Any
    members: Any
    sums: Innovations


class Rule(NamedTuple):
    """The static settings: the number of members, and the factor by which deviations are inflated, minus one."""

    members: int
    inflation: float


def prepare(
    model: Model,
    schedule: Schedule,
    theta: np.ndarray,
    *,
    members: int = 100,
    seed: int = 0,
    inflation: float = 0.0,
    scheme: str = "midpoint",
    substeps: int = 1,
) -> Prepared:
    """Return what is known of the intervals without data.

    Args:
        model: the system.
        schedule: its K intervals.
        theta: values of the parameters (p,).
        members: size of the ensemble.
        seed: of the draws.
        inflation: at each forecast the deviations from the mean are multiplied by 1 + `inflation`.
        scheme: "midpoint" or "euler".
        substeps: equal parts of each interval.

    Raises:
        InputError: another value of an option.
    """
    inflation = real_number("inflation", inflation, "a number from 0", lambda value: 0 <= value < np.inf)
    rule = Rule(whole_number("members", members, 2), inflation)
    return prepared_by(rule, model, schedule, theta, scheme, substeps, seed)


def init(prepared: Prepared, prior: Any) -> State:
    """Return draws of the prior."""
    return State(first_key(prepared), draws(prepared, prior, prepared.system.rule.members), Innovations())


def _advanced(system: System, interval: Interval, state: State, observation: Observation) -> tuple[State, Info]:
    """Advance an ensemble over an interval: cuthbert's forecast and analysis, and their health."""
    rule, key = system.rule, jax.random.wrap_key_data(state.key)
    equal = jnp.full(rule.members, 1.0 / rule.members)
    centre = state.members[0]
    if system.noise is not None or len(system.turning):
        centre = ahead(system, interval, moments(equal, state.members, system.angles)[0])
    observation, h = seen_from(system, observation, centre, interval.stop, interval.theta)

    # cuthbert asks the first function for nothing but the shape of a member.
    built = build_filter(
        lambda key: jnp.zeros(system.n),
        lambda inputs: lambda x, key: moved(system, interval, key, x),
        lambda inputs: (h, jnp.eye(system.m), observation.values),
        rule.members,
        rule.inflation,
        store_predicted_ensemble=True,
    )
    inputs = jnp.zeros(())
    before = EnKFState(key, state.members, inputs, jnp.array(0.0), state.members)
    after = built.filter_combine(before, built.filter_prepare(inputs, key=key))

    mean, cov = moments(equal, after.ensemble, system.angles)
    expected, spread = moments(equal, jax.vmap(h)(after.predicted_ensemble), ())
    sums = innovations(state.sums, observation, expected, spread * rule.members / (rule.members - 1) + jnp.eye(system.m))
    pure_noise = -0.5 * jnp.sum(observation.values**2) - 0.5 * system.m * jnp.log(2 * jnp.pi)
    evidence = after.log_normalizing_constant - pure_noise + observation.constant
    health = {"smallest_deviation": jnp.sqrt(jnp.min(jnp.diag(cov))), "innovation_excess": in_deviations(sums)}
    health |= image_health(system, observation, expected, spread + jnp.eye(system.m))
    return State(jax.random.key_data(after.key), after.ensemble, sums), Info(evidence, mean, cov, health)


step, segment = compiled(_advanced, 8)


def density(prepared: Prepared, state: State) -> PointMasses:
    """Return the members, with equal weights."""
    model, points = prepared.model, state.members
    periodic = tuple(name in model.periodic for name in model.state)
    return PointMasses(np.full(len(points), 1.0 / len(points)), points, model.state, periodic)


def valid(prepared: Prepared, state: State) -> bool:
    """Return whether the arrays of a state fit the model and the options."""
    return state.key.shape == first_key(prepared).shape and state.members.shape == (
        prepared.system.rule.members,
        prepared.model.n,
    )


METHOD: Method[Prepared, State] = Method(
    name="enkf",
    source="cuthbert, ensemble Kalman filter (Evensen 1994; Sanz-Alonso, Stuart and Taeb 2018, algorithm 10.2)",
    exactness="approximate: the posterior is taken as an affine function of the forecast; for a linear system convergent in "
    "1 / sqrt(members), up to an error of first order in the interval for increments, and in a substep of second (midpoint) or "
    "first (euler)",
    theorem=theorem,
    options={"members": 100, "seed": 0, "inflation": 0.0, "scheme": "midpoint", "substeps": 1},
    prepare=prepare,
    init=init,
    step=step,
    segment=segment,
    density=density,
    state=State,
    bounds={"innovation_excess": (DOUBTFUL, DIVERGED), "other_image": ONE_IMAGE},
    differentiable=False,
    valid=valid,
)
