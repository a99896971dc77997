"""The flow of a linear stochastic system over one interval, without a bound on the step."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401

DOUBLINGS = 10
TERMS = 10
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)


def linear_flow(
    matrix: jax.Array, change: jax.Array, offset: jax.Array, covariance: jax.Array, length: jax.Array, clock: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The flow of dx = (A x + a s + b) dt + dv, E dv dv' = G dt, where s runs from `clock` to `clock + length`.

    `matrix` A (n, n), `change` a (n,), `offset` b (n,), `covariance` G (n, n).  Gives (Phi, c, W): x moves to Phi x + c and
    gathers noise of covariance W, which is positive semidefinite by construction, also for singular G.
    """
    n = len(offset)
    # The state with its clock and a one: the forcing is part of the exponential.
    generator = jnp.zeros((n + 2, n + 2)).at[:n].set(jnp.column_stack([matrix, change, offset])).at[n, n + 1].set(1.0)
    tiny = length / 2**DOUBLINGS
    whole = _exponential(tiny * generator)
    inner = jax.vmap(lambda share: _exponential(share * tiny * matrix))(0.5 * (1.0 + _NODES))
    spread = 0.5 * tiny * jnp.einsum("q,qij,jk,qlk->il", jnp.asarray(_WEIGHTS), inner, covariance, inner)

    def double(_, carry):
        map_, gathered = carry
        part = map_[:n, :n]
        return map_ @ map_, part @ gathered @ part.T + gathered

    whole, spread = jax.lax.fori_loop(0, DOUBLINGS, double, (whole, spread))
    return whole[:n, :n], whole[:n, n] * clock + whole[:n, n + 1], spread


def _exponential(matrix: jax.Array) -> jax.Array:
    """The Taylor polynomial of the exponential, for a matrix whose norm is well below one."""
    identity = jnp.eye(len(matrix))
    return jax.lax.fori_loop(0, TERMS, lambda k, value: identity + matrix @ value / (TERMS - k), identity)
