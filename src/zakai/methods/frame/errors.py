"""The estimated error of the mean of a density, as a covariance: what a step adds, and what it leaves of earlier errors.

A build that is wrong by the relative error e(x) moves the mean of the density p after the observation by

    b = int e(x) (x - m) p(x) dx / int p dx,      with e less its mean under p,

a sum over the control points of the build, carried to the observation and weighted by it.  The sum has signs, unlike the error in
L1, which is three to thirty times as large (turns, bearings, re-entry, a robot).  What the choice of the points adds to it is
their sample variance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from zakai.methods.frame.placement import Mass
from zakai.methods.particles.programs import Array

FEW = 8.0  # effective control points of a prediction that a likelihood must leave
MOST = 3.0  # times the error in L1: more is that of a few points, which the likelihood happens to prefer


class ErrorOfMean(NamedTuple):
    """The error of a mean (n,), and the covariance (n, n) of an error of mean zero."""

    bias: Array
    spread: Array

    @property
    def square(self) -> Array:
        """The mean square (n, n)."""
        return np.outer(self.bias, self.bias) + self.spread


@dataclass(frozen=True)
class Missed:
    """The relative error (P,) of a density at weighted points of it."""

    mass: Mass
    relative: Array

    def at(self, ends: Array) -> Missed:
        """Return the same errors at other points (n, P), of which only finite ones count."""
        finite = np.isfinite(ends).all(axis=0)
        weights = self.mass.weights[finite]
        return Missed(Mass(np.ascontiguousarray(ends[:, finite]), weights / weights.sum()), self.relative[finite])

    def of_mean(self, logs: Array, cov: Array, angles: Array) -> ErrorOfMean:
        """Return the error of the mean of a density.

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
        shares = seen.weights * (self.relative - self.relative @ seen.weights) * (seen.points - mean[:, None])
        if few:
            shares = ratio(cov, P) @ shares
        found = ErrorOfMean(shares.sum(axis=1), shares @ shares.T)
        size, most = in_deviations(found.square, cov), MOST * float(self.mass.moving @ np.abs(self.relative))
        factor = min(1.0, most / max(size, 1e-300))
        return ErrorOfMean(factor * found.bias, factor**2 * found.spread)


def total(parts: list[tuple[float, ErrorOfMean]], n: int) -> ErrorOfMean:
    """Return the sum of errors times factors; what the choice of points adds is independent."""
    bias, spread = np.zeros(n), np.zeros((n, n))
    for factor, part in parts:
        bias, spread = bias + factor * part.bias, spread + factor**2 * part.spread
    return ErrorOfMean(bias, spread)


def ratio(cov: Array, P: Array) -> Array:
    """Return cov P^-1 (n, n)."""
    scale = np.maximum(np.sqrt(np.diag(P)), 1e-300)
    unit = P / np.outer(scale, scale) + 1e-9 * np.eye(len(P))
    return np.asarray(np.linalg.solve(unit, (cov / scale).T).T / scale)


def carried(mass: Mass, slope: Array, cov: Array) -> Array:
    """Return the matrix (n, n) by which a motion and an observation change an error of the mean.

    An observation does not change the ratio of a wrong density to the right one.  Where its logarithm is c'x the mean is off by
    P c, before and after with the covariance P of that time.

    Args:
        mass: points of the prediction.
        slope: the linearised motion (n, n).
        cov: the covariance after the observation.
    """
    return ratio(cov, mass.moments()[1]) @ slope


def in_deviations(error: Array, cov: Array) -> float:
    """Return the largest error of a mean in standard deviations, of covariances (n, n)."""
    return float(np.sqrt(np.max(np.diag(error) / np.maximum(np.diag(cov), 1e-300))))
