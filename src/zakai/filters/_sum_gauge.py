"""From the Gaussian sum v to the density u = e^phi v, without e^phi itself.

Where e^phi is a sum of exponentials of linear forms, as for log cosh, it is exact:

    e^{c + q.x} N(x; m, P) = e^{c + q.m + q'P q / 2} N(x; m + P q, P).

For any other phi each component of u is the Gaussian with the moments of e^{phi(x)} N(x; m, P), by quadrature in logarithms.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import sympy as sp

from zakai import _float64  # noqa: F401
from zakai.algebra.exponential_sum import exponential_sum
from zakai.densities.components import Components
from zakai.densities.quadrature import refit
from zakai.filters._directions import directions_of
from zakai.models.compile import jax_field, jax_function
from zakai.models.model import Model


class SumGauge:
    """phi of a model, compiled: `exact` where e^phi is a sum of exponentials, `directions` (n, k) along which phi varies."""

    def __init__(self, phi: sp.Expr, model: Model):
        self.n, self.none = model.n, phi == 0
        self.directions = directions_of([phi], model)
        self._potential = jax_field([phi], model)
        terms = exponential_sum(phi, model.x)
        self.exact = terms is not None
        self.count = len(terms) if terms is not None else 1
        if terms is not None:
            flat = [entry for constant, slopes in terms for entry in (constant, *slopes)]
            self._numbers = jax_function(flat, model, (self.count, 1 + model.n))

    def potential(self, x: jax.Array, t: Any, theta: Any) -> jax.Array:
        """phi at the points x (..., n)."""
        return self._potential(x, t, theta)[0]

    @partial(jax.jit, static_argnums=0)
    def lift(self, v: Components, t: Any, theta: Any) -> Components:
        """The components of u = e^phi v: `count` for each of v, one after another."""
        if self.none:
            return v
        if not self.exact:
            return refit(v, lambda x: self.potential(x, t, theta), self.directions, True).sum
        numbers = self._numbers(jnp.zeros(self.n), t, theta)
        constants, slopes = numbers[:, 0], numbers[:, 1:]
        across = jnp.einsum("kij,aj->kai", v.covs, slopes)
        logs = constants + v.means @ slopes.T + 0.5 * jnp.einsum("kai,ai->ka", across, slopes) + v.log_weights[:, None]
        means = v.means[:, None] + across
        return Components(
            logs.reshape(-1), means.reshape(-1, self.n), jnp.repeat(v.covs, self.count, axis=0), jnp.repeat(v.signs, self.count)
        )

    @partial(jax.jit, static_argnums=0)
    def divide(self, u: Components, t: Any, theta: Any) -> Components:
        """Components of v = e^-phi u, each with its moments: for the start, where u is given.

        Of a sum of exponentials the largest at the mean is divided out exactly, and quadrature is left with what differs from
        it: far from a bend that is nothing, however far the division moves the component.
        """
        if self.none:
            return u
        if not self.exact:
            return refit(u, lambda x: -self.potential(x, t, theta), self.directions, True).sum
        numbers = self._numbers(jnp.zeros(self.n), t, theta)
        largest = jnp.argmax(numbers[:, 0] + u.means @ numbers[:, 1:].T, axis=1)
        constant, slope = numbers[largest, 0], numbers[largest, 1:]
        across = jnp.einsum("kij,kj->ki", u.covs, slope)
        logs = u.log_weights - constant - jnp.sum(slope * (u.means - 0.5 * across), axis=1)

        def rest(x):
            one = constant[:, None] + jnp.einsum("kqi,ki->kq", x, slope)
            return one - jax.nn.logsumexp(x @ numbers[:, 1:].T + numbers[:, 0], axis=-1)

        return refit(u._replace(log_weights=logs, means=u.means - across), rest, self.directions, True).sum

    @partial(jax.jit, static_argnums=0)
    def doubt(self, u: Components, t: Any, theta: Any) -> jax.Array:
        """By how much each component (K,) of u is another one when it is divided and lifted again; an empty slot by nothing.

        The largest error of its mass, and along the directions of phi of its mean, in deviations, and of its variance; what is
        not a number counts as infinite.
        """
        used = jnp.isfinite(u.log_weights)
        u = jax.lax.stop_gradient(u._replace(log_weights=jnp.where(used, u.log_weights, 0.0)))
        back = jax.lax.stop_gradient(self.lift(self.divide(u, t, theta), t, theta))
        shape = (len(u.log_weights), -1)
        logs = back.log_weights.reshape(shape) - u.log_weights[:, None]
        share, along = jax.nn.softmax(logs, axis=1), jnp.asarray(self.directions)
        variance = jnp.einsum("ia,kij,ja->ka", along, u.covs, along)
        scale = jnp.where(variance > 0, variance, 1.0)[:, None]
        away = (back.means.reshape(*shape, self.n) - u.means[:, None]) @ along / jnp.sqrt(scale)
        inside = jnp.einsum("ia,kij,ja->ka", along, back.covs, along).reshape(*shape, along.shape[1]) / scale
        mean = jnp.einsum("kc,kca->ka", share, away)
        second = jnp.einsum("kc,kca->ka", share, inside + away**2) - mean**2
        wrong = jnp.where(variance > 0, jnp.maximum(jnp.abs(mean), jnp.abs(second - 1.0)), 0.0)
        mass = jnp.abs(jnp.expm1(jax.nn.logsumexp(logs, axis=1)))
        worst = jnp.maximum(mass, jnp.max(wrong, axis=1, initial=0.0))
        return jnp.where(used, jnp.where(jnp.isnan(worst), jnp.inf, worst), 0.0)
