"""Whether particles carry a Kalman filter, and what is asked of them where they do.

Where the others are moved by the linear states, their path says what these are.  With v = N(m, P) at the start the path of an
interval of length d has the information

    d tr(R^-1 A P A' R'^-1)

about v.  If that is large the path gives v away: drawing it is then as hard as drawing v, and moves of the past, which reach v in
one piece, leave a smaller error.

The equations of m and P are longer than those of v, and need more substeps where P changes fast.  So few particles filter the
first interval in both ways, and the filters are left out where their error^2 x work exceeds that of draws by more than `LATER`:
the variances of the means are those after the interval, the work is counted in the next one, if it is as long.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from zakai.densities import ConditionalParticleDensity, ParticleDensity
from zakai.methods._protocol import Backward, Info
from zakai.methods.particles import filter as particle_filter
from zakai.methods.particles.backward import BACKWARD as PLAIN_BACKWARD
from zakai.methods.particles.conditional import ConditionalSystem, covariances
from zakai.methods.particles.moments import moments_of
from zakai.methods.particles.programs import Array
from zakai.methods.particles.state import Cloud, Prepared, Rule, State
from zakai.methods.particles.substeps import substeps
from zakai.methods.particles.system import root
from zakai.methods.particles.time_step import TIME_ERROR
from zakai.methods.particles.validity import valid as valid_state
from zakai.numerics.particles.random import normals

# Information about v in the path of the first interval above which v is drawn.  Measured: at 3 the error^2 x time of a Kalman
# filter in each particle is two thirds of that of draws with moves of the past, at 8 the same, at 50 ten times as large.
GIVEN_AWAY = 4.0
# What the filters gain over draws in the long run, in error^2 x time, over what the first interval shows: draws lose what they
# know of slow states by resampling, later.  Measured on 24 systems: where it shows less than a quarter the filters have
# 0.02 to 0.4 of the merit of draws, else 0.7 to 70; on nine others, all of which show more, 0.9 to 25.
LATER = 4.0
OF_LEVEL = 4.0  # times that a power of the likelihood, with its moves, follows the particles through an interval
TRIED, SUBSTEPS = 1024, 8  # particles by which that is measured, and substeps of the first interval
MEASURED = 4  # sets of few particles by which the substeps are measured: one set leaves their number open to a fifth
_DRAWS, _TRIAL = 101, 102  # uses of random numbers, beside those of the filter and of smoothing


def suited(prepared: Prepared, state: State) -> Prepared:
    """Return what is prepared for particles such as those of a state."""
    return prepared if len(state.particles) == prepared.system.n else prepared.plain


def step(prepared: Prepared, k: int, state: State, values: Array) -> tuple[State, Info]:
    """Advance by interval k of the schedule, then use what is observed at its stop."""
    own, interval = suited(prepared, state), prepared.interval(k)
    decided = not own.system.linear or own.rule.split or state.control.length > 0 or interval.stop <= interval.start
    if not decided and (_given_away(own, k, state) or not _saves_time(own, k, state, values)):
        own, state = own.plain, drawn_at_start(own, state)
    return particle_filter.step(own, k, state, values)


def _saves_time(prepared: Prepared, k: int, state: State, values: Array) -> bool:
    """Return whether the filters have a smaller error^2 x work than draws, by few particles."""
    rule, number, interval = prepared.rule, len(state.log_weights), prepared.interval(k)
    count = min(TRIED, number)
    cloud = Cloud(state.particles, state.log_weights, state.window, state.islands)
    cloud, _ = cloud.resampled(np.exp(state.log_weights), count, prepared.key(state.control.interval, _TRIAL))
    own, few = replace(prepared, rule=Rule(count, count, None, rule.seed, False)), State(*cloud[:4], *state[4:])
    figures = []
    for one, before in ((own, few), (own.plain, drawn_at_start(own, few))):
        control = before.control._replace(
            length=interval.stop - interval.start, variance=before.control.variance * count / number,
            substeps=SUBSTEPS, stages=4, error=TIME_ERROR, trusted=1, pace=np.inf, steepness=np.inf,
        )  # fmt: skip
        before = before._replace(control=control, last_scale=_about(one, before)[1])
        after, info = particle_filter.step(one, k, before, values)
        loss = _loss(one, after) if np.isfinite(info.mean).all() else np.inf
        figures.append(loss * _work(one, k, (after, info), values))
    return figures[0] <= LATER * figures[1]


def _loss(prepared: Prepared, state: State) -> float:
    """Return the variances of the means of independent draws with the weights of the particles, in the mean of the states."""
    now = moments_of(prepared.system, state.particles, np.exp(state.log_weights))
    variance = np.maximum(np.diag(now.cov), 1e-300)
    return float((state.islands.spread(now.particles).independent / variance).mean())


def _work(prepared: Prepared, k: int, done: tuple[State, Info], values: Array) -> float:
    """Return the operations on a particle in an interval as long as k, after interval k and as it was observed."""
    motion, (state, info), about = prepared.motion, done, _about(prepared, done[0])
    events = state.window.events[state.window.length - 1]
    times = 1.0 + info.health["guided"] + OF_LEVEL * info.health["tempering_levels"]
    width, total = events.width // max(len(events.rows), 1), 0
    for turn in range(MEASURED):
        control = state.control._replace(trusted=0, interval=state.control.interval + turn)
        steps, _ = substeps(prepared, prepared.interval(k), values, state._replace(control=control), about)
        total += motion.operations(steps.scheme, width)
    return times * total / MEASURED


def _about(prepared: Prepared, state: State) -> tuple[Array, Array]:
    """Return the mean of the coordinates, and the deviations in which the error of the time step is measured."""
    spread = moments_of(prepared.system, state.particles, np.exp(state.log_weights))
    return spread.mean, state.control.narrow * np.maximum(prepared.system.scales(spread.cov), 1e-12)


def _given_away(prepared: Prepared, k: int, state: State) -> bool:
    """Return whether the path of the others in interval k would give the linear states away."""
    system, interval = prepared.system, prepared.interval(k)
    if not isinstance(system, ConditionalSystem) or system.information is None:
        return False
    u = np.zeros(0) if interval.inputs is None else np.array(interval.inputs.at(interval.start, prepared.model.input_hold))
    program = tuple(system.information.at(prepared.theta))
    point = np.ascontiguousarray((state.particles @ np.exp(state.log_weights))[:, None])
    rate = float(prepared.motion.values(program, point, interval.start, u)[0, 0])
    return not (interval.stop - interval.start) * rate <= GIVEN_AWAY


def drawn_at_start(prepared: Prepared, state: State) -> State:
    """Return the state before the first interval with draws of the linear states instead of their filters."""
    system, plain, window, n = prepared.system, prepared.plain, state.window, prepared.model.n
    assert isinstance(system, ConditionalSystem)
    if window.length or not len(window.first):  # a sample at the start, or a prior that is not Gaussian
        begun = particle_filter.begun_at(plain, drawn(prepared, state).particles)
        return begun._replace(log_weights=state.log_weights, control=state.control)
    count, cov = len(state.log_weights), np.zeros((n, n))
    cov[np.ix_(system.block.linear, system.block.linear)] = covariances(system.block, window.mean[n:, None])[0]
    return particle_filter.begun(plain, (window.mean[:n], root(window.root[:n] @ window.root[:n].T + cov)), count)


def drawn(prepared: Prepared, state: State) -> State:
    """Return a state whose particles have draws of the linear states; without the past."""
    system, n, count = prepared.system, prepared.model.n, len(state.log_weights)
    if not isinstance(system, ConditionalSystem) or len(state.particles) != system.n:
        return state
    noise = np.empty((len(system.block.linear), count))
    normals(prepared.key(state.control.interval, _DRAWS), 0, count, noise)
    P = covariances(system.block, state.particles[n:])
    values, vectors = np.linalg.eigh(P)
    particles = state.particles[:n].copy()
    particles[list(system.block.linear)] += np.einsum("pij,pj,jp->ip", vectors, np.sqrt(np.maximum(values, 0.0)), noise)
    reduced = particle_filter.reduced(state)
    known = {"shift": state.shift, "last_shift": state.last_shift[:n], "last_scale": state.last_scale[:n]}
    return reduced._replace(particles=particles, **known)


def density(prepared: Prepared, state: State) -> ParticleDensity | ConditionalParticleDensity:
    """Return the weighted particles, with the covariances that they carry."""
    system, model, weights = suited(prepared, state).system, prepared.model, np.exp(state.log_weights)
    weights, points = weights / weights.sum(), state.particles[: model.n].T
    periodic = tuple(name in model.periodic for name in model.state)
    if not isinstance(system, ConditionalSystem):
        return ParticleDensity(weights, points, model.state, periodic)
    covs = covariances(system.block, state.particles[model.n :])
    return ConditionalParticleDensity(weights, points, model.state, periodic, system.block.linear, covs)


def valid(prepared: Prepared, state: State) -> bool:
    """Return whether the arrays of a state fit together."""
    return len(state.particles) in (prepared.system.n, prepared.model.n) and valid_state(suited(prepared, state), state)


BACKWARD: Backward[Prepared, State, Any] = replace(PLAIN_BACKWARD, options={"split": False})
