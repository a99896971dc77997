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
    """Return the polynomials through the nearest eight values of functions (..., N) at offsets (J,), constant beyond the grid."""
    at = (offsets - window.centre) / window.spacing + window.size // 2
    weights, own = _nearest(values, window, at if window.closed else np.clip(at, 0.0, window.size - 1.0))
    return np.asarray(np.sum(weights * own, axis=-1))


def interpolated_logs(values: Array, window: Window, offsets: Array) -> Array:
    """Return the exponential of the polynomial through eight logarithms, zero where a value is zero or beyond the grid."""
    at = (offsets - window.centre) / window.spacing + window.size // 2
    weights, own = _nearest(values, window, at)
    with np.errstate(all="ignore"):
        found = np.exp(np.sum(weights * np.log(own), axis=1))
    inside = (own.real > 0).all(axis=1) & np.isfinite(found.real)
    if not window.closed:
        inside &= (at > -0.5) & (at < window.size - 0.5)
    return np.where(inside, found, 0.0)


def _nearest(values: Array, window: Window, at: Array) -> tuple[Array, Array]:
    """Return the weights (J, 8) and the values (..., J, 8) of the polynomials at indices of a grid (J,)."""
    near = np.floor(at)
    if not window.closed:
        near = np.clip(near, -_STENCIL[0], window.size - 1 - _STENCIL[-1])
    distance = (at - near)[:, None] - _STENCIL
    exact = np.abs(distance) < 1e-12
    weights = np.where(exact.any(axis=1, keepdims=True), exact, _WEIGHTS / np.where(exact, 1.0, distance))
    own = values[..., (near[:, None].astype(int) + _STENCIL) % window.size]
    return weights / np.sum(weights, axis=1, keepdims=True), own
