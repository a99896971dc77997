"""Standard errors from one run, by families: particles with a common ancestor share the noise of what came before it.

With the families of the particles of an earlier generation (a generation begins with a resampling) and their shares of the weight

    variance of a mean         = N / (N - 1) sum over families of (sum w_i (x_i - mean))^2
    variance of log evidence   = sum over families of (sum w_i)^2 - 1 / N - what systematic resampling itself adds

The earlier the generation, the more of the noise is seen, and the fewer families are left to see it by.  The largest variance of
the generations of the last `DEPTH` resamplings is taken.

References:
    Lee and Whiteley 2018, Variance estimation in the particle filter.
    Olsson and Douc 2019, Numerically stable online estimation of variance in particle filters.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai.methods.particles.programs import Array
from zakai.numerics.particles.population import lineage

DEPTH = 16  # resamplings that are looked back
LAG = 6  # resamplings after which a generation's share of the variance of the log-likelihood is settled
_NONE = np.zeros(0, np.int32)


class Genealogy(NamedTuple):
    """The parents of the last resamplings, newest last, and the first ancestors.

    `parents` and `sizes` are those of the last `DEPTH` resamplings, `rounding` what each adds to the spread of the shares;
    `founders` (N,) are the first ancestors, of `first` particles, `all_rounding` the sum of all.  `age` counts resamplings,
    `settled` of which `done` have given their part of the variance of the log-likelihood.
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

    @classmethod
    def begin(cls, count: int) -> Genealogy:
        """Return the genealogy of independent particles."""
        founders = np.arange(count, dtype=np.int32)
        return cls((_NONE,) * DEPTH, (0,) * DEPTH, (0.0,) * DEPTH, founders, count, 0.0, 0, 0.0, 0)

    def resampled(self, ancestors: Array, weights: Array) -> Genealogy:
        """Return the genealogy after systematic resampling with these weights (N,)."""
        number = len(ancestors) * weights
        share = number - np.floor(number)
        noise = float(np.sum(share * (1.0 - share))) / len(ancestors) ** 2
        return self._replace(
            parents=(*self.parents[1:], ancestors), sizes=(*self.sizes[1:], len(weights)), rounding=(*self.rounding[1:], noise),
            founders=self.founders[ancestors], all_rounding=self.all_rounding + noise, age=self.age + 1,
        )  # fmt: skip


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
