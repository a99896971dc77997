"""The motion of particles over an interval as a function of standard normal noise.

    x <- flow of the drift from t_e to t_(e+1);   x <- x + R w,   w ~ N(0, I)

An interval is a list of events: a Runge-Kutta step of order two or four, and a kick of noise after some of them.  The linear
part of the drift is integrated exactly where it is stiff (`exponential.py`).  Where the noise
depends on the state a kick is the flow of the fields g_j(x) sqrt(d) w_j over unit time, together where the fields commute, else
one after the other in an order that a further normal number decides.  With half of a substep's flow before and half after its
kick the law is that of the equation to second order in the substep.  The drift's outputs after the first n are integrated along
the way.  An observation may change the state: of particles that carry a Kalman filter, its mean and its covariance.

References:
    Ninomiya and Victoir 2008, Weak approximation of stochastic differential equations.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import types

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.formula_kernel import BLOCK
from zakai.numerics.particles.elementary import add_rows
from zakai.numerics.particles.exponential import (
    FIRST,
    HALF,
    HALFWAY,
    LAST,
    MIDDLE,
    MINUS_L,
    WEIGHTS,
    WHOLE,
    distinct_weights,
    write_weights,
)
from zakai.numerics.particles.formulas import BOX, F1, F2, F3, I2, PROGRAM, block_of, load_point, mirrored, run_program

Array = Any
ADDITIVE, COMMUTING, ORDERED = 0, 1, 2
# A step is too long for a particle where the estimate of its error by the slopes is this share of the state: a linear decay at a
# rate 2 / step.  It is halved, three times at once, and again where that is not enough.  What most particles need is measured
# beforehand; this is for those far out, which a stiff drift would throw to infinity.  By less than so much of the noise of a
# substep no particle is thrown far: dry friction holds a velocity near zero, where every step is too long for its sign.
_ROUGH, _PARTS, _LEVELS = 0.25, 8, 3
UPDATE = 0  # instead of the evaluations of a flow
# Drift, fields of the noise, ends of the domain, the kind of the noise, what an observation makes of the state, and L (n, n),
# the linear part of the drift, or (0, 0).
MOTION = types.Tuple((PROGRAM, PROGRAM, BOX, types.int64, PROGRAM, F2))
# Times (E, 2), [root, observation, stages] (E, 3): what follows each flow or -1, and its evaluations, 2 or 4, or `UPDATE`; given
# numbers at both ends (E, 2, L), roots (J, n or r, d), the first row of the noise of each root, its width, and 1 where a coin
# follows (J, 3), and the standard deviations of the noise of a substep (E, n).
EVENTS = types.Tuple((F2, I2, F3, F3, I2, F2))


class Buffers(NamedTuple):
    """What is overwritten.

    Rows of a block (rows, BLOCK), given numbers (L,), the times (2,) of a kick, and of the particles of a block: which a step is
    too long for, their places, and which needed a still shorter one (BLOCK,).  `noise` (n,) are the standard deviations of the
    noise of a substep.  `weights` (K, 7, n, n) are those of stiff flows, `which` (E,) the row of each event or -1, `part` those
    of a part of a flow.
    """

    work: Array
    row: Array
    time: Array
    rough: Array
    marked: Array
    failed: Array
    noise: Array
    weights: Array
    which: Array
    part: Array


class Stretch(NamedTuple):
    """A part of a flow.

    The length, the times (2,) and the given numbers (2, L) at both ends of the flow, the evaluations of a step, 2 or 4, where
    the part begins and how long it is, as shares of the flow, and the weights (7, n, n) of a stiff one, else (0, n, n).
    """

    length: float
    times: Array
    given: Array
    stages: int
    begin: float
    part: float
    weights: Array


class Kick(NamedTuple):
    """The noise of one substep: its root (n or r, d), the normal numbers (d, size), and the given numbers (2, L)."""

    root: Array
    noise: Array
    given: Array


class Arrival(NamedTuple):
    """What `advance` writes.

    The states (n, N) after the events, the integrals (N,) of the drift's output after the first n, zero where there is none, and
    the states (I, n, N) at the observations, or (0, n, N) where they are not wanted.
    """

    states: Array
    gained: Array
    ends: Array


ARRIVAL = types.NamedTuple((F2, F1, F3), Arrival)


@helper
def _runge_kutta(program: Any, values: Array, x: Array, box: Any, stretch: Any, buffers: Any, size: int) -> int:
    """Write the change of x (rows, size) by one Runge-Kutta step; mark the particles that it is too long for, and count them."""
    outputs, work, row = program[3], buffers.work, buffers.row
    length, times, given, stages, begin, part, _ = stretch
    count, rows, n = outputs.size, x.shape[0], box[0].size
    point, total, excess = work[:rows], work[rows : rows + count], work[rows + count : rows + count + n]
    length = part * length
    for d in range(count, rows):
        for i in range(size):
            point[d, i] = x[d, i]
    for stage in range(stages):
        share = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
        at = begin + part * share
        for j in range(row.size):
            row[j] = given[0, j] + at * (given[1, j] - given[0, j])
        load_point(program, values, point if stage else x, box, times[0] + at * (times[1] - times[0]), row, size)
        run_program(program, values, size)
        weight = length / 6.0 if stage == 0 or stage == 3 else length / 3.0
        sign = length / 6.0 if stage == 0 or stage == 3 else -length / 6.0
        if stages == 2:
            weight = 0.0 if stage == 0 else length
            sign = 0.5 * length if stage == 0 else -0.5 * length
        ahead = (1.0 if stage == 2 else 0.5) * length
        for d in range(count):
            slope = values[outputs[d]]
            if stage == 0:
                for i in range(size):
                    total[d, i] = weight * slope[i]
            else:
                for i in range(size):
                    total[d, i] += weight * slope[i]
            if d < n and stage == 0:
                for i in range(size):
                    excess[d, i] = sign * slope[i]
            elif d < n:
                for i in range(size):
                    excess[d, i] += sign * slope[i]
            if stage < stages - 1:
                for i in range(size):
                    point[d, i] = x[d, i] + ahead * slope[i]
    return _mark_rough(x, total, excess, buffers, size)


@helper
def _exponential_step(program: Any, values: Array, x: Array, box: Any, stretch: Any, buffers: Any, size: int) -> int:
    """Do what `_runge_kutta` does with the weights of a stiff linear part."""
    outputs, work, row, weights = program[3], buffers.work, buffers.row, stretch.weights
    length, times, given, stages, begin, part, _ = stretch
    count, rows, n = outputs.size, x.shape[0], box[0].size
    point, total, excess = work[:rows], work[rows : rows + count], work[rows + count : rows + count + n]
    base = 2 * (rows + count)
    y, g, first, half = work[base : base + n], work[base + n :], work[base + 2 * n :], work[base + 3 * n :]
    g, first, half = g[:n], first[:n], half[:n]
    length = part * length
    for d in range(rows):
        for i in range(size):
            point[d, i] = x[d, i]
    for stage in range(stages):
        share = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
        at = begin + part * share
        for j in range(row.size):
            row[j] = given[0, j] + at * (given[1, j] - given[0, j])
        load_point(program, values, point, box, times[0] + at * (times[1] - times[0]), row, size)
        run_program(program, values, size)
        weight = length / 6.0 if stage == 0 or stage == 3 else length / 3.0
        sign = length / 6.0 if stage == 0 or stage == 3 else -length / 6.0
        which = FIRST if stage == 0 else (LAST if stage == 3 else MIDDLE)
        if stages == 2:
            weight = 0.0 if stage == 0 else length
            sign = 0.5 * length if stage == 0 else -0.5 * length
            which = WHOLE
        for d in range(n):
            slope = values[outputs[d]]
            for i in range(size):
                g[d, i] = slope[i]
            if stage > 0:
                add_rows(g[d], weights[MINUS_L, d], y, size)
        for d in range(count):
            for i in range(size if stage == 0 else 0):
                total[d, i] = 0.0
                if d < n:
                    excess[d, i] = 0.0
            if d >= n:
                slope = values[outputs[d]]
                for i in range(size):
                    total[d, i] += weight * slope[i]
                continue
            if weight > 0.0:
                add_rows(total[d], weights[which, d], g, size)
            for i in range(size):
                excess[d, i] += sign * g[d, i]
        if stage == stages - 1:
            break
        for d in range(n):
            for i in range(size):
                y[d, i] = 0.0
            if stage == 2:
                add_rows(y[d], weights[HALFWAY, d], half, size)
        for d in range(n):
            for i in range(size):
                if stage == 0:
                    first[d, i] = g[d, i]
                elif stage == 2:
                    g[d, i] = 2.0 * g[d, i] - first[d, i]
        for d in range(n):
            add_rows(y[d], weights[HALF, d], g, size)
            for i in range(size):
                if stage == 0:
                    half[d, i] = y[d, i]
                point[d, i] = x[d, i] + y[d, i]
    return _mark_rough(x, total, excess, buffers, size)


@helper
def _mark_rough(x: Array, total: Array, excess: Array, buffers: Any, size: int) -> int:
    """Mark the particles that a step is too long for, and count them."""
    rough, noise, n = buffers.rough, buffers.noise, excess.shape[0]
    for i in range(size):
        rough[i] = 0.0
    for d in range(n):
        for i in range(size):
            end = x[d, i] + total[d, i]
            rough[i] += 0.0 if abs(excess[d, i]) <= _ROUGH * (abs(x[d, i]) + abs(end) + noise[d]) else 1.0  # NaN is rough, too
    left = 0
    for i in range(size):
        left += rough[i] > 0.0
    return left


@helper
def _step(program: Any, values: Array, x: Array, box: Any, stretch: Any, buffers: Any, size: int) -> int:
    """Write the change of x by one step, exponential where the linear part is stiff."""
    if stretch.weights.shape[0]:
        return _exponential_step(program, values, x, box, stretch, buffers, size)
    return _runge_kutta(program, values, x, box, stretch, buffers, size)


@helper
def _flow(program: Any, values: Array, x: Array, box: Any, stretch: Any, buffers: Any, size: int) -> None:
    """Advance the first rows of x (rows, size) by one Runge-Kutta step, or by as many as a particle needs to be stable."""
    count, rows, rough = program[3].size, x.shape[0], buffers.rough
    change = buffers.work[rows : rows + count]
    left = _step(program, values, x, box, stretch, buffers, size)
    if left == 0:
        for d in range(count):
            for i in range(size):
                x[d, i] += change[d, i]
        return
    marked, few = buffers.marked, buffers.work[rows + 2 * count : 2 * rows + 2 * count]
    place = 0
    for i in range(size):
        if rough[i] > 0.0:
            marked[place] = i
            place += 1
        else:
            for d in range(count):
                x[d, i] += change[d, i]
    for level in range(_LEVELS):
        if left == 0:
            break
        parts, weights = _PARTS ** (level + 1), stretch.weights
        if weights.shape[0]:
            write_weights(-weights[MINUS_L], stretch.length / parts, buffers.part)
            weights = buffers.part
        for c in range(left):
            buffers.failed[c] = 0.0
            for d in range(rows):
                few[d, c] = x[d, marked[c]]
        for p in range(parts):
            part = Stretch(stretch.length, stretch.times, stretch.given, 4, p / parts, 1.0 / parts, weights)
            _step(program, values, few, box, part, buffers, left)
            for c in range(left):
                buffers.failed[c] += rough[c]
                for d in range(count):
                    few[d, c] += change[d, c]
        kept = 0
        for c in range(left):
            if buffers.failed[c] > 0.0 and level < _LEVELS - 1:
                marked[kept] = marked[c]
                kept += 1
            else:
                for d in range(count):
                    x[d, marked[c]] = few[d, c]
        left = kept


@helper
def _kick(motion: Any, values: Array, x: Array, kick: Any, buffers: Any, size: int) -> None:
    """Add the noise of one kick to x; rows of x after those of the drift hold the coefficients of the fields."""
    fields, kind, work = motion[1], motion[3], buffers.work
    root, noise, given = kick
    n, width = motion[2][0].size, root.shape[1]
    if kind == ADDITIVE:
        for d in range(n):
            add_rows(x[d], root[d], noise, size)
        return
    # The point of the fields: the state, then a coefficient for each field.
    r = root.shape[0]
    point = work[: n + r]
    rest = Buffers(
        work[n + r :], buffers.row, buffers.time, buffers.rough, buffers.marked, buffers.failed, buffers.noise, buffers.weights,
        buffers.which, buffers.part,
    )
    for d in range(n):
        for i in range(size):
            point[d, i] = x[d, i]
    for turn in range(1 if kind == COMMUTING else width):
        for a in range(r):
            for i in range(size):
                value = 0.0
                if kind == COMMUTING:
                    for j in range(width):
                        value += root[a, j] * noise[j, i]
                else:
                    j = turn if noise[width, i] > 0.0 else width - 1 - turn
                    value = root[a, j] * noise[j, i]
                point[n + a, i] = value
        _flow(fields, values, point, motion[2], Stretch(1.0, buffers.time, given, 4, 0.0, 1.0, buffers.part[:0]), rest, size)
    for d in range(n):
        for i in range(size):
            x[d, i] = point[d, i]


@helper
def _update(program: Any, values: Array, x: Array, box: Any, time: float, given: Array, size: int) -> None:
    """Replace the state by what an observation makes of it."""
    load_point(program, values, x, box, time, given, size)
    run_program(program, values, size)
    for d in range(program[3].size):
        result = values[program[3][d]]
        for i in range(size):
            x[d, i] = result[i]


@helper
def run_event(motion: Any, events: Any, e: int, blocks: Any, x: Array, noise: Array, buffers: Any, size: int) -> None:
    """Advance x (rows, size) by one event; `noise` (D, size) is that of all events."""
    times, places, given, roots, rows, spreads = events
    n, box = motion[2][0].size, motion[2]
    if places[e, 2] == UPDATE:
        _update(motion[4], blocks[2], x, box, times[e, 1], given[e, 0], size)
        return
    if times[e, 1] != times[e, 0]:
        for d in range(n):
            buffers.noise[d] = spreads[e, d]
        k = buffers.which[e]
        weights = buffers.weights[k] if k >= 0 else buffers.part[:0]
        stretch = Stretch(times[e, 1] - times[e, 0], times[e], given[e], places[e, 2], 0.0, 1.0, weights)
        _flow(motion[0], blocks[0], x, box, stretch, buffers, size)
    r = places[e, 0]
    if r >= 0:
        buffers.time[0], buffers.time[1] = times[e, 1], times[e, 1]
        kick = Kick(roots[r, :, : rows[r, 1]], noise[rows[r, 0] :], _twice(given[e, 1:, :]))
        _kick(motion, blocks[1], x, kick, buffers, size)
    for d in range(n):
        if box[0][d] > -np.inf or box[1][d] < np.inf:
            for i in range(size):
                x[d, i] = mirrored(x[d, i], box[0][d], box[1][d])


@helper
def _twice(row: Array) -> Any:
    """Return the given numbers of one time as those of both ends."""
    out = np.empty((2, row.shape[1]))
    for j in range(row.shape[1]):
        out[0, j] = out[1, j] = row[0, j]
    return out


@helper
def buffers_of(motion: Any, events: Any) -> Any:
    """Return what `run_event` overwrites."""
    n, r = motion[2][0].size, events[3].shape[1]
    work, row = np.empty((9 * (n + r + 2), BLOCK)), np.empty(events[2].shape[2])
    noise, which, L = np.zeros(motion[2][0].size), np.empty(len(events[0]), np.int64), motion[5]
    weights, part = distinct_weights(L, events[0], which), np.empty((WEIGHTS, *L.shape))
    marked = np.empty(BLOCK, np.int64)
    return Buffers(work, row, np.empty(2), np.empty(BLOCK), marked, np.empty(BLOCK), noise, weights, which, part)


@kernel(types.void(MOTION, EVENTS, F2, F2, types.int64, types.int64, ARRIVAL))
def advance(motion: Any, events: Any, start: Array, noise: Array, low: int, high: int, arrival: Any) -> None:
    """Advance the particles from `low` to `high` by all events.

    Args:
        motion: the formulas.
        events: the events.
        start: states (n, N).
        noise: standard normal numbers (D, N).
        low: the first particle.
        high: the particle after the last one.
        arrival: receives the results.
    """
    out, gained, ends = arrival
    blocks = (block_of(motion[0]), block_of(motion[1]), block_of(motion[4]))
    buffers = buffers_of(motion, events)
    n, rows, places = start.shape[0], motion[0][3].size, events[1]
    x, own = np.empty((rows, BLOCK)), np.empty((max(noise.shape[0], 1), BLOCK))
    for first in range(low, high, BLOCK):
        size = min(BLOCK, high - first)
        for d in range(n):
            for i in range(size):
                x[d, i] = start[d, first + i]
        for d in range(n, rows):
            for i in range(size):
                x[d, i] = 0.0
        for j in range(noise.shape[0]):
            for i in range(size):
                own[j, i] = noise[j, first + i]
        for e in range(places.shape[0]):
            run_event(motion, events, e, blocks, x, own, buffers, size)
            if places[e, 1] >= 0 and ends.shape[0]:
                for d in range(n):
                    for i in range(size):
                        ends[places[e, 1], d, first + i] = x[d, i]
        for d in range(n):
            for i in range(size):
                out[d, first + i] = x[d, i]
        for i in range(size):
            gained[first + i] = x[n, i] if rows > n else 0.0
