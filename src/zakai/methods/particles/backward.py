"""Smoothing by backward simulation: draws of the state at the start of an interval, given draws at its end.

A draw is a particle of the filter with its past: the state x_j at the start of the interval, and the states after the first noise
of the interval, b_j, and later.  Given these the state at the start is that of particle i with the probability

    N(b_j; a_i, R R') exp(gained_i),     a_i the state of particle i before that noise, R the root of its covariance

beside its own.  Equally weighted particles are drawn first.  This is the transition of the filter itself, and needs no density of
the whole interval.  Where the noise is small against the distances of particles a draw keeps its own past, which the filter has
moved; where R has not the rank of the state, or depends on it, it always does.  At the last time the noise of the whole window is
moved once more.  A draw whose window has ended joins the particle from which the linearised transition leads nearest to it.

References:
    Godsill, Doucet and West 2004, Monte Carlo smoothing for nonlinear time series.
    Dau and Chopin 2023, On backward smoothing algorithms (the own past beside all particles).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.densities import ParticleDensity
from zakai.methods._protocol import Backward, Info
from zakai.methods.particles.descent import Descent, Piece, families
from zakai.methods.particles.events import Events
from zakai.methods.particles.filter import MOVE_CONTROL
from zakai.methods.particles.interval import Scheme
from zakai.methods.particles.moments import moments
from zakai.methods.particles.programs import Array
from zakai.methods.particles.state import Prepared, State
from zakai.numerics.particles.motion import ADDITIVE
from zakai.numerics.particles.population import Candidates, backward_draws, systematic
from zakai.numerics.particles.random import uniform_number

DRAWS = 1000  # that a message holds
CANDIDATES = 4000  # particles that a draw chooses from
ADDED = 0.02  # deviations of all particles that are added to those of the transition to a draw without a past
MOVES = 3  # of the noise of the last window, each until it has changed
_STEP = 1e-4
_USE = 100  # of random numbers, beside those of the filter
_SUBSTEPS = 2


class Message(NamedTuple):
    """Draws (n, M) of the state at a time given all observations, and their past.

    `joined` is the share of draws without a past in the interval after it, `last` says that it is the last time of the record,
    and `seed` distinguishes sets of draws.
    """

    draws: Array
    past: Descent
    joined: float
    last: bool
    seed: int


def message(prepared: Prepared, state: State) -> Message:
    """Return draws from the filter's particles at the last time."""
    return begin(prepared, state, DRAWS, 0)


def begin(prepared: Prepared, state: State, count: int, seed: int) -> Message:
    """Return so many draws from the filter's particles at the last time, whose past has been moved."""
    interval, window, motion = state.control.interval, state.window, prepared.motion
    draws, places = _chosen(prepared, state, count, (0, seed))
    labels = families(state.islands, places, interval)
    if window.length:
        window, places = window.part(motion, _last(window.ancestors[window.length - 1], places), window.length), np.arange(count)
        for turn in range(MOVES if window.width else 0):
            path, start = window.path()
            target = window.target(motion, start)
            gaussian = target.gaussian(path, None)
            if gaussian is None:
                break
            path, draws, *_ = target.sweep(gaussian, path, MOVE_CONTROL, prepared.key(interval, _USE, 2 + turn + 16 * seed))
            window = window.moved(path, start, draws)
    return Message(draws, Descent.begin(interval, window, places, labels), 0.0, True, seed)


def _last(ancestors: Array, places: Array) -> Array:
    return ancestors[places] if len(ancestors) else places


def _chosen(prepared: Prepared, state: State, count: int, use: tuple[int, int]) -> tuple[Array, Array]:
    """Return states (n, count) drawn by systematic resampling, and their places."""
    places, weights = np.empty(count, np.int32), np.exp(state.log_weights)
    key = prepared.key(state.control.interval, _USE, use[0] + 16 * use[1])
    systematic(weights / weights.sum(), uniform_number(key), places)
    return np.ascontiguousarray(state.particles[:, places]), places


def step(prepared: Prepared, k: int, later: Message, values: Array, state: State) -> Message:
    """Return the draws at the start of interval k; `state` is the filtered one there."""
    interval, count = state.control.interval, later.draws.shape[1]
    rng = np.random.Generator(np.random.Philox(key=prepared.key(interval, _USE, 1 + 16 * later.seed)))
    past, piece = later.past.piece(interval, prepared.motion)
    known = past.root >= 0
    places = np.full(count, -1, np.int32)
    draws = np.full_like(later.draws, np.nan)
    if piece is not None:
        draws[:, known] = piece.start[:, known]
        found = _exchanged(prepared, piece, state, rng)
        if found is not None:
            places[known] = found[known]
    if not known.all():
        places[~known] = _joined(prepared, k, np.ascontiguousarray(later.draws[:, ~known]), values, state, rng)
    fresh = places >= 0
    draws[:, fresh] = state.particles[:, places[fresh]]
    chosen = np.where(fresh, places, 0)
    other = Descent.begin(interval, state.window, chosen, families(state.islands, chosen, interval))
    return Message(draws, past.joined_by(fresh, other), float(np.mean(~known)), False, later.seed)


def _exchanged(prepared: Prepared, piece: Piece, state: State, rng: np.random.Generator) -> Array | None:
    """Return for each draw the particle (M,) from which its path goes on, -1 for its own; None where all keep theirs."""
    motion, system, events = prepared.motion, prepared.system, piece.events
    kicks = np.flatnonzero(events.places[:, 0] >= 0)
    if system.kind != ADDITIVE or not len(kicks):
        return None
    first = int(kicks[0])
    width = int(events.rows[events.places[first, 0], 1])
    R = events.roots[events.places[first, 0]][:, :width]
    if np.linalg.matrix_rank(R / np.maximum(np.linalg.norm(R, axis=1, keepdims=True), 1e-300)) < system.n:
        return None
    ahead = _until(events, first)
    count = min(CANDIDATES, len(state.log_weights))
    particles, chosen = _chosen(prepared, state, count, (14, 0))
    centres, gained = motion.advanced(ahead, particles, np.zeros((0, count)))
    start = np.ascontiguousarray(piece.start)
    own, own_gained = motion.advanced(ahead, start, np.zeros((0, start.shape[1])))
    later = own + R @ piece.noise[:width]
    logs = np.where(np.isfinite(centres).all(axis=0) & np.isfinite(gained), gained, -np.inf)
    mine = own_gained - 0.5 * np.sum(piece.noise[:width] ** 2, axis=0)
    whiten = np.linalg.inv(np.linalg.cholesky(R @ R.T))
    period = np.where(system.angles, 2 * np.pi, 0.0)
    centres = np.where(np.isfinite(centres), centres, 0.0)
    places = np.empty(start.shape[1], np.int32)
    backward_draws(later, Candidates(centres, whiten[None], logs, mine, period), rng.random(len(places)), places)
    return np.where(places >= 0, chosen[np.maximum(places, 0)], -1)


def _until(events: Events, first: int) -> Events:
    """Return the events until a kick, without it."""
    places = events.places[: first + 1].copy()
    places[:, :2] = -1
    rows = np.zeros((0, 3), np.int64)
    part = slice(first + 1)
    return Events(events.times[part], places, events.given[part], events.roots[:0], rows, events.spreads[part])


def _joined(
    prepared: Prepared, k: int, later: Array, values: Array, state: State, rng: np.random.Generator
) -> Array:
    """Return for each state (n, M) at the end of interval k a particle by the linearised transition from it."""
    motion, interval, angles = prepared.motion, prepared.interval(k), prepared.system.angles
    count = min(CANDIDATES, len(state.log_weights))
    start, chosen = _chosen(prepared, state, count, (15, 0))
    weights = np.exp(state.log_weights)
    mean, apart, _ = moments(state.particles, weights, angles)
    scale = np.maximum(np.sqrt(apart**2 @ weights), 1e-12)
    events = motion.events(interval, Scheme(_SUBSTEPS, 4), values, mean, scale)
    n, D = len(start), events.width
    ends, gained = np.empty((D + 1, n, count)), np.zeros(count)
    for j in range(D + 1):
        noise = np.zeros((D, count))
        if j:
            noise[j - 1] = _STEP
        ends[j], own = motion.advanced(events, start, noise)
        gained = own if j == 0 else gained
    M = (ends[1:] - ends[0]) / _STEP
    covs = np.einsum("jip,jkp->pik", M, M)
    covs += np.diag((ADDED * scale) ** 2)
    usable = np.isfinite(covs).all(axis=(1, 2)) & np.isfinite(ends[0]).all(axis=0)
    covs[~usable] = np.eye(n)
    factors = np.linalg.cholesky(covs)
    whiten = np.ascontiguousarray(np.linalg.inv(factors))
    logs = gained - np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)
    logs[~usable | ~np.isfinite(logs)] = -np.inf
    places = np.empty(later.shape[1], np.int32)
    centres = np.where(np.isfinite(ends[0]), ends[0], 0.0)
    nothing = np.full(len(places), -np.inf)
    period = np.where(angles, 2 * np.pi, 0.0)
    backward_draws(later, Candidates(centres, whiten, logs, nothing, period), rng.random(len(places)), places)
    return np.asarray(chosen[np.maximum(places, 0)])


def smoothed(prepared: Prepared, state: State, later: Message) -> tuple[Message, Info]:
    """Return the draws, and their moments; at the last time those of the filter.

    The evidence of the backward pass is not known: it is NaN.
    """
    weights, draws = np.exp(state.log_weights), later.draws
    if later.last:
        mean, _, cov = moments(state.particles, weights, prepared.system.angles)
    else:
        mean, _, cov = moments(draws, np.full(draws.shape[1], 1.0 / draws.shape[1]), prepared.system.angles)
    _, deviations, _ = moments(draws, np.full(draws.shape[1], 1.0 / draws.shape[1]), prepared.system.angles)
    errors = np.sqrt(later.past.variances(deviations) + state.shift**2)
    spread = np.sqrt(np.diag(cov))
    worst = float((errors / np.where(spread > 0, spread, np.inf)).max())
    health = {"draws": float(draws.shape[1]), "joined": later.joined, "monte_carlo_error": worst}
    return later, Info(np.nan, mean, cov, health, errors, np.nan)


def density(prepared: Prepared, state: State, later: Message) -> ParticleDensity:
    """Return the smoothed density, of equally weighted draws."""
    model, count = prepared.model, later.draws.shape[1]
    periodic = tuple(name in model.periodic for name in model.state)
    return ParticleDensity(np.full(count, 1.0 / count), later.draws.T, model.state, periodic)


BACKWARD: Backward[Prepared, State, Any] = Backward(message, step, smoothed, density, paths=begin)
