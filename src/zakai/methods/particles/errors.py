"""Standard errors from one run, by families: particles with a common ancestor share the noise of what came before it.

With the families of the particles of an earlier generation (a generation begins with a resampling) and their shares of the weight

    variance of a mean         = N / (N - 1) sum over families of (sum w_i (x_i - mean))^2
    variance of log evidence   = sum over families of (sum w_i)^2 - 1 / N - what systematic resampling itself adds

The earlier the generation, the more of the noise is seen, and the fewer families are left to see it by.  The largest variance of
the generations of the last `DEPTH` resamplings is taken.  It counts the particles of the oldest as independent draws.  What the
error of their mean exceeded that of independent draws by, a covariance X, is carried through every interval,

    X <- T X T',     T = cov(x after the observation, x before the interval) cov(x before)^-1

and added: T is near 0 for a state that forgets, and near 1 for a constant of which the observations say little.

References:
    Lee and Whiteley 2018, Variance estimation in the particle filter.
    Olsson and Douc 2019, Numerically stable online estimation of variance in particle filters.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai.methods.particles.moments import Weighted
from zakai.methods.particles.programs import Array
from zakai.numerics.particles.population import DEPTH, carry, lineage

LAG = 6  # resamplings after which a generation's share of the variance of the log-likelihood is settled
FEW_FAMILIES = 20  # below which families are too few to show their spread
# Few first ancestors matter to a state with this share of its variance between families of the oldest of the last generations: of
# a constant all is, and of a state that forgets it is their number over that of the particles.
REMEMBERED = 0.1
CAUTION = 2.0  # times a standard error that is a lower bound: the error that is warned of
_NONE = np.zeros(0, np.int32)


class Genealogy(NamedTuple):
    """The parents of the last resamplings, newest last, and the first ancestors.

    `parents` and `sizes` are those of the last `DEPTH` resamplings, `rounding` what each adds to the spread of the shares;
    `founders` (N,) are the first ancestors, of `first` particles, at the age `born`.  `age` counts resamplings,
    `settled` of which `done` have given their part of the variance of the log-likelihood.  `excess` (DEPTH + 1, n, n) is X of the
    generations of `parents`, and of the particles themselves last.
    """

    parents: tuple[Array, ...]
    sizes: tuple[int, ...]
    rounding: tuple[float, ...]
    founders: Array
    first: int
    born: int
    age: int
    settled: float
    done: int
    excess: Array

    @classmethod
    def begin(cls, count: int, n: int) -> Genealogy:
        """Return the genealogy of independent particles of n states."""
        founders = np.arange(count, dtype=np.int32)
        return cls((_NONE,) * DEPTH, (0,) * DEPTH, (0.0,) * DEPTH, founders, count, 0, 0, 0.0, 0, np.zeros((DEPTH + 1, n, n)))

    def resampled(self, ancestors: Array, weights: Array) -> Genealogy:
        """Return the genealogy after systematic resampling with these weights (N,)."""
        number = len(ancestors) * weights
        share = number - np.floor(number)
        noise = float(np.sum(share * (1.0 - share))) / len(ancestors) ** 2
        return self._replace(
            parents=(*self.parents[1:], ancestors), sizes=(*self.sizes[1:], len(weights)), rounding=(*self.rounding[1:], noise),
            founders=self.founders[ancestors], age=self.age + 1, excess=np.concatenate([self.excess[1:], self.excess[-1:]]),
        )  # fmt: skip

    def carried(self, since: int, before: Weighted, after: Weighted) -> tuple[Genealogy, Array]:
        """Return the genealogy with X carried from the particles at age `since` to those of now, and T (n, n)."""
        steps, n = self.age - since, len(before.cov)
        if steps > DEPTH:  # of so many powers of the likelihood standard errors are lower bounds
            return self._replace(excess=np.zeros_like(self.excess)), np.zeros((n, n))
        x = before.deviations
        for parents in self.parents[DEPTH - steps :]:
            x = np.take(x, parents, axis=1)
        excess, T = self.excess.copy(), np.empty((n, n))
        carry(excess, (after.deviations * after.weights) @ x.T, before.cov, T)
        return self._replace(excess=excess), T

    def seen(self, found: Variances, now: Weighted) -> tuple[Genealogy, Array]:
        """Return the genealogy with X of the particles of now, and the variances of their mean (n,).

        These are those of the last generations with what is older, or those of the first ancestors where they are larger.
        """
        older, excess, cov = np.diag(self.excess[0]), self.excess.copy(), now.cov
        variance = np.maximum(found.largest + older, found.means[-1])
        size = np.sqrt(np.maximum(variance - found.means[0] - older, 0.0))
        size = size / np.sqrt(np.maximum(np.diag(cov), 1e-300))
        excess[-1] = self.excess[0] + cov * np.outer(size, size)
        return self._replace(excess=excess), variance

    def renewed(self) -> Genealogy:
        """Return the genealogy of particles whose first ancestors have been drawn again."""
        count = len(self.founders)
        return self._replace(founders=np.arange(count, dtype=np.int32), first=count, born=self.age)

class Variances(NamedTuple):
    """By number of resamplings looked back (lags, ...), and last for the first ancestors.

    The variances of the means (n,), those of the states (n,) between families of the oldest generation, and of all generations
    the sum of the squares of the masses of families and their number (2, lags).
    """

    means: Array
    between: Array
    counts: Array

    @property
    def largest(self) -> Array:
        """The largest variances of the means (n,), without those of the first ancestors, of which few may be left."""
        return np.asarray(self.means[:-1].max(axis=0))

    def forgotten(self, now: Weighted) -> bool:
        """Return whether many first ancestors are left, or the states forget them."""
        if self.counts[0, -1] * FEW_FAMILIES <= 1.0:
            return True
        return not (self.between > REMEMBERED * np.diag(now.cov)).any()


def variances(genealogy: Genealogy, now: Weighted) -> Variances:
    """Return what families tell of the means of weighted particles."""
    lags = min(genealogy.age, DEPTH)
    sizes = np.array([len(now.weights), *genealogy.sizes[DEPTH - lags :][::-1], genealogy.first])
    count, n = len(sizes), len(now.cov)
    found, first = Variances(np.empty((count, n)), np.empty(n), np.empty((2, count))), genealogy.age - genealogy.born
    lineage(genealogy.parents, sizes, first, genealogy.founders, now.weights, now.deviations, tuple(found))
    return found


def of_log_likelihood(genealogy: Genealogy, found: Variances) -> tuple[Genealogy, float]:
    """Return the variance of the log-likelihood until now: settled parts of old generations, and what the last ones have."""
    done, settled, lags = genealogy.done, genealogy.settled, len(found.means) - 2
    sizes = np.array([len(genealogy.founders), *genealogy.sizes[DEPTH - lags :][::-1]])
    rounding = np.cumsum([0.0, *genealogy.rounding[DEPTH - lags :][::-1]])
    evidence = found.counts[0, :-1] - 1.0 / sizes - rounding
    while genealogy.age - done > LAG and len(evidence) > LAG:
        top = genealogy.age - done
        if top < len(evidence):
            settled += max(float(evidence[top] - evidence[top - 1]), 0.0)
        done += 1
    rest = min(genealogy.age - done, len(evidence) - 1)
    return genealogy._replace(settled=settled, done=done), settled + max(float(evidence[rest]), 0.0)
