"""Polynomials through the nearest eight values of a function on a uniform grid."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from zakai.numerics.line.window import Window

Array = NDArray[Any]

_STENCIL = np.arange(-3, 5)
_WEIGHTS = np.array([1.0 / np.prod([float(i - j) for j in _STENCIL if j != i]) for i in _STENCIL])


def local_polynomial(values: Array, window: Window, offsets: Array) -> Array:
    """Return the polynomial through the nearest eight values of any function at offsets (J,), constant beyond the grid."""
    at = (offsets - window.centre) / window.spacing + window.size // 2
    near = np.floor(at).astype(int)
    if not window.closed:
        at, near = np.clip(at, 0.0, window.size - 1.0), np.clip(near, 3, window.size - 5)
    distance = (at - near)[:, None] - _STENCIL
    exact = np.abs(distance) < 1e-9
    weights = np.where(exact.any(axis=1, keepdims=True), exact, _WEIGHTS / np.where(exact, 1.0, distance))
    own = values[(near[:, None] + _STENCIL) % window.size]
    return np.asarray(np.sum(weights * own, axis=1) / np.sum(weights, axis=1))
