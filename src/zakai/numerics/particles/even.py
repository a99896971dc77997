"""Normal numbers that fill their space evenly over particles whose states are in order along a curve.

The particles of an island are numbered along Hilbert's curve through their states, in whitened coordinates.  Particle j takes
the point j of Sobol's sequence under a digital shift, so that the pairs of state and noise fill their space evenly (array-RQMC).
Each number alone is uniform, and islands have independent shifts: means and evidence are as unbiased as with independent numbers.

References:
    L'Ecuyer, Lecot and Tuffin 2008, A randomized quasi-Monte Carlo simulation method for Markov chains.
    Gerber and Chopin 2015, Sequential quasi Monte Carlo (Hilbert's curve).
    Skilling 2004, Programming the Hilbert curve; Joe and Kuo 2008, Constructing Sobol sequences (the initial numbers).
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import types

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.formula_kernel import BLOCK
from zakai.numerics.particles.formulas import F2
from zakai.numerics.particles.noise import root_of
from zakai.numerics.particles.random import KEY, fill_row, hashed, write_quantiles

Array = Any
# Primitive polynomials, as bits, and the initial numbers of the coordinates after the first one.
_SOBOL = (
    (3, 1), (7, 1, 3), (11, 1, 3, 1), (13, 1, 1, 1), (19, 1, 1, 3, 3), (25, 1, 3, 5, 13), (37, 1, 1, 5, 5, 17),
    (41, 1, 1, 5, 5, 5), (47, 1, 1, 7, 11, 19), (55, 1, 1, 5, 1, 1), (59, 1, 1, 1, 3, 11), (61, 1, 3, 5, 5, 31),
    (67, 1, 3, 3, 9, 7, 49), (91, 1, 1, 1, 15, 21, 21), (97, 1, 3, 1, 13, 27, 49),
)  # fmt: skip
_BITS = 32
_SHIFT = np.uint64(1 << 61)  # counters from here on are those of shifts
_KEY_BITS, _AXES = 16, 8  # of a place on the curve, and coordinates that it runs through


class Even(NamedTuple):
    """The key of the shifts, the numbers of particles within their islands (N,), the ends of these (R + 1,), and directions."""

    key: Array
    rank: Array
    bounds: Array
    directions: Array


EVEN = types.NamedTuple((KEY, types.int32[::1], types.int64[::1], types.uint32[:, ::1]), Even)


@cache
def directions() -> Array:
    """Return the direction numbers (coordinates, 32) of Sobol's sequence."""
    rows = [[1 << (_BITS - 1 - k) for k in range(_BITS)]]
    for polynomial, *first in _SOBOL:
        degree = len(first)
        row = [number << (_BITS - 1 - k) for k, number in enumerate(first)]
        for k in range(degree, _BITS):
            number = row[k - degree] ^ (row[k - degree] >> degree)
            for i in range(1, degree):
                if polynomial >> (degree - i) & 1:
                    number ^= row[k - i]
            row.append(number)
        rows.append(row)
    return np.array(rows, np.uint32)


@helper
def _flip(bits: Array, numbers: Array, level: int, direction: int, size: int) -> None:
    """Invert the bits that `direction` names where the bit `level` of a number is set."""
    for i in range(size):
        bits[i] ^= direction & -((numbers[i] >> level) & 1)


@helper
def fill_even(even: Any, first: int, size: int, out: Array) -> None:
    """Write rows (d, size) of standard normal numbers for the particles from `first` on; rows past the last are independent."""
    key, rank, bounds, known = even
    p, bits, own = np.empty(size), np.empty(size, np.int64), np.empty(size, np.int64)
    for c in range(size):
        own[c] = rank[first + c]
    begin, most = 0, 0
    for b in range(bounds.size - 1):
        begin = b if bounds[b] <= first else begin
        most = max(most, bounds[b + 1] - bounds[b])
    for j in range(out.shape[0]):
        if j >= known.shape[0]:
            fill_row(key, j, first, size, out[j])
            continue
        i, island = 0, begin
        while i < size:
            stop = min(size, bounds[island + 1] - first)
            shift = np.int64(hashed(key, _SHIFT + (np.uint64(j) << np.uint64(32)) + np.uint64(island)) >> np.uint64(32))
            for c in range(i, stop):
                bits[c] = shift
            i, island = max(i, stop), island + 1
        level = 0
        while most >> level:
            _flip(bits, own, level, int(known[j, level]), size)
            level += 1
        for c in range(size):
            p[c] = (float(bits[c]) + 0.5) * 2.0**-32
        write_quantiles(p, size, out[j])


@kernel(types.void(EVEN, types.int64, types.int64, F2))
def even_normals(even: Any, low: int, high: int, out: Array) -> None:
    """Write the columns from `low` to `high` of standard normal numbers (d, N)."""
    for first in range(low, high, BLOCK):
        size = min(BLOCK, high - first)
        fill_even(even, first, size, out[:, first : first + size])


@helper
def _reflect(first: Array, other: Array, bit: int, low: int, size: int) -> None:
    """Invert the low bits of the first numbers where a bit of the others is set, and exchange those of both elsewhere."""
    for i in range(size):
        a, b = first[i], other[i]
        chosen = -((b >> bit) & 1)
        swap = (a ^ b) & low & ~chosen
        other[i] = b ^ swap
        first[i] = a ^ (swap | (low & chosen))


@kernel(types.void(F2, F2, types.uint16[::1]))
def curve_places(deviations: Array, cov: Array, out: Array) -> None:
    """Write the places (N,) along Hilbert's curve of states with these deviations (n, N) from their mean, and this covariance."""
    n, count = deviations.shape
    R, pivots = np.empty((n, n)), np.empty(n, np.int64)
    axes = min(root_of(cov, R, pivots), _AXES)
    if axes == 0:
        out[:] = 0
        return
    bits = _KEY_BITS // axes
    top, y, X = np.int32(1) << np.int32(bits - 1), np.empty((axes, BLOCK)), np.empty((axes, BLOCK), np.int32)
    turn, place = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int32)
    for first in range(0, count, BLOCK):
        size = min(BLOCK, count - first)
        for a in range(axes):
            for i in range(size):
                y[a, i] = deviations[pivots[a], first + i]
            for b in range(a):
                factor = R[pivots[a], b]
                for i in range(size):
                    y[a, i] -= factor * y[b, i]
            for i in range(size):
                y[a, i] /= R[pivots[a], a]
        for a in range(axes):
            for i in range(size):
                v = y[a, i]
                X[a, i] = np.int32(min(max(top * (1.0 + v / np.sqrt(1.5 + v * v)), 0.0), 2.0 * top - 1.0))
        for bit in range(bits - 1, 0, -1):
            low = (1 << bit) - 1
            for a in range(axes):
                _reflect(X[0], X[a], bit, low, size)
        for a in range(1, axes):
            for i in range(size):
                X[a, i] ^= X[a - 1, i]
        for i in range(size):
            turn[i] = place[i] = 0
        for bit in range(bits - 1, 0, -1):
            low = (1 << bit) - 1
            for i in range(size):
                turn[i] ^= low & -((X[axes - 1, i] >> bit) & 1)
        for bit in range(bits - 1, -1, -1):
            for a in range(axes):
                for i in range(size):
                    place[i] = 2 * place[i] + (((X[a, i] ^ turn[i]) >> bit) & 1)
        for i in range(size):
            out[first + i] = place[i]
