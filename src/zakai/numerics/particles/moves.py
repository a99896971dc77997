"""Moves of the noise of particles over several intervals, and draws of it, by a Gaussian that approximates its posterior.

The noise p of a window has the law N(0, I) times the likelihood L(p) of what is observed in it.  A move is reversible in a
Gaussian N(m, U^-2), whose mean m may be an affine function of the state at the start of the window, and which differs from
N(0, I) in the few directions V (orthonormal) that the observations inform,

    U = I + V diag(s - 1) V',    w = U (p - m),   w* = rho w + sqrt(1 - rho^2) e,   e ~ N(0, I),    p* = m + U^-1 w*

and is accepted with the exact ratio, so that the Gaussian decides how well the moves mix, and never what they converge to.

References:
    Neal 1998, Regression and classification using Gaussian process priors (the move).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import types

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.formula_kernel import BLOCK
from zakai.numerics.particles.chunks import CHUNK
from zakai.numerics.particles.elementary import add_rows
from zakai.numerics.particles.even import EVEN, fill_even
from zakai.numerics.particles.formulas import F1, F2, PROGRAM, block_of, load_point, run_program
from zakai.numerics.particles.motion import EVENTS, MOTION, buffers_of, run_event
from zakai.numerics.particles.random import KEY, fill_row, uniform

Array = Any
# The law, and of each observation its time (I,), given numbers (I, L), and which terms count (I, terms).
_OBSERVED = types.Tuple((PROGRAM, F1, F2, F2))
# The mean (n,) and a root (n, d0) of the prior; without columns the window starts from states that do not move.
_PRIOR = types.Tuple((F1, F2))
# The mean (D,), its derivative by the start (D, n), the start to which that refers (n,), the rows of V' (r, D), and s (r,).
GAUSSIAN = types.Tuple((F1, F2, F1, F2, F1))
_FAR = 1e100  # a state that has left every bounded set
_ACCEPTANCE = np.uint64(1 << 60)  # counters from here on are those of acceptance
_WORST, _BEST = 0.2, 0.4  # acceptance below which steps become shorter, and above which they become longer
_LONGEST = 0.96  # of the share of the old noise


class WindowLaw(NamedTuple):
    """The law of the noise of a window: the formulas, its events, what is observed in it, and the prior of its first state."""

    motion: Any
    events: Any
    observed: Any
    prior: Any


class Paths(NamedTuple):
    """The particles that `sweep` moves: the states (n, N) at the start of the window and the noise (D, N), which is replaced.

    It writes the states (n, N) at the end, the logarithms (N,) of what has the power, and of each chunk the mean acceptance and
    the change (chunks, 2).
    """

    start: Array
    noise: Array
    out: Array
    total: Array
    moved: Array


class Advance(NamedTuple):
    """What `propagate` writes: noise (d, N), states (n, N) after an interval and at the observation, before it updates them.

    The latter may have no rows.  `gained` (N,) is the log-likelihood, -inf where a state has left every bounded set: it is the
    one at the start then.
    """

    noise: Array
    states: Array
    seen: Array
    gained: Array


class Workspace(NamedTuple):
    """The slots of the programs, and what an event overwrites."""

    blocks: Any
    buffers: Any


WINDOW_LAW = types.NamedTuple((MOTION, EVENTS, _OBSERVED, _PRIOR), WindowLaw)
ADVANCE = types.NamedTuple((F2, F2, F2, F1), Advance)
PATHS = types.NamedTuple((F2, F2, F2, F1, F2), Paths)


@helper
def _follow(
    window: Any, workspace: Any, start: Array, path: Array, x: Array, totals: Array, seen: Array, size: int
) -> None:
    """Write the states x (rows, size) at the end of a window and the log-likelihoods of what is observed in it.

    `totals` (2, size) receives these, and those without the last observation; `seen` (n, size) the states at that, before they
    are updated by it; it may have no rows.
    """
    motion, events, observed, prior = window
    blocks, buffers = workspace
    law, times, given, counted = observed
    mean, root = prior
    total, past = totals[0], totals[1]
    n, rows, places, d0 = start.shape[0], x.shape[0], events[1], root.shape[1]
    for d in range(n):
        for i in range(size):
            x[d, i] = start[d, i] if d0 == 0 else mean[d]
        for j in range(d0):
            for i in range(size):
                x[d, i] += root[d, j] * path[j, i]
    for d in range(n, rows):
        for i in range(size):
            x[d, i] = 0.0
    for i in range(size):
        total[i] = past[i] = 0.0
    own = path[d0:]
    for e in range(places.shape[0]):
        run_event(motion, events, e, blocks, x, own, buffers, size)
        k = places[e, 1]
        if k < 0:
            continue
        for d in range(seen.shape[0]):
            for i in range(size):
                seen[d, i] = x[d, i]
        if counted[k].sum() > 0.0:
            load_point(law, blocks[3], x, motion[2], times[k], given[k], size)
            run_program(law, blocks[3], size)
        for term in range(law[3].size):
            if counted[k, term] != 0.0:
                values = blocks[3][law[3][term]]
                for i in range(size):
                    total[i] += values[i]
        if k == times.size - 2:
            for i in range(size):
                past[i] = total[i] + (x[n, i] if rows > n else 0.0)
    for i in range(size):
        if rows > n:
            total[i] += x[n, i]
        if not total[i] < np.inf:  # NaN, too
            total[i] = -np.inf


@helper
def _workspace(window: Any) -> Any:
    motion = window.motion
    blocks = block_of(motion[0]), block_of(motion[1]), block_of(motion[4]), block_of(window.observed[0])
    return Workspace(blocks, buffers_of(motion, window.events))


@helper
def _mean(gaussian: Any, start: Array, out: Array, size: int) -> None:
    """Write the means (D, size) of the Gaussians for their starts (n, size)."""
    mean, gain, centre = gaussian[0], gaussian[1], gaussian[2]
    for r in range(mean.size):
        for i in range(size):
            out[r, i] = mean[r]
        for d in range(centre.size):
            factor = gain[r, d]
            if factor != 0.0:
                for i in range(size):
                    out[r, i] += factor * (start[d, i] - centre[d])


@helper
def _scale(gaussian: Any, inverse: bool, given: Array, along: Array, size: int) -> None:
    """Multiply columns (D, size) by U, or by its inverse; `along` (r, size) is overwritten."""
    V, factors = gaussian[3], gaussian[4]
    changes = np.empty(factors.size)
    for k in range(factors.size):
        factor = (1.0 / factors[k] if inverse else factors[k]) - 1.0
        for i in range(size):
            along[k, i] = 0.0
        add_rows(along[k], V[k], given, size)
        for i in range(size):
            along[k, i] *= factor
    for r in range(V.shape[1]):
        for k in range(factors.size):
            changes[k] = V[k, r]
        add_rows(given[r], changes, along, size)


@helper
def _norms(rows: Array, count: int, begin: float, out: Array, size: int) -> None:
    """Write a number less half of the sums of squares of the first rows."""
    for i in range(size):
        out[i] = begin
    for r in range(count):
        for i in range(size):
            out[i] -= 0.5 * rows[r, i] ** 2


@kernel(types.void(WINDOW_LAW, F2, F2, types.int64, types.int64, F2, F1))
def follow(window: Any, start: Array, path: Array, low: int, high: int, out: Array, total: Array) -> None:
    """Write the states (n, N) at the end of a window and the log-likelihoods (N,), for the noise (D, N) from given starts."""
    n, D = start.shape[0], path.shape[0]
    workspace = _workspace(window)
    x, totals = np.empty((window.motion[0][3].size, BLOCK)), np.empty((2, BLOCK))
    found = totals[0]
    own, begin = np.empty((D + 1, BLOCK)), np.empty((n, BLOCK))
    for first in range(low, high, BLOCK):
        size = min(BLOCK, high - first)
        for d in range(n):
            for i in range(size):
                begin[d, i] = start[d, first + i]
        for r in range(D):
            for i in range(size):
                own[r, i] = path[r, first + i]
        _follow(window, workspace, begin, own, x, totals, own[:0], size)
        for d in range(n):
            for i in range(size):
                out[d, first + i] = x[d, i]
        for i in range(size):
            total[first + i] = found[i]


@kernel(types.int64(WINDOW_LAW, EVEN, F2, types.int64, types.int64, ADVANCE))
def propagate(window: Any, even: Any, start: Array, low: int, high: int, after: Any) -> int:
    """Advance the particles (n, N) from `low` to `high` by an interval with noise that is drawn; return how many are lost."""
    noise, states, seen, gained = after
    n, D, lost = start.shape[0], noise.shape[0], 0
    workspace = _workspace(window)
    x, totals = np.empty((window.motion[0][3].size, BLOCK)), np.empty((2, BLOCK))
    found = totals[0]
    own, begin, at = np.empty((D + 1, BLOCK)), np.empty((n, BLOCK)), np.empty((seen.shape[0], BLOCK))
    for first in range(low, high, BLOCK):
        size = min(BLOCK, high - first)
        fill_even(even, first, size, own[:D])
        for d in range(n):
            for i in range(size):
                begin[d, i] = start[d, first + i]
        _follow(window, workspace, begin, own, x, totals, at, size)
        for r in range(D):
            for i in range(size):
                noise[r, first + i] = own[r, i]
        far = 0
        for d in range(n):
            for i in range(size):
                far += 0 if abs(x[d, i]) < _FAR else 1  # NaN, too
        for d in range(n):
            for i in range(size):
                states[d, first + i] = x[d, i]
        for d in range(seen.shape[0]):
            for i in range(size):
                seen[d, first + i] = at[d, i]
        for i in range(size):
            gained[first + i] = found[i]
        for i in range(size if far else 0):
            gone = False
            for d in range(n):
                gone |= not abs(x[d, i]) < _FAR
            if not gone:
                continue
            lost += 1
            gained[first + i] = -np.inf
            for d in range(n):
                states[d, first + i] = begin[d, i]
            for d in range(seen.shape[0]):
                seen[d, first + i] = begin[d, i]
    return lost


@kernel(types.void(GAUSSIAN, types.float64, EVEN, F2, types.int64, types.int64, F2, F1))
def draw(gaussian: Any, share: float, even: Any, start: Array, low: int, high: int, path: Array, ratio: Array) -> None:
    """Write noise (D, N) drawn from share N(0, I) + (1 - share) N(m, U^-2), and log N(0, I) less the log of that density."""
    n, D, along = start.shape[0], path.shape[0], np.empty((gaussian[4].size, BLOCK))
    w, p, m = np.empty((D, BLOCK)), np.empty((D, BLOCK)), np.empty((D, BLOCK))
    begin, qs, phis, plain = np.empty((n, BLOCK)), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK, np.bool_)
    log_det = 0.0
    for factor in gaussian[4]:
        log_det += math.log(factor)
    for first in range(low, high, BLOCK):
        size = min(BLOCK, high - first)
        fill_even(even, first, size, w)
        for d in range(n):
            for i in range(size):
                begin[d, i] = start[d, first + i]
        _mean(gaussian, begin, m, size)
        for i in range(size):
            plain[i] = uniform(even.key, _ACCEPTANCE + np.uint64(first + i)) < share
        for r in range(D):
            for i in range(size):
                p[r, i] = w[r, i]
        _scale(gaussian, True, p, along, size)
        for r in range(D):
            for i in range(size):
                p[r, i] = w[r, i] if plain[i] else p[r, i] + m[r, i]
                path[r, first + i] = p[r, i]
                m[r, i] = p[r, i] - m[r, i]
        _scale(gaussian, False, m, along, size)
        _norms(m, D, log_det, qs, size)
        _norms(p, D, 0.0, phis, size)
        for i in range(size):
            q, phi = qs[i], phis[i]
            top = max(q, phi)
            ratio[first + i] = phi - top - math.log((1.0 - share) * math.exp(q - top) + share * math.exp(phi - top))


@kernel(types.void(WINDOW_LAW, GAUSSIAN, F1, KEY, types.int64, types.int64, PATHS))
def sweep(window: Any, gaussian: Any, control: Array, key: Array, low: int, high: int, paths: Any) -> None:
    """Move the noise of the particles from `low` to `high`, in chunks, until their noise has changed enough.

    Args:
        window: the law of the noise.
        gaussian: the Gaussian in which moves are reversible.
        control: the power, the sum of acceptance (1 - rho^2) after which it is enough, the most sweeps, the first rho, the
            share of N(0, I) in q = share N(0, I) + (1 - share) Gaussian, and whether the power is that of the last observation
            alone; the target is q (N(0, I) L / q)^power, with share one N(0, I) L^power, times the other likelihoods.
        key: of the random numbers.
        low: the first particle, a multiple of `CHUNK`.
        high: the particle after the last one.
        paths: the particles.
    """
    start, path, out, total, moved = paths
    n, D = start.shape[0], path.shape[0]
    power, enough, most, part, alone = control[0], control[1], int(control[2]), control[4], control[5] > 0.0
    log_det = 0.0
    for factor in gaussian[4]:
        log_det += math.log(factor)
    workspace = _workspace(window)
    along = np.empty((gaussian[4].size, BLOCK))
    x, totals = np.empty((window.motion[0][3].size, BLOCK)), np.empty((2, BLOCK))
    found = totals[0]
    begin, new, fresh, m = np.empty((n, BLOCK)), np.empty((D + 1, BLOCK)), np.empty((D, BLOCK)), np.empty((D, BLOCK))
    w, target = np.empty((D, CHUNK)), np.empty(CHUNK)
    gs, phis, taken = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK, np.bool_)
    for chunk in range(low, high, CHUNK):
        end = min(chunk + CHUNK, high)
        rho, done, rates, count = control[3], 0.0, 0.0, 0
        for turn in range(-1, most):
            # The first turn only computes the targets of the noise as it is.
            accepted, s = 0, math.sqrt(1.0 - rho * rho)
            for first in range(chunk, end, BLOCK):
                size, at = min(BLOCK, end - first), first - chunk
                for d in range(n):
                    for i in range(size):
                        begin[d, i] = start[d, first + i]
                _mean(gaussian, begin, m, size)
                for r in range(D):
                    if turn < 0:
                        for i in range(size):
                            new[r, i] = path[r, first + i]
                            fresh[r, i] = new[r, i] - m[r, i]
                    else:
                        fill_row(key, turn * D + r, first, size, fresh[r])
                        for i in range(size):
                            fresh[r, i] = rho * w[r, at + i] + s * fresh[r, i]
                            new[r, i] = fresh[r, i]
                _scale(gaussian, turn >= 0, new if turn >= 0 else fresh, along, size)
                for r in range(D if turn >= 0 else 0):
                    for i in range(size):
                        new[r, i] += m[r, i]
                _follow(window, workspace, begin, new, x, totals, new[:0], size)
                _norms(fresh, D, log_det, gs, size)
                _norms(new, D, 0.0, phis, size)
                for i in range(size):
                    g, phi = gs[i], phis[i]
                    top = max(g, phi)
                    q = phi if part == 1.0 else top + math.log((1.0 - part) * math.exp(g - top) + part * math.exp(phi - top))
                    kept = totals[1, i] if alone else 0.0
                    found[i] = found[i] + phi - q - kept if kept > -np.inf else -np.inf
                    value = kept + power * found[i] + q - g
                    if not value < np.inf:
                        value = -np.inf
                    taken[i] = turn < 0
                    if turn >= 0:
                        u = uniform(key, _ACCEPTANCE + (np.uint64(turn) << np.uint64(32)) + np.uint64(first + i))
                        taken[i] = math.log(u) < value - target[at + i]
                        accepted += taken[i]
                    if taken[i]:
                        target[at + i] = value
                        total[first + i] = found[i]
                for r in range(D):
                    for i in range(size):
                        w[r, at + i] = fresh[r, i] if taken[i] else w[r, at + i]
                    for i in range(size):
                        path[r, first + i] = new[r, i] if taken[i] else path[r, first + i]
                for d in range(n):
                    for i in range(size):
                        out[d, first + i] = x[d, i] if taken[i] else out[d, first + i]
            if turn < 0:
                continue
            rate = accepted / (end - chunk)
            rates += rate
            count += 1
            done += rate * (1.0 - rho * rho)
            if rate < _WORST:
                rho = min(_LONGEST, rho + 0.2)
            elif rate > _BEST:
                rho = max(0.0, rho - 0.3)
            if done > enough:
                break
        moved[chunk // CHUNK, 0] = rates / max(count, 1)
        moved[chunk // CHUNK, 1] = done
