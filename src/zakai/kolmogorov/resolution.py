"""Whether a lattice of points resolves a density: what both spectral movers ask, and how they reach an axis."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401

LAYERS = 2  # cells on each side that are the outermost layers, and
OUTERMOST = 1 / 48  # the share of an axis that they are at least: what a few of many cells hold says little of what lies beyond


def along(matrix: Any, values: jax.Array, axis: int) -> jax.Array:
    """A matrix applied to one axis of an array."""
    if values.ndim == 1:
        return matrix @ values
    return jnp.moveaxis(jnp.tensordot(matrix, values, axes=([1], [axis])), 0, axis)


class Resolution(NamedTuple):
    """The `aliasing`, how much of the density is at the highest frequency of an axis, relative to its mass: of a resolved one
    nothing; and the share of the mass in the outermost layers, the `edge_mass`."""

    aliasing: jax.Array
    edge_mass: jax.Array


def resolution_of(values: jax.Array) -> Resolution:
    """How well a lattice resolves and holds the values (*sizes) of a density."""
    told = []
    for d, size in enumerate(values.shape):
        # The magnitudes of all lines along the axis, then their sums: products, for a reduction takes its time.
        lines = jnp.abs(jnp.tensordot(_rows(size), values, axes=([1], [d])))
        while lines.ndim > 1:
            lines = lines @ np.ones(lines.shape[-1])
        told.append(lines)
    mass = told[0][0]
    return Resolution(jnp.max(jnp.stack([each[1] for each in told])) / mass, sum(each[2] for each in told) / mass)


@lru_cache(maxsize=64)
def _rows(size: int) -> np.ndarray:
    """Whose products with a line are its sum, what is at the highest frequency, and its outermost values on each side."""
    index, outer = np.arange(size), max(LAYERS, int(size * OUTERMOST))
    return np.stack([np.ones(size), 1.0 - 2.0 * (index % 2), np.minimum(index, index[::-1]) < outer])
