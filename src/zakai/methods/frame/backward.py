"""Smoothing by draws: the state at the start of an interval given that at its end, back through the motion of the filter.

    x_K ~ p(x_K | all observations),      x_k ~ p(x_k | x_(k+1), observations until k + 1),      k = K - 1, ..., 0

The ratio of two trains, which a message needs, is not resolved in their tails.  A draw needs none: the filter's density before
the noise, times a Gaussian, is a train.

Draws are independent.  Means have less chance than draws: with the means c_j = E[x_-j | x_j] before a move, of draws x_j after
it, and the matrix J of their regression on x_j,

    E x_- = avg c + J (E x - avg x),      Cov x_- = Cov (c - J x) + avg (x_-  - c)(x_- - c)' + J Cov x J',

where E x and Cov x are known at the last time.  Where c is linear in x, the means have no random error; else it is that of the
residuals c_j - J x_j, which each draw carries back.  With angles the moments are those of the draws.

References:
    Godsill, Doucet and West 2004, Monte Carlo smoothing for nonlinear time series.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from zakai.densities import Density, ParticleDensity
from zakai.densities._values import wrap
from zakai.methods._protocol import Backward, Info
from zakai.methods.frame.chain import Chain
from zakai.methods.frame.filter import GAIN, WITHIN, builder_of, direction_of, error_of, predicted
from zakai.methods.frame.filter import density as filtered_density
from zakai.methods.frame.moves import Led
from zakai.methods.frame.state import Prepared, State
from zakai.methods.frame.unresolved import Unresolved
from zakai.methods.particles.programs import Array
from zakai.numerics.particles.random import key_of
from zakai.numerics.trains.conditional import drawn_before

DRAWS = 1000  # that a message holds


class Moments(NamedTuple):
    """The mean (n,), the covariance (n, n), and what each draw adds to the error of the mean, times their number (n, M)."""

    mean: Array
    cov: Array
    residual: Array

    def before(self, x: Array, led: Led) -> Moments:
        """Return the moments before a move, of draws x (n, M) after it."""
        mean, c = x.mean(axis=1), led.means.mean(axis=1)
        apart, moved = x - mean[:, None], led.means - c[:, None]
        scale = np.maximum(apart.std(axis=1), 1e-300)[:, None]
        J = np.linalg.lstsq((apart / scale).T, moved.T, rcond=1e-10)[0].T / scale.T
        rest, own, count = moved - J @ apart, led.draws - led.means, x.shape[1]
        cov = (rest @ rest.T + own @ own.T) / count + J @ self.cov @ J.T
        return Moments(c + J @ (self.mean - mean), cov, rest + J @ self.residual)


class Message(NamedTuple):
    """Draws (n, M) of the state at a time given all observations, and their moments, None with angles.

    `error` is the estimated error of the mean without chance, in standard deviations, `unknown` the share of draws to which the
    filter's density did not lead in the interval after it, `last` whether this is the last time of the record, and `seed`
    distinguishes sets of draws.
    """

    draws: Array
    moments: Moments | None
    error: float
    unknown: float
    last: bool
    seed: int


def message(prepared: Prepared, state: State) -> Message:
    """Return draws of the filter's density at the last time."""
    return begin(prepared, state, DRAWS, 0)


def begin(prepared: Prepared, state: State, count: int, seed: int) -> Message:
    """Return so many draws of the filter's density at the last time."""
    u, n = prepared.train(state), prepared.model.n
    rng, nothing = _generator(state.control.interval, seed), np.zeros((n, count))
    found = drawn_before(u, np.full(n, np.inf), nothing, rng.random((2 * n, count)))
    draws = np.where(found.exists, u.grid.x_of(found.z), np.nan)
    moments = None if prepared.system.base.angles.any() else Moments(*u.moments(), np.zeros((n, count)))
    return Message(_wrapped(prepared, draws), moments, error_of(prepared, state), 0.0, True, seed)


def _generator(interval: int, seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.Philox(key=key_of(seed, interval)))


def _wrapped(prepared: Prepared, x: Array) -> Array:
    return np.where(prepared.system.base.angles[:, None], wrap(x), x)


def step(prepared: Prepared, k: int, later: Message, values: Array, state: State) -> Message:
    """Return the draws at the start of interval k; `state` is the filtered one there."""
    control = state.control
    if not np.isfinite(later.draws).all():  # the density was lost
        return later._replace(last=False, unknown=0.0)
    chain = Chain(prepared, prepared.interval(k), values, builder_of(prepared, state))
    rng, x, moments, unknown = _generator(control.interval, later.seed), later.draws, later.moments, 0.0
    try:
        law = prepared.motion.likelihood(chain.interval, values)
        prediction, _, _, in_time, _ = predicted(chain, state, law)
    except (Unresolved, np.linalg.LinAlgError):
        return later._replace(draws=np.full_like(x, np.nan), moments=None, error=math.nan, unknown=0.0, last=False)
    for move in reversed(chain.moves):
        led = move.before(x, rng)
        if moments is not None and np.isfinite(led.draws).all():
            moments = moments.before(x, led)
        else:
            moments = None
        x, unknown = led.draws, max(unknown, led.unknown)
    off_grid = sum(report.off_grid for report in chain.builder.reports)
    # The draws go by the finer substeps alone, which have GAIN / 3 times the error of what is extrapolated.
    made = 0.5 * (off_grid + prediction.defect + GAIN / 3.0 * in_time)
    return Message(_wrapped(prepared, x), moments, max(error_of(prepared, state), later.error, made), unknown, False, later.seed)


def smoothed(prepared: Prepared, state: State, later: Message) -> tuple[Message, Info]:
    """Return the draws and their moments; at the last time those of the filter, without chance.

    The evidence of the backward pass is not known: it is NaN.
    """
    draws, angles = later.draws, prepared.system.base.angles
    n, count = draws.shape
    if later.last:
        u = prepared.train(state)
        mean, cov = u.moments(direction_of(prepared, u))
        errors = np.zeros(n)
    elif later.moments is not None:
        mean, cov, residual = later.moments
        errors = np.sqrt((residual**2).sum(axis=1)) / count
    else:
        centre = np.where(angles, np.angle(np.exp(1j * draws).mean(axis=1)), draws.mean(axis=1))
        apart = draws - centre[:, None]
        apart[angles] = wrap(apart[angles])
        mean, cov = centre, apart @ apart.T / count
        errors = np.sqrt(np.diag(cov) / count)
    health = {
        "error_estimate": later.error,
        "tolerance_ratio": later.error / (WITHIN * prepared.tolerance),
        "draws": float(count),
        "unknown_draws": later.unknown,
    }
    return later, Info(np.nan, mean, cov, health, errors, np.nan)


def density(prepared: Prepared, state: State, later: Message) -> Density:
    """Return the smoothed density: of equally weighted draws, which are moved so that they have the moments that are reported."""
    if later.last:
        return filtered_density(prepared, state)
    model, draws, count = prepared.model, later.draws, later.draws.shape[1]
    if later.moments is not None:
        mean = draws.mean(axis=1)[:, None]
        apart = draws - mean
        try:
            wanted, own = np.linalg.cholesky(later.moments.cov), np.linalg.cholesky(apart @ apart.T / count)
            draws = later.moments.mean[:, None] + wanted @ np.linalg.solve(own, apart)
        except np.linalg.LinAlgError:  # a state without variance
            draws = draws + later.moments.mean[:, None] - mean
    periodic = tuple(name in model.periodic for name in model.state)
    return ParticleDensity(np.full(count, 1.0 / count), draws.T, model.state, periodic)


BACKWARD: Backward[Prepared, State, Any] = Backward(message, step, smoothed, density, paths=begin)
