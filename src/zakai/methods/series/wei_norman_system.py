"""Wei and Norman's statistics: their differential equations, and the product of exponentials that they make."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import sympy as sp

from zakai.algebra.estimation_algebra import estimation_algebra
from zakai.algebra.exponentials import exponentials
from zakai.errors import ConditionError
from zakai.methods.system.residuals import Sensors
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.numerics.complex_step import is_complex

Array = np.ndarray
_SUBSTEPS = np.array([2, 4, 6, 8, 10])  # of the midpoint rule, which is extrapolated to order ten
_EXTRAPOLATION = np.array([np.prod([1 / (1 - (b / a) ** 2) for b in _SUBSTEPS if b != a]) for a in _SUBSTEPS.astype(float)])


@lru_cache(maxsize=16)
def _gauss(count: int) -> list[tuple[float, float]]:
    """Return the nodes and weights of Gauss and Legendre on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(count)
    return list(zip(0.5 * (x + 1), 0.5 * w))


class System:
    """A model with a finite algebra at one theta; `count` is the number d of statistics."""

    def __init__(self, model: Model, theta: Array):
        algebra = estimation_algebra(model)
        factors, equations = exponentials(model, algebra), algebra.wei_norman
        assert equations is not None and not isinstance(factors, str)
        general = algebra.parameters.startswith("the same for general values") if algebra.parameters else True
        if is_complex(theta) and not general:
            raise ConditionError(f"{model.source}: wei-norman has no gradient here: its algebra is known {algebra.parameters}")
        variables = (*equations.statistics, *equations.rates)
        polynomials = [sp.Poly(rate, *variables) for rate in equations.stratonovich.values()]
        monomials = sorted({powers for p in polynomials for powers in p.monoms()})
        count, origin = len(factors), np.zeros(model.n)

        def numbers(expressions: list[Any], *shape: int) -> Array:
            return numpy_function([*expressions, sp.Integer(0)], model)(origin, 0.0, theta)[:-1].reshape(shape)

        self.model, self.theta, self.n, self.count = model, theta, model.n, count
        self.coefficients = numbers([p.coeff_monomial(m) for p in polynomials for m in monomials], count, len(monomials))
        self.directions = numbers([a for factor in factors for a in factor.direction], count, model.n)
        # The variables whose product a monomial is, filled up with the last, which is one.
        products = [[i for i, k in enumerate(powers) for _ in range(k)] for powers in monomials]
        longest = max([len(which) for which in products], default=0)
        self.products = np.array([which + [len(variables)] * (longest - len(which)) for which in products], int)
        linear = np.array([float(len(which) == 1 and which[0] < count) for which in products])
        self.speed = float(np.max(np.abs(self.coefficients.real) @ linear, initial=0.0)) if count else 0.0
        self.rates = [numpy_function([factor.rate], model) for factor in factors]
        self.drift = numpy_function(model.drift, model)
        self.covariance = numpy_function(model.covariance, model, (model.n, model.n))(origin, 0.0, theta)
        self.sensors = Sensors.of(model)

    def advanced(self, r: Array, rates: Array, tau: float) -> Array:
        """Return the statistics after `tau`, with constant rates of y, by Gragg's midpoint rule, extrapolated."""
        if not self.count:
            return r
        known = np.broadcast_to(np.append(rates, 1.0), (len(_SUBSTEPS), len(rates) + 1))

        def slope(r: Array) -> Array:
            z = np.concatenate([r, known], axis=1)
            return np.asarray(np.prod(z[:, self.products], axis=2) @ self.coefficients.T)

        h = tau / _SUBSTEPS[:, None]
        before = np.broadcast_to(r, (len(_SUBSTEPS), len(r)))
        now = before + h * slope(before)
        for step in range(1, _SUBSTEPS[-1]):
            after = before + 2 * h * slope(now)
            last = step >= _SUBSTEPS[:, None]
            before, now = np.where(last, before, now), np.where(last, now, after)
        return np.asarray(_EXTRAPOLATION @ (0.5 * (before + now + h * slope(now))))

    def product(self, r: Array, points: Array, spacing: Array) -> tuple[Array, Array]:
        """Return the shift (n,) and, at the points (..., n) of v, the log of the multiplier: u(z - shift) = exp(...) v(z).

        The integrals are exact for what the grid, `spacing` (n,), resolves.
        """
        at, logs = points, np.zeros(points.shape[:-1])
        for k in range(self.count):
            step = r[k] * self.directions[k]
            if np.any(self.directions[k] != 0):
                at = at - step
                for s, w in _gauss(min(12, 4 + int(np.ceil(4 * np.max(np.abs(step.real) / spacing))))):
                    logs = logs + w * r[k] * self.rates[k](at + s * step, 0.0, self.theta)[..., 0]
            else:
                logs = logs + r[k] * self.rates[k](at, 0.0, self.theta)[..., 0]
        return r @ self.directions, logs
