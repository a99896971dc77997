"""A run of steps of the limited direct method for one state, on a lattice that stands still.

The kernel of an interval is the exponential of a quadratic form in (x, y).  On one lattice for both,

    x y = (x^2 + y^2 - (x - y)^2) / 2

makes of it a filter with the same taps at every point, between two factors that are Gaussian functions of the point,

    p'(x) = e^{after(x)} sum_y e^{-(x - y)^2 / (2 P11 Sigma)} e^{before(y)} p(y).

They are multiplied with the factors of the observation, and h at the points is computed once for a whole run: a step is two
exponentials, a filter, and one product that gives mass, mean, variance and what stands at the edges.  Everything is positive, so
that rounding loses no tail.  Every `LOOK` steps the window is laid over the mass anew, by whole cells, and its resolution is
looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import gcd
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.filters.observations import Factors
from zakai.kolmogorov import lattice as lat
from zakai.kolmogorov.flow import Flow, motion
from zakai.kolmogorov.lattice import Lattice

LOOK = 16  # steps


class Kernel(NamedTuple):
    """The kernel of an interval between the points of one lattice: the `variance` of its taps and, as polynomials (3,) in x from
    the constant on, `before` and `after`; or of many intervals with a leading axis."""

    variance: Any
    before: Any
    after: Any


def kernel_of(flow: Flow) -> Kernel:
    """The kernel of one flow of one state, up to the length of a cell."""
    moved = motion(flow, jnp.zeros(1), jnp.ones(1))
    scale, spread, at = flow.map[0, 0], flow.spread[0, 0], moved.centre[0]
    variance = scale * spread
    # Equation (2) of `flow` in x = at + scale xi.
    tilt, bend = moved.tilt[0] / scale, flow.bend[0, 0] / scale**2 - 0.5 / (scale * variance)
    before = jnp.stack([jnp.zeros(()), -at / variance, 0.5 * (1 - scale) / variance])
    constant = moved.log_mass - at * tilt + at**2 * bend - 0.5 * jnp.log(2 * jnp.pi * spread)
    narrow = flow.bend[0, 0] / scale**2 + 0.5 * (scale - 1) / (scale * variance)
    return Kernel(variance, before, jnp.stack([constant, tilt - 2 * at * bend, narrow]))


def _around(polynomial: jax.Array, centre: jax.Array) -> jax.Array:
    """A polynomial (..., 3) in x as one in x - centre."""
    constant, slope, bend = jnp.moveaxis(polynomial, -1, 0)
    return jnp.stack([constant + centre * (slope + centre * bend), slope + 2 * centre * bend, bend], axis=-1)


class Steps(NamedTuple):
    """What a run of K steps tells: for each step the `sums` (K, 4) of p, p i, p i^2 and of p at the edges, i an index from the
    window's centre, which is at `place` (K,) in cells, before p is normalised, and if asked for this p, `values` (K, N); for each
    look (L,) the narrowest feature in `cells`, that of its product with a kernel, `joint`, and how deep in its tails the mass
    lies, `depth`."""

    sums: Any
    place: Any
    values: Any
    cells: Any
    joint: Any
    depth: Any


def moved(
    lattice: Lattice,
    flow: Flow,
    given: Factors,
    observe: Callable[[Any], Sequence[Any]],
    corrected: Callable[..., Any],
    taps: int,
    keep: bool,
) -> tuple[jax.Array, Steps]:
    """K intervals, from the density on a lattice of N points: the values (N,) at the end and what is told on the way.

    `observe` gives h at points (M, 1) and its slopes, an array for each; `corrected` makes up half of the logarithm of a
    factor for the error of the splitting, from itself and the square of the first half's slope, times the transition's spread.
    """
    size, cell, count = len(lattice.log_values), lattice.basis[0, 0], len(flow.map)
    each = gcd(count, LOOK)
    index = np.arange(size, dtype=float) - size // 2
    xi = cell * index
    outer = (np.minimum(np.arange(size), np.arange(size)[::-1]) < 2).astype(float)
    columns = np.stack([np.ones(size), index, index**2, outer], axis=1)
    # As far as the window may come in a run.
    wide = np.arange(3 * size, dtype=float) - size - size // 2
    h = jnp.stack(observe(lattice.centre + (cell * wide)[:, None]))
    kernel = jax.vmap(kernel_of)(flow)
    weights = cell * jnp.exp(-0.5 * (cell * np.arange(taps + 1)) ** 2 / kernel.variance[:, None])
    slices = weights, kernel, flow.spread[:, 0, 0], given.before, given.after

    def exponents(slices: Any, seen: Any) -> tuple[Any, Any]:
        _, kernel, spread, first, last = slices
        steepness = spread * _weighted(first, seen[1]) ** 2
        return tuple(
            p[0] + xi * (p[1] + xi * p[2]) + corrected(_weighted(linear, seen[0]), steepness)
            for p, linear in ((kernel.before, first), (kernel.after, last))
        )  # type: ignore[return-value]

    def look(carry: Any, slices: Any) -> tuple[Any, Any]:
        p, mass, place, own = carry
        used = (p > np.exp(-lat.SUPPORT) * jnp.max(p)).astype(float)
        shift = jnp.clip(jnp.rint(used @ index / jnp.sum(used)).astype(int), -(size // 4), size // 4)
        shift = jnp.clip(shift, -size - place, size - place)
        p, place = lat.slid(p, shift, 0.0), place + shift
        seen = jnp.split(jax.lax.dynamic_slice_in_dim(h, size + place, size, axis=1), 2)
        centre = lattice.centre[0] + cell * place
        kernel = slices[1]
        kernel = kernel._replace(before=_around(kernel.before, centre), after=_around(kernel.after, centre))
        slices = slices[0], kernel, *slices[2:]

        def step(carry: Any, slices: Any) -> tuple[Any, Any]:
            p, mass = carry
            before, after = exponents(slices, seen)
            new = jnp.exp(after) * lat.filtered(p * (jnp.exp(before) / mass), slices[0])
            sums = new @ columns
            return (new, sums[0]), (sums, new if keep else None)

        (p, mass), told = jax.lax.scan(step, (p, mass), slices)
        end = lattice._replace(log_values=lat.log(p))
        cells = lat.features(end)[0]
        joint = jax.lax.rsqrt(1.0 / jnp.minimum(own, cells) ** 2 + cell**2 / jnp.min(kernel.variance))
        depth = lat.reach(end, end.log_values - exponents(jax.tree.map(lambda a: a[-1], slices), seen)[1])
        return (p, mass, place, cells), (*told, jnp.broadcast_to(place, (each,)), cells, joint, depth)

    first = jnp.exp(lattice.log_values)
    carry = first, jnp.sum(first), jnp.zeros((), int), lat.features(lattice)[0]
    blocks = jax.tree.map(lambda a: a.reshape(count // each, each, *a.shape[1:]), slices)
    (p, *_), (sums, kept, place, *looks) = jax.lax.scan(look, carry, blocks)
    sums, kept, place = jax.tree.map(lambda a: a.reshape(count, *a.shape[2:]), (sums, kept, place))
    return p, Steps(sums, place, kept, *looks)


def _weighted(weights: Any, arrays: Any) -> Any:
    """An elementwise sum, which is fused with what follows."""
    return sum((weights[i] * array for i, array in enumerate(arrays)), start=jnp.zeros(()))
