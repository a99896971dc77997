"""Functions that keep derivatives by the complex step.

    f'(a) = Im f(a + i h) / h,   h = 1e-150,

is exact to rounding for an analytic f (Squire and Trapp 1998), so that a filter that receives complex parameters returns the
derivative of its log-likelihood in the imaginary part.  NumPy's arithmetic, `exp`, `log`, `sqrt`, `sin`, `inv`, `solve` and
matrix products are analytic.  What is not (comparisons, absolute values, factorizations that conjugate) is here, correct to first
order in the imaginary part.  All functions return real arrays for real arguments.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

STEP = 1e-150
Array = NDArray[Any]


def is_complex(*arrays: Any) -> bool:
    """Return whether any argument carries a derivative."""
    for array in arrays:
        if array.dtype.kind == "c" if isinstance(array, np.ndarray) else np.iscomplexobj(array):
            return True
    return False


def absolute(values: Any) -> Array:
    """Return |values| with the sign of the real part, so that the derivative is kept."""
    values = np.asarray(values)
    return np.where(values.real < 0, -values, values) if is_complex(values) else np.abs(values)


def angle(sine: Any, cosine: Any) -> Array:
    """Return the angle of (cosine, sine) in (-pi, pi]."""
    found = np.arctan2(np.real(sine), np.real(cosine))
    if not is_complex(sine, cosine):
        return np.asarray(found)
    turn = np.imag(sine) * np.real(cosine) - np.imag(cosine) * np.real(sine)
    return np.asarray(found + 1j * (turn / (np.real(sine) ** 2 + np.real(cosine) ** 2)))


def real_product(matrix: Array, values: Array) -> Array:
    """Return the product of a real matrix (J, N) with values (N, ...), complex or not.

    NumPy makes the matrix complex first, which takes tens of times longer than the product.
    """
    if not is_complex(values) or is_complex(matrix):
        return np.asarray(matrix @ values)
    pairs = np.ascontiguousarray(values, complex).view(float).reshape(len(values), -1)
    return (matrix @ pairs).view(complex).reshape(len(matrix), *values.shape[1:])


def log_sum_exp(logs: Any, axis: int = -1) -> Array:
    """Return log sum_i exp(logs_i) along an axis; -inf for an empty sum."""
    logs = np.asarray(logs)
    top = np.max(logs.real, axis=axis, keepdims=True, initial=-np.inf)
    top = np.where(np.isfinite(top), top, 0.0)
    total = np.sum(np.exp(logs - top), axis=axis)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(total) + np.squeeze(top, axis=axis))


def log_determinant(matrices: Any) -> Array:
    """Return log |det| of matrices (..., n, n): d log det A = tr A^-1 dA."""
    matrices = np.asarray(matrices)
    if not is_complex(matrices):
        return np.asarray(np.linalg.slogdet(matrices)[1])
    real = matrices.real
    change = np.trace(np.linalg.solve(real, matrices.imag), axis1=-2, axis2=-1)
    return np.asarray(np.linalg.slogdet(real)[1] + 1j * change)


def cholesky(matrices: Any) -> Array:
    """Return the lower Cholesky factor of symmetric matrices (..., n, n): dF = F tril(F^-1 dA F^-T), its diagonal halved."""
    matrices = np.asarray(matrices)
    if not is_complex(matrices):
        return np.linalg.cholesky(matrices)
    factor = np.linalg.cholesky(matrices.real)
    inner = np.linalg.solve(factor, np.swapaxes(np.linalg.solve(factor, matrices.imag), -1, -2))
    lower = np.tril(inner)
    lower[..., range(inner.shape[-1]), range(inner.shape[-1])] *= 0.5
    return factor + 1j * (factor @ lower)
