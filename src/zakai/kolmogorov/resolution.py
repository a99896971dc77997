"""Whether a lattice of points resolves a density: what both spectral movers ask, and how they reach an axis."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from zakai import _float64  # noqa: F401


def along(matrix: Any, values: jax.Array, axis: int) -> jax.Array:
    """A matrix applied to one axis of an array."""
    if values.ndim == 1:
        return matrix @ values
    return jnp.moveaxis(jnp.tensordot(matrix, values, axes=([1], [axis])), 0, axis)


def edge_mass(values: jax.Array) -> jax.Array:
    """The share of the mass in the two outermost layers."""
    outer = jnp.zeros(())
    for d, size in enumerate(values.shape):
        for begin in (0, size - 2):
            outer = outer + jnp.sum(lax.slice_in_dim(values, begin, begin + 2, axis=d))
    return outer / jnp.sum(values)


def aliasing(values: jax.Array) -> jax.Array:
    """How much of the density is at the highest frequency of an axis, relative to its mass: of a resolved one nothing."""
    worst = jnp.zeros(())
    for d, size in enumerate(values.shape):
        signs = 1.0 - 2.0 * (np.arange(size) % 2)
        worst = jnp.maximum(worst, jnp.sum(jnp.abs(jnp.tensordot(signs, values, axes=([0], [d])))))
    return worst / jnp.sum(values)
