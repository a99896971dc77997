"""Standard errors from one run, by islands: groups of particles that are drawn independently of each other.

The offspring of a particle belong to its island, and the noise of islands is independent.  With the weights w of the particles

    variance of a mean       = R / (R - 1) sum over R islands of (sum w_i (x_i - mean))^2
    variance of a variance V = R / (R - 1) sum over R islands of (sum w_i ((x_i - mean)^2 - V))^2
    variance of log evidence = R / (R - 1) sum over R islands of (sum w_i - 1 / R)^2

whatever is done inside of an island: its noise may fill its space evenly, and its particles may descend from few.  An island
whose share of the likelihood is larger has more offspring.  When few islands have most of it, the particles are dealt to new ones
of equal sizes.  The error until then, a covariance X, is carried through every interval,

    X <- T X T',     T = cov(x after the observation, x before the interval) cov(x before)^-1

and added: T is near 0 for a state that forgets, and near 1 for a constant of which the observations say little.  The error of a
variance, relative to it, is large where few particles are far from the others.  That until then is carried by the largest share
of a variance that is explained by the states before the interval.

References:
    Lee and Whiteley 2018, Variance estimation in the particle filter (the same with the families of single particles).
    Verge, Dubarry, Del Moral and Moulines 2015, On parallel implementation of sequential Monte Carlo methods (islands).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai.methods.particles.moments import Weighted
from zakai.methods.particles.programs import Array
from zakai.numerics.particles.even import Even, curve_places, directions
from zakai.numerics.particles.population import Sums, carry, sums_of_islands

ISLANDS, FEWEST = 16, 4  # islands, and particles of one at least
# Effective shares of the islands: below the first one particles are dealt to new ones, below the second the spread is not known.
UNEVEN, FEW_ISLANDS = 0.5, 0.25
FEW_FAR = 0.2  # relative error of a standard deviation, above which few particles hold what is far from the others
FEW_FOUNDERS = 20  # below which first ancestors are too few for a state that does not forget them
# Few first ancestors matter to a state with this share of its variance between their families: of a constant all is, and of a
# state that forgets it is their number over that of the particles.
REMEMBERED = 0.1
CAUTION = 2.0  # times a standard error that is a lower bound: the error that is warned of


class Islands(NamedTuple):
    """The particles of each island, from one of the `bounds` (R + 1,) to the next, and what they descend from.

    `founders` (N,) are the first ancestors, of `first` particles.  `age` counts resamplings, `epoch` the times at which islands
    were made, and `settled` is the variance of the log-likelihood until then.  `excess` (n, n) is X, and `wide` the relative
    variance of a variance until then.
    """

    bounds: Array
    founders: Array
    first: int
    age: int
    epoch: int
    settled: float
    excess: Array
    wide: float

    @classmethod
    def begin(cls, count: int, n: int) -> Islands:
        """Return independent particles of n states."""
        return cls(_dealt(count), np.arange(count, dtype=np.int32), count, 0, 0, 0.0, np.zeros((n, n)), 0.0)

    @property
    def label(self) -> Array:
        """The islands (N,) of the particles."""
        return np.repeat(np.arange(len(self.bounds) - 1), np.diff(self.bounds))

    @property
    def rank(self) -> Array:
        """The numbers (N,) of the particles within their islands, int32."""
        return (np.arange(self.bounds[-1]) - np.repeat(self.bounds[:-1], np.diff(self.bounds))).astype(np.int32)

    def even(self, key: Array, rank: Array) -> Even:
        """Return what makes numbers that fill their space evenly over particles with these numbers (N,) within their islands."""
        return Even(key, rank, self.bounds, directions())

    def order(self, now: Weighted, together: bool) -> Array:
        """Return the particles (N,) in order along a curve, of each island or `together`."""
        places = np.empty(now.deviations.shape[1], np.uint16)
        curve_places(now.deviations, now.cov, places)
        order = np.argsort(places, kind="stable")
        if together:
            return order
        return order[np.argsort(self.label.astype(np.uint8)[order], kind="stable")]

    def resampled(self, places: Array, ancestors: Array) -> Islands:
        """Return islands of particles with these ancestors (N',), at increasing `places` of particles in the order of islands."""
        bounds = np.searchsorted(places, self.bounds.astype(places.dtype)).astype(np.int64)
        return self._replace(bounds=bounds, founders=self.founders[ancestors], age=self.age + 1)

    def dealt(self, spread: Spread, count: int) -> tuple[Islands, Array]:
        """Return new islands of so many particles, and which of them, in order along a curve, is each."""
        bounds = _dealt(count)
        deal = np.concatenate([np.arange(b, count, len(bounds) - 1) for b in range(len(bounds) - 1)])
        settled = self.settled + spread.evidence
        islands = self._replace(
            bounds=bounds, epoch=self.epoch + 1, settled=settled, excess=spread.cov, wide=spread.wide
        )
        return islands, deal

    def spread(self, now: Weighted) -> Spread:
        """Return what the islands say of the errors of weighted particles."""
        n, R = len(now.cov), len(self.bounds) - 1
        out, factor = Sums(np.empty(R), np.empty((R, n)), np.empty((R, n)), np.empty(n)), R / (R - 1)
        sums_of_islands(self.bounds, now.weights, now.deviations, out)
        masses, sums, squares, independent = out
        cov = factor * (sums.T @ sums) + self.excess
        total = squares.sum(axis=0)
        apart = squares / np.where(total > 0, total, np.inf) - masses[:, None]
        wide = factor * float(np.sum(np.where(total > 0, apart, 0.0) ** 2, axis=0).max()) + self.wide
        evidence = factor * float(np.sum((masses - 1.0 / R) ** 2))
        return Spread(cov, wide, evidence, independent, 1.0 / (R * float(masses @ masses)))

    def carried(self, T: Array, before: Weighted, after: Weighted) -> Islands:
        """Return the islands with what has been carried from before an interval to after it."""
        positive = np.diag(after.cov) > 0
        explained = np.diag(T @ before.cov @ T.T)[positive] / np.diag(after.cov)[positive]
        share = min(float(explained.max(initial=0.0)), 1.0)
        return self._replace(excess=T @ self.excess @ T.T, wide=share**2 * self.wide)

    def renewed(self) -> Islands:
        """Return the islands of particles whose first ancestors have been drawn again."""
        count = len(self.founders)
        return self._replace(founders=np.arange(count, dtype=np.int32), first=count)

    def families(self, now: Weighted) -> Families:
        """Return how many first ancestors are left, in effective number too, and whether the states forget them."""
        masses = np.bincount(self.founders, now.weights, self.first)
        left = masses > 0.0
        number, effective = int(left.sum()), 1.0 / float(masses @ masses)
        if effective >= FEW_FOUNDERS:
            return Families(number, True)
        for row, variance in zip(now.deviations, np.diag(now.cov), strict=True):
            sums = np.bincount(self.founders, now.weights * row, self.first)[left]
            if np.sum(sums**2 / masses[left]) > REMEMBERED * variance:
                return Families(number, False)
        return Families(number, True)


class Spread(NamedTuple):
    """The covariance (n, n) of the means, and the variance of the log-likelihood since the islands were made.

    `wide` is the largest variance of a variance, relative to its square.
    `independent` (n,) are the variances of the means of as many independent draws with these weights, `effective` the share of
    the islands that has the mass.
    """

    cov: Array
    wide: float
    evidence: float
    independent: Array
    effective: float

    @property
    def variance(self) -> Array:
        """The variances of the means (n,)."""
        return np.diag(self.cov)


class Families(NamedTuple):
    """How many first ancestors are left, and whether they are many or the states forget them."""

    number: int
    forgotten: bool


def _dealt(count: int) -> Array:
    """Return the ends of islands of so many particles."""
    R = min(max(count // FEWEST, 2), ISLANDS)
    return np.arange(R + 1) * count // R


def regression(before: Weighted, after: Weighted, parents: Array | None = None) -> Array:
    """Return T (n, n): the regression of particles on their `parents` (N,) before, None where these are the same."""
    x = before.deviations if parents is None else np.take(before.deviations, parents, axis=1)
    T = np.empty(before.cov.shape)
    carry((after.deviations * after.weights) @ x.T, before.cov, T)
    return T
