"""A Gaussian sum times a function, each component replaced by the Gaussian with its moments.

    N(x; m, P) e^{g(x)}  ->  e^{a} N(x; m', P')

The function depends on x through W'x alone.  Given W'x the rest of x stays Gaussian, so that quadrature is in k directions only
and any n will do; the integrals are Gauss-Hermite sums, in logarithms.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

from zakai import _float64  # noqa: F401

import jax  # isort: skip
import jax.numpy as jnp  # isort: skip
import numpy as np

from zakai.densities.components import Components, regression

# Nodes a direction, by the number of directions.
NODES = {0: 1, 1: 9, 2: 6, 3: 5, 4: 4, 5: 4}


class Rule(NamedTuple):
    """The tensor Gauss-Hermite rule for N(0, 1) in k directions: `nodes` (Q, k), `weights` (Q,), `size` a direction."""

    nodes: np.ndarray
    weights: np.ndarray
    size: int


@lru_cache(maxsize=16)
def gauss_hermite(directions: int) -> Rule:
    """The rule for that many directions; exact for polynomials of degree 2 size - 1 in each."""
    size = NODES[directions]
    node, weight = np.polynomial.hermite_e.hermegauss(size)
    weight = weight / weight.sum()
    nodes = np.array(list(product(node, repeat=directions))).reshape(-1, directions)
    weights = np.array([np.prod(w) for w in product(weight, repeat=directions)])
    return Rule(nodes, weights, size)


def points(sum_: Components, gain: jax.Array, nodes: jax.Array) -> jax.Array:
    """The nodes in x, (K, Q, n), of nodes (Q, k) or (K, Q, k); `gain` (K, n, k) from `regression`."""
    return sum_.means[:, None] + jnp.einsum("kia,...qa->kqi" if nodes.ndim == 2 else "kia,kqa->kqi", gain, nodes)


def refit(
    sum_: Components, log_factor: Callable[[jax.Array], jax.Array], directions: np.ndarray, sharp: bool
) -> tuple[Components, jax.Array]:
    """The sum times exp(log_factor); and how far each component moved, in its own standard deviations (K,).

    log_factor: takes (K, Q, n), gives (K, Q).  sharp: the factor may be much narrower than a component, as that of a sample
    may; the nodes are then moved to where the product is, twice, by the factor's quadratic part.
    """
    k = directions.shape[1]
    if k == 0:
        return sum_._replace(log_weights=sum_.log_weights + log_factor(sum_.means[:, None])[:, 0]), jnp.zeros(len(sum_.signs))
    rule = gauss_hermite(k)
    gain = regression(sum_.covs, jnp.asarray(directions))
    nodes, log_weights = jnp.asarray(rule.nodes), jnp.log(rule.weights)
    values = log_factor(points(sum_, gain, nodes))
    if not sharp:
        z = jnp.broadcast_to(nodes, (*values.shape, k))
        logs = values + log_weights
    else:
        centre, width = _proposal(values, rule)
        for _ in range(2):
            z = centre[:, None] + jnp.einsum("kab,qb->kqa", width, nodes)
            values = log_factor(points(sum_, gain, z))
            volume = jnp.sum(jnp.log(jnp.diagonal(width, axis1=1, axis2=2)), axis=1)
            logs = values + log_weights - 0.5 * jnp.sum(z**2, -1) + 0.5 * jnp.sum(nodes**2, -1) + volume[:, None]
            centre, cov = _weighted(logs, z)[1:]
            width = jax.lax.stop_gradient(_square_root(cov))
            centre = jax.lax.stop_gradient(centre)
    log_mass, shift, cov = _weighted(logs, z)
    means = sum_.means + jnp.einsum("kia,ka->ki", gain, shift)
    covs = sum_.covs + jnp.einsum("kia,kab,kjb->kij", gain, cov - jnp.eye(k), gain)
    moved = jnp.sqrt(jax.lax.stop_gradient(jnp.sum(shift**2, -1)))
    return Components(sum_.log_weights + log_mass, means, 0.5 * (covs + jnp.swapaxes(covs, 1, 2)), sum_.signs), moved


def _weighted(logs: jax.Array, z: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Log-mass (K,), mean (K, k) and covariance (K, k, k) of nodes z (K, Q, k) with logarithmic weights (K, Q)."""
    top = jax.lax.stop_gradient(jnp.max(logs, axis=1))
    top = jnp.where(jnp.isfinite(top), top, 0.0)
    weight = jnp.exp(logs - top[:, None])
    mass = jnp.sum(weight, axis=1)
    weight = weight / mass[:, None]
    mean = jnp.einsum("kq,kqa->ka", weight, z)
    rest = z - mean[:, None]
    return jnp.log(mass) + top, mean, jnp.einsum("kq,kqa,kqb->kab", weight, rest, rest)


def _proposal(values: jax.Array, rule: Rule) -> tuple[jax.Array, jax.Array]:
    """Where the product with N(0, 1) lies, by the quadratic part of the function: centre (K, k) and width (K, k, k)."""
    nodes, weights = rule.nodes, rule.weights
    k = nodes.shape[1]
    slope = jax.lax.stop_gradient(jnp.einsum("q,kq,qa->ka", weights, values, nodes))
    square = nodes[:, :, None] * nodes[:, None, :] - np.eye(k)
    bend = jax.lax.stop_gradient(jnp.einsum("q,kq,qab->kab", weights, values, square))
    if k == 1:
        cov = 1.0 / jnp.maximum(1.0 - bend, 0.5)
        return jnp.clip((cov @ slope[..., None])[..., 0], -6.0, 6.0), jnp.sqrt(cov)
    size, frame = jnp.linalg.eigh(jnp.eye(k) - bend)
    cov = jnp.einsum("kab,kb,kcb->kac", frame, 1.0 / jnp.maximum(size, 0.5), frame)
    return jnp.clip((cov @ slope[..., None])[..., 0], -6.0, 6.0), _square_root(cov)


def _square_root(cov: jax.Array) -> jax.Array:
    """The lower-triangular root, with a floor where all the mass sits on one node."""
    cov = jax.lax.stop_gradient(cov)
    k = cov.shape[-1]
    cov = cov + (1e-6 * jnp.trace(cov, axis1=1, axis2=2)[:, None, None] / k + 1e-12) * jnp.eye(k)
    return jnp.sqrt(cov) if k == 1 else jnp.linalg.cholesky(cov)


def curvature(
    sum_: Components, observe: Callable[[jax.Array], Any], precision: jax.Array, directions: np.ndarray
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """How far h is from affine over each component: (residual energy (K,), energy of the linear fit (K,), axis (K, n)).

    Energies are in the metric S^-1, E|h - c0 - c1 z|^2 and |c1|^2 with c0, c1 by least squares.  The axis is the direction to
    which most of the residual is due (its total effect in the analysis of variance), one standard deviation long.
    """
    rule = gauss_hermite(directions.shape[1])
    gain = regression(sum_.covs, jnp.asarray(directions))
    h = jnp.stack(observe(points(sum_, gain, jnp.asarray(rule.nodes))), axis=-1)
    weights, nodes = rule.weights, rule.nodes
    rest = h - jnp.einsum("q,kqm->km", weights, h)[:, None]
    slope = jnp.einsum("q,kqm,qa->kma", weights, rest, nodes)
    linear = jnp.einsum("kma,mn,kna->k", slope, precision, slope)
    rest = rest - jnp.einsum("kma,qa->kqm", slope, nodes)
    residual = jnp.einsum("q,kqm,mn,kqn->k", weights, rest, precision, rest)
    k = nodes.shape[1]
    if k == 1:
        return residual, linear, gain[:, :, 0]
    shape = (-1, *[rule.size] * k, rest.shape[-1])
    grid, grid_weights = rest.reshape(shape), weights.reshape(shape[1:-1])
    effects = []
    for a in range(k):
        line = grid_weights.sum(axis=tuple(b for b in range(k) if b != a))
        inner = grid - jnp.expand_dims(jnp.tensordot(grid, line, (a + 1, 0)), a + 1)
        inner = inner.reshape(rest.shape)
        effects.append(jnp.einsum("q,kqm,mn,kqn->k", weights, inner, precision, inner))
    worst = jnp.argmax(jnp.stack(effects, axis=1), axis=1)
    return residual, linear, jnp.take_along_axis(gain, worst[:, None, None], axis=2)[:, :, 0]
