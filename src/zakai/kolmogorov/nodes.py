"""A function as a sum of narrow Gaussians of one covariance on a lattice,

    v(z) = sum_l w_l N(z; z_l, W),     z_l = origin + B l,  W = width^2 B B'.

The weights interpolate v at the lattice points, which inverts the convolution by N(0, W) on the lattice; that inverse decays
by a third of an e-fold a cell, so that a weight is as accurate, relative to v, as v is near it.  Weights may be negative.
Where the sum differs from v between the points says how well it represents v.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from zakai.kolmogorov.numpy_or_jax import numpy_or_jax

WIDTH = 1.25  # the standard deviation of a node, in cells: the sum of nodes of equal weight is flat to 1e-13


@dataclass(frozen=True, eq=False)
class NodeLattice:
    """`origin` (k,), `basis` B (k, k), and the number of nodes along each axis; an axis without width has one node."""

    origin: np.ndarray
    basis: np.ndarray
    sizes: tuple[int, ...]

    @property
    def count(self) -> int:
        return int(np.prod(self.sizes))

    def points(self, shift: np.ndarray | float = 0.0) -> np.ndarray:
        """z (N, k); `shift` in cells."""
        index = np.stack(np.meshgrid(*[np.arange(float(s)) for s in self.sizes], indexing="ij"), axis=-1)
        moved = np.where(np.array(self.sizes) > 1, index + shift, index)
        return self.origin + moved.reshape(-1, len(self.sizes)) @ self.basis.T

    @property
    def covariance(self) -> np.ndarray:
        """W, without width along the axes of one node."""
        wide = self.basis * (np.array(self.sizes) > 1)
        return WIDTH**2 * wide @ wide.T

    def weights(self, values: Any) -> Any:
        """The weights (N,) of v from its values (N,) at the points; pure."""
        shape = np.array(self.sizes)
        xp = numpy_or_jax(values)
        array = xp.reshape(values, shape)
        for axis, size in enumerate(self.sizes):
            if size > 1:
                array = xp.moveaxis(xp.tensordot(_inverse(size), array, (1, axis)), 0, axis)
        wide = self.basis[:, shape > 1]
        # The Gaussians have unit mass; the taps are those of cells.
        return xp.ravel(array) * np.sqrt(np.linalg.det(wide.T @ wide))

    def sums(self, weights: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """sum_l w_l N(z; z_l, W) at the points shifted by `shift` (k,) cells, relative to the axes that have width."""
        array = np.reshape(weights, self.sizes)
        for axis, size in enumerate(self.sizes):
            if size > 1:
                away = np.arange(size)[:, None] + shift[axis] - np.arange(size)
                array = np.moveaxis(np.tensordot(_taps(away), array, (1, axis)), 0, axis)
        wide = self.basis[:, np.array(self.sizes) > 1]
        return np.ravel(array) / np.sqrt(np.linalg.det(wide.T @ wide))


def _taps(away: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * (away / WIDTH) ** 2) / (np.sqrt(2 * np.pi) * WIDTH)


def _inverse(size: int) -> np.ndarray:
    """The inverse (size, size) of the convolution with a node, on an endless lattice.

    The taps' Fourier series is a theta function of nome q; the coefficients of its reciprocal, each to full relative accuracy,
    are (-1)^k sum_m (-1)^m q^((m + 1/2)(m + 2|k| + 1/2)) but for a factor (Whittaker and Watson, chapter 21).
    """
    q = np.exp(-0.5 / WIDTH**2)
    k, m = np.arange(max(size, 64)), np.arange(24)[:, None]
    row = (-1.0) ** k * np.sum((-1.0) ** m * q ** ((m + 0.5) * (m + 2 * k + 0.5)), axis=0)
    row /= row[0] * _taps(np.array(0.0)) + 2 * row[1:] @ _taps(k[1:])
    return row[np.abs(np.arange(size)[:, None] - np.arange(size))]


def resolve(
    log_values: Callable[[np.ndarray], np.ndarray],
    log_scale: Callable[[np.ndarray], np.ndarray],
    lattice: NodeLattice,
    tolerance: float,
    most: int,
) -> tuple[NodeLattice, float]:
    """A lattice, finer where need be, whose nodes represent v = exp(log_values), and its error.

    The error is the largest of |sum - v| exp(log_scale) between the points, relative to the largest of v exp(log_scale).
    """
    while True:
        error = representation_error(log_values, log_scale, lattice)
        sizes = tuple(2 * s - 1 if s > 1 else 1 for s in lattice.sizes)
        if error <= tolerance or int(np.prod(sizes)) > most:
            return lattice, error
        lattice = NodeLattice(lattice.origin, lattice.basis * np.where(np.array(sizes) > 1, 0.5, 1.0), sizes)


def representation_error(log_values, log_scale, lattice: NodeLattice) -> float:
    k = len(lattice.sizes)
    points = lattice.points()
    logs = np.asarray(log_values(points))
    top = logs.max()
    with np.errstate(all="ignore"):
        weights = lattice.weights(np.exp(logs - top))
        highest = np.max(logs + np.asarray(log_scale(points)))
        worst = 0.0
        for corner in np.ndindex(*(2,) * k):
            shift = 0.5 * np.array(corner)
            if not shift.any():
                continue
            between = lattice.points(shift)
            exact = np.exp(np.asarray(log_values(between)) - top)
            difference = np.abs(lattice.sums(weights, shift) - exact)
            weighed = difference * np.exp(np.asarray(log_scale(between)) + top - highest)
            worst = max(worst, float(np.max(np.where(np.isfinite(weighed), weighed, np.inf))))
    return worst


def signed_logs(weights: Any) -> tuple[Any, Any]:
    """log |w| and the sign of w; a weight of zero has the logarithm -inf, and no gradient."""
    xp = numpy_or_jax(weights)
    zero = weights == 0
    return xp.where(zero, -xp.inf, xp.log(xp.abs(xp.where(zero, 1.0, weights)))), xp.where(weights < 0, -1.0, 1.0)
