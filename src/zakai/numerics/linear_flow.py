"""The flow of a linear stochastic system with constant coefficients over one interval of any length."""

from __future__ import annotations

import numpy as np

from zakai.numerics.transition import Array

_TERMS = 12  # of the series of an exponential of norm below 1/8
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)


def linear_flow(
    matrix: Array, change: Array, offset: Array, covariance: Array, length: float, clock: float
) -> tuple[Array, Array, Array]:
    """Return the flow of dx = (A x + a s + b) dt + dv, E dv dv' = G dt, where s runs from `clock` to `clock + length`.

    `matrix` A (n, n), `change` a (n,), `offset` b (n,), `covariance` G (n, n).  Gives (Phi, c, W): x moves to Phi x + c and
    gathers noise of covariance W, which is positive semidefinite by construction, also for singular G.
    """
    n = len(offset)
    # The state with its clock and a one: the forcing is part of the exponential.
    generator = np.zeros((n + 2, n + 2), np.result_type(matrix, change, offset))
    generator[:n, :n], generator[:n, n], generator[:n, n + 1], generator[n, n + 1] = matrix, change, offset, 1.0
    size = length * float(np.abs(matrix.real).sum(axis=1).max())
    if not np.isfinite(size):
        return np.full((n, n), np.nan), np.full(n, np.nan), np.full((n, n), np.nan)
    doublings = max(0, int(np.ceil(np.log2(max(8.0 * size, 1.0)))))
    tiny = length / 2**doublings
    whole = _exponential(tiny * generator)
    inner = _exponential((0.5 * tiny * (1.0 + _NODES))[:, None, None] * matrix)
    gathered = inner @ covariance @ np.swapaxes(inner, 1, 2)
    spread = 0.5 * tiny * np.tensordot(_WEIGHTS, gathered, 1)
    for _ in range(doublings):
        part = whole[:n, :n]
        spread = part @ spread @ part.T + spread
        whole = whole @ whole
    return whole[:n, :n], whole[:n, n] * clock + whole[:n, n + 1], spread


def _exponential(matrices: Array) -> Array:
    """Return the Taylor polynomial of the exponential, for matrices of norm below 1/8."""
    identity = np.eye(matrices.shape[-1])
    value = identity + matrices / _TERMS
    for order in range(_TERMS - 1, 0, -1):
        value = identity + matrices @ value / order
    return value
