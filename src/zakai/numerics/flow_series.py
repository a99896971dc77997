"""Transitions of short panels, on which the coefficients are polynomials in time, as power series about the middle.

The characteristics of `zakai.numerics.transition` are a linear system whose generator is sum_j A_j tau^j, tau in [-1, 1]:

    (i + 1) Y_{i+1} = sum_j A_j Y_{i-j},     P = Y(1) Y(-1)^-1,

where the inverse is a transpose, since the system is Hamiltonian.  The series ends where its terms are negligible in every entry,
so that it does not depend on the units of the coordinates.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from zakai.numerics.complex_step import log_determinant
from zakai.numerics.flow_kernel import panels
from zakai.numerics.transition import Array, Coefficients, Transition, symmetric, transposed

STAGES = 8  # Gauss nodes of a panel: the coefficients are polynomials of degree 7 on it


def _gauss(stages: int) -> tuple[Array, Array, Array, Array]:
    """Return Gauss' nodes and weights on [-1, 1], and matrices from values to Legendre's polynomials and from these to powers."""
    nodes, weights = np.polynomial.legendre.leggauss(stages)
    legendre = np.polynomial.legendre.legvander(nodes, stages - 1)
    to_legendre = np.ascontiguousarray((legendre * weights[:, None]).T * (np.arange(stages) + 0.5)[:, None])
    to_powers = np.zeros((stages, stages))
    for degree in range(stages):
        to_powers[: degree + 1, degree] = np.polynomial.legendre.leg2poly(np.eye(stages)[degree])
    return nodes, weights, to_legendre, to_powers


NODES, WEIGHTS, _TO_LEGENDRE, _TO_POWERS = _gauss(STAGES)
_ONE = np.ones((1, 1))


def solve(c: Coefficients, lengths: Array) -> tuple[Transition, Array]:
    """Return the transitions of panels of `lengths` (J,), and where the series has too few terms (J,).

    The coefficients are those at Gauss' nodes (J STAGES, ...), or at one time (J, ...) where they are constant.
    """
    count, (n, k) = len(lengths), c.offset.shape[1:]
    size, rows, twice = STAGES if len(c.constant) > count else 1, 2 * n + k, 2 * n
    kind = np.result_type(*c)
    values = np.zeros((count * size, rows, rows), kind)
    values[:, :n, :n], values[:, n:twice, n:twice] = c.matrix, -transposed(c.matrix)
    values[:, :n, n:twice], values[:, n:twice, :n] = -2.0 * c.covariance, c.quadratic
    values[:, :n, twice:], values[:, n:twice, twice:] = c.offset, 0.5 * c.linear
    values[:, twice:, :n], values[:, twice:, n:twice] = 0.5 * transposed(c.linear), -transposed(c.offset)
    values = values.reshape(count, size, rows * rows)
    patterns = (values != 0.0).any(axis=1).reshape(count, rows, rows)[:, :twice, :twice]
    depths = np.array([_depth(pattern.tobytes(), twice) for pattern in patterns], int)
    ahead, back, coarse = np.empty((count, rows, rows), kind), np.empty((count, rows, rows), kind), np.empty(count, bool)
    polynomials = (_TO_LEGENDRE, _TO_POWERS) if size > 1 else (_ONE, _ONE)
    panels(values, np.ascontiguousarray(lengths), polynomials, twice, depths, (ahead, back), coarse)
    half, weights = 0.5 * lengths, WEIGHTS if size > 1 else np.full(1, 2.0)
    growth = half[:, None] * (weights @ c.constant.reshape(count, size, k))
    trace = 0.5 * half * (np.trace(c.matrix, axis1=1, axis2=2).reshape(count, size) * weights).sum(axis=1)
    return _transition(ahead, back, growth, trace), coarse


@lru_cache(maxsize=256)
def _depth(pattern: bytes, size: int) -> int:
    """Return the order at which the last entry of the exponential of a matrix with this pattern appears, at least."""
    linked = np.frombuffer(pattern, bool).reshape(size, size)
    reached, depth = linked, 1
    while True:
        further = reached | ((reached.astype(float) @ linked) > 0)
        if np.array_equal(further, reached):
            break
        reached, depth = further, depth + 1
    # States on no cycle: what passes through all of them in a row has as many factors.
    free = ~np.diagonal(reached)
    passed = linked[np.ix_(free, free)]
    while passed.any():
        passed, depth = (passed.astype(float) @ linked[np.ix_(free, free)]) > 0, depth + 1
    return depth


def _transition(ahead: Array, back: Array, growth: Array, trace: Array) -> Transition:
    """Return equation (2) from the characteristics [Y r; c s] at the ends and the beginnings of panels."""
    k = growth.shape[1]
    twice, n = ahead.shape[1] - k, (ahead.shape[1] - k) // 2
    # P = Y(1) Y(-1)^-1, where the inverse is a transpose; the functionals are integrals over the panel.
    inverse = np.empty((len(ahead), twice, twice), ahead.dtype)
    inverse[:, :n, :n], inverse[:, :n, n:] = transposed(back[:, n:twice, n:twice]), -transposed(back[:, :n, n:twice])
    inverse[:, n:, :n], inverse[:, n:, n:] = -transposed(back[:, n:twice, :n]), transposed(back[:, :n, :n])
    ahead[:, twice:] -= back[:, twice:]
    whole = ahead[:, :, :twice] @ inverse
    response = ahead[:, :, twice:] - whole @ back[:, :twice, twice:]
    inverse = np.linalg.inv(whole[:, n:twice, n:])
    noise = symmetric(-0.5 * whole[:, :n, n:] @ inverse)
    push = response[:, n:twice]
    offset = response[:, :n] + 2.0 * noise @ push
    constant = symmetric(transposed(push) @ offset + response[:, twice:])
    constant[:, 0] += 0.5 * growth
    constant[:, :, 0] += 0.5 * growth
    constant[:, 0, 0] += trace + 0.5 * log_determinant(inverse)
    information = symmetric(-2.0 * inverse @ whole[:, n:twice, :n])
    return Transition(transposed(inverse), offset, noise, information, 2.0 * inverse @ push, constant)
