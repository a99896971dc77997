"""The papers' Algorithm 1: a Gaussian sum fitted to the peaks of a density, then to the negative peaks of what is left.

Kept as it was printed, for comparison.  A peak below alpha times the maximum is not fitted: what lies there is deleted, and a
filter cannot get it back.
"""

from __future__ import annotations

from zakai import _float64  # noqa: F401

import jax  # isort: skip
import jax.numpy as jnp  # isort: skip
import numpy as np

from zakai.densities.components import Components, shares

POINTS = 512
_REACH = 6.0


def _values(sum_: Components, x: jax.Array) -> jax.Array:
    """The sum, of mass one, at points x (N,); one state."""
    share = shares(sum_)[0]
    variance = sum_.covs[:, 0, 0]
    z = (x[:, None] - sum_.means[:, 0]) ** 2 / variance
    return jnp.exp(-0.5 * z) @ (share / jnp.sqrt(2 * jnp.pi * variance))


def fit_peaks(sum_: Components, alpha: float) -> Components:
    """The survey's Algorithm 1 with threshold alpha max, in as many Gaussians as the sum has slots; one state.

    A Gaussian has a peak's place, height and curvature; its weight has the peak's sign.
    """
    K = len(sum_.log_weights)
    deviation = jnp.sqrt(sum_.covs[:, 0, 0])
    alive = jnp.isfinite(sum_.log_weights)
    low = jnp.min(jnp.where(alive, sum_.means[:, 0] - _REACH * deviation, jnp.inf))
    high = jnp.max(jnp.where(alive, sum_.means[:, 0] + _REACH * deviation, -jnp.inf))
    x = low + (high - low) * jnp.arange(POINTS) / (POINTS - 1)
    cell = x[1] - x[0]
    target = _values(sum_, x)
    threshold = alpha * jnp.max(target)

    def fit(carry, _):
        left, negative = carry
        negative = negative | (jnp.max(left) <= threshold)
        sign = jnp.where(negative, -1.0, 1.0)
        signed = sign * left
        at = jnp.clip(jnp.argmax(signed), 1, POINTS - 2)
        height = signed[at]
        logs = jnp.log(jnp.maximum(jax.lax.dynamic_slice(signed, (at - 1,), (3,)), 1e-12 * jnp.abs(height) + 1e-300))
        bend = 2 * logs[1] - logs[0] - logs[2]
        variance = cell**2 / jnp.maximum(bend, 1e-4)
        place = x[at] + jnp.clip(0.5 * (logs[2] - logs[0]) / jnp.maximum(bend, 1e-4), -0.5, 0.5) * cell
        used = height > threshold
        left = left - jnp.where(used, sign * height, 0.0) * jnp.exp(-0.5 * (x - place) ** 2 / variance)
        weight = jnp.where(used, jnp.log(jnp.maximum(height, 1e-300)) + 0.5 * jnp.log(2 * jnp.pi * variance), -jnp.inf)
        return (left, negative), (weight, place, variance, sign)

    _, (weights, places, variances, signs) = jax.lax.scan(fit, (target, jnp.array(False)), None, length=K)
    return Components(weights, places[:, None], variances[:, None, None], signs)


def fit_dictionary(sum_: Components, share: jax.Array, iterations: int = 300) -> Components:
    """Non-negative least squares on a lattice of equal Gaussians with as many nodes as the sum has slots; one or two states.

    Minimises the integrated square of the difference by multiplicative steps w <- w b / (A w).  The spacing is a power of
    2^(1/4), so that the nodes seldom change from step to step.
    """
    K, n = sum_.means.shape
    count = int(round(K ** (1 / n) - 0.499))
    used = share > 1e-6
    deviation = jnp.sqrt(jnp.diagonal(sum_.covs, axis1=1, axis2=2))
    low = jnp.min(jnp.where(used[:, None], sum_.means - 2.0 * deviation, jnp.inf), axis=0)
    high = jnp.max(jnp.where(used[:, None], sum_.means + 2.0 * deviation, -jnp.inf), axis=0)
    spacing = 2.0 ** (jnp.ceil(4 * jnp.log2((high - low) / (count - 2))) / 4)
    first = jnp.round((low + high) / (2 * spacing)) - (count - 1) // 2
    index = np.stack(np.meshgrid(*[np.arange(count)] * n, indexing="ij"), axis=-1).reshape(-1, n)
    nodes = (first + index) * spacing
    cov = jnp.diag((0.8 * spacing) ** 2)

    def overlap(a, P):
        apart = nodes - a
        inner = cov + P
        quadratic = jnp.einsum("ki,ki->k", apart, jnp.linalg.solve(inner, apart.T).T)
        return jnp.exp(-0.5 * quadratic) / jnp.sqrt(jnp.linalg.det(2 * jnp.pi * inner))

    weight = shares(sum_)[0]
    wanted = jax.vmap(overlap)(sum_.means, sum_.covs).T @ weight
    gram = jax.vmap(lambda a: overlap(a, cov))(nodes)

    def improve(_, w):
        return w * wanted / jnp.maximum(gram @ w, 1e-300)

    w = jax.lax.fori_loop(0, iterations, improve, jnp.maximum(wanted, 1e-300) * jnp.prod(spacing))
    w = w / jnp.sum(w)
    logs = jnp.where(w > 1e-12, jnp.log(jnp.maximum(w, 1e-12)), -jnp.inf)
    missing = K - len(logs)
    pad = (jnp.full(missing, -jnp.inf), jnp.broadcast_to(nodes[:1], (missing, n)))
    return Components(
        jnp.concatenate([logs, pad[0]]), jnp.concatenate([nodes, pad[1]]), jnp.broadcast_to(cov, (K, n, n)), jnp.ones(K)
    )
