"""A function as a sum of narrow Gaussians of one covariance on a grid.

    v(z) = sum_l w_l N(z; z_l, W),     z_l = origin + B l,  W = width^2 B B'.

The weights interpolate v at the grid points, which inverts the convolution by N(0, W) on the grid; that inverse decays
by a third of an e-fold a grid spacing, so that a weight is as accurate, relative to v, as v is near it.  Weights may be negative.
Where the sum differs from v between the points says how well it represents v.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from zakai.numerics.complex_step import absolute

WIDTH = 1.25  # the standard deviation of a node, in grid spacings: the sum of nodes of equal weight is flat to 1e-13


@dataclass(frozen=True, eq=False)
class NodeGrid:
    """`origin` (k,), `basis` B (k, k), and the number of nodes along each axis; an axis without width has one node."""

    origin: np.ndarray
    basis: np.ndarray
    sizes: tuple[int, ...]

    @property
    def count(self) -> int:
        """The number of nodes."""
        return int(np.prod(self.sizes))

    def points(self, shift: np.ndarray | float = 0.0) -> np.ndarray:
        """Return z (N, k); `shift` in grid spacings."""
        index = np.stack(np.meshgrid(*[np.arange(float(s)) for s in self.sizes], indexing="ij"), axis=-1)
        moved = np.where(np.array(self.sizes) > 1, index + shift, index)
        return np.asarray(self.origin + moved.reshape(-1, len(self.sizes)) @ self.basis.T)

    @property
    def covariance(self) -> np.ndarray:
        """The covariance W (k, k) of a node, without width along the axes of one node."""
        wide = self.basis * (np.array(self.sizes) > 1)
        return np.asarray(WIDTH**2 * wide @ wide.T)

    def weights(self, values: Any) -> Any:
        """Return the weights (N,) of v from its values (N,) at the points."""
        shape = np.array(self.sizes)
        array = np.reshape(values, self.sizes)
        for axis, size in enumerate(self.sizes):
            if size > 1:
                array = _convolved(array, _inverse(size), axis)
        wide = self.basis[:, shape > 1]
        # The Gaussians have unit mass; the taps are those of grid spacings.
        return np.ravel(array) * np.sqrt(np.linalg.det(wide.T @ wide))

    def sums(self, weights: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Return sum_l w_l N(z; z_l, W) at points shifted by `shift` (k,) spacings along the axes that have width."""
        array = np.reshape(weights, self.sizes)
        for axis, size in enumerate(self.sizes):
            if size > 1:
                array = _convolved(array, _taps(np.arange(1 - size, size) + shift[axis]), axis)
        wide = self.basis[:, np.array(self.sizes) > 1]
        return np.asarray(np.ravel(array) / np.sqrt(np.linalg.det(wide.T @ wide)))


def _convolved(array: Any, taps: np.ndarray, axis: int) -> Any:
    """Return sum_j taps_(i - j) a_j at each of the points i of an axis, for taps from 1 - size to size - 1."""
    return np.apply_along_axis(np.convolve, axis, array, taps, "valid")


def _taps(away: np.ndarray) -> np.ndarray:
    return np.asarray(np.exp(-0.5 * (away / WIDTH) ** 2) / (np.sqrt(2 * np.pi) * WIDTH))


def _inverse(size: int) -> np.ndarray:
    """Return the taps from 1 - size to size - 1 of the inverse of the convolution with a node, on an infinite grid.

    The taps' Fourier series is a theta function of nome q; the coefficients of its reciprocal, each to full relative accuracy,
    are (-1)^k sum_m (-1)^m q^((m + 1/2)(m + 2|k| + 1/2)) but for a factor (Whittaker and Watson, chapter 21).
    """
    q = np.exp(-0.5 / WIDTH**2)
    k, m = np.arange(max(size, 64)), np.arange(24)[:, None]
    row = (-1.0) ** k * np.sum((-1.0) ** m * q ** ((m + 0.5) * (m + 2 * k + 0.5)), axis=0)
    row /= row[0] * _taps(np.array(0.0)) + 2 * row[1:] @ _taps(k[1:])
    return np.asarray(row[np.abs(np.arange(1 - size, size))])


def resolve(
    log_values: Callable[[np.ndarray], np.ndarray],
    log_scale: Callable[[np.ndarray], np.ndarray],
    grid: NodeGrid,
    tolerance: float,
    most: int,
) -> tuple[NodeGrid, float]:
    """Return a grid, refined until its nodes represent v = exp(log_values), and its error.

    The error is the largest of |sum - v| exp(log_scale) between the points, relative to the largest of v exp(log_scale).
    """
    while True:
        error = representation_error(log_values, log_scale, grid)
        sizes = tuple(2 * s - 1 if s > 1 else 1 for s in grid.sizes)
        if error <= tolerance or int(np.prod(sizes)) > most:
            return grid, error
        grid = NodeGrid(grid.origin, grid.basis * np.where(np.array(sizes) > 1, 0.5, 1.0), sizes)


def representation_error(
    log_values: Callable[[np.ndarray], np.ndarray], log_scale: Callable[[np.ndarray], np.ndarray], grid: NodeGrid
) -> float:
    """Return the error of `resolve` for one grid."""
    k = len(grid.sizes)
    points = grid.points()
    logs = np.asarray(log_values(points))
    top = logs.max()
    with np.errstate(all="ignore"):
        weights = grid.weights(np.exp(logs - top))
        highest = np.max(logs + np.asarray(log_scale(points)))
        worst = 0.0
        for corner in np.ndindex(*(2,) * k):
            shift = 0.5 * np.array(corner)
            if not shift.any():
                continue
            between = grid.points(shift)
            exact = np.exp(np.asarray(log_values(between)) - top)
            difference = np.abs(grid.sums(weights, shift) - exact)
            weighed = difference * np.exp(np.asarray(log_scale(between)) + top - highest)
            worst = max(worst, float(np.max(np.where(np.isfinite(weighed), weighed, np.inf))))
    return worst


def signed_logs(weights: Any) -> tuple[Any, Any]:
    """Return log |w| and the sign of w; a weight of zero has the logarithm -inf."""
    with np.errstate(divide="ignore"):
        return np.log(absolute(weights)), np.where(np.real(weights) < 0, -1.0, 1.0)
