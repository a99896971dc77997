"""The error of substeps, by points of a density that s and 2 s substeps move with the same noise.

The error of a prediction by s substeps is 4 / 3 of its difference from one by 2 s.  It is measured where the observation leads:
with the likelihood L, in deviations of the density after it, it is the largest change of a mean or a deviation,

    e = 4 / 3 (E L(x_s) phi(x_s) / E L(x_s) - E L(x_2s) phi(x_2s) / E L(x_2s)),      phi = z_a, z_a z_b

No build is needed.  Each point moves with four noises, of both signs and with both halves of each substep in both orders: what is
odd, or says nothing about the time step, cancels in their sum.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from zakai.methods.frame.chain import Chain
from zakai.methods.frame.errors import Error, root_of
from zakai.methods.frame.placement import Mass
from zakai.methods.particles.interval import Pilots, coupled
from zakai.methods.particles.programs import Array
from zakai.numerics.trains.carried import Likelihood
from zakai.numerics.trains.train import Train

# Points, each with four noises, for a tolerance below this one, and for another: their chance is .2 to .5 of it.
POINTS, FEWER_POINTS, SMALL = 512, 128, 3e-3
FEW = 100.0  # effective points that a likelihood must leave, or a power of it is taken
LEAST = 0.25  # share of the square of an error that is left when that of the points is subtracted


class TimeError(NamedTuple):
    """The error of a number of substeps after the observation, and its size."""

    substeps: int
    size: float
    error: Error


def measured(chain: Chain, u: Train, count: int, likelihood: Likelihood) -> TimeError | None:
    """Return the error of so many substeps from a density; None where no point stays finite."""
    prepared, interval, motion = chain.prepared, chain.interval, chain.prepared.motion
    angles = prepared.system.base.angles
    number = POINTS if chain.builder.allowed < SMALL else FEWER_POINTS
    before = Mass(*u.cloud(number)).unwrapped(angles)
    mean, P = before.moments()
    pilots = Pilots(np.tile(before.points, 4), mean, np.maximum(np.sqrt(np.diag(P)), 1e-12), count, 0.0)
    found = coupled(motion.coefficients, interval, chain.values, pilots, count, paired=True)
    x, gained = found.by(motion.coefficients, 4)
    y, finer = found.finer, found.finer_gained
    # The likelihood weighs the points of both.
    gained, finer = gained + motion.logs(likelihood, x), finer + motion.logs(likelihood, y)
    finite = np.isfinite(x).all(axis=0) & np.isfinite(y).all(axis=0) & np.isfinite(gained) & np.isfinite(finer)
    shares = np.where(finite, np.tile(before.weights, 4), 0.0)
    if not shares.sum() > 0:
        return None
    x, y, gained, finer = (np.where(finite, part, 0.0) for part in (x, y, gained, finer))
    mass = Mass(y, shares / shares.sum())
    power = 1.0 if mass.reweighted(finer).effective >= FEW else mass.power(finer, FEW)
    other = mass.reweighted(power * finer).unwrapped(angles)
    one = Mass(x + other.points - y, mass.weights).reweighted(power * gained)
    mean, P = other.moments()
    n, root = len(mean), root_of(P)
    moved, terms = (_monomials(np.linalg.solve(root, part.points - mean[:, None])) for part in (one, other))
    average = (terms @ other.weights)[:, None]
    each = one.weights * (moved - average) - other.weights * (terms - average)
    each = 4.0 / 3.0 * each.reshape(len(each), 4, number).sum(axis=1)
    change = each.sum(axis=1)
    random = (each**2).sum(axis=1) - change**2 / number
    square = np.maximum(change**2 - random, LEAST * change**2)
    if not np.isfinite(square).all():
        return None
    second, pairs = np.zeros((n, n)), np.triu_indices(n)
    second[pairs] = math.sqrt(2.0) * change[n:]
    second = second + np.triu(second, 1).T
    return TimeError(count, math.sqrt(float(square.max())), Error.zero(n)._replace(first=change[:n], second=second))


def _monomials(z: Array) -> Array:
    """Return the coordinates (n, P) and their products of two over the root of two: (n + n (n + 1) / 2, P)."""
    first, second = np.triu_indices(len(z))
    return np.concatenate([z, math.sqrt(0.5) * z[first] * z[second]])
