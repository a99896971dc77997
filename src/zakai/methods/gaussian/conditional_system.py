"""The linear system of a model whose coefficients depend on the observed path y(t), which is linear between observations.

The Zakai equation is one of Ito, and y linear between observations gives that of Stratonovich.  With h = C x + c and D = g N
their difference is

    - 1/2 sum_ij S_ij d/dy_j (S^-1 h)_i = -1/2 div_y h + 1/2 e S^-1 h          in the potential, and
    - 1/2 sum_ij S_ij d/dy_j (D S^-1)_i = -1/2 sum_j dD_j/dy_j + 1/2 D S^-1 e'     in the drift,

where e_a = sum_j dS_ja/dy_j, beside what it is for coefficients that do not depend on y (`affine_system.py`).
"""

from __future__ import annotations

import numpy as np
import sympy as sp

from zakai.algebra.systems import affine_observation
from zakai.methods.gaussian.affine_system import AffineSystem, Matrices, precision_of
from zakai.models.model import Model
from zakai.numerics.flow import Coefficients
from zakai.numerics.transition import Array


class ConditionalSystem(AffineSystem):
    """The coefficients for a model whose last m inputs are the path."""

    def __init__(self, model: Model):
        super().__init__(model)
        observed = affine_observation(model)
        assert observed is not None
        (slope, intercept), path, S = observed, model.u[-model.m :], model.observation_noise
        D = model.diffusion * model.cross_noise

        def divergence(rows: sp.MatrixBase) -> sp.Matrix:
            return sum((rows[j, :].diff(symbol) for j, symbol in enumerate(path)), sp.zeros(1, rows.cols))

        blocks = [divergence(sp.Matrix(part)) for part in (slope, intercept, S, D.T)]
        self._corrections = Matrices(blocks, model)

    def coefficients(
        self, times: Array, theta: Array, origin: Array, inside: Array, u: Array | None = None
    ) -> Coefficients:
        """Return the coefficients with the difference between Ito and Stratonovich."""
        found = super().coefficients(times, theta, origin, inside, u)
        C, c, S = self._observation(times, theta, u)
        by_slope, by_intercept, by_noise, by_cross = self._corrections(times, theta, u)
        weight = by_noise @ precision_of(S, inside)
        linear, constant = 0.5 * (weight @ C - by_slope), 0.5 * (weight @ c - by_intercept)
        vector, level = np.array(found.linear), np.array(found.constant)
        vector[:, :, :1] += np.swapaxes(linear, 1, 2)
        level[:, :1] += (constant + linear @ origin[:, None])[:, :, 0]
        if self._cross is None:
            return found._replace(linear=vector, constant=level)
        (D,) = self._cross(times, theta, u)
        offset = np.array(found.offset)
        offset[:, :, :1] += 0.5 * np.swapaxes(weight @ np.swapaxes(D, 1, 2) - by_cross, 1, 2)
        return found._replace(linear=vector, constant=level, offset=offset)

    def features(self, times: Array, theta: Array, u: Array | None = None) -> Array:
        """Return the functions of time that the coefficients are made of, (J, F)."""
        return np.concatenate([super().features(times, theta, u), self._corrections.features(times, theta, u)], axis=1)
