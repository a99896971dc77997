"""Linear systems at the cost of products of matrices.

With many right-hand sides a triangular solve of LAPACK starts threads, and inside of a scan, on a processor that others use as
well, it then takes a hundred times as long as a product.  So from some size on the triangular factors are inverted by halves,

    [[A, 0], [B, C]]^-1 = [[A^-1, 0], [-C^-1 B A^-1, C^-1]],

which has the error bounds of substitution (Higham, Accuracy and Stability of Numerical Algorithms, section 14.2).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.kolmogorov.numpy_or_jax import numpy_or_jax

_BLOCK = 25  # up to this size substitution is the cheaper way, and no library starts a thread


def solve(matrix: Any, right: Any) -> tuple[Any, Any]:
    """(matrix^-1 right, log |det matrix|) from one factorisation; `matrix` (n, n), `right` (n, k)."""
    n = len(matrix)
    lu, _, permutation = jax.lax.linalg.lu(matrix)
    log_volume = jnp.sum(jnp.log(jnp.abs(jnp.diagonal(lu))))
    right = right[permutation]
    if n <= _BLOCK:
        half = jax.lax.linalg.triangular_solve(lu, right, left_side=True, lower=True, unit_diagonal=True)
        return jax.lax.linalg.triangular_solve(lu, half, left_side=True, lower=False), log_volume
    lower, upper = _inverses(jnp.stack([jnp.tril(lu, -1) + jnp.eye(n), jnp.triu(lu).T]))
    return upper.T @ (lower @ right), log_volume


def inverse(matrix: Any) -> Any:
    """matrix^-1 (n, n); NumPy for a NumPy matrix."""
    if numpy_or_jax(matrix) is np:
        return np.linalg.inv(matrix)
    return solve(matrix, jnp.eye(len(matrix)))[0]


def _inverses(lower: Any) -> Any:
    """The inverses of lower triangular matrices (k, n, n)."""
    k, n = lower.shape[:2]
    count = 1
    while count * _BLOCK < n:
        count *= 2
    size = -(-n // count)
    more = count * size - n
    whole = jnp.pad(lower, ((0, 0), (0, more), (0, more))) + jnp.diag(jnp.arange(n + more) >= n)
    identity = jnp.broadcast_to(jnp.eye(size), (k, count, size, size))
    found = jax.lax.linalg.triangular_solve(_diagonal(whole, size), identity, left_side=True, lower=True)
    while size < n:
        above, below = found[:, 0::2], found[:, 1::2]
        size *= 2
        between = _diagonal(whole, size)[..., size // 2 :, : size // 2]
        corner = -below @ between @ above
        found = jnp.block([[above, jnp.zeros_like(above)], [corner, below]])
    return found[:, 0, :n, :n]


def _diagonal(whole: Any, size: int) -> Any:
    """The blocks (k, count, size, size) on the diagonal."""
    k, n = whole.shape[:2]
    blocks = whole.reshape(k, n // size, size, n // size, size)
    return jnp.moveaxis(jnp.diagonal(blocks, axis1=1, axis2=3), -1, 1)
