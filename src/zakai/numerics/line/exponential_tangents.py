"""Derivatives of exp(L) u, with L u = (G u)'' / 2 - (f u)' + V u, with respect to several parameters at once.

Taylor's series of the exponential is differentiated term by term:

    w_k = L w_k-1 / k,      dw_k = (L dw_k-1 + dL w_k-1) / k.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import float64, void
from numpy.typing import NDArray

from zakai.numerics.compiled import kernel
from zakai.numerics.complex_step import STEP
from zakai.numerics.line.fourier import FourierOperator, exponential_of
from zakai.numerics.line.operator import DENSE, PART, TERMS, derivatives
from zakai.numerics.line.window import Window

Array = NDArray[Any]
Coefficients = tuple[Any, Array, Array | None]  # G, one number or (N,), f (N,) and V (N,), or integrals over time of these

LONG = 8.0  # series of an operator with so large a norm take longer than its exponential by complex steps

_M = float64[:, ::1]


def exponential_tangents(
    window: Window, coefficients: Coefficients, changed: Sequence[Coefficients], values: Array, tangents: Array
) -> tuple[Array, Array]:
    """Return exp(L) u and its derivatives (p, N).

    Args:
        window: the grid.
        coefficients: those of L.
        changed: the same at p parameters with infinitesimal imaginary parts.
        values: u (N,).
        tangents: its derivatives (p, N).
    """
    matrix = window.generator(*coefficients)
    if isinstance(matrix, FourierOperator):
        return _by_complex_steps(window, changed, values, tangents)
    size, unit = window.size, 1.0 if window.closed else window.spacing
    shift = float(np.trace(matrix)) / size
    norm = float(np.abs(matrix - shift * np.eye(size)).sum(axis=0).max())
    if not np.isfinite(norm):
        return np.full_like(values, np.nan), np.full_like(tangents, np.nan)
    scales = 0.5 / unit**2, 1.0 / unit, 1.0
    if norm * DENSE > LONG * size**2:
        return _by_complex_steps(window, changed, values, tangents)
    rows = np.zeros((3, 1 + len(changed), size))  # of G, f and V: the values, and their derivatives
    for row, scale, *parts in zip(rows, scales, coefficients, *changed, strict=True):
        row[0] = 0.0 if parts[0] is None else scale * parts[0]
        row[1:] = [np.zeros(size) if one is None else scale * np.imag(one) / STEP * np.ones(size) for one in parts[1:]]
    rows[2, 0] -= shift
    found = np.concatenate([values[None], tangents])
    _taylor(np.concatenate(derivatives(size, window.closed)), *rows, found, shift, norm)
    return found[0], found[1:]


def _by_complex_steps(window: Window, changed: Sequence[Coefficients], values: Array, tangents: Array) -> tuple[Array, Array]:
    pairs = zip(changed, tangents, strict=True)
    after = np.array([exponential_of(window.generator(*one))(values + 1j * STEP * tangent)[0] for one, tangent in pairs])
    return after[0].real, after.imag / STEP


@kernel(void(_M, _M, _M, _M, _M, float64, float64))
def _taylor(matrices: Array, covariance: Array, drift: Array, potential: Array, rows: Array, shift: float, norm: float) -> None:
    """Replace a vector and its derivatives, the rows (1 + p, N), by those after the exponential.

    Args:
        matrices: those of the first derivative, antisymmetric, and of the second, symmetric (2 N, N).
        covariance, drift, potential: G / 2, f and V - shift in units of the spacing, and their derivatives (1 + p, N).
        rows: the vectors.
        shift: a number that is added to V.
        norm: a bound of the norm of the operator without it.
    """
    count, size = rows.shape
    parts = max(1, int(np.ceil(norm / PART)))
    factor = np.exp(shift / parts)
    products, largest = np.empty((count, 2 * size)), np.empty(count)
    for _ in range(parts):
        term = rows.copy()
        for i in range(count):
            largest[i] = np.max(np.abs(rows[i]))
        for k in range(1, TERMS):
            for i in range(count):
                for j in range(size):
                    products[i, j] = drift[0, j] * term[i, j]
                    products[i, size + j] = covariance[0, j] * term[i, j]
                    if i > 0:
                        products[i, j] += drift[i, j] * term[0, j]
                        products[i, size + j] += covariance[i, j] * term[0, j]
            moved = np.dot(products, matrices)
            scale, settled = 1.0 / (parts * k), True
            for i in range(count):
                change = 0.0
                for j in range(size):
                    found = moved[i, j] + potential[0, j] * term[i, j]
                    if i > 0:
                        found += potential[i, j] * term[0, j]
                    found *= scale
                    rows[i, j] += found
                    moved[i, j] = found
                    change = max(change, abs(found))
                settled = settled and change <= 1e-17 * largest[i]
            term = moved
            if settled:
                break
        rows *= factor
