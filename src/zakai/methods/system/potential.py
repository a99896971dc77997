"""The potential phi of a Yau form as a function of points: its closed form, or the line integral of its gradient.

    phi(x, t) = int_0^1 grad phi(b + s (x - b), t).(x - b) ds,     b the base of the form,

by Gauss and Legendre's formula with 32, 64, ... nodes, until its value at a point changes by less than 1e-12 of itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.algebra.yau import YauForm
from zakai.models.model import Model
from zakai.models.numeric import NumericFunction, numpy_function

FIRST, LAST = 32, 512  # nodes
ENOUGH = 1e-12
_AT_ONCE = 2**18  # values that are held in memory

Array = Any


def potential_of(form: YauForm, model: Model) -> NumericFunction:
    """Return phi(x, t, theta) for x (..., n) and t (...)."""
    if form.potential is not None:
        return numpy_function([form.potential], model, ())
    return LineIntegral(form, model)


class LineIntegral:
    """phi by quadrature; the value at a point depends on this point alone."""

    def __init__(self, form: YauForm, model: Model):
        self._gradient = numpy_function(form.gradient, model)
        self._base = np.array([float(value) for value in form.base])

    def __call__(self, x: Array, t: Any, theta: Array, u: Array | None = None) -> Array:
        """Return phi (...) at x (..., n)."""
        x = np.asarray(x)
        shape = np.broadcast_shapes(x.shape[:-1], np.shape(t))
        points = np.broadcast_to(x, (*shape, x.shape[-1])).reshape(-1, x.shape[-1])
        times = np.broadcast_to(t, shape).ravel()
        found = [
            self._at(points[first : first + _AT_ONCE // LAST], times[first : first + _AT_ONCE // LAST], theta, u)
            for first in range(0, len(points), _AT_ONCE // LAST)
        ]
        return np.concatenate(found).reshape(shape) if found else np.zeros(shape)

    def _at(self, points: Array, times: Array, theta: Array, u: Array | None) -> Array:
        result, pending, count = self._sum(points, times, theta, u, FIRST), np.arange(len(points)), 2 * FIRST
        while len(pending) and count <= LAST:
            finer = self._sum(points[pending], times[pending], theta, u, count)
            change = np.abs(finer - result[pending])
            result[pending] = finer
            pending, count = pending[change > ENOUGH * (1.0 + np.abs(finer))], 2 * count
        return result

    def _sum(self, points: Array, times: Array, theta: Array, u: Array | None, count: int) -> Array:
        nodes, weights = np.polynomial.legendre.leggauss(count)
        along = points - self._base
        lines = self._base + 0.5 * (1.0 + nodes)[:, None, None] * along
        slopes = (self._gradient(lines, times, theta, u) * along).sum(axis=-1)
        return np.einsum("k,kj->j", 0.5 * weights, slopes)
