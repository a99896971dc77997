"""Whether a covariance matrix is one, and its square root."""

from __future__ import annotations

import numpy as np

ROUNDING = 1e-12
_ENORMOUS = 1e100


def smallest_eigenvalue(matrices: np.ndarray) -> np.ndarray:
    """The smallest eigenvalue of each symmetric matrix in (..., n, n), scaled to a unit diagonal.

    The scaling makes the answer independent of units: diag(1e-20, 1e20) is as positive as the identity.
    """
    diagonal = np.diagonal(matrices, axis1=-2, axis2=-1)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    # Dividing twice, because a product of two scales can leave the range of a double.
    with np.errstate(over="ignore"):
        scaled = matrices / scale[..., :, None] / scale[..., None, :]
    # An infinite entry is a correlation far beyond one; a large finite one says the same, and has eigenvalues.
    return np.linalg.eigvalsh(np.clip(scaled, -_ENORMOUS, _ENORMOUS))[..., 0]


def is_symmetric(matrices: np.ndarray) -> np.ndarray:
    """Whether each matrix in (..., n, n) is symmetric up to rounding."""
    size = np.abs(matrices).max(axis=(-2, -1), initial=0.0)
    with np.errstate(over="ignore"):
        return np.abs(matrices - np.swapaxes(matrices, -2, -1)).max(axis=(-2, -1), initial=0.0) <= ROUNDING * size


def square_root(matrices: np.ndarray) -> np.ndarray:
    """A square root R with R R' = P of each semidefinite P in (..., n, n), singular ones included."""
    values, vectors = np.linalg.eigh(matrices)
    return vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
