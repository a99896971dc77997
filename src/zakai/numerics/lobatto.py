"""Polynomials on intervals side by side, by their values at Gauss-Lobatto points."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from zakai.numerics.arrays import Array


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


def interpolation(nodes: Array, weights: Array, points: Array) -> Array:
    """Return the matrix (J, N) from values at nodes to those of the polynomials through them at points (J,).

    Args:
        nodes: Gauss-Lobatto points (N,), of one interval or of several side by side, whose common ends nearly coincide.
        weights: the weights of the quadrature (N,).
        points: (J,).
    """
    breaks, near = np.flatnonzero(np.diff(nodes) < _SAME * (nodes[-1] - nodes[0])) + 1, _NEAR * (nodes[-1] - nodes[0])
    # A density may jump at a common end: a point beside it belongs to its own side, however near it is.
    ends = 0.5 * (nodes[breaks - 1] + nodes[breaks])
    result, piece = np.zeros((len(points), len(nodes))), np.searchsorted(ends, points, side="right")
    for j, (first, last) in enumerate(zip([0, *breaks], [*breaks, len(nodes)], strict=True)):
        here = piece == j
        apart = points[here, None] - nodes[first:last]
        same = np.abs(apart) <= near
        terms = np.where(same.any(axis=1)[:, None], same, _barycentric(weights[first:last]) / np.where(same, 1.0, apart))
        result[here, first:last] = terms / terms.sum(axis=1)[:, None]
    return result


_SAME = 1e-9  # distance of two points, relative to the length of all, below which they are the end of two intervals
_NEAR = 1e-10  # distance from a node within which a point is the node: common ends of other intervals lie elsewhere
_BESIDE = 1e-12  # how far inside of its interval a common end of two lies


class Element(NamedTuple):
    """The intervals between `lower`, `cuts` and `upper`, with `size` Gauss-Lobatto points each.

    A density is a vector of probabilities, its values times the weights.  Coefficients may have kinks and jumps at the cuts.
    """

    lower: float
    upper: float
    size: int
    cuts: tuple[float, ...] = ()

    @property
    def closed(self) -> bool:
        """Whether it goes around a circle: no."""
        return False

    @property
    def origin(self) -> float:
        """The point from which offsets count."""
        return self.lower

    @property
    def halves(self) -> Array:
        """Half the lengths of the intervals (P,)."""
        return _geometry(self)[0]

    @property
    def spacing(self) -> float:
        """The largest mean distance of the points of an interval."""
        return float(2.0 * np.max(self.halves)) / (self.size - 1)

    @property
    def points(self) -> Array:
        """The points (N,), of which the first and the last are the ends; those at cuts lie beside them."""
        return _geometry(self)[1]

    @property
    def offsets(self) -> Array:
        """The points (N,) relative to the lower end."""
        return np.asarray(self.points - self.lower)

    @property
    def weights(self) -> Array:
        """The weights (N,) of the quadrature."""
        return _geometry(self)[2]

    def derivative(self, values: Array) -> Array:
        """Return the derivative of polynomials at the points from their values there (N,)."""
        result = values.reshape(-1, self.size) @ rule(self.size).derivative.T / self.halves[:, None]
        return np.asarray(result.reshape(-1))

    def interpolation(self, points: Array) -> Array:
        """Return the matrix (J, N) from values to those of the polynomials at points (J,)."""
        return interpolation(self.points, self.weights, points)

    def panel(self, points: Array) -> Array:
        """Return the interval (J,) in which points are."""
        return np.searchsorted(np.asarray(self.cuts), points, side="right")

    def at(self, values: Array, points: Array) -> Array:
        """Return the density at points (J,) from probabilities; zero beyond the ends."""
        inside, panel = (points >= self.lower) & (points <= self.upper), self.panel(points)
        apart = points[:, None] - self.points.reshape(-1, self.size)[panel]
        same = np.abs(apart) <= _NEAR * self.halves[panel, None]
        terms = np.where(same.any(axis=1)[:, None], same, _barycentric(rule(self.size).weights) / np.where(same, 1.0, apart))
        own = (values / self.weights).reshape(-1, self.size)[panel]
        return np.asarray(np.where(inside, np.sum(terms * own, axis=1) / np.sum(terms, axis=1), 0.0))

    def finer(self, values: Array, size: int) -> Array:
        """Return the polynomials with values (N,) at as many other points in each interval."""
        own = rule(self.size)
        matrix = interpolation(own.points, own.weights, rule(size).points)
        return np.asarray((values.reshape(-1, self.size) @ matrix.T).reshape(-1))

    def sums(self, values: Array) -> Array:
        """Return the sums over the points of each interval (P,)."""
        return values.reshape(-1, self.size).sum(axis=1)

    def tails(self, values: Array) -> Array:
        """Return the highest Legendre coefficients of each interval (P,): |c_n| + |c_n-1|, or a tenth of the two before."""
        fourth, third, second, first = np.abs(values.reshape(-1, self.size) @ rule(self.size).analysis[-4:].T).T
        return np.maximum(first + second, 0.1 * (third + fourth))

    def bisected(self, where: Array) -> Element:
        """Return the element with some of its intervals (P,) bisected."""
        ends = np.array([self.lower, *self.cuts, self.upper])
        middles = 0.5 * (ends[1:] + ends[:-1])[where]
        return self._replace(cuts=tuple(np.sort(np.concatenate([ends[1:-1], middles])).tolist()))

    def unresolved(self, values: Array) -> float:
        """Return the largest share of the mass that an interval leaves unresolved."""
        return float(np.max(2.0 * self.halves * self.tails((values / self.weights).real)) / np.sum(np.abs(values.real)))


@lru_cache(maxsize=256)
def _geometry(element: Element) -> tuple[Array, Array, Array]:
    """Return half the lengths of the intervals of an element, its points and its weights."""
    lower, upper, size, cuts = element
    halves, x = 0.5 * np.diff([lower, *cuts, upper])[:, None], rule(size).points
    tiny = max(_BESIDE * (upper - lower), 4.0 * float(np.spacing(max(abs(lower), abs(upper)))))
    low, high = (np.array(ends)[:, None] for ends in ([lower, *cuts], [*cuts, upper]))
    points = np.where(x < 0, low + halves * (1.0 + x), high - halves * (1.0 - x))
    points[1:, 0] += tiny
    points[:-1, -1] -= tiny
    result = halves[:, 0], points.reshape(-1), (halves * rule(size).weights).reshape(-1)
    for array in result[:2]:  # kernels take the weights
        array.setflags(write=False)
    return result
