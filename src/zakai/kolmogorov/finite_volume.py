"""The Kolmogorov forward equation by finite volumes: positive and conserving mass whatever the time and the cells.

    u_t = -div(f u) + G : Hess u / 2,        x in R^n, f(x, t), G(t) positive semidefinite

A cell gives mass to its neighbours at rates that are never negative: with D = G_dd / 2 and the flow v through a face, both in
cells, D B(-v / D) forwards and D B(v / D) backwards, B(p) = p / (e^p - 1) (Scharfetter and Gummel 1969; Chang and Cooper 1970),
of second order in the cells, and the upwind rates, of first order, where D vanishes.  Noise that couples two axes moves mass
along their diagonals.  Nothing leaves the lattice.

The rates are the generator A of a Markov chain.  exp(tau A) is the mean of (1 + A / L)^k over a Poisson variable k of mean L tau,
L the largest rate of leaving a cell (uniformisation; Jensen 1953): every term is positive, and the only error in time is that of
the coefficients, taken at the middle of tau.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from zakai import _float64  # noqa: F401
from zakai.kolmogorov import comoving
from zakai.kolmogorov.comoving import Covariance, Drift, Field
from zakai.kolmogorov.differences import OUTER, differences

TERMS = {16: 1.0, 40: 8.0}  # how many terms are enough for how much of L tau

Generator = Callable[[jax.Array], jax.Array]


def moved(
    field: Field, drift: Drift, covariance: Covariance, time: Any, tau: Any, terms: int
) -> tuple[Field, jax.Array]:
    """The density after the time `tau`, its lattice moved by the mean flow and by whole cells; and an estimate of the error.

    `drift(x, t)` gives n arrays for x (*sizes, n), `covariance(t)` is G (n, n).  The error is relative: what the cells leave,
    found by comparison with derivatives of sixth order, and what the series and the middle of tau leave.
    """
    values, n = field.values, field.values.ndim
    still = lax.stop_gradient
    total = jnp.sum(values)
    back = comoving.inverse(field.basis)

    def flow(centre: jax.Array, t: Any, shift: Any = None) -> list[jax.Array]:
        points = comoving.points_of(values.shape, centre, field.basis)
        f = jnp.stack(drift(points if shift is None else points + shift, t))
        return list(jnp.tensordot(back, f - velocity.reshape(-1, *[1] * n), axes=1))

    velocity = still(jnp.stack([jnp.sum(values * f) for f in drift(field.points(), time)]) / total)
    middle, later = field.centre + 0.5 * tau * velocity, time + 0.5 * tau
    spread = back @ covariance(later) @ back.T
    faces = [flow(middle, later, 0.5 * field.basis[:, d])[d] for d in range(n)]
    generator, leaving = _generator(faces, spread)
    series, missing = _exponential(generator, leaving, tau, terms, values)
    # What the cells leave, and how much the coefficients change within tau.
    exact = _derived(flow(middle, later), spread, values)
    inner = tuple(slice(OUTER, size - OUTER) for size in values.shape)
    cells = tau * jnp.sum(jnp.abs(generator(values) - exact)[inner])
    turned = [b - a for a, b in zip(flow(field.centre, time), flow(field.centre + tau * velocity, time + tau), strict=True)]
    change = tau**2 / 12 * jnp.sum(jnp.abs(_derived(turned, 0.0 * spread, values))) * jnp.sum(jnp.abs(exact)) / total
    error = (cells + change) / total + missing
    # The mean goes to the centre by whole cells.
    whole = still(jnp.round(comoving.moments(series).mean))
    series = jnp.roll(series, -whole.astype(int), axis=tuple(range(n)))
    return Field(series, field.centre + tau * velocity + field.basis @ whole, field.basis), still(error)


def _bernoulli(p: jax.Array) -> jax.Array:
    small = jnp.abs(p) < 1e-4
    safe = jnp.where(small, 1.0, jnp.clip(p, -600.0, 600.0))
    return jnp.where(small, 1.0 - 0.5 * p + p**2 / 12, safe / jnp.expm1(safe))


def _generator(faces: list[jax.Array], spread: jax.Array) -> tuple[Generator, jax.Array]:
    """A as a function, and the largest rate at which mass leaves a cell; `faces` are the flows through the upper faces."""
    n = len(faces)
    across = jnp.abs(spread - jnp.diag(jnp.diagonal(spread)))
    own = jnp.maximum(0.5 * (jnp.diagonal(spread) - across.sum(axis=1)), 0.0)
    rates = []
    for d, v in enumerate(faces):
        v = lax.slice_in_dim(v, 0, v.shape[d] - 1, axis=d)
        some = own[d] > 1e-12 * jnp.max(jnp.abs(v))
        D = jnp.where(some, own[d], 1.0)
        up, down = (jnp.where(some, D * _bernoulli(-s * v / D), jnp.maximum(s * v, 0.0)) for s in (1.0, -1.0))
        rates.append((up, down))
    pairs = [(d, e, sign) for d in range(n) for e in range(d) for sign in (1, -1)]

    def generator(u: jax.Array) -> jax.Array:
        result = jnp.zeros(u.shape)
        for d, (up, down) in enumerate(rates):
            size = u.shape[d]
            flux = up * lax.slice_in_dim(u, 0, size - 1, axis=d) - down * lax.slice_in_dim(u, 1, size, axis=d)
            edges = [(1, 1) if a == d else (0, 0) for a in range(n)]
            padded = jnp.pad(flux, edges)
            result = result + lax.slice_in_dim(padded, 0, size, axis=d) - lax.slice_in_dim(padded, 1, size + 1, axis=d)
        for d, e, sign in pairs:
            rate = 0.5 * jnp.maximum(sign * spread[d, e], 0.0)
            low, high = _diagonal(u, d, e, sign)
            flux = rate * (low - high)
            result = result + _placed(flux, d, e, sign, u.ndim, True) - _placed(flux, d, e, sign, u.ndim, False)
        return result

    leaving = jnp.zeros(faces[0].shape)
    for d, (up, down) in enumerate(rates):
        leaving = leaving + jnp.pad(up, [(0, a == d) for a in range(n)]) + jnp.pad(down, [(a == d, 0) for a in range(n)])
    return generator, jnp.max(leaving) + 0.5 * across.sum()


def _diagonal(u: jax.Array, d: int, e: int, sign: int) -> tuple[jax.Array, jax.Array]:
    """The cells at the two ends of every diagonal of the axes d and e."""
    first = lax.slice_in_dim(u, 0, u.shape[d] - 1, axis=d), lax.slice_in_dim(u, 1, u.shape[d], axis=d)
    low, high = first if sign > 0 else first[::-1]
    return lax.slice_in_dim(low, 0, u.shape[e] - 1, axis=e), lax.slice_in_dim(high, 1, u.shape[e], axis=e)


def _placed(flux: jax.Array, d: int, e: int, sign: int, n: int, high: bool) -> jax.Array:
    """The flux along diagonals at the cells of one of their ends."""
    at = {d: high if sign > 0 else not high, e: high}
    return jnp.pad(flux, [((1, 0) if at[a] else (0, 1)) if a in at else (0, 0) for a in range(n)])


def _exponential(generator: Generator, leaving: jax.Array, tau: Any, terms: int, values: jax.Array) -> tuple[Any, Any]:
    """exp(tau A) of the values, and the weight of the terms that are missing, which is given to the others."""
    mean = lax.stop_gradient(tau * leaving)
    rate = jnp.where(leaving > 0, leaving, 1.0)

    def term(carry: Any, k: Any) -> tuple[Any, None]:
        u, weight, total, summed = carry
        u = jnp.maximum(u + generator(u) / rate, 0.0)
        weight = weight * mean / k
        return (u, weight, total + weight * u, summed + weight), None

    first = jnp.exp(-mean)
    (_, _, total, summed), _ = lax.scan(term, (values, first, first * values, first), jnp.arange(1.0, terms))
    return total / summed, 1.0 - summed


def _derived(flow: list[jax.Array], spread: jax.Array, u: jax.Array) -> jax.Array:
    """-div(flow u) + spread : Hess u / 2 by differences; an interpolant would ring with what the edges hold."""
    result = jnp.zeros(u.shape)
    for d, v in enumerate(flow):
        inner = v * u - 0.5 * sum((spread[d, e] * differences(u, e) for e in range(u.ndim)), start=jnp.zeros(()))
        result = result - differences(inner, d)
    return result
