"""The online half of a Wei-Norman filter: the statistics' equations, and the product of exponentials on a lattice.

    u = exp(r_d E_d) ... exp(r_1 E_1) v,      r' a polynomial in r and dy/dt,      v = exp(t L_0) sigma_0

For z = x + sum_k r_k a_k, exp(r_k E_k) goes from z - r_1 a_1 - ... - r_k a_k to the point before it, so that u is v on a lattice
that is shifted as a whole, times exp of integrals along these segments: nothing is interpolated.
"""

from __future__ import annotations

from collections.abc import Hashable
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import sympy as sp
from jax import lax

from zakai import _float64  # noqa: F401
from zakai.algebra.estimation_algebra import estimation_algebra
from zakai.algebra.exponentials import exponentials
from zakai.filters._formulas import Formulas, formulas
from zakai.models.compile import jax_field, jax_function
from zakai.models.model import Model

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
_SUBSTEPS = np.array([2.0, 4.0, 6.0, 8.0, 10.0])  # of the midpoint rule, which is extrapolated to order ten
_EXTRAPOLATION = np.array([np.prod([1 / (1 - (b / a) ** 2) for b in _SUBSTEPS if b != a]) for a in _SUBSTEPS])
STEP = 0.25  # of the statistics' equations, in units of their linear part


class System:
    """A model with a finite algebra as functions of x and the parameters; `count` is d."""

    def __init__(self, model: Model):
        algebra = estimation_algebra(model)
        factors, equations = exponentials(model, algebra), algebra.wei_norman
        assert equations is not None and not isinstance(factors, str)
        variables = (*equations.statistics, *equations.rates)
        polynomials = [sp.Poly(rate, *variables) for rate in equations.stratonovich.values()]
        monomials = sorted({powers for p in polynomials for powers in p.monoms()})
        coefficients = [p.coeff_monomial(powers) for p in polynomials for powers in monomials]
        self.n, self.count = model.n, len(factors)
        self._numbers = jax_function([*coefficients, *[a for factor in factors for a in factor.direction], sp.Integer(0)], model)
        # The numbers of the variables whose product a monomial is.
        self._monomials = [[i for i, k in enumerate(powers) for _ in range(k)] for powers in monomials]
        self._linear = np.array([float(len(which) == 1 and which[0] < self.count) for which in self._monomials])
        self._still = [all(a == 0 for a in factor.direction) for factor in factors]
        self._rates = [jax_field([factor.rate], model) for factor in factors]
        self.drift = jax_field(model.drift, model)
        self.observed = jax_field(model.observation, model)
        self.covariance = jax_function(model.covariance, model, (model.n, model.n))

    def numbers(self, theta: Any) -> tuple[jax.Array, jax.Array]:
        """The coefficients of the statistics' equations (d, monomials), and the directions (d, n)."""
        d, count = self.count, len(self._monomials)
        values = self._numbers(jnp.zeros(self.n), 0.0, theta)
        return values[: d * count].reshape(d, count), values[d * count : -1].reshape(d, self.n)

    def speed(self, coefficients: jax.Array) -> jax.Array:
        """The size of the linear part of the statistics' equations."""
        return jnp.max(jnp.abs(coefficients) @ self._linear, initial=0.0)

    def advanced(self, coefficients: jax.Array, r: jax.Array, rates: jax.Array, tau: jax.Array) -> jax.Array:
        """The statistics after `tau`, with constant rates of y, by Gragg's midpoint rule, extrapolated."""
        if not self.count:
            return r

        def slope(r: jax.Array) -> jax.Array:
            z = jnp.concatenate([r, rates])
            products = []
            for factors in self._monomials:
                value = jnp.ones(())
                for i in factors:
                    value = value * z[i]
                products.append(value)
            return coefficients @ jnp.stack(products)

        h = tau / _SUBSTEPS[:, None]
        slopes = jax.vmap(slope)

        def midpoint(pair: Any, last: Any) -> tuple[Any, None]:
            before, now = pair
            after = before + 2 * h * slopes(now)
            return (jnp.where(last, before, now), jnp.where(last, now, after)), None

        start = jnp.broadcast_to(r, (len(_SUBSTEPS), len(r)))
        done = np.arange(1, int(_SUBSTEPS[-1]))[:, None, None] >= _SUBSTEPS[:, None]
        (before, now), _ = lax.scan(midpoint, (start, start + h * slopes(start)), done)
        return jnp.asarray(_EXTRAPOLATION) @ (0.5 * (before + now + h * slopes(now)))

    def product(self, directions: jax.Array, r: jax.Array, points: jax.Array, theta: Any) -> tuple[jax.Array, jax.Array]:
        """The shift (n,) and, at the points (..., n) of v, the logarithm of what multiplies it: u(z - shift) = exp(...) v(z)."""
        at, logs = points, jnp.zeros(points.shape[:-1])
        for k in range(self.count):
            rate, step = self._rates[k], r[k] * directions[k]
            if self._still[k]:
                logs = logs + r[k] * rate(at, 0.0, theta)[0]
                continue
            at = at - step
            start = at

            def add(total, node, start=start, step=step, rate=rate):
                return total + node[1] * rate(start + node[0] * step, 0.0, theta)[0], None

            nodes = jnp.stack([0.5 * (_NODES + 1), 0.5 * _WEIGHTS], axis=1)
            logs = logs + r[k] * lax.scan(add, jnp.zeros_like(logs), nodes)[0]
        return r @ directions, logs


@lru_cache(maxsize=64)
def _system(of: Formulas, algebra: Hashable) -> System:
    return System(of.model)


def system_of(model: Model) -> System:
    """The system of a model, made once for all models with the same formulas and the same algebra."""
    algebra = estimation_algebra(model)
    assert algebra.wei_norman is not None
    return _system(formulas(model), (algebra.basis, tuple(algebra.wei_norman.stratonovich.values())))
