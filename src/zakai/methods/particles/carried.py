"""Whether particles carry a Kalman filter, and what is asked of them where they do.

Where the others are moved by the linear states, their path says what these are.  With v = N(m, P) at the start the path of an
interval of length d has the information

    d tr(R^-1 A P A' R'^-1)

about v.  If that is large the path gives v away: drawing it is then as hard as drawing v, and moves of the past, which reach v in
one piece, leave a smaller error.

The equations of m and P are longer than those of v, and need more substeps where P changes fast.  So the first interval is
filtered in both ways, and the filters are left out where their error^2 x work exceeds that of draws by more than `LATER`: the
variances of the means are those after the interval, the work is counted in the next one, if it is as long.
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
from zakai.methods.particles.state import Prepared, State
from zakai.methods.particles.system import root
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
_DRAWS = 101  # use of random numbers, beside those of the filter and of smoothing


def suited(prepared: Prepared, state: State) -> Prepared:
    """Return what is prepared for particles such as those of a state."""
    return prepared if len(state.particles) == prepared.system.n else prepared.plain


def step(prepared: Prepared, k: int, state: State, values: Array) -> tuple[State, Info]:
    """Advance by interval k of the schedule, then use what is observed at its stop."""
    own, interval = suited(prepared, state), prepared.interval(k)
    if not own.system.linear or own.rule.split or state.control.length or interval.stop <= interval.start:
        return particle_filter.step(own, k, state, values)
    other = particle_filter.step(own.plain, k, drawn_at_start(own, state), values)
    if _given_away(own, k, state):
        return other
    found = particle_filter.step(own, k, state, values)
    both = ((own, found), (own.plain, other))
    errors, others = (_loss(state, *done) * _work(p, k, done, values) for p, done in both)
    return found if errors <= LATER * others else other


def _loss(before: State, after: State, info: Info) -> float:
    """Return the variance of the means that a step reports, times the number of particles, infinite where it has failed."""
    return after.control.losses - before.control.losses if np.isfinite(info.mean).all() else np.inf


def _work(prepared: Prepared, k: int, done: tuple[State, Info], values: Array) -> float:
    """Return the operations on a particle in an interval as long as k, after interval k and as it was observed."""
    system, motion, (state, info) = prepared.system, prepared.motion, done
    spread, control = moments_of(system, state.particles, np.exp(state.log_weights)), state.control
    about = spread.mean, control.narrow * np.maximum(system.scales(spread.cov), 1e-12)
    state = state._replace(control=control._replace(trusted=0))
    steps, _ = particle_filter.substeps(prepared, prepared.interval(k), values, state, about)
    events = state.window.events[state.window.length - 1]
    times = 1.0 + info.health["guided"] + OF_LEVEL * info.health["tempering_levels"]
    return times * motion.operations(steps.scheme, events.width // max(len(events.rows), 1))


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
