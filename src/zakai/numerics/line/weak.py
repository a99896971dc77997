"""Functions with kinks on a uniform grid, in the weak sense.

Of a function F with a kink, sums over a grid of F times a smooth function are accurate to second order only, and operators that
contain F too.  With the values

    F_j = int psi(t) F(x_j + t spacing) dt,     psi = sum_k c_k B(t - k),     B the cubic B-spline,

c such that psi has the moments of a point mass up to degree 2 K + 1, they are as accurate as those of smooth functions are: the
spectrum of psi is zero where the grid folds frequencies.  Sums over nodes between the points stand for the integral.  The
difference to a rule of smaller K estimates the error.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import float64, int64, void
from numpy.typing import NDArray

from zakai.numerics.compiled import kernel
from zakai.numerics.line.density import moments
from zakai.numerics.line.terms import exponent_added

Array = NDArray[Any]
_V, _M = float64[::1], float64[:, ::1]

PARTS = 16  # nodes of a spacing
_WITHIN = 8  # places of which the mean is the value of a node
REACH = 5  # spacings on both sides of a point
WEAK_SHARE = 0.05  # of the tolerance that a sample may leave in the weak sense
_POSITIONS = (np.arange(2 * REACH * PARTS) + 0.5) / PARTS - REACH


def _rule(order: int, derivative: int) -> Array:
    """Return the weights of the nodes for K = `order`, of F or its derivative."""
    apart = _POSITIONS[:, None] - np.arange(-order, order + 1)
    near, far = (np.maximum(reach - np.abs(apart), 0.0) for reach in (1.0, 2.0))
    basis = (2.0 * near**2 - 0.5 * far**2) * np.sign(apart) if derivative else (far**3 - 4.0 * near**3) / 6.0
    degrees = np.arange(2 * order + 1) + derivative
    return np.asarray(basis @ np.linalg.solve((_POSITIONS[:, None] ** degrees).T @ basis, 1.0 * (degrees == derivative)))


_VALUES, _SLOPES, _OTHER = _rule(3, 0), _rule(3, 1), _rule(2, 0)


def nodes(points: Array, spacing: float) -> Array:
    """Return where `at_nodes` needs the values of a function on a grid (N,)."""
    count = (len(points) + 2 * REACH - 1) * PARTS + 2
    first = points[0] - spacing * (REACH + 1.0 / PARTS)
    return np.asarray(first + spacing / (PARTS * _WITHIN) * (np.arange(count * _WITHIN) + 0.5))


def at_nodes(values: Array) -> Array:
    """Return a function at the nodes (..., (N + 2 REACH - 1) PARTS): means, less what the curvature of a smooth one adds."""
    means = values.reshape(*values.shape[:-1], -1, _WITHIN).mean(axis=-1)
    curvature = means[..., 2:] - 2.0 * means[..., 1:-1] + means[..., :-2]
    return np.ascontiguousarray(means[..., 1:-1] - (1.0 - _WITHIN**-2) / 24.0 * curvature)


def weak(values: Array, spacing: float) -> tuple[Array, Array]:
    """Return a function and its derivative (N,) from values at the nodes."""
    windows = np.lib.stride_tricks.sliding_window_view(values, len(_POSITIONS))[::PARTS]
    return windows @ _VALUES, windows @ _SLOPES / spacing


@kernel(void(_M, int64, _M, _V, _V, _V, _V))
def weaken(fine: Array, start: int, precision: Array, observed: Array, centre: Array, b: Array, change: Array) -> None:
    """Replace log-likelihoods b (N,) of h at the points by those of its values at nodes.

    Args:
        fine: h at the nodes (m, F) of a longer grid.
        start: the first point.
        precision, observed: S^-1 and y.
        centre: the values of h of which b is zero.
        b: receives the logarithms.
        change: receives the relative difference of another rule.
    """
    m, size, length = fine.shape[0], b.size, (b.size + 2 * REACH - 1) * PARTS
    h, logs = np.empty((m, length)), np.zeros(length)
    for i in range(m):
        for f in range(length):
            h[i, f] = fine[i, start * PARTS + f]
    exponent_added(h, centre, precision, observed, 1.0, 1.0, logs)
    tops = np.empty(length // PARTS)
    for cell in range(tops.size):
        tops[cell] = -np.inf
        for f in range(cell * PARTS, (cell + 1) * PARTS):
            tops[cell] = max(tops[cell], logs[f])
        for f in range(cell * PARTS, (cell + 1) * PARTS):
            logs[f] = np.exp(logs[f] - tops[cell])
    for j in range(size):
        one, other, top = 0.0, 0.0, max(tops[j + REACH - 1], tops[j + REACH])
        for cell in range(2 * REACH):
            here, there = 0.0, 0.0
            for f in range(PARTS):
                here += _VALUES[cell * PARTS + f] * logs[(j + cell) * PARTS + f]
                there += _OTHER[cell * PARTS + f] * logs[(j + cell) * PARTS + f]
            scale = np.exp(min(tops[j + cell] - top, 600.0))
            one, other = one + scale * here, other + scale * there
        change[j] = 1.0
        if 0.0 < one < np.inf:
            b[j], change[j] = top + np.log(one), 1.0 - other / one


@kernel(float64(_V, _V))
def weak_error(now: Array, change: Array) -> float:
    """Return the change of mass, mean and variance, in deviations, by relative changes of a density."""
    mean, variance = moments(now)[1:]
    mass, first, second = 0.0, 0.0, 0.0
    for j in range(now.size):
        at, part = (j - now.size // 2 - mean) / np.sqrt(variance), now[j] * change[j]
        mass, first, second = mass + part, first + part * at, second + part * (at * at - 1.0)
    return abs(mass) + abs(first) + abs(second)
