"""A Gaussian sum with a fixed number of slots, and what can be done to it inside a compiled step.

    v(x) = sum_i s_i exp(log_weights_i) N(x; means_i, covs_i)

An empty slot has the logarithm -inf and any Gaussian.  The signs s_i are one, but for a sum that a fit with negative parts made.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from zakai import _float64  # noqa: F401

import jax  # isort: skip
import jax.numpy as jnp  # isort: skip
import numpy as np


class Components(NamedTuple):
    """`log_weights` (K,), `means` (K, n), `covs` (K, n, n), `signs` (K,)."""

    log_weights: Any
    means: Any
    covs: Any
    signs: Any


def components(log_weights: Any, means: Any, covs: Any) -> Components:
    """A sum of positive Gaussians."""
    return Components(log_weights, means, covs, jnp.ones(len(log_weights)))


def padded(sum_: Components, slots: int) -> Components:
    """The same sum with empty slots after it, `slots` in all."""
    missing = slots - len(sum_.log_weights)
    return Components(
        jnp.concatenate([sum_.log_weights, jnp.full(missing, -jnp.inf)]),
        jnp.concatenate([sum_.means, jnp.repeat(sum_.means[:1], missing, axis=0)]),
        jnp.concatenate([sum_.covs, jnp.repeat(sum_.covs[:1], missing, axis=0)]),
        jnp.concatenate([sum_.signs, jnp.ones(missing)]),
    )


def shares(sum_: Components) -> tuple[jax.Array, jax.Array]:
    """The signed share (K,) of each component, adding up to one, and the logarithm of the mass; a negative mass is nan."""
    top = jax.lax.stop_gradient(jnp.max(sum_.log_weights))
    top = jnp.where(jnp.isfinite(top), top, 0.0)
    parts = sum_.signs * jnp.exp(sum_.log_weights - top)
    mass = jnp.sum(parts)
    return parts / mass, jnp.log(mass) + top


def moments(share: jax.Array, means: jax.Array, covs: jax.Array, angles: tuple[int, ...] = ()) -> tuple[jax.Array, jax.Array]:
    """The mean (n,) and covariance (n, n) of a mixture; an angle has its mean direction, and wrapped deviations."""
    mean = share @ means
    for i in angles:
        size = share * jnp.exp(-0.5 * covs[:, i, i])
        sine, cosine = size @ jnp.sin(means[:, i]), size @ jnp.cos(means[:, i])
        # An angle that could be anything has no direction.
        some = sine**2 + cosine**2 > 1e-18
        mean = mean.at[i].set(jnp.where(some, jnp.arctan2(jnp.where(some, sine, 0.0), jnp.where(some, cosine, 1.0)), 0.0))
    deviation = wrapped(means - mean, angles)
    cov = jnp.einsum("k,kij->ij", share, covs) + jnp.einsum("k,ki,kj->ij", share, deviation, deviation)
    return mean, cov


def wrapped(difference: Any, angles: tuple[int, ...]) -> Any:
    """Differences (..., n) whose angles are taken in (-pi, pi]; NumPy's or JAX'."""
    if not angles:
        return difference
    turning = np.isin(np.arange(difference.shape[-1]), angles)
    turns = (np.pi - difference) // (2 * np.pi)
    return difference + 2 * np.pi * turning * jax.lax.stop_gradient(turns)


def regression(covs: jax.Array, directions: jax.Array) -> jax.Array:
    """The gain B (K, n, k) with x = m + B z + rest, z ~ N(0, 1) white and spanning W'x, for `directions` W (n, k)."""
    across = covs @ directions
    inner = jnp.einsum("ia,kib->kab", directions, across)
    k = directions.shape[1]
    if k == 1:
        return across * jax.lax.rsqrt(jnp.maximum(inner, 1e-280))
    # A direction without any variance keeps a whitening of its own; B is then zero along it.
    floor = 1e-15 * jnp.trace(inner, axis1=1, axis2=2)[:, None, None] + 1e-280
    factor = jnp.linalg.cholesky(inner + floor * jnp.eye(k))
    return jnp.swapaxes(jax.lax.linalg.triangular_solve(factor, jnp.swapaxes(across, 1, 2), left_side=True, lower=True), 1, 2)
