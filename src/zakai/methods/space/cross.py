"""The equation of several states whose noise is correlated with that of the observations: E dv dw' = C dt.

With a = g C (n, m), K = S^-1, r = dy/dt and y linear between observations,

    u_t = (G - a K a') : Hess u / 2 - div((f + a K (r - h) - sum K_ij (a_j.grad) a_i / 2) u) + V u,
    V   = h'K r - h'K h / 2 - sum K_ij a_j.grad h_i / 2,

which is u_t = L u - sum K_ij M_i M_j u / 2 + sum K_ij r_j M_i u with M_i u = h_i u - div(a_i u), the Zakai equation in the sense
of Stratonovich.  Derivatives in the first term act on the coefficients too.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any

import numpy as np
import sympy

from zakai.methods.space.functions import PointFunction
from zakai.methods.space.observed import Observations
from zakai.methods.space.system import System
from zakai.models.functions import without_jumps
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.numerics.space.average import panel_rule
from zakai.numerics.space.grid import Grid
from zakai.numerics.space.splitting import Factor

Array = Any


class CrossFormulas:
    """The coefficients of the equation as functions of x, t, the parameters and, after the inputs, of r and K."""

    def __init__(self, model: Model):
        n, m, x, h = model.n, model.m, model.x, model.observation
        rates = sympy.Matrix(m, 1, lambda i, _: sympy.Dummy(f"r{i}", real=True))
        gain = sympy.Matrix(m, m, lambda i, j: sympy.Dummy(f"K{i}_{j}", real=True))
        self.model = copy(model)
        vars(self.model).update(u=(*model.u, *rates, *gain))
        cross = sympy.Matrix(model.diffusion * model.cross_noise)

        def along(formula: sympy.Expr, j: int) -> sympy.Expr:
            return sum((cross[k, j] * without_jumps(formula, x[k]) for k in range(n)), sympy.S.Zero)

        pairs = [(i, j) for i in range(m) for j in range(m)]
        drift = sympy.Matrix(model.drift) + cross * gain * (rates - sympy.Matrix(h))
        drift -= sympy.Matrix([sum((gain[i, j] * along(cross[k, i], j) for i, j in pairs), sympy.S.Zero) for k in range(n)]) / 2
        potential = (sympy.Matrix(h).T * gain * (rates - sympy.Matrix(h) / 2))[0]
        potential -= sum((gain[i, j] * along(h[i], j) for i, j in pairs), sympy.S.Zero) / 2
        divergence = sum((without_jumps(f, s) for f, s in zip(drift, x, strict=True)), sympy.S.Zero)
        covariance = sympy.Matrix(model.covariance) - cross * gain * cross.T
        self.drift = PointFunction([*drift, divergence], self.model, (n + 1,))
        self.jacobian = PointFunction([without_jumps(f, s) for f in drift for s in x], self.model, (n, n))
        self.covariance = numpy_function(covariance, self.model, (n, n))
        self.potential = PointFunction([potential, *(without_jumps(potential, s) for s in x)], self.model, (n + 1,))
        given, noise = {model.t, *model.u}, bool(model.observation_noise.free_symbols & {model.t, *model.u})
        self.state_dependent = bool(covariance.free_symbols & set(x))
        self.covariance_varies = noise or bool(covariance.free_symbols & given)
        self.drift_varies = noise or bool(drift.free_symbols & given)
        self.potential_varies = noise or bool(potential.free_symbols & given)


@once_for_a_model
def cross_formulas(model: Model) -> CrossFormulas:
    """Return the coefficients of a model, made once."""
    return CrossFormulas(model)


class CrossSystem(System):
    """The functions of a model for one interval: what is observed there enters the drift, the noise and the potential."""

    def __init__(self, observations: Observations, inside: Array, rates: Array, start: float, stop: float):
        system, formulas = observations.system, cross_formulas(observations.model)
        vars(self).update(vars(system))
        self.drift_varies, self.covariance_varies = formulas.drift_varies, formulas.covariance_varies
        self.state_dependent = formulas.state_dependent
        self.potential_varies = formulas.potential_varies
        rows, m = np.ix_(inside, inside), len(inside)
        origin, theta = np.zeros(system.n), observations.theta

        def given(t: Any) -> Array:
            """Return the inputs, r and K at times t (...)."""
            times = np.asarray(t, float)
            noise = np.broadcast_to(system.noise(origin, times, theta), (*times.shape, m, m))
            gain = np.zeros(noise.shape, noise.dtype)
            gain[..., rows[0], rows[1]] = np.linalg.inv(noise[..., rows[0], rows[1]])
            parts = [np.broadcast_to(np.where(inside, rates, 0.0), (*times.shape, m)), gain.reshape(*times.shape, m * m)]
            inputs = observations.inputs_within(times, start, stop)
            if inputs is not None:
                parts.insert(0, inputs)
            return np.concatenate(parts, axis=-1)

        def bind(function: Callable[..., Array]) -> Callable[..., Array]:
            return lambda x, t, theta: function(x, t, theta, given(t))

        self.drift, self.jacobian, self.covariance = bind(formulas.drift), bind(formulas.jacobian), bind(formulas.covariance)
        self.potential = bind(formulas.potential)


def potential_of(observations: Observations, start: float, length: float) -> Any:
    """Return the factor of V over a substep, as a function of a grid."""
    system, theta, dynamics = observations.system, observations.theta, observations.dynamics
    assert isinstance(system, CrossSystem)

    def factor(grid: Grid, a: float, b: float, end: bool) -> Factor:
        a, b = max(a, start), min(b, start + length)
        places, weights = np.array([0.5]), np.ones(1)
        if system.potential_varies:
            places, weights = panel_rule(1)
        fields: Array = 0.0
        for share, weight in zip(places, weights, strict=True):
            fields = fields + (b - a) * weight * system.potential(grid.points, a + (b - a) * share, theta).T
        lost = ~np.isfinite(fields.real).all(axis=0)  # the density ends where V is not finite
        log, slope = np.where(lost, -1e300, fields[0]), np.where(lost, 0.0, fields[1:])
        if dynamics.diffusion is None:
            steep = ((dynamics.noise(a, b)[0] @ slope) * slope).sum(axis=0)
        else:
            steep = np.einsum("jde,dj,ej->j", dynamics.diffusion(grid.points, 0.5 * (a + b)), slope, slope)
        return Factor(log.reshape(grid.sizes), ((a - b) / 144 * steep).reshape(grid.sizes))

    return factor
