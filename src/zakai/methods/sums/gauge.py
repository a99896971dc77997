"""From the Gaussian sum v to the density u = e^phi v, and along which directions functions of the state vary.

Where e^phi is a sum of exponentials of linear forms, as for log cosh, the product is exact.  For any other phi each component of
u is the Gaussian with the moments of e^{phi(x)} N(x; m, P), by quadrature in logarithms.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sympy as sp

from zakai.algebra.gauges import exponential_terms
from zakai.algebra.yau import YauForm
from zakai.methods.system.potential import potential_of
from zakai.models.features import JUMP_FUNCTIONS
from zakai.models.functions import Maximum, Minimum, TableFunction
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.numerics.complex_step import log_sum_exp
from zakai.numerics.sums.mixture import Array, Components, dot, product, tilted
from zakai.numerics.sums.quadrature import refit

_POINTS = 64
_FLAT, _NUMBER = (TableFunction, Minimum, Maximum, *JUMP_FUNCTIONS), sp.Rational(31, 41)
_AGREED = 1e-6  # relative error of the masses of components that e^phi multiplies or divides


def directions_of(functions: Sequence[sp.Expr], model: Model) -> Array:
    """Return an orthonormal W (n, k) such that the functions depend on x through W'x alone, at every time and for all parameters.

    Found from the gradients at random states, times, parameters, inputs and observations; a coordinate that no function has is
    never in the span.  Of a function that is constant in places, as a table is, those of its arguments count.
    """
    n, functions = model.n, _without_flat(functions, model)
    jacobian = sp.Matrix([[sp.diff(f, symbol) for symbol in model.x] for f in functions])
    used = np.array([any(entry != 0 for entry in jacobian[:, i]) for i in range(n)])
    if used.sum() <= 1:
        return np.eye(n)[:, used]
    rng = np.random.default_rng(0)
    x = rng.standard_normal((_POINTS, n)) * np.geomspace(0.1, 10.0, _POINTS)[:, None]
    times = model.start + rng.uniform(0.0, 3.0, _POINTS)
    own = model.theta()
    theta = own * rng.uniform(0.7, 1.4, (_POINTS, len(own))) + rng.uniform(0, 1e-2, (_POINTS, len(own)))
    u, z = rng.standard_normal((_POINTS, len(model.u))), rng.standard_normal((_POINTS, model.m))
    rows = numpy_function(jacobian, model, jacobian.shape)(x, times, theta, u, z).reshape(-1, n)
    rows = rows[np.isfinite(rows).all(axis=1)]
    size = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = (rows / np.where(size > 0, size, 1.0))[size[:, 0] > 0]
    # A coordinate of which no gradient knows, as where a function is constant at all of these states, is a direction of its own.
    rows = np.vstack([rows, np.eye(n)[used & ~rows.any(axis=0)]])
    _, values, vectors = np.linalg.svd(rows, full_matrices=False)
    rank = int(np.sum(values > 1e-9 * values[0]))
    # As many directions as coordinates: the coordinates themselves.
    return np.asarray(np.eye(n)[:, used] if rank >= used.sum() else vectors[:rank].T)


def _without_flat(functions: Sequence[sp.Expr], model: Model) -> list[sp.Expr]:
    """Return the functions with a number for each call that may be constant in places, and the arguments of those calls."""
    found: list[sp.Expr] = []
    for f in functions:
        calls = [call for call in f.atoms(*_FLAT) if call.has(*model.x)]
        for part in (f, *(a for call in calls for a in call.args)):
            found.append(part.replace(lambda e: e.has(*model.x) and isinstance(e, _FLAT), lambda e: _NUMBER))
    return found


def span(directions: Array) -> Array:
    """Return an orthonormal basis of the columns' span; coordinates where they are coordinates."""
    if directions.shape[1] == 0:
        return directions
    left, values, _ = np.linalg.svd(directions, full_matrices=False)
    left = left[:, values > 1e-9]
    used = np.flatnonzero(np.abs(left).max(axis=1) > 1e-12)
    return np.asarray(np.eye(len(directions))[:, used] if len(used) == left.shape[1] else left)


class SumGauge:
    """phi of a model as functions of z = x - origin: `exact` where e^phi is a sum of exponentials, `directions` (n, k)."""

    def __init__(self, form: YauForm, model: Model, origin: Array):
        self.n, self.none, self.origin = model.n, not form.curved, origin
        self.directions = directions_of([*form.gradient] if form.potential is None else [form.potential], model)
        self._potential = potential_of(form, model)
        terms = None if form.potential is None else exponential_terms(form.potential, model)
        self.exact, self.count = terms is not None, 1 if terms is None else terms[0].rows
        if terms is not None:
            logs, slopes = terms
            shift = sp.Matrix([sp.Rational(float(value)) for value in origin])
            self._numbers = numpy_function(sp.Matrix.hstack(logs + slopes * shift, slopes), model, (self.count, 1 + model.n))

    def potential(self, z: Array, t: float, theta: Array) -> Array:
        """Return phi at the points z (..., n)."""
        return np.asarray(self._potential(self.origin + z, t, theta))

    def terms(self, t: float, theta: Array) -> tuple[Array, Array]:
        """Return c (E,) and q (E, n) of e^phi = sum_e exp(c_e + q_e.z), where it is exact."""
        if self.none:
            return np.zeros(1), np.zeros((1, self.n))
        numbers = self._numbers(self.origin, t, theta)
        return numbers[:, 0], numbers[:, 1:]

    def lift(self, v: Components, t: float, theta: Array) -> Components:
        """Return the components of u = e^phi v: `count` for each of v, one after another."""
        if self.none:
            return v
        if not self.exact:
            return refit(v, lambda z, _: self.potential(z, t, theta), self.directions, True, agreed=_AGREED).sum
        return tilted(v, *self.terms(t, theta))

    def divide(self, u: Components, t: float, theta: Array) -> Components:
        """Return components of v = e^-phi u, each with its moments: for the start, where u is given.

        Of a sum of exponentials the largest at the mean is divided out exactly, and quadrature integrates what differs from it.
        """
        if self.none:
            return u
        if not self.exact:
            return refit(u, lambda z, _: -self.potential(z, t, theta), self.directions, True, agreed=_AGREED).sum
        constants, slopes = self.terms(t, theta)
        largest = np.argmax((constants + u.means @ slopes.T).real, axis=1)
        constant, slope = constants[largest], slopes[largest]
        across = dot(u.covs, slope[:, None, :])
        logs = u.log_weights - constant - dot(slope, u.means - 0.5 * across)

        def rest(z: Array, rows: Array) -> Array:
            one = constant[rows, None] + dot(z, slope[rows, None])
            return np.asarray(one - log_sum_exp(z @ slopes.T + constants, axis=-1))

        return refit(u._replace(log_weights=logs, means=u.means - across), rest, self.directions, True, agreed=_AGREED).sum

    def doubt(self, u: Components, t: float, theta: Array) -> Array:
        """Return by how much each component (K,) of u changes when it is divided and lifted again.

        The largest error of its mass, and along the directions of phi of its mean, in deviations, and of its variance; NaN counts
        as infinite.
        """
        u = Components(*(array.real for array in u))
        back = self.lift(self.divide(u, t, theta.real), t, theta.real)
        shape = (len(u.signs), -1)
        logs = back.log_weights.reshape(shape) - u.log_weights[:, None]
        log_mass = log_sum_exp(logs, axis=1)
        share, along = np.exp(logs - log_mass[:, None]), self.directions
        variance = (product(u.covs, along) * along).sum(axis=1)
        scale = np.where(variance > 0, variance, 1.0)[:, None]
        away = (back.means.reshape(*shape, self.n) - u.means[:, None]) @ along / np.sqrt(scale)
        inside = (product(back.covs, along) * along).sum(axis=1).reshape(*shape, along.shape[1]) / scale
        mean = (share[..., None] * away).sum(axis=1)
        second = (share[..., None] * (inside + away**2)).sum(axis=1) - mean**2
        wrong = np.where(variance > 0, np.maximum(np.abs(mean), np.abs(second - 1.0)), 0.0)
        worst = np.maximum(np.abs(np.expm1(log_mass)), wrong.max(axis=1, initial=0.0))
        return np.where(np.isnan(worst), np.inf, worst)
