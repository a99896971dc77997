"""Products and inverses of small matrices for compiled kernels: loops, which cost less there than a call of a library."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.numerics.compiled import helper
from zakai.numerics.transition import Array


@helper
def dot(left: Array, right: Array) -> Any:  # pragma: no cover
    """Return the scalar product of two vectors, without conjugation."""
    total = left[0] * right[0]
    for i in range(1, len(left)):
        total += left[i] * right[i]
    return total


@helper
def assign(out: Array, matrix: Array) -> None:  # pragma: no cover
    """Set `out` to a matrix of its shape; a slice would take twenty times as long to compile."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = matrix[i, j]


@helper
def multiply(out: Array, left: Array, right: Array) -> None:  # pragma: no cover
    """Set `out` (n, p) to left right."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            total = left[i, 0] * right[0, j]
            for a in range(1, len(right)):
                total += left[i, a] * right[a, j]
            out[i, j] = total


@helper
def symmetrise(out: Array, matrix: Array) -> None:  # pragma: no cover
    """Set `out` (n, n) to the symmetric part of a matrix, which may be larger."""
    for i in range(len(out)):
        for j in range(i + 1):
            out[i, j] = out[j, i] = 0.5 * (matrix[i, j] + matrix[j, i])


@helper
def congruence(out: Array, matrix: Array, cov: Array, product: Array) -> None:  # pragma: no cover
    """Set `out`, which may be `cov`, to matrix cov matrix'; `product` (n, n) is overwritten."""
    multiply(product, matrix, cov)
    for i in range(len(cov)):
        for j in range(i + 1):
            out[i, j] = out[j, i] = dot(product[i], matrix[j])


@helper
def one_plus(out: Array, left: Array, right: Array) -> None:  # pragma: no cover
    """Set `out` (n, n) to I + left right."""
    multiply(out, left, right)
    for i in range(len(out)):
        out[i, i] += 1.0


@helper
def solve(left: Array, right: Array) -> Any:  # pragma: no cover
    """Set `right` (n, c) to left^-1 right, and return log |det left|; `left` (n, n) is overwritten."""
    n, width = right.shape
    total = 0.0 * left[0, 0]
    for i in range(n):
        pivot = i
        for j in range(i + 1, n):
            if abs(left[j, i]) > abs(left[pivot, i]):
                pivot = j
        for j in range(n):
            left[i, j], left[pivot, j] = left[pivot, j], left[i, j]
        for j in range(width):
            right[i, j], right[pivot, j] = right[pivot, j], right[i, j]
        total += np.log(-left[i, i] if left[i, i].real < 0.0 else left[i, i])
        for j in range(n):
            if j != i:
                factor = left[j, i] / left[i, i]
                for a in range(i, n):
                    left[j, a] -= factor * left[i, a]
                for a in range(width):
                    right[j, a] -= factor * right[i, a]
    for i in range(n):
        for j in range(width):
            right[i, j] /= left[i, i]
    return total
