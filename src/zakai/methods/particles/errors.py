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

from zakai.methods.particles.programs import Array
from zakai.numerics.particles.population import effective, lineage

DEPTH = 16  # resamplings that are looked back
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
    `founders` (N,) are the first ancestors, of `first` particles, `all_rounding` the sum of all.  `age` counts resamplings,
    `settled` of which `done` have given their part of the variance of the log-likelihood.  `excess` (DEPTH + 1, n, n) is X of the
    generations of `parents`, and of the particles themselves last.
    """

    parents: tuple[Array, ...]
    sizes: tuple[int, ...]
    rounding: tuple[float, ...]
    founders: Array
    first: int
    all_rounding: float
    age: int
    settled: float
    done: int
    excess: Array

    @classmethod
    def begin(cls, count: int, n: int) -> Genealogy:
        """Return the genealogy of independent particles of n states."""
        founders = np.arange(count, dtype=np.int32)
        return cls((_NONE,) * DEPTH, (0,) * DEPTH, (0.0,) * DEPTH, founders, count, 0.0, 0, 0.0, 0, np.zeros((DEPTH + 1, n, n)))

    def resampled(self, ancestors: Array, weights: Array) -> Genealogy:
        """Return the genealogy after systematic resampling with these weights (N,)."""
        number = len(ancestors) * weights
        share = number - np.floor(number)
        noise = float(np.sum(share * (1.0 - share))) / len(ancestors) ** 2
        return self._replace(
            parents=(*self.parents[1:], ancestors), sizes=(*self.sizes[1:], len(weights)), rounding=(*self.rounding[1:], noise),
            founders=self.founders[ancestors], all_rounding=self.all_rounding + noise, age=self.age + 1,
            excess=np.concatenate([self.excess[1:], self.excess[-1:]]),
        )  # fmt: skip

    def carried(self, since: int, before: Weighted, after: Weighted) -> Genealogy:
        """Return the genealogy with X carried from the particles at age `since` to those of now."""
        steps = self.age - since
        if steps > DEPTH:  # of so many powers of the likelihood standard errors are lower bounds
            return self._replace(excess=np.zeros_like(self.excess))
        if not self.excess.any():
            return self
        x = before.deviations
        for parents in self.parents[DEPTH - steps :]:
            x = np.take(x, parents, axis=1)
        T = (after.deviations * after.weights) @ x.T @ _inverse(before.cov)
        return self._replace(excess=T @ self.excess @ T.T)

    def seen(self, found: Variances, now: Weighted) -> tuple[Genealogy, Array]:
        """Return the genealogy with X of the particles of now, and the variances of their mean (n,).

        These are those of the last generations with what is older, or those of the first ancestors where they are larger.
        """
        older, excess, cov = np.diag(self.excess[0]), self.excess.copy(), now.cov
        variance = np.maximum(found.largest + older, self.of_founders(now).variance)
        size = np.sqrt(np.maximum(variance - found.means[0] - older, 0.0))
        size = size / np.sqrt(np.maximum(np.diag(cov), 1e-300))
        excess[-1] = self.excess[0] + cov * np.outer(size, size)
        return self._replace(excess=excess), variance

    def renewed(self) -> Genealogy:
        """Return the genealogy of particles whose first ancestors have been drawn again."""
        count = len(self.founders)
        return self._replace(founders=np.arange(count, dtype=np.int32), first=count, all_rounding=0.0)

    def of_founders(self, now: Weighted) -> Families:
        """Return what the families of the first ancestors tell."""
        return now.by_families(self.founders, self.first)

    def forgotten(self, now: Weighted) -> bool:
        """Return whether many first ancestors are left, or the states forget them."""
        if self.of_founders(now).effective >= FEW_FAMILIES:
            return True
        lags = min(self.age, DEPTH)
        index = self.parents[-1] if lags else np.arange(len(now.weights))
        for back in range(2, lags + 1):
            index = np.take(self.parents[-back], index)
        recent = now.by_families(index, self.sizes[-lags] if lags else len(index))
        return not (recent.between > REMEMBERED).any()


class Families(NamedTuple):
    """Of families: the variances of the means (n,), their shares of the variances of the states (n,), the effective number."""

    variance: Array
    between: Array
    effective: float


class Weighted(NamedTuple):
    """Deviations (n, N) of particles from their mean, their weights (N,), and the covariance (n, n)."""

    deviations: Array
    weights: Array

    @property
    def cov(self) -> Array:
        """The covariance of the particles, without what each carries by a filter of its own."""
        return np.asarray((self.deviations * self.weights) @ self.deviations.T)

    def by_families(self, labels: Array, count: int) -> Families:
        """Return what families with these labels (N,) below `count` tell."""
        shares = np.bincount(labels, self.weights, count)
        alive = shares > 0
        sums = np.array([np.bincount(labels, self.weights * row, count)[alive] for row in self.deviations])
        between, whole = (sums**2 / shares[alive]).sum(axis=1), (self.weights * self.deviations**2).sum(axis=1)
        known = np.divide(between, whole, out=np.zeros_like(whole), where=whole > 0)
        return Families((sums**2).sum(axis=1), known, effective(shares[alive]))


def _inverse(cov: Array) -> Array:
    """Return the inverse in the directions in which the particles differ."""
    scale = np.sqrt(np.diag(cov))
    known = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0)
    correlation = cov * np.outer(known, known)
    return np.asarray(np.linalg.pinv(correlation, rcond=1e-9, hermitian=True) * np.outer(known, known))


class Variances(NamedTuple):
    """By number of resamplings looked back (lags, ...): variances of the means (n,) and of the log evidence, and families.

    The last row is that of the first ancestors.
    """

    means: Array
    evidence: Array
    families: Array

    @property
    def largest(self) -> Array:
        """The largest variances of the means (n,), without those of the first ancestors, of which few may be left."""
        return np.asarray(self.means[:-1].max(axis=0) if len(self.means) > 1 else self.means[0])


def variances(genealogy: Genealogy, weights: Array, deviations: Array) -> Variances:
    """Return the variances of the weighted means of deviations (n, N) from the mean."""
    count = deviations.shape[1]
    lags = min(genealogy.age, DEPTH)
    recent = [genealogy.parents[-back] for back in range(1, lags + 1)]
    sizes, noise = [count, *(genealogy.sizes[-back] for back in range(1, lags + 1))], [0.0]
    for back in range(1, lags + 1):
        noise.append(noise[-1] + genealogy.rounding[-back])
    parts = [_lineage(recent, sizes, noise, weights, deviations)]
    if genealogy.age > DEPTH:
        last = _lineage([genealogy.founders], [count, genealogy.first], [0.0, genealogy.all_rounding], weights, deviations)
        parts.append(Variances(*(part[1:] for part in last)))
    else:
        parts.append(Variances(*(part[-1:] for part in parts[0])))
    return Variances(*(np.concatenate(rows) for rows in zip(*parts, strict=True)))


def _lineage(
    parents: list[Array], sizes: list[int], noise: list[float], weights: Array, deviations: Array
) -> Variances:
    """Return the variances by generation."""
    found = Variances(np.empty((len(sizes), len(deviations))), np.empty(len(sizes)), np.empty(len(sizes)))
    flat = np.concatenate([*parents, _NONE])
    lineage(flat, np.array(sizes), weights, deviations, np.array(noise), *found)
    return found


def of_log_likelihood(genealogy: Genealogy, found: Variances) -> tuple[Genealogy, float]:
    """Return the variance of the log-likelihood until now: settled parts of old generations, and what the last ones have."""
    evidence, done, settled = found.evidence[:-1], genealogy.done, genealogy.settled
    while genealogy.age - done > LAG and len(evidence) > LAG:
        top = genealogy.age - done
        if top < len(evidence):
            settled += max(float(evidence[top] - evidence[top - 1]), 0.0)
        done += 1
    rest = min(genealogy.age - done, len(evidence) - 1)
    return genealogy._replace(settled=settled, done=done), settled + max(float(evidence[rest]), 0.0)
