"""The noise of the last intervals drawn again, given an observation that the noise of one interval does not explain.

A particle with the noise p in the last intervals, from a state before them that is kept, gets new noise p* there and in the new
interval.  It has the weight

    N(p*; 0, I) L_k(p*) / q_k(p* | state)  q_(k-1)(p | state) / (N(p; 0, I) L_(k-1)(p))

L_(k-1) is the likelihood of what was observed in these intervals, L_k that with the new observation.  q_k and q_(k-1) are the
Gaussians of the linearised windows; any others would be as exact.  Of q_(k-1) no part may be wider than the law of p: a share of
plain noise, as in q_k, would be a mass that no particle shows.

References:
    Doucet, Briers and Senecal 2006, Efficient block sampling strategies for sequential Monte Carlo methods.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from zakai.methods.particles.events import Events
from zakai.methods.particles.programs import Array
from zakai.methods.particles.window import MOST, Target, Window, joined
from zakai.numerics.particles.even import Even
from zakai.numerics.particles.population import effective, normalised

# On Lorenz-96 with eight states, two of them unseen, and 2,000 particles the log-likelihood has the deviation 1.8 without blocks,
# and 0.45 with eight intervals.
LONGEST = 8
TRIED, FEW = 16, 128  # what is expensive is tried on one particle in so many, where these are as many at least
_KEEP = (1.0, 1.0, 0.0, 0.0, 0.0, 0.0)  # power, change, no sweeps, rho, share of plain noise: weights of the noise as it is


class Past(NamedTuple):
    """The last intervals: their events and observations, the states (n, N) before them, the noise (D, N) in them, and its law."""

    events: tuple[Events, ...]
    observed: tuple[Array, Array, Array]
    start: Array
    path: Array
    law: Target

    def whole(self, target: Target) -> Target:
        """Return the law of the noise in these intervals and in a new one."""
        now = target.times, target.given, target.counted
        times, given, counted = (np.concatenate(pair) for pair in zip(self.observed, now, strict=True))
        return replace(self.law, events=joined((*self.events, target.events)), times=times, given=given, counted=counted)


def past_of(window: Window, target: Target) -> Past | None:
    """Return the last intervals, at most `LONGEST` with up to `MOST` numbers, None where there are none."""
    count, width = 0, target.events.width
    while count < min(window.length, LONGEST) and width + len(window.noises[window.length - 1 - count]) <= MOST:
        count += 1
        width += len(window.noises[window.length - count])
    if count == 0:
        return None
    motion, rows = target.motion, slice(window.length - count, window.length)
    observed = window.times[rows], window.given[rows], window.counted[rows]
    _, start, path = window.last(motion, count)
    events = window.events[rows]
    return Past(events, observed, start, path, Target(motion, joined(events), *observed, None, start))


class Block(NamedTuple):
    """Noise that is drawn again in the last intervals and in the new one.

    So many `intervals` before the new one have new noise, `path` (D, N) is all of it, for the law `target`, `particles` (n, N)
    are the states after it, and `logs` (N,) the log weights, of which `earlier` (N,) is the part of the old noise; `path` was
    drawn from `gaussian`.
    """

    intervals: int
    target: Target
    gaussian: Any
    path: Array
    particles: Array
    logs: Array
    earlier: Array


def drawn_again(past: Past, logs: Array, target: Target, share: float, even: Even, least: float) -> Block | None:
    """Return particles whose noise in the last intervals is drawn again, None where that leaves too few of them.

    That is tried on one particle in `TRIED`.

    Args:
        past: the last intervals.
        logs: log weights of the particles (N,).
        target: the law of the noise of the new interval.
        share: of plain noise in q_k.
        even: what makes normal numbers.
        least: effective share of the particles.
    """
    weights, whole, start, path = np.exp(logs), past.whole(target), past.start, past.path
    begin = np.append(path @ weights, np.zeros(target.events.width))[:, None]
    before, after = past.law.gaussian(path, weights, wider=1.0), whole.gaussian(begin, weights)
    if before is None or after is None:
        return None

    def drawn(start: Array, path: Array, even: Even) -> tuple[Array, Array, Array, Array]:
        """Return new noise, the states after it, log weights, and their part of the old noise."""
        target = replace(whole, start=start)
        new, ratio = target.draw(after, share, even)
        particles, logs = target.follow(new)
        _, _, old, _, _ = replace(past.law, start=start).sweep(before, path, _KEEP, even.key)
        logs += ratio - old
        logs[~np.isfinite(particles).all(axis=0) | np.isnan(logs)] = -np.inf
        return new, particles, logs, -old

    if len(logs) >= TRIED * FEW and least > 0.0:
        few = slice(None, None, TRIED)
        own = even._replace(rank=np.ascontiguousarray(even.rank[few]), bounds=-(-even.bounds // TRIED))
        found = logs[few] + drawn(np.ascontiguousarray(start[:, few]), np.ascontiguousarray(path[:, few]), own)[2]
        if not effective(normalised(found)[0]) > least * len(found):
            return None
    return Block(len(past.events), whole, after, *drawn(start, path, even))


def with_block(window: Window, target: Target, count: int, path: Array) -> Window:
    """Return the past of the particles with other noise in its last intervals."""
    return window.last(target.motion, count)[0].with_noise(count, path)
