"""What carries particles through an interval and its observation.

A step whose plain weights leave few particles draws the noise again from the Gaussian posterior of the linearised interval, then
of the last intervals, and where that fails too, carries particles to the posterior by powers of their weights with moves between
them: of the noise of the interval, or of the last intervals where the observation says nothing of it.

References:
    Del Moral, Doucet and Jasra 2006, Sequential Monte Carlo samplers (powers of the likelihood).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from zakai.methods.particles.block import Block, drawn_again, past_of, with_block
from zakai.methods.particles.events import Events, Observed
from zakai.methods.particles.moments import moments_of
from zakai.methods.particles.programs import Array
from zakai.methods.particles.state import GUIDE, LEVELS, MOST_LEVELS, NOISE, RESAMPLING, Cloud, Prepared
from zakai.methods.particles.window import Target, taken
from zakai.numerics.particles.even import Even
from zakai.numerics.particles.population import effective, next_power, normalised

GUIDE_BELOW = 0.3  # effective share below which the noise of an interval, then of the last ones, is drawn again
# Least ratio of the effective sizes after and before that, and in how many intervals it rests at most where it is in vain, twice
# as many each time.
BLOCK_GAIN, MOST_RESTS = 1.5, 16
TEMPER_BELOW, TEMPER_FLOOR = 0.1, 400  # effective share and number below which powers of the likelihood are taken
HOPELESS = 0.01  # effective share below which that is done even where the observation says nothing of the last noise
GUIDE_SHARE, FIRST_SHARE = 0.1, 0.2  # of plain noise in draws from the linearised posterior, of an interval and of the prior
FIRST_WIDER, FIRST_ROUNDS = 1.5, 6
INFORMED = 0.25  # log det of the linearised posterior of the noise, below which the observation says nothing about the noise


class Advanced(NamedTuple):
    """Particles after an interval, with what was needed.

    `weights` (N,) are those of the particles, `gained` is the increment of the log-likelihood, `noise` (D, N) that of the
    interval, `predicted` (n',) the spread of the coordinates before the weights of the observation act, `deviations` (n,)
    those of the states before it, `acceptance` that of moves between powers of the likelihood; the next one is the share of
    the particles that left every bounded set, `unseen` says that few particles are left by an observation that says nothing of
    the noise, and `block` is 1 where the noise of the last intervals was drawn again, -1 where that was tried in vain.
    """

    cloud: Cloud
    weights: Array
    gained: float
    noise: Array
    predicted: Array
    deviations: Array
    levels: int = 0
    guided: bool = False
    acceptance: float = np.nan
    lost: float = 0.0
    unseen: bool = False
    block: int = 0


class Drawn(NamedTuple):
    """A draw of noise, and the particles after it.

    `path` (D, N) is the noise of an interval, with that of the prior where that is moved, or of so many `intervals` before it;
    `logs` (N,) are the log weights, of which `earlier` (N,) does not depend on it, `target` its law, and `gaussian` that of which
    it is drawn, none for plain noise.
    """

    after: Advanced
    target: Target
    path: Array
    logs: Array
    gaussian: Any
    intervals: int = 0
    earlier: Array | float = 0.0


def advanced(
    prepared: Prepared, cloud: Cloud, given: tuple[Events, Observed], number: int, rank: Array, resting: bool
) -> Advanced:
    """Return the particles, with these numbers (N,) within their islands, after the events of an interval and its observation.

    `resting`: the noise of the last intervals is drawn again only where very few particles are left.
    """
    events, observed = given
    system, count = prepared.system, len(cloud.logs)
    single = (np.array([observed.time]), observed.given[None], observed.counted[None])
    target = Target(prepared.motion, events, *single, None, cloud.particles)
    even = cloud.islands.even(prepared.key(number, NOISE), rank)
    (noise, particles, seen, logs), lost = target.propagate(even, system.update is not None)
    weights = np.exp(cloud.logs)
    moved = moments_of(system, particles, weights)
    before = moments_of(system, seen, weights) if len(seen) else moved
    spreads = moved.spread, before.deviations
    if system.sampled and not observed.counted.any() and not lost:
        return Advanced(cloud._replace(particles=particles), weights, 0.0, noise, *spreads)
    total = cloud.logs + logs
    weights, top = normalised(total)
    after = cloud._replace(particles=particles, logs=total - top)
    plain = Advanced(after, weights, top, noise, *spreads, lost=lost / count)
    if effective(weights) >= GUIDE_BELOW * count and np.isfinite(top):
        return plain
    moving = cloud.window.length == 0 and len(cloud.window.first) > 0
    target = replace(target, prior=(cloud.window.mean, cloud.window.root) if moving else None)
    first = np.concatenate([cloud.window.first, noise]) if moving else noise
    gaussian = _linearised(target, cloud, plain)
    # Of noise of which the observation says nothing no draw is of use, and where enough particles are left, moves of the past are
    # better than draws of it (predator and prey: errors of 0.05 and 0.09).
    if gaussian is not None and not moving and not np.isinf(top) and _uninformed(gaussian, 1.0):
        gaussian, plain = None, plain._replace(unseen=True)
    even = cloud.islands.even(prepared.key(number, GUIDE), rank)
    best = (gaussian and _guided(target, cloud, plain, gaussian, even)) or Drawn(plain, target, first, logs, None)
    size = effective(best.after.weights) if np.isfinite(best.after.gained) else 0.0
    hopeless = plain.unseen and size < HOPELESS * count
    below = HOPELESS if plain.unseen else TEMPER_BELOW if resting else GUIDE_BELOW
    if size < below * count and not moving:
        least, past = max(BLOCK_GAIN * size / count, TEMPER_BELOW), past_of(cloud.window, target)
        block = past and drawn_again(past, cloud.logs, target, GUIDE_SHARE, even, 0.0 if hopeless else least)
        drawn = block and _in_block(cloud, plain, block)
        if drawn and effective(drawn.after.weights) > least * count:
            return drawn.after
        if hopeless and past:  # powers of the weights move the past, from where they leave more particles
            plainly = Drawn(plain, past.whole(target), np.concatenate([past.path, noise]), logs, None, len(past.events))
            best = drawn if drawn and effective(drawn.after.weights) > size else plainly
        best = best._replace(after=best.after._replace(block=-1))
    few = HOPELESS * count if plain.unseen else min(TEMPER_BELOW * count, TEMPER_FLOOR)
    if size >= few or not np.isfinite(best.logs).any() or plain.unseen and not best.intervals:
        return best.after
    return _tempered(prepared, cloud, best, number)


def _linearised(target: Target, cloud: Cloud, plain: Advanced) -> Any:
    """Return the linearised posterior of the noise, None where there is none."""
    moving = target.prior is not None
    begin = np.zeros(((len(cloud.window.first) if moving else 0) + len(plain.noise), 1))
    wider, rounds = (FIRST_WIDER, FIRST_ROUNDS) if moving else (1.0, 2)
    return target.gaussian(begin, np.exp(cloud.logs), rounds=rounds, wider=wider) if len(begin) else None


def _uninformed(gaussian: Any, wider: float) -> bool:
    return bool(np.log(gaussian[4] * np.sqrt(wider)).sum() < INFORMED)


def _guided(target: Target, cloud: Cloud, plain: Advanced, gaussian: Any, even: Even) -> Drawn | None:
    """Return the particles whose noise is drawn from the linearised posterior, None where that is no better."""
    moving = target.prior is not None
    d0 = len(cloud.window.first) if moving else 0
    if _uninformed(gaussian, FIRST_WIDER if moving else 1.0):
        return None
    share = FIRST_SHARE if moving else GUIDE_SHARE
    path, ratio = target.draw(gaussian, share, even)
    particles, logs = target.follow(path)
    logs = logs + ratio
    lost = ~np.isfinite(particles).all(axis=0)
    particles[:, lost] = plain.cloud.particles[:, lost]
    logs[lost | np.isnan(logs)] = -np.inf
    found, top = normalised(cloud.logs + logs)
    if not np.isfinite(top) or np.isfinite(plain.gained) and effective(found) <= effective(plain.weights):
        return None
    window = cloud.window._replace(first=np.ascontiguousarray(path[:d0])) if moving else cloud.window
    after = cloud._replace(particles=particles, logs=cloud.logs + logs - top, window=window)
    done = plain._replace(cloud=after, weights=found, gained=top, noise=np.ascontiguousarray(path[d0:]), guided=True)
    return Drawn(done, target, path, logs, gaussian)


def _in_block(cloud: Cloud, plain: Advanced, block: Block) -> Drawn | None:
    """Return the particles whose noise in the last intervals is drawn again, None where none of them has a weight."""
    weights, gained = normalised(cloud.logs + block.logs)
    if not np.isfinite(gained):
        return None
    window = with_block(cloud.window, block.target, block.intervals, block.path)
    particles = np.where(np.isfinite(block.logs), block.particles, plain.cloud.particles)
    after = cloud._replace(particles=particles, logs=cloud.logs + block.logs - gained, window=window)
    noise = np.ascontiguousarray(block.path[-len(plain.noise) :])
    done = plain._replace(cloud=after, weights=weights, gained=gained, noise=noise, guided=True, unseen=False, block=1)
    return Drawn(done, block.target, block.path, block.logs, block.gaussian, block.intervals, block.earlier)


def _tempered(prepared: Prepared, cloud: Cloud, drawn: Drawn, number: int) -> Advanced:
    """Return particles carried from what they were drawn from to the posterior, by powers of their weights with moves between."""
    target, fixed, earlier = drawn.target, drawn.gaussian, np.broadcast_to(drawn.earlier, drawn.logs.shape)
    count, moving, after = len(cloud.logs), target.prior is not None, drawn.after
    path, logs, particles = drawn.path, drawn.logs, after.cloud.particles
    gained, low, levels, rates = 0.0, 0.0, 0, list[float]()
    share = 1.0 if fixed is None else FIRST_SHARE if moving else GUIDE_SHARE
    control = (2.0, 20.0) if moving else (1.5, 12.0)
    while low < 1.0 and levels < MOST_LEVELS:
        high = next_power(cloud.logs, logs, 0.5 * count, low)
        weights, top = normalised(cloud.logs + (high - low) * np.maximum(logs, -1e300))
        gained, levels, low = gained + top, levels + 1, high
        cloud, ancestors = cloud.resampled(weights, count, prepared.key(number, RESAMPLING, levels))
        path, earlier = taken(path, ancestors), earlier[ancestors]
        target = replace(target, start=taken(target.start, ancestors))
        gaussian = target.gaussian(path, None, power=high) if fixed is None else fixed
        if gaussian is None:
            n, D = target.start.shape[0], len(path)
            gaussian = (np.zeros(D), np.zeros((D, n)), np.zeros(n), np.zeros((0, D)), np.zeros(0))
        own = prepared.key(number, LEVELS, levels)
        path, particles, logs, rate, _ = target.sweep(gaussian, path, (high, *control, 0.4, share, float(fixed is None)), own)
        logs = logs + earlier
        rates.append(rate)
    window = cloud.window
    if moving:
        window = window._replace(first=np.ascontiguousarray(path[: len(window.first)]))
    elif drawn.intervals:
        window = with_block(window, target, drawn.intervals, path)
    noise = np.ascontiguousarray(path[-len(after.noise) :])
    spreads, weights = (after.predicted, after.deviations), np.exp(cloud.logs)
    cloud, guided = cloud._replace(particles=particles, window=window), fixed is not None
    done = Advanced(cloud, weights, gained, noise, *spreads, levels, guided, float(np.mean(rates)), after.lost)
    return done._replace(block=after.block)
