"""One formula for NumPy and for JAX: what is done once, outside of a trace, is not worth a compilation."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401


def numpy_or_jax(*trees: Any) -> Any:
    """`jax.numpy` where a leaf of the arguments is a JAX array, traced or not; else `numpy`."""
    return jnp if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(trees)) else np
