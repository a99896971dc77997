"""The motion of particles over an interval as a function of standard normal noise.

    x <- flow of the drift from t_e to t_(e+1);   x <- x + R w,   w ~ N(0, I)

An interval is a list of events: a Runge-Kutta step of order two or four, and a kick of noise after some of them.  Where the noise
depends on the state a kick is the flow of the fields g_j(x) sqrt(d) w_j over unit time, together where the fields commute, else
one after the other in an order that a further normal number decides.  With half of a substep's flow before and half after its
kick the law is that of the equation to second order in the substep.  The drift's outputs after the first n are integrated along
the way.

References:
    Ninomiya and Victoir 2008, Weak approximation of stochastic differential equations.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.formula_kernel import BLOCK
from zakai.numerics.particles.formulas import BOX, F1, F2, F3, I2, PROGRAM, block_of, load_point, mirrored, run_program

Array = Any
ADDITIVE, COMMUTING, ORDERED = 0, 1, 2
# Drift, fields of the noise, ends of the domain, and the kind of the noise.
MOTION = types.Tuple((PROGRAM, PROGRAM, BOX, types.int64))
# Times (E, 2), [root, observation, stages] (E, 3): what follows each flow or -1, and its evaluations, 2 or 4; given numbers at
# both ends (E, 2, L), roots (J, n or r, d), and the first row of the noise of each root, its width, and 1 where a coin follows
# (J, 3).
EVENTS = types.Tuple((F2, I2, F3, F3, I2))


@helper
def _flow(program: Any, values: Array, x: Array, work: Array, box: Any, length: float, times: Array, given: Array, row: Array,
          stages: int, size: int) -> None:  # fmt: skip
    """Advance the first rows of x (rows, size) by one Runge-Kutta step; `times` and `given` at both ends."""
    outputs = program[3]
    count, rows = outputs.size, x.shape[0]
    point, slopes, total = work[:rows], work[rows : rows + count], work[rows + count : rows + 2 * count]
    for stage in range(stages):
        share = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
        if stage == 0:
            for d in range(rows):
                for i in range(size):
                    point[d, i] = x[d, i]
        else:
            for d in range(count):
                for i in range(size):
                    point[d, i] = x[d, i] + share * length * slopes[d, i]
        for j in range(row.size):
            row[j] = given[0, j] + share * (given[1, j] - given[0, j])
        load_point(program, values, point, box, times[0] + share * (times[1] - times[0]), row, size)
        run_program(program, values, size)
        weight = length / 6.0 if stage == 0 or stage == 3 else length / 3.0
        if stages == 2:
            weight = 0.0 if stage == 0 else length
        for d in range(count):
            result = values[outputs[d]]
            for i in range(size):
                slopes[d, i] = result[i]
                total[d, i] = weight * slopes[d, i] + (total[d, i] if stage else 0.0)
    for d in range(count):
        for i in range(size):
            x[d, i] += total[d, i]


@helper
def _kick(motion: Any, values: Array, x: Array, work: Array, root: Array, noise: Array, given: Array, row: Array, time: Array,
          size: int) -> None:  # fmt: skip
    """Add the noise of one kick to x; rows of x after those of the drift hold the coefficients of the fields."""
    fields, kind = motion[1], motion[3]
    n, width = motion[2][0].size, root.shape[1]
    if kind == ADDITIVE:
        for d in range(n):
            for j in range(width):
                factor = root[d, j]
                if factor != 0.0:
                    for i in range(size):
                        x[d, i] += factor * noise[j, i]
        return
    # The point of the fields: the state, then a coefficient for each field.
    r = root.shape[0]
    point, rest = work[: n + r], work[n + r :]
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
        _flow(fields, values, point, rest, motion[2], 1.0, time, given, row, 4, size)
    for d in range(n):
        for i in range(size):
            x[d, i] = point[d, i]


@helper
def run_event(motion: Any, events: Any, e: int, blocks: Any, x: Array, noise: Array, buffers: Any, size: int) -> None:
    """Advance x (rows, size) by one event; `noise` (D, size) is that of all events."""
    times, places, given, roots, rows = events
    work, row, time = buffers
    n, box = motion[2][0].size, motion[2]
    if times[e, 1] != times[e, 0]:
        _flow(motion[0], blocks[0], x, work, box, times[e, 1] - times[e, 0], times[e], given[e], row, places[e, 2], size)
    r = places[e, 0]
    if r >= 0:
        width = rows[r, 1]
        time[0], time[1] = times[e, 1], times[e, 1]
        constant = given[e, 1:, :]
        first = rows[r, 0]
        _kick(motion, blocks[1], x, work, roots[r, :, :width], noise[first:], _twice(constant), row, time, size)
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
    return np.empty((6 * (n + r + 2), BLOCK)), np.empty(events[2].shape[2]), np.empty(2)


@kernel(types.void(MOTION, EVENTS, F2, F2, types.int64, types.int64, F2, F1, F3))
def advance(motion: Any, events: Any, start: Array, noise: Array, low: int, high: int, out: Array, gained: Array,
            ends: Array) -> None:  # fmt: skip
    """Advance the particles from `low` to `high` by all events.

    Args:
        motion: the formulas.
        events: the events.
        start: states (n, N).
        noise: standard normal numbers (D, N).
        low: the first particle.
        high: the particle after the last one.
        out: the states (n, N) after the events.
        gained: the integrals (N,) of the drift's output after the first n, zero where there is none.
        ends: the states (I, n, N) at the observations, or (0, n, N) where they are not wanted.
    """
    blocks = (block_of(motion[0]), block_of(motion[1]))
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
