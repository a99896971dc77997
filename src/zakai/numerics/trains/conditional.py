"""Draws from a train times a product of Gaussians along its axes: a state before noise, given the state after it.

    p(z | z + e = y) ~ u(z) prod_k N(y_k - z_k; 0, D_k),      e ~ N(0, D) with a diagonal D

The Gaussians have rank one, so that the product is a train with the ranks of u.  An axis is summed over equally spaced nodes with
an offset that is drawn: of all offsets together that is the continuous law, up to the error of the trapezoidal rule.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import types

from zakai.numerics.compiled import kernel
from zakai.numerics.particles.formulas import F1, F2
from zakai.numerics.trains.grid import PAD, taps
from zakai.numerics.trains.kernels import TRAIN
from zakai.numerics.trains.train import Train

Array = Any
REACH = 6.0  # deviations of a Gaussian beyond which it is left out
SPACING = 0.5  # deviations of a Gaussian between nodes: an error of exp(-2 pi^2 / SPACING^2)
NONE = 1e-9  # spacings, below which a deviation is no noise
ROUND = 2 * math.pi  # deviation on a circle, above which the wrapped Gaussian is uniform to 3e-9


@kernel(types.void(TRAIN, types.boolean[::1], F1, F2, F2, types.int64, F2), reordered=True)
def draw_before(train: Any, closed: Array, deviations: Array, y: Array, share: Array, most: int, out: Array) -> None:
    """Write draws of z given y, their means, and whether there are any: (2 n + 1, P).

    From the last axis to the first the sums over the axes to the right, R_k = sum_i g_i C_k(z_i) R_(k+1); then from the first
    axis to the last a node in proportion to v g_i C_k(z_i) R_(k+1), with what was drawn on the axes before it in v.  With the
    sums over these axes instead that gives the means.

    Args:
        train: u.
        closed: which axes go once around a circle (n,).
        deviations: roots of D (n,); infinite for no factor.
        y: the coordinates after the noise (n, P).
        share: uniform numbers: for the nodes (n, P), below them for the offsets (n, P).
        most: the largest number of nodes.
        out: receives the draws (n, P), their means given y (n, P), and one, zero where the density is not positive (P,).
    """
    low, step, sizes, ranks, offsets, flat = train[2], train[3], train[4], train[6], train[7], train[8]
    n, count = low.size, y.shape[1]
    width, longest = 1, 1
    for k in range(n):
        width, longest = max(width, ranks[k + 1]), max(longest, sizes[k] + 2 * PAD)
    weights, rows = np.empty((n, most)), np.empty((n, most, width))
    origin, spacing, nodes = np.empty(n), np.empty(n), np.empty(n, np.int64)
    carried, right, before = np.empty((longest, width)), np.empty(width), np.empty(width)
    v, left = np.empty(width), np.empty(width)
    w, summed, ends = np.empty(6), np.empty((n, longest)), np.empty((n, 2), np.int64)
    for p in range(count):
        right[0], exists = 1.0, True
        for k in range(n - 1, -1, -1):
            a, b, long = ranks[k], ranks[k + 1], sizes[k] + 2 * PAD
            deviation = deviations[k]
            first, last = low[k] - 2.9 * step[k], low[k] + (sizes[k] + 1.9) * step[k]
            if closed[k]:
                first, last = y[k, p] - REACH * deviation, y[k, p] + REACH * deviation
            if deviation <= NONE * step[k]:
                origin[k], spacing[k], nodes[k] = y[k, p], 0.0, 1
            else:
                h = min(step[k], SPACING * deviation)
                first, last = max(first, y[k, p] - REACH * deviation), min(last, y[k, p] + REACH * deviation)
                start = first if math.isinf(deviation) else y[k, p]
                i = math.ceil((first - start) / h - share[n + k, p])
                origin[k], spacing[k] = start + (share[n + k, p] + i) * h, h
                nodes[k] = min(max(int(math.floor((last - origin[k]) / h)) + 1, 0), most)
            # The coefficients that the nodes use times the sum to the right, and the sums of their splines.
            lowest, highest = 0, long - 1
            if not closed[k] and nodes[k] > 0:
                lowest = max(int(math.floor((origin[k] - low[k]) / step[k])) - 2 + PAD, 0)
                highest = min(int(math.floor((origin[k] + (nodes[k] - 1) * spacing[k] - low[k]) / step[k])) + 3 + PAD, long - 1)
            for j in range(lowest, highest + 1):
                summed[k, j] = 0.0
                for i in range(a):
                    base, t = offsets[k] + (j * a + i) * b, 0.0
                    core = flat[base : base + b]
                    for q in range(b):
                        t += right[q] * core[q]
                    carried[j, i] = t
            ends[k, 0], ends[k, 1] = lowest, highest
            top = 0.0
            for i in range(a):
                before[i] = 0.0
            for node in range(nodes[k]):
                z = origin[k] + node * spacing[k]
                s = (z - low[k]) / step[k]
                if closed[k]:
                    s -= sizes[k] * math.floor(s / sizes[k])
                row = rows[k, node]
                for i in range(a):
                    row[i] = 0.0
                weights[k, node] = 0.0
                if not closed[k] and (s <= -2.9 or s >= sizes[k] + 1.9):
                    continue
                apart = (y[k, p] - z) / deviation if spacing[k] > 0.0 else 0.0
                g = math.exp(-0.5 * apart * apart)
                weights[k, node] = g
                j = int(math.floor(s))
                taps(s - j, w)
                for d in range(6):
                    tap, one = g * w[d], carried[j - 2 + PAD + d]
                    summed[k, j - 2 + PAD + d] += tap
                    for i in range(a):
                        row[i] += tap * one[i]
                for i in range(a):
                    before[i] += row[i]
            for i in range(a):
                right[i] = before[i]
                top = max(top, abs(before[i]))
            if not top > 0.0:
                exists = False
                break
            for i in range(a):  # what is drawn does not depend on the scale
                right[i] /= top
        out[2 * n, p] = 0.0
        if not (exists and right[0] > 0.0):
            continue
        v[0] = left[0] = out[2 * n, p] = 1.0
        for k in range(n):
            a, b = ranks[k], ranks[k + 1]
            total = mass = moment = 0.0
            for node in range(nodes[k]):
                t = u = 0.0
                row = rows[k, node]
                for i in range(a):
                    t += v[i] * row[i]
                    u += left[i] * row[i]
                t, u = max(t, 0.0), max(u, 0.0)
                weights[k, node] = t
                total += t
                mass += u
                moment += u * node
            out[n + k, p] = origin[k] + spacing[k] * moment / (mass + 1e-300)
            rest, chosen = share[k, p] * total, 0
            while chosen < nodes[k] - 1 and rest > weights[k, chosen]:
                rest -= weights[k, chosen]
                chosen += 1
            out[k, p] = origin[k] + chosen * spacing[k]
            if not total > 0.0:
                out[2 * n, p] = 0.0
            s = (out[k, p] - low[k]) / step[k]
            if closed[k]:
                s -= sizes[k] * math.floor(s / sizes[k])
            j, top = int(math.floor(s)), 0.0
            taps(s - j, w)
            right[:b] = 0.0
            for d in range(6):
                for i in range(a):
                    base, factor = offsets[k] + ((j - 2 + PAD + d) * a + i) * b, w[d] * v[i]
                    core = flat[base : base + b]
                    for q in range(b):
                        right[q] += factor * core[q]
            for q in range(b):
                top = max(top, abs(right[q]))
            for q in range(b):
                v[q] = right[q] / (top + 1e-300)
            top = 0.0
            right[:b] = 0.0
            for j in range(ends[k, 0], ends[k, 1] + 1):
                if summed[k, j] != 0.0:
                    for i in range(a):
                        base, factor = offsets[k] + (j * a + i) * b, summed[k, j] * left[i]
                        core = flat[base : base + b]
                        for q in range(b):
                            right[q] += factor * core[q]
            for q in range(b):
                top = max(top, abs(right[q]))
            for q in range(b):
                left[q] = right[q] / (top + 1e-300)


class Drawn(NamedTuple):
    """Draws z (n, P), their means given y (n, P), and for which there is a density (P,)."""

    z: Array
    means: Array
    exists: Array


def drawn_before(u: Train, variances: Array, y: Array, share: Array) -> Drawn:
    """Return draws of z given z + noise = y.

    Args:
        u: the density of z, in the frame.
        variances: of the noise (n,), zero where there is none, infinite where y says nothing.
        y: coordinates in the frame (n, P).
        share: uniform numbers (2 n, P).
    """
    grid, (n, count) = u.grid, y.shape
    deviations: Array = np.sqrt(np.maximum(variances, 0.0))
    deviations = np.where(grid.closed, np.minimum(deviations, ROUND), deviations)
    spacing = np.minimum(grid.step, SPACING * np.maximum(deviations, NONE * grid.step))
    reach: Array = 2 * REACH * deviations
    reach = np.where(grid.closed, reach, np.minimum(reach, (grid.sizes + 5) * grid.step))
    out = np.zeros((2 * n + 1, count))
    most = int(np.max(reach / spacing)) + 3
    draw_before(u.arrays, grid.closed, deviations, np.ascontiguousarray(y), np.ascontiguousarray(share), most, out)
    return Drawn(out[:n], out[n : 2 * n], out[2 * n] > 0.0)
