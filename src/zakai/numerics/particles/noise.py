"""The noise of substeps that does not depend on the state: its covariance, carried to the middle, and the root of that.

    Q = int exp(-s A) G exp(-s A') ds over (-d/2, d/2),      R R' = Q

A is df/dx where the path of a state without noise is in the middle of the substep, of length d.  Where an input jumps within it,
A is another one on each side of the jump.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.formula_kernel import BLOCK
from zakai.numerics.particles.exponential import norm_of
from zakai.numerics.particles.formulas import BOX, F1, F2, F3, PROGRAM, block_of, load_point, run_program
from zakai.numerics.particles.motion import EVENTS, MOTION, buffers_of, run_event
from zakai.numerics.small_matrices import assign, multiply

Array = Any
_SERIES = 4.0  # norm of A times the length up to which Q is a series; twice as long by halves
_SMALL = 1e-11  # residual of a variance, relative to it, that is no direction of its own
# Spectral radius of df/dx without the linear part, times a substep, above which that is reduced: noise that is carried far to the
# middle of a substep is amplified there, and a nonlinear flow does not take that back.
_CARRIED = 2.0
_STEP = 1e-5  # of forward differences, in standard deviations


@helper
def root_of(Q: Array, out: Array, pivots: Array) -> int:
    """Write columns R (n, n) with R R' = Q (n, n) by Cholesky's factor with pivots (n,), and return how many are not zero.

    A coordinate with little noise keeps it: variances are compared with what they were.
    """
    n = Q.shape[0]
    left, used = np.empty(n), np.zeros(n, np.bool_)
    out[:] = 0.0
    for i in range(n):
        left[i] = Q[i, i]
    for rank in range(n):
        pivot, most = 0, 0.0
        for i in range(n):
            share = left[i] / Q[i, i] if Q[i, i] > 0.0 and not used[i] else 0.0
            if share > most:
                pivot, most = i, share
        if not most > _SMALL:
            return rank
        used[pivot], pivots[rank] = True, pivot
        size = np.sqrt(left[pivot])
        for i in range(n):
            if used[i] and i != pivot:
                continue
            total = Q[i, pivot]
            for k in range(rank):
                total -= out[i, k] * out[pivot, k]
            out[i, rank] = size if i == pivot else total / size
            left[i] -= out[i, rank] ** 2
    return n


@kernel(types.int64(F3, F3))
def write_roots(Q: Array, out: Array) -> int:
    """Write the roots (J, n, n) of covariances (J, n, n), and return how many of their columns are not all zero."""
    width, pivots = 0, np.empty(Q.shape[1], np.int64)
    for j in range(Q.shape[0]):
        width = max(width, root_of(Q[j], out[j], pivots))
    return width


@helper
def _exponential(A: Array, length: float, out: Array) -> None:
    """Write exp(length A)."""
    n = A.shape[0]
    term, product = np.zeros((n, n)), np.empty((n, n))
    norm, squares = 0.0, 0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += abs(A[i, j] * length)
        norm = max(norm, total)
    while norm > _SERIES and squares < 60:
        norm, squares, length = 0.5 * norm, squares + 1, 0.5 * length
    out[:] = 0.0
    for i in range(n):
        term[i, i] = out[i, i] = 1.0
    for k in range(1, 30):
        multiply(product, A, term)
        for i in range(n):
            for j in range(n):
                term[i, j] = product[i, j] * length / k
                out[i, j] += term[i, j]
    for _ in range(squares):
        multiply(product, out, out)
        assign(out, product)


@helper
def noise_about(A: Array, G: Array, length: float, out: Array) -> None:
    """Write int exp(-s A) G exp(-s A') ds over (-length/2, length/2)."""
    n = A.shape[0]
    norm, halves = 0.0, 0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += abs(A[i, j])
        norm = max(norm, total * length)
    while norm > _SERIES and halves < 60:
        norm, halves = 0.5 * norm, halves + 1
    own = length / 2.0**halves
    term, product, factor = np.empty((n, n)), np.empty((n, n)), own
    for i in range(n):
        for j in range(n):
            term[i, j], out[i, j] = G[i, j], own * G[i, j]
    for k in range(1, 40):
        multiply(product, A, term)
        factor = factor * 0.5 * own / (k + 1)
        largest = change = 0.0
        for i in range(n):
            for j in range(n):
                term[i, j] = -(product[i, j] + product[j, i])
        if k % 2:
            continue
        for i in range(n):
            for j in range(n):
                out[i, j] += factor * term[i, j]
                change, largest = max(change, abs(factor * term[i, j])), max(largest, abs(out[i, j]))
        if change <= 1e-15 * largest:
            break
    if halves:
        back, ahead, other = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
        _exponential(A, -0.5 * own, back)
        _exponential(A, 0.5 * own, ahead)
        for _ in range(halves):
            _congruence(back, out, product, term)
            _congruence(ahead, out, product, other)
            for i in range(n):
                for j in range(n):
                    out[i, j] = term[i, j] + other[i, j]
            multiply(product, back, back)
            assign(back, product)
            multiply(product, ahead, ahead)
            assign(ahead, product)
    for i in range(n):
        for j in range(i):
            out[i, j] = out[j, i] = 0.5 * (out[i, j] + out[j, i])


@helper
def _congruence(M: Array, Q: Array, product: Array, out: Array) -> None:
    """Write M Q M'; `product` is overwritten."""
    n = M.shape[0]
    multiply(product, M, Q)
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += product[i, k] * M[j, k]
            out[i, j] = total


@helper
def _reduced(A: Array, L: Array, length: float, out: Array) -> None:
    """Write A, with A - L made smaller where its spectral radius times the length is above `_CARRIED`; L may be (0, 0).

    The radius is estimated by the eighth power, so that it hardly depends on the units of the states.
    """
    n, linear = A.shape[0], L.shape[0] > 0
    power, product = np.empty((n, n)), np.empty((n, n))
    for i in range(n):
        for j in range(n):
            power[i, j] = A[i, j] - L[i, j] if linear else A[i, j]
    for _ in range(3):
        multiply(product, power, power)
        assign(power, product)
    radius = norm_of(power) ** 0.125 * length
    share = _CARRIED / radius if radius > _CARRIED else 1.0
    for i in range(n):
        for j in range(n):
            exact = L[i, j] if linear and share < 1.0 else 0.0
            out[i, j] = exact + share * (A[i, j] - exact)


@helper
def _noise_across(times: Array, slopes: Array, e: int, G: Array, length: float, L: Array, out: Array) -> None:
    """Write the noise of a substep in which df/dx jumps, carried to its middle, where event e (E, 2) ends.

    `slopes` (E, n, n) are df/dx at the ends of the events, which end at jumps, too.
    """
    n, middle = G.shape[0], times[e, 1]
    A, Q, M, E, product = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    out[:] = 0.0
    for side in (-1, 1):
        M[:] = 0.0
        for i in range(n):
            M[i, i] = 1.0
        f, source, first, last = e if side < 0 else e + 1, e, middle - 0.5 * length, middle + 0.5 * length
        while 0 <= f < times.shape[0] and times[f, 1] > first and times[f, 0] < last:
            own = min(times[f, 1], last) - max(times[f, 0], first)
            _reduced(slopes[source], L, own, A)
            noise_about(A, G, own, Q)
            _exponential(A, -0.5 * side * own, E)
            multiply(product, M, E)
            multiply(M, product, E)  # the way from the far end, product that from its middle
            _congruence(product, Q, A, E)
            for i in range(n):
                for j in range(n):
                    out[i, j] += E[i, j]
            f += side
            source = f


@kernel(types.void(F2, F2, types.float64, F2))
def noise_about_middle(A: Array, G: Array, length: float, out: Array) -> None:
    """Write the covariance (n, n) of the noise of a substep, carried to its middle."""
    noise_about(A, G, length, out)


@helper
def _slopes(program: Any, values: Array, box: Any, x: Array, step: Array, time: float, given: Array, out: Array) -> None:
    """Write df/dx (n, n) at a point (n,) by forward differences with steps (n,); `values` is a block of the program."""
    n, most = x.size, BLOCK - 1
    points, f = np.empty((n, BLOCK)), np.empty(n)
    for first in range(0, n, most):
        size = min(most, n - first)
        for i in range(n):
            for j in range(size + 1):
                points[i, j] = x[i]
        for j in range(size):
            points[first + j, j + 1] += step[first + j]
        load_point(program, values, points, box, time, given, size + 1)
        run_program(program, values, size + 1)
        for i in range(n):
            f[i] = values[program[3][i], 0]
        for i in range(n):
            row = values[program[3][i]]
            for j in range(size):
                slope = (row[j + 1] - f[i]) / step[first + j]
                out[i, first + j] = slope if np.isfinite(slope) else 0.0


@kernel(types.void(PROGRAM, BOX, F1, F1, types.float64, F1, F2))
def slopes(program: Any, box: Any, x: Array, scale: Array, time: float, given: Array, out: Array) -> None:
    """Write df/dx (n, n) at a point (n,) with the standard deviations (n,) of the state, 0 where it is not finite."""
    _slopes(program, block_of(program), box, x, _STEP * scale, time, given, out)


@kernel(types.int64(MOTION, EVENTS, F2, types.float64, F2, F3, F3, F3))
def kick_roots(motion: Any, events: Any, A: Array, length: float, about: Array, G: Array, slopes: Array, out: Array) -> int:
    """Write the roots (J, n, n) of the noise of all kicks, and return how many of their columns are not all zero.

    Args:
        motion: the formulas.
        events: the events of an interval, without roots.
        A: the matrix (n, n) of an affine drift, or (0, 0), where it is computed along the path of a state.
        length: of a substep.
        about: the state at the start, and its standard deviations (2, n).
        G: the covariance of the noise per unit time at each kick (J, n, n), or at all (1, n, n).
        slopes: receives df/dx (J, n, n) at the kicks.
        out: receives the roots.
    """
    times, places, given = events[0], events[1], events[2]
    n, width, mean, scale, count = about.shape[1], 0, about[0], about[1], places.shape[0]
    blocks = (block_of(motion[0]), block_of(motion[1]), block_of(motion[4]))
    buffers = buffers_of(motion, events)
    x, none, at = np.zeros((motion[0][3].size, BLOCK)), np.empty((1, BLOCK)), np.empty(n)
    Q, pivots, ends = np.empty((n, n)), np.empty(n, np.int64), np.empty((count, n, n))
    for d in range(n):
        x[d, 0] = mean[d]
    for e in range(count):
        if not A.size:
            run_event(motion, events, e, blocks, x, none, buffers, 1)
        j, slope = places[e, 0], ends[e]
        if A.size:
            assign(slope, A)
        elif j >= 0 or count > slopes.shape[0] + 1:
            for d in range(n):
                at[d] = x[d, 0]
            _slopes(motion[0], blocks[0], motion[2], at, _STEP * scale, times[e, 1], given[e, 1], slope)
        if j >= 0 and A.size:
            assign(slopes[j], slope)
        elif j >= 0:
            _reduced(slope, motion[5], length, slopes[j])
    for e in range(count):
        j = places[e, 0]
        if j < 0:
            continue
        own = G[j if G.shape[0] > 1 else 0]
        before, after = times[e, 0] > times[e, 1] - 0.5 * length, e + 1 < count and times[e + 1, 1] < times[e, 1] + 0.5 * length
        if not A.size and count > slopes.shape[0] + 1 and (before or after):
            _noise_across(times, ends, e, own, length, motion[5], Q)
        else:
            noise_about(slopes[j], own, length, Q)
        width = max(width, root_of(Q, out[j], pivots))
    return width
