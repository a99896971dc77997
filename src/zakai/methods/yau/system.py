"""The coefficients of a time-varying Yau system and its gauge u = e^phi v."""

from __future__ import annotations

from typing import Any

import numpy as np
import sympy as sp

from zakai.algebra.systems import yau_system
from zakai.methods.gaussian.affine_system import Matrices, precision_of
from zakai.methods.system.potential import potential_of
from zakai.methods.yau.kernel import PowerSeries
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model
from zakai.numerics.flow import Coefficients

Array = Any


class YauSystem:
    """The coefficients of the equation of v as functions of time, and the gauge."""

    def __init__(self, model: Model):
        yau = yau_system(model)
        assert yau is not None
        n, m = model.n, model.m
        self.affine = yau.slope is not None and model.observation_kind != "samples"
        self.unobserved, self.full = yau.unobserved is not None, yau.full is not None
        slope = yau.slope if self.affine else sp.zeros(m, n)
        intercept = yau.intercept if self.affine else sp.zeros(m, 1)
        blocks = [yau.form.matrix, yau.form.offset, model.covariance]
        full = yau.unobserved if model.observation_kind == "samples" else yau.full  # a sample acts at its time alone
        for quadratic in (yau.unobserved or yau.full, full or yau.full or yau.unobserved):
            assert quadratic is not None
            blocks += [quadratic.matrix, quadratic.linear, sp.Matrix([quadratic.constant])]
        if n == 1 and (model.drift.has(model.t) or model.covariance.has(model.t)):
            found = _unexpanded(model, yau)
            self.unobserved = self.unobserved and found is not None
            blocks[:6] = blocks[:6] if found is None else [sp.Matrix([entry]) for entry in found]
        self.blocks = [entry for block in blocks for entry in block.flat()]
        self.matrices = Matrices([*blocks, slope, intercept], model)
        self._noise = Matrices([model.observation_noise], model)
        self.gauged = yau.form.curved
        self.gauge_varies = yau.form.gradient.has(model.t)
        self._potential = potential_of(yau.form, model)

    def potential(self, points: Array, t: float, theta: Array) -> Array:
        """Return phi (J,)."""
        return self._potential(points, t, theta)

    def coefficients(self, times: Array, theta: Array, origin: Array, inside: Array, full: bool) -> Coefficients:
        """Return the coefficients at times (J,) in coordinates relative to the origin.

        With an affine h the coordinates `inside` (m,) act with inputs; otherwise `full` tells whether -h'S^-1 h / 2 is inside.
        """
        L, l, G, Q, p, r, Qf, pf, rf, C, c = self.matrices(times, theta)
        if full:
            Q, p, r = Qf, pf, rf
        pushed = Q @ origin[:, None]
        r = r + np.swapaxes(p + pushed, 1, 2) @ origin[:, None]
        l, p, c = l + L @ origin[:, None], p + 2.0 * pushed, c + C @ origin[:, None]
        if not (self.affine and inside.any()):
            return Coefficients(L, l, G, Q, p, r[:, :, 0])
        S = self._noise(times, theta)[0]
        precision = precision_of(S, np.broadcast_to(inside, (len(times), len(inside))))
        gain, driven = np.swapaxes(C, 1, 2) @ precision, precision @ c
        linear = np.concatenate([p - gain @ c, gain], axis=2)
        constant = np.concatenate([r[:, :, 0] - 0.5 * (np.swapaxes(c, 1, 2) @ driven)[:, :, 0], driven[:, :, 0]], axis=1)
        offset = np.concatenate([l, np.zeros((*l.shape[:2], len(inside)))], axis=2)
        return Coefficients(L, offset, G, Q - 0.5 * gain @ C, linear, constant)

    def varies(self, inside: Array) -> bool:
        """Return whether the coefficients depend on time."""
        return bool(self.matrices.varying or (self.affine and inside.any() and self._noise.varying))


def _unexpanded(model: Model, yau: Any) -> list[sp.Expr] | None:
    """L, l, G, Q, p, r from the formulas as they were written, or None where these do not show that they are all there is.

    An expanded pulse such as exp(-(t - 1/3)^2 / w^2) overflows, and its parts may be taken for zero.
    """
    x, t, G = model.x[0], model.t, model.covariance[0, 0]
    phi, slope = yau.form.potential, yau.form.gradient[0]
    if phi is None:
        return None
    rest = model.drift[0] - G * slope
    matrix = sp.diff(rest, x).subs(x, 0)
    offset = rest.subs(x, 0)
    q = -(sp.diff(phi, t) + G * (sp.diff(slope, x) + slope**2) / 2 + (matrix * x + offset) * slope + matrix)
    entries = [matrix, offset, G, sp.diff(q, x, 2).subs(x, 0) / 2, sp.diff(q, x).subs(x, 0), q.subs(x, 0)]
    if any(entry.has(sp.zoo, sp.nan, sp.oo) for entry in entries) or sp.expand(rest - matrix * x - offset) != 0:
        return None
    return entries


@once_for_a_model
def yau_of(model: Model) -> YauSystem:
    """Return the equation of a model, made once."""
    return YauSystem(model)


@once_for_a_model
def power_series_of(model: Model) -> PowerSeries:
    """Return the equation of a model as Taylor series in time, made once."""
    return PowerSeries(model, yau_of(model).blocks)
