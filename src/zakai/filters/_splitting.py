"""The splitting of an increment's likelihood from the transition: its first error is undone, what is left is estimated.

With b the logarithm of the likelihood of an interval tau and A the forward operator, Strang's exp(b/2) exp(tau A) exp(b/2) is
the exponential of

    tau A + b - tau [b, [b, A]] / 24 - tau^2 [A, [b, A]] / 12 - ...

Of a path that has noise, b is of the order of sqrt(tau), so that the first error is of the order tau^2 in every interval and
has always one sign.  [b, [b, A]] = grad b . G grad b is a function, so that it can be undone by the factors themselves
(Takahashi and Imada 1984).  The second is smaller and changes its sign with the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.kolmogorov import comoving

ALIKE = 0.1  # how much the errors of different intervals have in common: between those of noise, 0, and those of one sign, 1
LONGEST = 1e4  # intervals after which every error is taken for forgotten


def slopes(values: jax.Array) -> list[jax.Array]:
    """The slope of an array along each of its axes, a cell the unit, by central differences."""
    if values.ndim > 1:
        return [_differences(values, d) for d in range(values.ndim)]
    # A product is compiled faster than what has several parts.
    return [jnp.asarray(_central(len(values))) @ values]


def _differences(values: jax.Array, axis: int) -> jax.Array:
    size = values.shape[axis]

    def part(begin: int, end: int) -> jax.Array:
        return jax.lax.slice_in_dim(values, begin, end, axis=axis)

    first, last = part(1, 2) - part(0, 1), part(size - 1, size) - part(size - 2, size - 1)
    return jnp.concatenate([first, 0.5 * (part(2, size) - part(0, size - 2)), last], axis=axis)


def bends(values: jax.Array) -> tuple[list[jax.Array], list[list[jax.Array]]]:
    """The slopes and the second derivatives of an array."""
    if values.ndim > 1:
        slope = slopes(values)
        return slope, [slopes(s) for s in slope]
    # One product is compiled in half of the time that two take.
    both = jnp.asarray(_central_twice(len(values))) @ values
    return [both[: len(values)]], [[both[len(values) :]]]


@lru_cache(maxsize=64)
def _central_twice(size: int) -> np.ndarray:
    return np.concatenate([_central(size), _central(size) @ _central(size)])


@lru_cache(maxsize=64)
def _central(size: int) -> np.ndarray:
    return np.asarray(np.gradient(np.eye(size), axis=0))


def product(spread: jax.Array, a: Sequence[jax.Array], b: Sequence[jax.Array]) -> jax.Array:
    """a'(spread) b at every point."""
    return sum((spread[i, j] * p * q for i, p in enumerate(a) for j, q in enumerate(b)), start=jnp.zeros(()))


def corrected(half: jax.Array, spread: jax.Array, length: Any) -> jax.Array:
    """b/2 + tau grad b . G grad b / 48 for b/2 on a lattice in whose coordinates G is `spread`; where that is large, less."""
    slope = slopes(half)
    return made_up(half, length * product(spread, slope, slope))


def made_up(half: Any, steepness: Any) -> Any:
    """The same, where tau grad(b/2) . G grad(b/2) is known."""
    more = steepness / 12
    return half + more / (1.0 + more)


class Left(NamedTuple):
    """What the splitting of one interval leaves, relative to the density, and the rate at which the filter forgets."""

    error: jax.Array
    forgets: jax.Array


def left(values: jax.Array, half: jax.Array, flow: Sequence[jax.Array], spread: jax.Array, length: Any) -> Left:
    """The second error of the splitting, and the next one after the first, for the density `values` and b/2 on its lattice.

    `flow` is the drift and `spread` G in the lattice's coordinates.  With L the backward operator, [A, [b, A]] has a part that is
    the function L L b, one in which the slopes of L b stand beside those of the density, and one in which the second derivatives
    of b stand beside its own; each is taken for itself.  An error of the mean is
    forgotten at the rate G P^-1 + f', averaged over the coordinates, which for a Kalman-Bucy filter is its own rate.
    """
    n = values.ndim
    total, mean, cov = comoving.moments(values)
    narrow = comoving.inverse(cov)
    growth = jnp.trace(spread @ narrow)

    def generated(function: jax.Array) -> tuple[list[jax.Array], jax.Array, jax.Array]:
        slope, second = bends(function)
        bent = jnp.tensordot(spread, jnp.stack([jnp.stack(row) for row in second]), axes=1)
        carried = sum((v * s for v, s in zip(flow, slope, strict=True)), start=jnp.zeros(()))
        return slope, bent, carried + 0.5 * jnp.trace(bent)

    slope, bent, generator = generated(2 * half)
    upward, _, twice = generated(generator)
    once = product(spread, upward, upward)
    never = jnp.sum(bent * jnp.swapaxes(bent, 0, 1), axis=(0, 1))
    first = length / 24 * product(spread, slope, slope)
    apart = [z - mean[d] for d, z in enumerate(comoving.combined(np.eye(n), values.shape))]
    moved = [v * z for v in flow for z in apart]
    # All means by one product: what is compiled fast.
    functions = jnp.stack([twice, twice**2, first, first**2, once, never, *moved]).reshape(6 + n * n, -1)
    means = functions @ (values.reshape(-1) / total)
    twice_spread, first_spread = (jnp.sqrt(jnp.maximum(means[k + 1] - means[k] ** 2, 0.0)) for k in (0, 2))
    rest = twice_spread + 2 * jnp.sqrt(jnp.maximum(means[4], 0.0) * growth) + growth * jnp.sqrt(2 * jnp.maximum(means[5], 0.0))
    beyond = first_spread * jnp.minimum(1.0, jnp.sqrt(means[2]) + length * growth)
    forgets = (growth + jnp.trace(means[6:].reshape(n, n) @ narrow)) / n
    return Left(length**2 / 12 * rest + beyond, forgets)


def added(before: Any, error: Any, forgets: Any, length: Any) -> jax.Array:
    """The error of a density that had one `before` and then made another."""
    left = _kept(forgets, length) * before
    return jnp.sqrt(left**2 + 2 * ALIKE * left * error + error**2)


def expected(error: Any, forgets: Any, length: Any) -> jax.Array:
    """What errors like this one come to in the long run."""
    kept = _kept(forgets, length)
    alike, rest = ALIKE * kept, 1.0 - kept**2
    return error * (alike + jnp.sqrt(alike**2 + rest)) / rest


def _kept(forgets: Any, length: Any) -> jax.Array:
    return jnp.exp(-jnp.clip(forgets * length, 1.0 / LONGEST, 50.0))
