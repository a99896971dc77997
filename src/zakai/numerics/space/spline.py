"""Values of a density between the points of its grid: those of the quintic spline.

Its error for a Gaussian of s spacings is about 5e-4 / s^6.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.compiled import kernel
from zakai.numerics.complex_step import is_complex
from zakai.numerics.space.grid import Grid, filtered

Array = NDArray[Any]
BLOCK = 5  # points of a block along each axis, of which the six taps of a spline reach two at most
TOGETHER = 64  # points whose weights are found together
PAD = 3  # zeros, or the other end of a circle, around the coefficients of a spline


@kernel(
    "void(float64[::1], int64[::1], boolean[::1], float64, float64[:, ::1], float64[::1])",
    "void(complex128[::1], int64[::1], boolean[::1], float64, complex128[:, ::1], complex128[::1])",
)
def _gather(values: Any, sizes: Any, closed: Any, least: Any, z: Any, out: Any) -> None:
    """out_j = sum over the taps of coefficients times quintic B-splines at indices z (n, J).

    Outside it is zero, and where all coefficients are below `least`.
    """
    n, count = z.shape
    padded = sizes + 2 * PAD
    strides = np.ones(n, np.int64)
    for d in range(n - 2, -1, -1):
        strides[d] = strides[d + 1] * padded[d + 1]
    last = sizes[n - 1]
    c = np.zeros(strides[0] * padded[0], z.dtype)
    for line in range(c.size // padded[n - 1]):
        # The source of a padded line: zeros, or the other end of a circle, surround the coefficients.
        rest, source, scale, inside = line, 0, last, True
        for d in range(n - 2, -1, -1):
            i = rest % padded[d] - PAD
            rest //= padded[d]
            if closed[d]:
                i = i % sizes[d]
            inside = inside and 0 <= i < sizes[d]
            source += i * scale
            scale *= sizes[d]
        first = line * padded[n - 1] + PAD
        if inside:
            for i in range(last):
                c[first + i] = values[source + i]
            if closed[n - 1]:
                for i in range(PAD):
                    c[first - 1 - i] = values[source + last - 1 - i]
                    c[first + last + i] = values[source + i]
    # The largest coefficient of each block.
    blocks = (padded + BLOCK - 1) // BLOCK if least > 0.0 else 0 * padded
    steps = np.ones(n, np.int64)
    for d in range(n - 2, -1, -1):
        steps[d] = steps[d + 1] * blocks[d + 1]
    largest = np.zeros(steps[0] * blocks[0])
    for line in range(c.size // padded[n - 1] if least > 0.0 else 0):
        rest, block = line, 0
        for d in range(n - 2, -1, -1):
            block += rest % padded[d] // BLOCK * steps[d]
            rest //= padded[d]
        first = line * padded[n - 1]
        for i in range(padded[n - 1]):
            at = block + i // BLOCK
            largest[at] = max(largest[at], abs(c[first + i].real))
    # The taps along all axes but the last, as distances in memory; unsigned indices are not checked for negative ones.
    outer = 6 ** (n - 1)
    offsets, weights = np.zeros(outer, np.uint64), np.zeros(outer, z.dtype)
    one, two, three, four, five = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4), np.uint64(5)
    for i in range(outer):
        rest, offset = i, 0
        for d in range(n - 2, -1, -1):
            offset += rest % 6 * strides[d]
            rest //= 6
        offsets[i] = np.uint64(offset)
    w, firsts, blocks_at = np.zeros(n * 6 * TOGETHER, z.dtype), np.zeros(n, np.int64), np.zeros(2**n, np.int64)
    for j in range(count):
        k = j % TOGETHER
        if k == 0:
            for d in range(n):
                at, rows = z[d, j : j + TOGETHER], w[6 * TOGETHER * d : 6 * TOGETHER * (d + 1)]
                for i in range(at.size):
                    t = at[i] - np.floor(at[i].real)
                    s = 1.0 - t
                    t2 = t * t
                    s2 = s * s
                    rows[i] = s2 * s2 * s
                    rows[TOGETHER + i] = 26.0 + t * (-50.0 + t * (20.0 + t * (20.0 + t * (-20.0 + 5.0 * t))))
                    rows[2 * TOGETHER + i] = 66.0 + t2 * (-60.0 + t2 * (30.0 - 10.0 * t))
                    rows[3 * TOGETHER + i] = 66.0 + s2 * (-60.0 + s2 * (30.0 - 10.0 * s))
                    rows[4 * TOGETHER + i] = 26.0 + s * (-50.0 + s * (20.0 + s * (20.0 + s * (-20.0 + 5.0 * s))))
                    rows[5 * TOGETHER + i] = t2 * t2 * t
        base, inside = 0, True
        for d in range(n):
            x = z[d, j].real
            if not (abs(x) < 1e8 and (closed[d] or -1.0 <= x < sizes[d])):
                inside = False
                break
            cell = int(np.floor(x))
            if closed[d]:
                cell = cell % sizes[d]
            firsts[d] = cell + (PAD - 2)
            base += firsts[d] * strides[d]
        if inside and least > 0.0:
            used, inside = 1, False
            blocks_at[0] = 0
            for d in range(n):
                low, high = firsts[d] // BLOCK, (firsts[d] + 5) // BLOCK
                for i in range(used):
                    blocks_at[used + i] = blocks_at[i] + high * steps[d]
                    blocks_at[i] += low * steps[d]
                used *= 2
            for i in range(used):
                inside = inside or largest[blocks_at[i]] >= least
        if not inside:
            out[j] = 0.0
            continue
        size = 1
        weights[0] = 120.0**-n
        for d in range(n - 1):
            for i in range(size - 1, -1, -1):
                for tap in range(5, -1, -1):
                    weights[6 * i + tap] = weights[i] * w[(6 * d + tap) * TOGETHER + k]
            size *= 6
        last_weights = w[6 * TOGETHER * (n - 1) + k :]
        w0, w1, w2 = last_weights[0], last_weights[TOGETHER], last_weights[2 * TOGETHER]
        w3, w4, w5 = last_weights[3 * TOGETHER], last_weights[4 * TOGETHER], last_weights[5 * TOGETHER]
        total = 0.0 * w0
        for i in range(outer):
            o = np.uint64(base) + offsets[i]
            row = c[o] * w0 + c[o + one] * w1 + c[o + two] * w2 + c[o + three] * w3 + c[o + four] * w4 + c[o + five] * w5
            total += weights[i] * row
        out[j] = total


def gather(coefficients: Array, z: Array, grid: Grid, least: float = 0.0) -> Array:
    """Return the spline with the coefficients (*sizes) at the indices z (J, n), counted from the first point of the grid.

    It is zero where all coefficients nearby are below `least`.
    """
    dtype = complex if is_complex(coefficients, z) else float
    out = np.empty(len(z), dtype)
    c, at = np.ascontiguousarray(coefficients, dtype).reshape(-1), np.ascontiguousarray(z.T, dtype)
    _gather(c, grid.shape, grid.circles, least, at, out)
    return out


@kernel(
    "void(int64[::1], float64[:, ::1], float64[::1], float64[:, ::1], float64[::1], boolean[::1], float64[:, ::1],"
    " float64[:, ::1])",
    "void(int64[::1], float64[:, ::1], float64[::1], float64[:, ::1], float64[::1], boolean[::1], complex128[:, ::1],"
    " complex128[:, ::1])",
)
def _relative(
    sizes: Any, basis: Any, shift: Any, inverse: Any, first: Any, periodic: Any, moved: Any, z: Any
) -> None:  # fmt: skip
    """Write the indices z (n, J) in one grid of the points of another, moved by (k, J), k >= n or J = 0; angles are wrapped."""
    n, count = z.shape
    index = np.zeros(n)
    x = np.zeros(n, z.dtype)
    for j in range(count):
        rest = j
        for d in range(n - 1, -1, -1):
            index[d] = rest % sizes[d] - sizes[d] // 2
            rest //= sizes[d]
        for d in range(n):
            x[d] = shift[d] + (moved[d, j] if moved.shape[1] else 0.0)
            for e in range(n):
                x[d] += basis[d, e] * index[e]
            if periodic[d] and math.isfinite(x[d].real):
                x[d] -= 2 * math.pi * np.round(x[d].real / (2 * math.pi))
        for d in range(n):
            z[d, j] = first[d]
            for e in range(n):
                z[d, j] += inverse[d, e] * x[e]


def relative_index(new: Grid, grid: Grid, periodic: Sequence[bool] | None = None, moved: Array | None = None) -> Array:
    """Return the indices (J, n), counted from the first point of a grid, of the points of another; angles are wrapped.

    Args:
        new: the grid of the points.
        grid: the grid of the indices.
        periodic: which coordinates are angles (n,).
        moved: displacements that are added to the points, in its first columns (J, n + ...).
    """
    n, dtype = grid.n, complex if moved is not None and np.iscomplexobj(moved) else float
    z = np.empty((n, math.prod(new.sizes)), dtype)
    displacement = np.zeros((n, 0), dtype) if moved is None else np.ascontiguousarray(moved.T)
    _relative(
        new.shape, np.ascontiguousarray(new.basis), new.centre - grid.centre, np.ascontiguousarray(grid.inverse),
        (grid.shape // 2).astype(float), np.array(periodic or (False,) * n), displacement, z,
    )  # fmt: skip
    return z.T


def resampled(values: Array, grid: Grid, new: Grid, periodic: Sequence[bool] | None = None) -> Array:
    """Return the spline interpolant of a density at the points of another grid (*sizes)."""
    coefficients = filtered(values, np.zeros((grid.n, grid.n)), spline=True)
    return gather(coefficients, relative_index(new, grid, periodic), grid).reshape(new.sizes)
