"""Values of a density that is carried by a flow and multiplied by a likelihood, at many points: no Python between points.

    v(x) = sum_j a_j u_j(phi_j(x)) exp(int c along phi_j)  *  p(z | x)^power / e^top

by `flow`, `add_train`, `evaluate` of the likelihood, and `weigh`.  They are called one after the other: a kernel that called
them would be compiled with all of them in it once more.

A motion is a program of formulas (`numerics/particles/formulas.py`) whose first n outputs are the velocity and whose last is the
rate c of the logarithm, with the ends of the domain; a path is a list of Runge-Kutta steps through known numbers.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import types

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.formula_kernel import BLOCK
from zakai.numerics.particles.formulas import BOX, F1, F2, F3, I1, PROGRAM, block_of, load_point, run_program
from zakai.numerics.trains.grid import PAD, taps

Array = Any
# Times at both ends of each step (E, 2), and the given numbers there (E, 2, L).
PATH = types.Tuple((F2, F3))
# Centre, inverse of the basis, low, step, sizes; periods (0 or 2 pi); ranks (n + 1,), offsets, coefficients (N + 2 PAD, a, b) of
# each core; of the Gaussian that stands for the tails the mean less the centre, the inverse of a root of the covariance, and
# [square of the radius where it begins, largest value, value at the radius].
TRAIN = types.Tuple((F1, F2, F1, F1, I1, F1, I1, I1, F1, F1, F2, F1))
# Ranks (n + 1,), sizes (n,), where each core begins (n,), and the cores in the order (N, a, b).
PACKED = types.Tuple((I1, I1, I1, F1))
POINTS, TOGETHER = 1024, 64  # of a block, which are sorted, and of one product of matrices
LARGEST_LOG = 500.0  # of a factor; the exponential of more is cut
# Later observations lead into what are tails now, where an error relative to the density becomes one of the mean.  With the power
# 1/2 of the sums (the scaling of correspondence analysis) the error of a skeleton is relative to the density, as an average over
# its mass.  On fourteen wide tracks seen by bearings .4 had a quarter of the error of no scaling, for 1.15 times the evaluations.
POWER = 0.4


@kernel(types.void(PROGRAM, BOX, PATH, F2, F2))
def flow(program: Any, box: Any, path: Any, x: Array, out: Array) -> None:
    """Write the ends of paths that begin at points x (n, P), and below them the integral of the last output: (n + 1, P)."""
    times, given = path
    n, count, outputs = x.shape[0], x.shape[1], program[3]
    rows = n + 1
    values = block_of(program)
    point, slopes, total = np.empty((rows, BLOCK)), np.empty((rows, BLOCK)), np.empty((rows, BLOCK))
    row = np.empty(given.shape[2])
    for first in range(0, count, BLOCK):
        size = min(BLOCK, count - first)
        now = out[:, first : first + size]
        for d in range(n):
            for i in range(size):
                now[d, i] = x[d, first + i]
        for i in range(size):
            now[n, i] = 0.0
        for e in range(times.shape[0]):
            length = times[e, 1] - times[e, 0]
            for stage in range(4):
                share = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
                for d in range(rows):
                    for i in range(size):
                        point[d, i] = now[d, i] + (share * length * slopes[d, i] if stage else 0.0)
                for j in range(row.size):
                    row[j] = given[e, 0, j] + share * (given[e, 1, j] - given[e, 0, j])
                load_point(program, values, point, box, times[e, 0] + share * length, row, size)
                run_program(program, values, size)
                weight = length / 6.0 if stage == 0 or stage == 3 else length / 3.0
                for d in range(rows):
                    result = values[outputs[d]]
                    for i in range(size):
                        slopes[d, i] = result[i]
                        total[d, i] = weight * slopes[d, i] + (total[d, i] if stage else 0.0)
            for d in range(rows):
                for i in range(size):
                    now[d, i] += total[d, i]


@kernel(types.void(TRAIN, F2, types.boolean, F1, F1), reordered=True)
def add_train(train: Any, x: Array, moved: bool, scale: Array, out: Array) -> None:
    """Add the values of a train at points x (n, P) to `out` (P,).

    v <- sum_d w_d(z_k) v C_k[j + d] over the axes, times scale[0] and, if moved, exp(x[n] - scale[1]); a value that is not a
    number counts as zero.  Points of a block are sorted by their cell j on each axis: those of a cell are a product of matrices.
    """
    centre, inverse, low, step, sizes, periods, ranks, offsets, flat, mean, whitening, tail = train
    n, count, tails = low.size, x.shape[1], tail[0] < math.inf
    width, cells, most = 1, 0, max(1, min(POINTS, count))
    for k in range(n):
        width, cells = max(width, ranks[k + 1]), max(cells, sizes[k] + 2 * PAD)
    y, s, square, inside = np.empty((n, most)), np.empty((n, most)), np.empty(most), np.empty(most, np.bool_)
    # Row row_of[p] of `v` belongs to point p of the block; `after` are the rows after an axis, in the order of its cells.
    v, after, row_of = np.empty(most * width), np.empty(most * width), np.empty(most, np.int64)
    w, c = np.empty(6), np.empty(TOGETHER * 6 * width)
    alive, cell, order = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most, np.int64)
    starts = np.empty(cells + 1, np.int64)
    for first in range(0, count, most):
        size, used = min(most, count - first), 0
        for d in range(n):
            for p in range(size):
                y[d, p] = x[d, first + p] - centre[d]
            if periods[d] > 0.0:
                for p in range(size):
                    y[d, p] -= periods[d] * math.floor(y[d, p] / periods[d] + 0.5)
        inside[:size], square[:size] = True, 0.0
        for k in range(n):
            here, top = s[k], sizes[k] + 1.9
            here[:size] = -low[k] / step[k]
            for d in range(n):
                factor, other = inverse[k, d] / step[k], y[d]
                if factor != 0.0:
                    for p in range(size):
                        here[p] += factor * other[p]
            for p in range(size):
                inside[p] = inside[p] and here[p] > -2.9 and here[p] < top
            if tails:
                for p in range(size):
                    white = 0.0
                    for d in range(n):
                        white += whitening[k, d] * (y[d, p] - mean[d])
                    square[p] += white * white
        for p in range(size):
            if inside[p]:
                alive[used], row_of[p], v[used] = p, used, 1.0
                used += 1
        for k in range(n):
            a, b = ranks[k], ranks[k + 1]
            starts[: sizes[k] + 2 * PAD + 1] = 0
            for i in range(used):
                cell[i] = int(math.floor(s[k, alive[i]])) - 2 + PAD
                starts[cell[i] + 1] += 1
            for j in range(sizes[k] + 2 * PAD):
                starts[j + 1] += starts[j]
            for i in range(used):
                order[starts[cell[i]]] = alive[i]
                starts[cell[i]] += 1  # now the end of the cell
            begin, j = 0, 0
            while begin < used:
                while starts[j] <= begin:
                    j += 1
                end = min(starts[j], begin + TOGETHER)
                for i in range(begin, end):
                    p = order[i]
                    one, row = v[row_of[p] * a : (row_of[p] + 1) * a], c[(i - begin) * 6 * a : (i - begin + 1) * 6 * a]
                    taps(s[k, p] - math.floor(s[k, p]), w)
                    for d in range(6):
                        factor = w[d]
                        for q in range(a):
                            row[d * a + q] = factor * one[q]
                group, base = end - begin, offsets[k] + j * a * b
                matrix = flat[base : base + 6 * a * b].reshape(6 * a, b)
                np.dot(c[: group * 6 * a].reshape(group, 6 * a), matrix, after[begin * b : end * b].reshape(group, b))
                begin = end
            for i in range(used):
                row_of[order[i]] = i
            v, after = after, v
        for p in range(size):
            far = square[p] > tail[0]
            if inside[p] or far:
                value = v[row_of[p]] if inside[p] else 0.0
                if far:  # the train from twice the value at the radius, the Gaussian below it, smoothly in between
                    share = min(max(value / tail[2] - 1.0, 0.0), 1.0)
                    share *= share * (3.0 - 2.0 * share)
                    value = share * value + (1.0 - share) * tail[1] * math.exp(-0.5 * square[p])
                value *= scale[0]
                if moved:
                    value *= math.exp(min(x[n, first + p] - scale[1], LARGEST_LOG))
                if value == value:
                    out[first + p] += value


@kernel(types.void(F2, F1, BOX, F1, F2, F1))
def weigh(logs: Array, numbers: Array, box: Any, turn: Array, x: Array, out: Array) -> None:
    """Multiply values (P,) at points x (n, P) by a likelihood; zero outside of the domain.

    Args:
        logs: the logarithms (m, P) of the factors of the likelihood, which may have none.
        numbers: [power, top]: the power of the likelihood, and the logarithm of what divides it.
        box: the domain.
        turn: the centre (n,) of the turn on which angles are taken, NaN for other states.
        x: the points.
        out: the values.
    """
    for p in range(x.shape[1]):
        for d in range(x.shape[0]):
            if abs(x[d, p] - turn[d]) > math.pi * (1.0 + 1e-6) or x[d, p] < box[0][d] or x[d, p] > box[1][d]:
                out[p] = 0.0
        if logs.shape[0] and out[p] != 0.0:
            total = 0.0
            for k in range(logs.shape[0]):
                total += logs[k, p]
            value = out[p] * math.exp(min(numbers[0] * total - numbers[1], LARGEST_LOG)) if total == total else 0.0
            out[p] = value if value == value else 0.0


@kernel(types.void(F2, F2, F2, F2))
def fibre_points(left: Array, axis: Array, right: Array, out: Array) -> None:
    """Write all sums left[:, i] + axis[:, j] + right[:, k] (n, a N b), the last index fastest."""
    for d in range(out.shape[0]):
        p = 0
        for i in range(left.shape[1]):
            for j in range(axis.shape[1]):
                base = left[d, i] + axis[d, j]
                for k in range(right.shape[1]):
                    out[d, p] = base + right[d, k]
                    p += 1


@helper
def _to_factors(sums: Array, power: float, deepest: float) -> None:
    """Replace sums of rows or columns by the factors of these."""
    top = 0.0
    for p in range(sums.size):
        top = max(top, sums[p])
    for p in range(sums.size):
        sums[p] = max(sums[p] / top, deepest) ** -power if top > 0.0 else 1.0


@kernel(types.int64(F2, types.float64, types.UniTuple(types.float64, 2), types.int64, I1, I1, F2), reordered=True)
def skeleton(A: Array, tolerance: float, scaling: Any, most: int, rows: Array, columns: Array, out: Array) -> int:
    """Write rows of A (m, b) whose span interpolates it, and return their number r.

    Pivoted Gram-Schmidt to a relative error in the Frobenius norm, then rows of nearly maximal volume, both for A with rows and
    columns divided by powers of their sums: see `POWER`.

    Args:
        A: the matrix.
        tolerance: the relative error.
        deepest: the share of the largest sum below which rows and columns are not divided by less.
        most: the largest r.
        rows: receives the rows (r,).
        columns: receives the columns (r,) that were pivots.
        out: receives C (m, r) with A ~ C A[rows], with contiguous rows of its first m r numbers.
    """
    m, b = A.shape
    most = min(most, b, m)
    Q, rest, norms, total = np.empty((most, m)), np.empty((b, m)), np.empty(b), 0.0
    of_row, of_column = np.zeros(m), np.zeros(b)
    for p in range(m):
        for q in range(b):
            of_row[p] += abs(A[p, q])
            of_column[q] += abs(A[p, q])
    _to_factors(of_row, scaling[0], scaling[1])
    _to_factors(of_column, scaling[0], scaling[1])
    for q in range(b):
        column, size = rest[q], 0.0
        for p in range(m):
            column[p] = A[p, q] * of_row[p] * of_column[q]
            size += column[p] * column[p]
        norms[q] = size
        total += size
    r = 0
    while r < most:
        left, best = 0.0, 0
        for q in range(b):
            left += norms[q]
            if norms[q] > norms[best]:
                best = q
        if (r > 0 and left <= tolerance * tolerance * total) or norms[best] <= 1e-28 * total:
            break
        v = Q[r]
        for p in range(m):
            v[p] = rest[best, p]
        for s in range(r):  # once more against the others, for orthogonality
            f = 0.0
            for p in range(m):
                f += Q[s, p] * v[p]
            for p in range(m):
                v[p] -= f * Q[s, p]
        size = 0.0
        for p in range(m):
            size += v[p] * v[p]
        size = 1.0 / math.sqrt(size)
        for p in range(m):
            v[p] *= size
        columns[r] = best
        r += 1
        for q in range(b):
            f, size = 0.0, 0.0
            for p in range(m):
                f += v[p] * rest[q, p]
            for p in range(m):
                rest[q, p] -= f * v[p]
                size += rest[q, p] * rest[q, p]
            norms[q] = size
        norms[best] = 0.0
    r = max(r, 1)
    C = out[:m, :r]
    for p in range(m):
        for q in range(r):
            C[p, q] = Q[q, p] if total > 0.0 else 0.0
    for q in range(r):
        rows[q] = q
    if total == 0.0:
        columns[0] = 0
        return 1
    for turn in range(r + 40):
        # Elimination, in which each column takes its largest row, then exchanges of rows while they enlarge the volume.
        largest, i, j = -1.0, 0, min(turn, r - 1)
        for p in range(m):
            if turn < r:
                if abs(C[p, j]) > largest:
                    largest, i = abs(C[p, j]), p
            else:
                for q in range(r):
                    if abs(C[p, q]) > largest:
                        largest, i, j = abs(C[p, q]), p, q
        if turn >= r and largest <= 1.1:
            break
        pivot = C[i, j]
        row = C[i].copy()
        row[j] -= 1.0
        for p in range(m):
            f = C[p, j] / pivot
            if f != 0.0:
                for q in range(r):
                    C[p, q] -= f * row[q]
        rows[j] = i
    for p in range(m):
        for q in range(r):
            C[p, q] *= of_row[rows[q]] / of_row[p]
    return r


@kernel(types.void(PACKED, F1, F2, types.boolean, F2), reordered=True)
def draw(packed: Any, right: Array, share: Array, flat: bool, out: Array) -> None:
    """Draw grid positions by conditional sampling, one axis after the other; negative values count as zero.

    Args:
        packed: a train.
        right: its cores times the sums over all axes to the right (a, N), one after the other.
        share: uniform numbers (n, P).
        flat: each conditional law is drawn in proportion to its square root.
        out: receives positions in units of the spacing (n, P), the probability of the cell, and that of having been drawn by the
            square roots: (n + 2, P).
    """
    ranks, sizes, offsets, cores = packed
    n, count = share.shape
    width, longest = 1, 1
    for k in range(n):
        width, longest = max(width, ranks[k + 1]), max(longest, sizes[k])
    v, next_v, sums = np.empty(width), np.empty(width), np.empty((n, 2))
    laws, roots = np.empty((n, longest)), np.empty((n, longest))
    for p in range(count):
        v[0] = 1.0
        likely, drawn, at_right = 1.0, 1.0, 0
        for k in range(n):
            a, b, N = ranks[k], ranks[k + 1], sizes[k]
            w, root = laws[k], roots[k]
            if p == 0 or k > 0:  # the law on the first axis is that of all draws
                total, root_total = 0.0, 0.0
                w[:N] = 0.0
                for q in range(a):
                    factor, row = v[q], right[at_right + q * N : at_right + (q + 1) * N]
                    for i in range(N):
                        w[i] += factor * row[i]
                for i in range(N):
                    w[i] = max(w[i], 0.0)
                    root[i] = math.sqrt(w[i])
                for i in range(N):
                    total += w[i]
                    root_total += root[i]
                sums[k, 0], sums[k, 1] = total, root_total
            total, root_total = sums[k]
            at_right += N * a
            chosen, chosen_total = (root, root_total) if flat else (w, total)
            u, j, before = share[k, p] * chosen_total, 0, 0.0
            while j < N - 1 and before + chosen[j] < u:
                before += chosen[j]
                j += 1
            out[k, p] = j + min(max((u - before) / (chosen[j] + 1e-300), 0.0), 1.0) - 0.5
            likely *= w[j] / (total + 1e-300)
            drawn *= root[j] / (root_total + 1e-300)
            next_v[:b] = 0.0
            for s in range(a):
                base, factor = offsets[k] + (j * a + s) * b, v[s]
                row = cores[base : base + b]
                for q in range(b):
                    next_v[q] += factor * row[q]
            top = 0.0
            for q in range(b):
                top = max(top, abs(next_v[q]))
            for q in range(b):
                v[q] = next_v[q] / (top + 1e-300)
        out[n, p] = likely
        out[n + 1, p] = drawn


@kernel(types.void(PACKED, types.int64[:, ::1], F1), reordered=True)
def values_on_grid(packed: Any, index: Array, out: Array) -> None:
    """Write the values of a train at grid indices (P, n)."""
    ranks, sizes, offsets, cores = packed
    count, n = index.shape
    width = 1
    for k in range(n + 1):
        width = max(width, ranks[k])
    v, next_v = np.empty(width), np.empty(width)
    for p in range(count):
        v[0] = 1.0
        for k in range(n):
            a, b = ranks[k], ranks[k + 1]
            base = offsets[k] + index[p, k] * a * b
            next_v[:b] = 0.0
            for s in range(a):
                factor, row = v[s], cores[base + s * b : base + (s + 1) * b]
                for q in range(b):
                    next_v[q] += factor * row[q]
            for q in range(b):
                v[q] = next_v[q]
        out[p] = v[0]
