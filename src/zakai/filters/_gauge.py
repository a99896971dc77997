"""The gauge of a model as numbers, and what a family of Gaussians becomes under it: u = e^phi v, with its moments.

If e^phi = sum_j e^{c_j + q_j.x} every Gaussian becomes a sum of tilted ones,

    e^{q.x} N(x; m, P) = e^{q.m + q'P q/2} N(x; m + P q, P).

Else phi depends on one or two directions z = D x, and the integrals over z are sums over equidistant points.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.algebra.gauges import gauge
from zakai.filters._affine_system import Matrices
from zakai.filters._formulas import Formulas
from zakai.kolmogorov.families import Family, log_terms
from zakai.kolmogorov.numpy_or_jax import numpy_or_jax
from zakai.models.compile import jax_field
from zakai.models.model import Model
from zakai.models.numeric import numpy_function

# Standard deviations to each side, and points, of the sums over a direction of a general gauge.
_REACH, _POINTS = 9.0, {1: 145, 2: 49}


class GaugeFunctions:
    """phi and its exponentials as functions of time and parameters; `exact` where e^phi is a sum of exponentials.

    They are NumPy for NumPy arguments, and JAX for JAX arguments.
    """

    def __init__(self, model: Model):
        form = gauge(model)
        assert form is not None
        self.trivial = form.potential == 0
        self.exact = form.slopes is not None
        self.count = form.directions.rows
        self._field, self._function = jax_field([form.potential], model), numpy_function(form.potential, model)
        blocks = [form.directions]
        if form.slopes is not None and form.logs is not None:
            blocks += [form.slopes, form.logs]
        self._matrices = Matrices(blocks, model)

    def potential(self, x: Any, t: Any, theta: Any) -> Any:
        """phi (...) at x (..., n)."""
        return self._function(x, t, theta) if numpy_or_jax(x, t, theta) is np else self._field(x, t, theta)[0]

    def at(self, t: Any, theta: Any) -> Tilts:
        """The directions, slopes and logarithms of the coefficients at time t."""
        blocks = self._matrices(t, theta)
        slopes, logs = blocks[1:] if self.exact else (None, None)
        return Tilts(blocks[0], slopes, None if logs is None else logs[..., 0])


class Tilts(NamedTuple):
    """`directions` D (k, n); where e^phi is a sum of exponentials `slopes` q (K, n) and `logs` c (K,), else None."""

    directions: Any
    slopes: Any
    logs: Any


@lru_cache(maxsize=32)
def gauge_of(of: Formulas) -> GaugeFunctions:
    """The gauge of a model, one for all values of its parameters."""
    return GaugeFunctions(of.model)


def lifted(directions: Any, z: Any) -> Any:
    """A state x (..., n) with D x = z (..., k)."""
    return z @ numpy_or_jax(directions).linalg.solve(directions @ directions.T, directions)


class Posterior(NamedTuple):
    """u as Gaussians: the log-mass of u, its `mean` and `cov`; `logs` and `signs` (J, N, E) are the weights of
    N(centres (J, E) + Gamma (J) s (J, N), covs (J)), and `doubt` an estimate of the relative error of the sums over z."""

    log_mass: Any
    mean: Any
    cov: Any
    logs: Any
    signs: Any
    centres: Any
    covs: Any
    doubt: Any


@partial(jax.jit, static_argnums=0)
def posterior(functions: GaugeFunctions, tilts: Tilts, t: Any, theta: Any, families: Family) -> Posterior:
    """e^phi times the families (leading axis J), with its first two moments."""
    logs = jax.vmap(log_terms)(families)
    centres, covs, extra = _exponential(tilts, families) if functions.exact else _summed(functions, tilts, t, theta, families)
    logs = logs[:, :, None] + extra
    signs = families.signs[:, :, None]
    top = jax.lax.stop_gradient(jnp.max(logs))
    weights = signs * jnp.exp(logs - top)
    total = jnp.sum(weights)
    share = weights / total
    doubt = jnp.zeros(())
    if not functions.exact:
        # Twice the spacing squares the error of such a sum, or worse.
        sign = _checkerboard(functions.count)
        doubt = (jnp.sum(weights * sign) / total) ** 2
    # Sums over the nodes, relative to a node near the mass, so that nothing is subtracted that is large against the spread.
    near = jax.vmap(lambda s, w: s[jnp.argmax(jnp.max(w, axis=1))])(families.nodes, logs)
    s = families.nodes - near[:, None]
    zeroth = jnp.sum(share, axis=1)
    first = jnp.einsum("jne,jnk->jek", share, s)
    second = jnp.einsum("jne,jnk,jnl->jkl", share, s, s)
    here = centres + jnp.einsum("jnk,jk->jn", families.response, near)[:, None]
    reference = jnp.einsum("je,jen->n", zeroth, here)
    mean = reference + jnp.einsum("jnk,jek->n", families.response, first)
    away = here - mean
    cross = jnp.einsum("jen,jmk,jek->nm", away, families.response, first)
    cov = (
        jnp.einsum("je,jen,jem->nm", zeroth, away, away)
        + cross
        + cross.T
        + jnp.einsum("jnk,jkl,jml->nm", families.response, second, families.response)
        + jnp.einsum("je,jnm->nm", zeroth, covs)
    )
    return Posterior(top + jnp.log(total), mean, 0.5 * (cov + cov.T), logs, signs, centres, covs, doubt)


def _exponential(tilts: Tilts, families: Family):
    """(centres, covariances, log-factors) of the tilted Gaussians."""
    pushed = jnp.einsum("jnm,em->jen", families.cov, tilts.slopes)
    at_mean = families.mean @ tilts.slopes.T + 0.5 * jnp.einsum("jen,en->je", pushed, tilts.slopes)
    at_node = jnp.einsum("en,jnk,jmk->jme", tilts.slopes, families.response, families.nodes)
    return families.mean[:, None] + pushed, families.cov, tilts.logs + at_mean[:, None] + at_node


def _checkerboard(count: int) -> np.ndarray:
    index = np.arange(_POINTS[count])
    sign = (-1.0) ** index
    return sign if count == 1 else np.outer(sign, sign).ravel()


def _standard(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Equidistant points xi (R, k) and log-weights (R,) of the standard Gaussian."""
    line = np.linspace(-_REACH, _REACH, _POINTS[count])
    points = np.stack(np.meshgrid(*[line] * count, indexing="ij"), axis=-1).reshape(-1, count)
    return points, -0.5 * np.sum(points**2, axis=1) + count * np.log((line[1] - line[0]) / np.sqrt(2 * np.pi))


def _summed(functions: GaugeFunctions, tilts: Tilts, t: Any, theta: Any, families: Family):
    """(centres, remaining covariances, log-factors): x = m + Gamma s + P D'C'^-1 xi + rest, C C' = D P D', xi standard."""
    points, log_weights = _standard(functions.count)
    directions = tilts.directions

    def one(family: Family):
        across = family.cov @ directions.T
        inner = directions @ across
        # Where z has no width there is nothing to sum over, and the rest of the covariance is all of it.
        least = 1e-14 * jnp.trace(inner) * (len(inner) > 1) + 1e-300
        factor = jnp.linalg.cholesky(inner + least * jnp.eye(len(inner)))
        along = jax.lax.linalg.triangular_solve(factor, across, left_side=False, lower=True, transpose_a=True)
        moved = points @ along.T
        x = family.mean + (family.nodes @ family.response.T)[:, None] + moved
        return family.mean + moved, family.cov - along @ along.T, functions.potential(x, t, theta) + log_weights

    return jax.vmap(one)(families)
