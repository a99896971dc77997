"""How far a function is from affine over each component of a Gaussian sum, and along which direction."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from zakai.numerics.sums.mixture import Array, Components, dot, regression
from zakai.numerics.sums.quadrature import gauss_hermite, points


class Curvature(NamedTuple):
    """How far h is from affine over components, in the metric S^-1, at Gauss-Hermite nodes.

    `residual` (K,) is the energy E|h - c0 - c1 z|^2 with c0, c1 by least squares, `linear` (K,) is |c1|^2, `rest` (K, Q, m) what
    of h is not linear, all real; `gain` (K, n, k) is that of `regression`.
    """

    residual: Array
    linear: Array
    rest: Array
    gain: Array

    def axes(self, rows: Any = slice(None)) -> Array:
        """Return the vectors (R, n) along which some components are split, one standard deviation long.

        The direction is that to which most of the residual is due: its total effect in the analysis of variance.
        """
        gain, rest = self.gain[rows], self.rest[rows]
        k = gain.shape[2]
        if k == 1 or not len(gain):
            return np.asarray(gain[:, :, 0])
        rule = gauss_hermite(k)
        shape = (-1, *[rule.size] * k, rest.shape[-1])
        grid, grid_weights = rest.reshape(shape), rule.weights.reshape(shape[1:-1])
        effects = []
        for a in range(k):
            line = grid_weights.sum(axis=tuple(b for b in range(k) if b != a))
            inner = grid - np.expand_dims(np.tensordot(grid, line, (a + 1, 0)), a + 1)
            inner = inner.reshape(rest.shape)
            effects.append(dot(inner, inner) @ rule.weights)
        # A later direction is chosen only where it is clearly worse.
        worst = np.argmax(np.stack(effects, axis=1) * (1.0 - 1e-6 * np.arange(k)), axis=1)
        return np.asarray(np.take_along_axis(gain, worst[:, None, None], axis=2)[:, :, 0])


def curvature(sum_: Components, observe: Callable[[Array], Array], precision: Array, directions: Array) -> Curvature:
    """Return how far h is from affine over each component; `observe` returns h (..., m) at points (..., n)."""
    gain, rule = regression(sum_.covs, directions), gauss_hermite(directions.shape[1])
    real = Components(*(array.real for array in sum_))
    # With S^-1 = F F' the metric is that of the entries of F'h.
    h = observe(points(real, gain.real, rule.nodes)).real @ np.linalg.cholesky(precision.real)
    rest = h - (rule.weights @ h)[:, None]
    slope = (rule.nodes * rule.weights[:, None]).T @ rest
    rest = rest - rule.nodes @ slope
    return Curvature(dot(rest, rest) @ rule.weights, (slope * slope).sum(axis=(1, 2)), rest, gain)
