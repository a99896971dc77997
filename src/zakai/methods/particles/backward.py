"""Smoothing by backward simulation: draws of the state at the start of an interval, given draws at its end.

    P(x_k = x_i | x_(k+1), observations) ~ w_i p(x_(k+1) | x_i)

The transition from a particle is taken as the Gaussian of the motion that is linearised in its noise, with a small part of the
deviations of all particles added, so that coordinates without noise have a density too.

References:
    Godsill, Doucet and West 2004, Monte Carlo smoothing for nonlinear time series.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.densities import ParticleDensity
from zakai.methods._protocol import Backward, Info
from zakai.methods.particles.filter import moments
from zakai.methods.particles.interval import Scheme
from zakai.methods.particles.programs import Array
from zakai.methods.particles.state import Prepared, State
from zakai.numerics.particles.population import backward_draws, systematic
from zakai.numerics.particles.random import uniform_number

DRAWS = 1000  # that a message holds
CANDIDATES = 8000  # particles that a draw chooses from
ADDED = 0.02  # deviations of all particles that are added to those of a transition
_STEP = 1e-4
_USE = 100  # of random numbers, beside those of the filter
_SUBSTEPS = 2


class Message(NamedTuple):
    """Draws (n, M) of the state at a time given all observations; `last` says that it is the last time of the record."""

    draws: Array
    last: bool


def message(prepared: Prepared, state: State) -> Message:
    """Return draws from the filter's particles at the last time."""
    return Message(_chosen(prepared, state, DRAWS, 0)[0], True)


def _chosen(prepared: Prepared, state: State, count: int, more: int) -> tuple[Array, Array]:
    """Return states (n, count) drawn by systematic resampling, and their places."""
    places, weights = np.empty(count, np.int32), np.exp(state.log_weights)
    systematic(weights / weights.sum(), uniform_number(prepared.key(state.control.interval, _USE, more)), places)
    return np.ascontiguousarray(state.particles[:, places]), places


def before(prepared: Prepared, k: int, later: Array, values: Array, state: State, rng: np.random.Generator) -> Array:
    """Return draws (n, M) at the start of interval k given those at its end, `later` (n, M)."""
    motion, interval, angles = prepared.motion, prepared.interval(k), prepared.system.angles
    if interval.stop <= interval.start:
        return later
    count = min(CANDIDATES, len(state.log_weights))
    start, _ = _chosen(prepared, state, count, 1)
    weights = np.exp(state.log_weights)
    mean, apart, _ = moments(state.particles, weights, angles)
    scale = np.maximum(np.sqrt(apart**2 @ weights), 1e-12)
    events = motion.events(interval, Scheme(_SUBSTEPS, 4), values, mean, scale)
    n, D = len(start), events.width
    ends = np.empty((D + 1, n, count))
    gained = np.zeros(count)
    for j in range(D + 1):
        noise = np.zeros((D, count))
        if j:
            noise[j - 1] = _STEP
        end, own = motion.advanced(events, start, noise)
        ends[j] = end
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
    centre = np.where(np.isfinite(ends[0]), ends[0], 0.0)
    period = np.where(angles, 2 * np.pi, 0.0)
    backward_draws(np.ascontiguousarray(later), centre, whiten, logs, period, rng.random(later.shape[1]), places)
    return np.ascontiguousarray(start[:, places])


def step(prepared: Prepared, k: int, later: Message, values: Array, state: State) -> Message:
    """Return the draws at the start of interval k; `state` is the filtered one there."""
    rng = np.random.Generator(np.random.Philox(key=prepared.key(state.control.interval, _USE, 2)))
    return Message(before(prepared, k, later.draws, values, state, rng), False)


def smoothed(prepared: Prepared, state: State, later: Message) -> tuple[Message, Info]:
    """Return the draws, and their moments; at the last time those of the filter.

    The evidence of the backward pass is not known: it is NaN.
    """
    if later.last:
        weights = np.exp(state.log_weights)
        mean, _, cov = moments(state.particles, weights, prepared.system.angles)
    else:
        count = later.draws.shape[1]
        mean, _, cov = moments(later.draws, np.full(count, 1.0 / count), prepared.system.angles)
    return later, Info(np.nan, mean, cov, {"draws": float(later.draws.shape[1])})


def density(prepared: Prepared, state: State, later: Message) -> ParticleDensity:
    """Return the smoothed density, of equally weighted draws."""
    model, count = prepared.model, later.draws.shape[1]
    periodic = tuple(name in model.periodic for name in model.state)
    return ParticleDensity(np.full(count, 1.0 / count), later.draws.T, model.state, periodic)


def draw(
    prepared: Prepared, k: int, later: Array, values: Array, state: State, rng: np.random.Generator
) -> tuple[Array, float]:
    """Return draws (P, n) at the start of interval k given those at its end."""
    return before(prepared, k, np.ascontiguousarray(later.T), values, state, rng).T, 0.0


BACKWARD: Backward[Prepared, State, Any] = Backward(message, step, smoothed, density, draw=draw)
