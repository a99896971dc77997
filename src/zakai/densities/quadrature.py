"""A Gaussian sum times a function, each component replaced by the Gaussian with its moments.

    N(x; m, P) e^{g(x)}  ->  e^{a} N(x; m', P')

The function depends on x through W'x alone.  Given W'x the rest of x stays Gaussian, so that quadrature is in k directions only
and any n will do; the integrals are sums in logarithms: over Gauss-Hermite nodes, or, where the function may be much narrower
than a component or have several peaks, over a lattice that is laid again where the product was found.
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

# Gauss-Hermite nodes a direction, by the number of directions.
NODES = {0: 1, 1: 9, 2: 6, 3: 5, 4: 4, 5: 4}
# Nodes of a lattice a direction and their spacing in standard deviations; a sum over it is as good as exp(-2 pi^2 / spacing^2).
LATTICE = {1: (33, 0.375), 2: (13, 1.0), 3: (9, 1.1), 4: (5, 1.3), 5: (4, 1.5)}
# A lattice is laid so often, each time wider by this factor than the product that was found on the one before.
_LAID = 3
_STRETCH = 1.25
# Of the weights that make up for what single products lose: what is added to a matrix of norm one, the largest relative change,
# and the share below which a component keeps its weight.
_RIDGE, _CHANGE, _LIGHT = 1e-3, 0.5, 1e-12
# An empty slot has minus this for the logarithm of its weight where minus infinity would make no number.
_EMPTY = 1e30


class Rule(NamedTuple):
    """A tensor rule for N(0, 1) in k directions: `nodes` (Q, k), `weights` (Q,), `size` and `spacing` a direction."""

    nodes: np.ndarray
    weights: np.ndarray
    size: int
    spacing: float = 0.0


class Refitted(NamedTuple):
    """The new sum, and of each component (K,): how far it `moved`, in its own standard deviations; the `loss`, the relative
    entropy of the product from the Gaussian that is kept of it; and the `doubt` of the quadrature, the logarithm of the ratio
    of its masses by two rules."""

    sum: Components
    moved: Any
    loss: Any
    doubt: Any


@lru_cache(maxsize=16)
def gauss_hermite(directions: int) -> Rule:
    """The rule for that many directions; exact for polynomials of degree 2 size - 1 in each."""
    size = NODES[directions]
    node, weight = np.polynomial.hermite_e.hermegauss(size)
    return _tensor(node, weight / weight.sum(), directions)


@lru_cache(maxsize=16)
def lattice(directions: int) -> Rule:
    """Equal steps in each of that many directions."""
    size, spacing = LATTICE[directions]
    node = spacing * (np.arange(size) - (size - 1) / 2)
    return _tensor(node, spacing * np.exp(-0.5 * node**2) / np.sqrt(2 * np.pi), directions)._replace(spacing=spacing)


def _tensor(node: np.ndarray, weight: np.ndarray, directions: int) -> Rule:
    nodes = np.array(list(product(node, repeat=directions))).reshape(-1, directions)
    weights = np.array([np.prod(w) for w in product(weight, repeat=directions)])
    return Rule(nodes, weights, len(node))


def points(sum_: Components, gain: jax.Array, nodes: jax.Array) -> jax.Array:
    """The nodes in x, (K, Q, n), of nodes (Q, k) or (K, Q, k); `gain` (K, n, k) from `regression`."""
    return sum_.means[:, None] + jnp.einsum("kia,...qa->kqi" if nodes.ndim == 2 else "kia,kqa->kqi", gain, nodes)


def refit(
    sum_: Components, log_factor: Callable[[jax.Array], jax.Array], directions: np.ndarray, sharp: bool, products: int = 0
) -> Refitted:
    """The sum times exp(log_factor), which takes (K, Q, n) and gives (K, Q).

    sharp: the factor may be much narrower than a component, as that of a sample may, and have several peaks there.
    products: for how many such products the weights make up for the shape that each loses; one state, not sharp.
    """
    k = directions.shape[1]
    zero = jnp.zeros(len(sum_.signs))
    if k == 0:
        heavier = sum_._replace(log_weights=sum_.log_weights + log_factor(sum_.means[:, None])[:, 0])
        return Refitted(heavier, zero, zero, zero)
    rule = lattice(k) if sharp else gauss_hermite(k)
    gain = regression(sum_.covs, jnp.asarray(directions))
    nodes, log_weights = jnp.asarray(rule.nodes), jnp.log(rule.weights)
    z = jnp.broadcast_to(nodes, (len(zero), *nodes.shape))
    values = log_factor(points(sum_, gain, z))
    logs = values + log_weights
    doubt, width = zero, jnp.broadcast_to(jnp.eye(k), (len(zero), k, k))
    for _ in range(_LAID - 1 if sharp else 0):
        before, centre, cov = jax.lax.stop_gradient(_weighted(logs, z))
        # What is narrower than the spacing lies between nodes, and is looked for there.
        between = (0.3 * rule.spacing) ** 2 * jnp.einsum("kab,kcb->kac", width, width)
        width = _STRETCH * _square_root(cov + between)
        z = centre[:, None] + jnp.einsum("kab,qb->kqa", width, nodes)
        values = log_factor(points(sum_, gain, z))
        volume = jnp.sum(jnp.log(jnp.diagonal(width, axis1=1, axis2=2)), axis=1)
        logs = values + log_weights - 0.5 * jnp.sum(z**2, -1) + 0.5 * jnp.sum(nodes**2, -1) + volume[:, None]
        doubt = jnp.abs(jax.lax.stop_gradient(_weighted(logs, z)[0]) - before)
    log_mass, shift, cov = _weighted(logs, z)
    means = sum_.means + jnp.einsum("kia,ka->ki", gain, shift)
    covs = sum_.covs + jnp.einsum("kia,kab,kjb->kij", gain, cov - jnp.eye(k), gain)
    new = Components(sum_.log_weights + log_mass, means, 0.5 * (covs + jnp.swapaxes(covs, 1, 2)), sum_.signs)
    if products and sum_.means.shape[1] == 1 and not sharp:
        new = _rebalanced(sum_, new, points(sum_, gain, nodes)[..., 0], values, rule, products)
    moved = jnp.sqrt(jax.lax.stop_gradient(jnp.sum(shift**2, -1)))
    return Refitted(new, moved, jax.lax.stop_gradient(_divergence(logs, values, z, log_mass, cov)), doubt)


def _rebalanced(old: Components, new: Components, x: jax.Array, values: jax.Array, rule: Rule, products: int) -> Components:
    """`new`, which has the moments of each product, with weights that make up for the shape that each lost; one state.

    A product's skewness, lost at every reading, adds up to a wrong evidence of each mode; neighbours can carry it.  With
    p = sum_i w_i N_i e^g, known at nodes x (K, Q), and q = `new` this is Newton's step for the weights w_j (1 + e_j) of least
    E_p log(p / q),

        sum_l E_p[r_j r_l] e_l = E_p[r_j] - E_q[r_j],    r_j = w_j N_j / q,

    as many times as there were `products` that lost about the same.  Since sum_j r_j = 1, components that overlap no others
    keep their weight, and modes their mass.
    """
    log_mass = jax.nn.logsumexp(new.log_weights)
    before, after = (jnp.where(jnp.isfinite(v.log_weights), v.log_weights - log_mass, -_EMPTY) for v in (old, new))
    wide = old.covs[:, :1, 0] + 1e-280
    narrow = jnp.maximum(new.covs[:, :1, 0], 1e-12 * wide)
    height, half = after[:, None] - 0.5 * jnp.log(narrow), jnp.sqrt(0.5 / narrow)

    def logs(y):
        return height - ((y - new.means) * half) ** 2

    log_weights = np.log(rule.weights)
    p = jnp.exp(before[:, None] + values + log_weights).reshape(-1)
    q = jnp.exp(logs(x) + 0.5 * (jnp.log(wide) + rule.nodes[:, 0] ** 2) + log_weights).reshape(-1)
    share = jnp.exp(after)
    counted = share > _LIGHT
    scale = jnp.where(counted, jax.lax.rsqrt(jnp.where(counted, share, 1.0)), 0.0)
    parts = jnp.exp(logs(x.reshape(-1)))
    parts = parts * scale[:, None] / jnp.maximum(jnp.sum(parts, axis=0), 1e-290)
    gram = (parts * p) @ parts.T + _RIDGE * jnp.eye(len(share))
    # A sum and no product of a matrix and a vector, which takes several times as long here.
    slope = jnp.sum(parts * (p - q), axis=1)
    change = products * scale * jax.scipy.linalg.solve(gram, slope, assume_a="pos")
    change = jnp.where(jnp.all(jnp.isfinite(change)), change, 0.0)
    # The step is shortened as a whole: of near-duplicates the changes cancel, and one of them cut short alone would not.
    change = change / jnp.maximum(1.0, jnp.max(jnp.abs(change)) / _CHANGE)
    return new._replace(log_weights=new.log_weights + jnp.log1p(change) - jnp.log1p(jnp.sum(share * change)))


def refit_affine(sum_: Components, C: jax.Array, c: jax.Array, linear: jax.Array, energy: jax.Array) -> Components:
    """The sum times exp(linear.h - h'(energy) h / 2), exactly, for h = C x + c with C (m, n) and c (m,)."""

    def one(m, P):
        centre = C @ m + c
        slope = C.T @ (linear - energy @ centre)
        spread = P @ C.T
        # P (1 + C'E C P)^-1, by the smaller system in the observations.
        inner = jnp.eye(len(c)) + energy @ C @ spread
        gain = spread @ jnp.linalg.solve(inner, energy)
        new = P - gain @ spread.T
        new = 0.5 * (new + new.T)
        shift = new @ slope
        mass = linear @ centre - 0.5 * centre @ energy @ centre + 0.5 * slope @ shift - 0.5 * jnp.linalg.slogdet(inner)[1]
        return m + shift, new, mass

    mean, cov, mass = jax.vmap(one)(sum_.means, sum_.covs)
    return Components(sum_.log_weights + mass, mean, cov, sum_.signs)


def _divergence(logs: jax.Array, values: jax.Array, z: jax.Array, log_mass: jax.Array, cov: jax.Array) -> jax.Array:
    """The relative entropy (K,) of N(z; 0, 1) e^values, normalised, from the Gaussian with its moments."""
    weight = jax.nn.softmax(logs, axis=1)
    level = jnp.where(weight > 0, values - 0.5 * jnp.sum(z**2, -1), 0.0)
    k = z.shape[-1]
    entropy = jnp.log(jnp.maximum(cov[:, 0, 0], 1e-300)) if k == 1 else jnp.linalg.slogdet(cov)[1]
    return jnp.maximum(jnp.sum(weight * level, axis=1) - log_mass + 0.5 * (k + entropy), 0.0)


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
