"""Polynomials on an interval by their values at Gauss-Lobatto points, and the Kolmogorov operator without flux at its ends.

    L u = ((G u)' / 2 - f u)',      (G u)' / 2 - f u = 0 at both ends

The weak form int phi L u = -int phi' ((G u)' / 2 - f u) has the condition of no flux in it: the solution is spectrally accurate
up to the ends.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


class Rule(NamedTuple):
    """Points and weights (N,) on [-1, 1], the matrix (N, N) of the derivative, and that from values to Legendre coefficients."""

    points: Array
    weights: Array
    derivative: Array
    analysis: Array


@lru_cache(maxsize=16)
def rule(size: int) -> Rule:
    """Return the Gauss-Lobatto rule with some number of points."""
    x = -np.cos(np.pi * np.arange(size) / (size - 1))
    for _ in range(12):  # Newton's method for (1 - x^2) P'(x) = 0
        values = np.polynomial.legendre.legvander(x, size - 1)
        x = x - (x * values[:, -1] - values[:, -2]) / (size * values[:, -1])
    values = np.polynomial.legendre.legvander(x, size - 1)
    weights = 2.0 / (size * (size - 1) * values[:, -1] ** 2)
    signs = _barycentric(weights)
    apart = x[:, None] - x
    derivative = (signs / signs[:, None]) / np.where(apart == 0, 1.0, apart)
    np.fill_diagonal(derivative, 0.0)
    np.fill_diagonal(derivative, -derivative.sum(axis=1))
    norms = 2.0 / (2.0 * np.arange(size) + 1.0)
    norms[-1] = 2.0 / (size - 1)
    return Rule(x, weights, derivative, values.T * weights / norms[:, None])


def _barycentric(weights: Array) -> Array:
    """Return the barycentric weights that belong to those of the quadrature."""
    return np.asarray((-1.0) ** np.arange(len(weights)) * np.sqrt(weights))


class Element(NamedTuple):
    """`size` Gauss-Lobatto points of [lower, upper]; a density is a vector of probabilities, its values times the weights."""

    lower: float
    upper: float
    size: int

    @property
    def closed(self) -> bool:
        """Whether it goes around a circle: no."""
        return False

    @property
    def origin(self) -> float:
        """The point from which offsets count."""
        return self.lower

    @property
    def half(self) -> float:
        """Half the length."""
        return 0.5 * (self.upper - self.lower)

    @property
    def spacing(self) -> float:
        """The mean distance of the points."""
        return (self.upper - self.lower) / (self.size - 1)

    @property
    def points(self) -> Array:
        """The points (N,), of which the first and the last are the ends."""
        x = rule(self.size).points
        return np.asarray(np.where(x < 0, self.lower + self.half * (1.0 + x), self.upper - self.half * (1.0 - x)))

    @property
    def offsets(self) -> Array:
        """The points (N,) relative to the lower end."""
        return np.asarray(self.points - self.lower)

    @property
    def weights(self) -> Array:
        """The weights (N,) of the quadrature."""
        return self.half * rule(self.size).weights

    def symmetric(self, covariance: Array, slope: Array) -> Array:
        """Return -L (N, N) as a symmetric operator on psi W^(1/2), with u = s psi, for G (N,) and s'/s (N,).

        The flux is s G (psi' - psi s'/s) / 2, and the weak form is sum W G (phi' - phi s'/s) (psi' - psi s'/s) / 2.
        """
        root = np.sqrt(self.weights)
        flux = (rule(self.size).derivative / self.half - np.diag(slope)) * (root * np.sqrt(0.5 * covariance))[:, None] / root
        return np.asarray(flux.T @ flux)

    def derivative(self, values: Array) -> Array:
        """Return the derivative of a polynomial at the points from its values there (N,)."""
        return rule(self.size).derivative @ values / self.half

    def interpolation(self, points: Array) -> Array:
        """Return the matrix (J, N) from values to those of the polynomial at points (J,)."""
        apart = points[:, None] - self.points
        same = apart == 0
        terms = np.where(same.any(axis=1)[:, None], same, _barycentric(self.weights) / np.where(same, 1.0, apart))
        return np.asarray(terms / terms.sum(axis=1)[:, None])

    def at(self, values: Array, points: Array) -> Array:
        """Return the density at points (J,) from probabilities; zero beyond the ends."""
        inside = (points >= self.lower) & (points <= self.upper)
        return np.asarray(np.where(inside, self.interpolation(points) @ (values / self.weights), 0.0))

    def unresolved(self, values: Array) -> float:
        """Return the largest Legendre coefficient in the highest eighth, relative to the largest of all."""
        coefficients = np.abs(rule(self.size).analysis @ (values / self.weights).real)
        return float(coefficients[-max(3, self.size // 8) :].max() / coefficients.max())
