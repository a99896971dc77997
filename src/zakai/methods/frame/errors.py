"""The estimated error of a density: what a step adds, and what it leaves of earlier errors.

A build that is wrong by the relative error e(x) moves the mean of the density p after the observation by

    b = int e(x) (x - m) p(x) dx / int p dx,      with e less its mean under p,

a sum over the control points of the build, carried to the observation and weighted by it.  The sum has signs, unlike the error in
L1, which is three to thirty times as large (turns, bearings, re-entry, a robot).  What the choice of the points adds to it is
their sample variance.

An observation does not change the ratio of a wrong density to the right one.  That ratio, less one, is known as a cubic function:
a quadratic error does not move the mean until an observation shifts it, a cubic one not until an observation narrows the density.
With a linear one alone the estimate was a third of the error for a distance that bearings hardly show, with a quadratic one a
fifth for a state after a long gap.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from zakai.methods.frame.placement import Mass
from zakai.methods.particles.programs import Array

FEW = 8.0  # effective control points of a prediction that a likelihood must leave
# Times the error in L1, and the exponential of the depth to which a likelihood leads: more is that of a few points, which the
# likelihood happens to prefer.
MOST, DEEPEST = 3.0, 10.0
# Times what chance adds to the square of third derivatives, that is left out: with 1 a body that falls is warned of at four times
# its error, with 3 two states have an error of three estimates after a long gap.
CERTAIN = 2.0


class Error(NamedTuple):
    """The relative error of a density as a cubic function, and what chance adds to the error of its mean.

    In coordinates z in which the density has mean zero and the covariance one, its derivatives have the means `first` (n,),
    `second` (n, n) and `third` (n, n, n), the coefficients of Hermite polynomials.  So the mean is off by `first`, the covariance
    by `second` and the third moments by `third`.  What chance adds to the error of the mean has the covariance `spread` (n, n).
    """

    first: Array
    second: Array
    third: Array
    spread: Array

    @classmethod
    def zero(cls, n: int) -> Error:
        """Return no error."""
        return cls(np.zeros(n), np.zeros((n, n)), np.zeros((n, n, n)), np.zeros((n, n)))

    @classmethod
    def by_chance(cls, n: int, error: float) -> Error:
        """Return an error of the mean of so many deviations, in a direction that is not known."""
        return cls.zero(n)._replace(spread=error**2 * np.eye(n))

    @classmethod
    def of(cls, z: Array, shares: Array) -> Error:
        """Return the error of points z (n, P) whose relative errors times their weights are `shares` (P,).

        The third derivatives are shrunk by the share of their size that chance explains.
        """
        n, one, moved = len(z), np.eye(len(z)), shares * z
        first, square = moved.sum(axis=1), (z * z).sum(axis=0)
        pairs = (moved[:, None] * z).reshape(n * n, -1)
        third = (pairs @ z.T).reshape(n, n, n) - _with_unit(first)
        # The sum of the squares of the Hermite polynomials of degree three.
        sizes = square * (square * (square - 6.0) + 3.0 * n + 6.0)
        return cls(first, moved @ z.T - shares.sum() * one, _certain(third, float(shares**2 @ sizes)), moved @ moved.T)

    @classmethod
    def between(cls, total: Array, chance: Array, n: int) -> Error:
        """Return the error of sums of `hermite` times shares of points (H,), and of what chance adds to their squares (H,)."""
        known = monomials(n)
        third = _certain(total[known.triples], float(chance[known.triples].sum()))
        return cls(total[:n], total[known.pairs], third, np.zeros((n, n)))

    def plus(self, other: Error, factor: float = 1.0) -> Error:
        """Return the sum with an error times a factor; what chance adds is independent."""
        first, second, third = (one + factor * part for one, part in zip(self[:3], other[:3], strict=True))
        return Error(first, second, third, self.spread + factor**2 * other.spread)

    def scaled(self, factor: float) -> Error:
        """Return the error times a factor."""
        return Error.zero(len(self.first)).plus(self, factor)

    def along(self, A: Array) -> Error:
        """Return the mean before a motion z -> A z + noise, given z after it; A A' and the noise add up to one."""
        return Error(A @ self.first, A @ self.second @ A.T, _turned(self.third, A), A @ self.spread @ A.T)

    def seen(self, B: Array, shift: Array) -> Error:
        """Return the same function where an observation has moved the mean to z = shift, with the covariance B B'."""
        second = self.second + self.third @ shift
        change = np.outer(shift, shift) + B @ B.T - np.eye(len(shift))
        first = self.first + self.second @ shift + 0.5 * self.third.reshape(len(shift), -1) @ change.ravel()
        return Error(B.T @ first, B.T @ second @ B, _turned(self.third, B.T), B.T @ self.spread @ B)

    def in_deviations(self, root: Array) -> float:
        """Return the largest error of a mean or a deviation, in deviations, where the covariance is root root'."""
        square = np.outer(self.first, self.first) + self.spread
        variances, means, changes = (np.diag(root @ part @ root.T) for part in (np.eye(len(root)), square, self.second))
        variances = np.maximum(variances, 1e-300)
        return float(np.maximum(np.sqrt(np.maximum(means, 0.0) / variances), 0.5 * np.abs(changes) / variances).max())


@dataclass(frozen=True)
class Missed:
    """The relative error (P,) of a density at weighted points of it."""

    mass: Mass
    relative: Array

    @property
    def size(self) -> float:
        """The error in L1, where a point far from the mean counts by its distance in deviations: so much it moves the mean."""
        return float(self.mass.moving @ np.abs(self.relative))

    def at(self, ends: Array) -> Missed:
        """Return the same errors at other points (n, P), of which only finite ones count."""
        finite = np.isfinite(ends).all(axis=0)
        weights = self.mass.weights[finite]
        return Missed(Mass(np.ascontiguousarray(ends[:, finite]), weights / weights.sum()), self.relative[finite])

    def after(self, logs: Array, cov: Array, angles: Array) -> Error:
        """Return the error of a density, after its weights have changed.

        Where a sharp likelihood leaves few points, a power of it is taken: from there on the logarithm of the relative error is
        taken to be linear.

        Args:
            logs: by which the weights change (P,).
            cov: the covariance of the density (n, n).
            angles: which states are angles (n,).
        """
        logs = np.maximum(logs, np.max(logs) - 1e6) if np.isfinite(logs).any() else np.zeros(len(logs))
        mass = self.mass.unwrapped(angles)
        seen = mass.reweighted(logs)
        few = seen.effective < FEW
        if few:
            seen = mass.reweighted(mass.power(logs, FEW) * logs)
        mean, P = seen.moments()
        z = np.linalg.solve(root_of(P), seen.points - mean[:, None])
        shares = seen.weights * (self.relative - self.relative @ seen.weights)
        found = Error.of(z, shares)
        if few:
            found = found.seen(np.linalg.solve(root_of(P), root_of(cov)), np.zeros(len(cov)))
        size, most = found.in_deviations(root_of(cov)), MOST * self.size * math.exp(min(max(mass.depth(logs), 0.0), DEEPEST))
        return found.scaled(min(1.0, most / max(size, 1e-300)))


class Monomials(NamedTuple):
    """The monomials of degrees one to three, without permutations: how many there are of degrees one and two, and their numbers.

    `recurrence` has for each of degree two and three the number of that without its last index, the last index, and those that
    are subtracted (-1 is the constant one); `pairs` (n, n) and `triples` (n, n, n) are the numbers for all orders of indices.
    """

    low: int
    recurrence: tuple[tuple[int, int, tuple[int, ...]], ...]
    pairs: Array
    triples: Array


@lru_cache(maxsize=8)
def monomials(n: int) -> Monomials:
    """Return the monomials of n variables."""
    found = [index for degree in range(4) for index in itertools.combinations_with_replacement(range(n), degree)]
    number = {index: i - 1 for i, index in enumerate(found)}
    recurrence = tuple(
        (number[first], last, tuple(number[first[:i] + first[i + 1 :]] for i, other in enumerate(first) if other == last))
        for *first_indices, last in found[n + 1 :]
        for first in [tuple(first_indices)]
    )
    pairs, triples = (np.array([number[tuple(sorted(i))] for i in np.ndindex(*[n] * k)]).reshape([n] * k) for k in (2, 3))
    return Monomials(n + n * (n + 1) // 2, recurrence, pairs, triples)


def hermite(z: Array) -> Array:
    """Return the Hermite polynomials of degrees one to three of points z (n, P), for all `monomials` (H, P)."""
    n, recurrence = len(z), monomials(len(z)).recurrence
    out = np.empty((n + len(recurrence), z.shape[1]))
    out[:n] = z
    for row, (before, last, subtracted) in enumerate(recurrence, n):
        np.multiply(out[before], z[last], out=out[row])
        for other in subtracted:
            out[row] -= 1.0 if other < 0 else out[other]
    return out


def _with_unit(first: Array) -> Array:
    """Return the symmetric sum (n, n, n) of products of a vector (n,) and the unit matrix."""
    one = np.eye(len(first))
    return np.asarray(one[:, :, None] * first + one[:, None] * first[:, None] + one * first[:, None, None])


def _certain(third: Array, chance: float) -> Array:
    """Return third derivatives without the share of their size that chance explains."""
    return third * max(0.0, 1.0 - CERTAIN * chance / max(float(np.vdot(third, third)), 1e-300))


def _turned(third: Array, A: Array) -> Array:
    """Return third derivatives (n, n, n) along other axes: the rows of a matrix (n, n)."""
    n = len(A)
    return np.asarray(A @ (A @ third.reshape(n, -1)).reshape(n, n, n) @ A.T)


def root_of(P: Array) -> Array:
    """Return the Cholesky factor (n, n) of a covariance, with the accuracy of rounding."""
    scale = np.maximum(np.sqrt(np.diag(P)), 1e-300)
    return np.asarray(scale[:, None] * np.linalg.cholesky(P / np.outer(scale, scale) + 1e-9 * np.eye(len(P))))
