"""The error of substeps, by points of a density that s and 2 s substeps move with the same noise.

The error of a prediction by s substeps is 4 / 3 of its difference from one by 2 s.  It is measured where the observation leads:
with the likelihood L, in deviations of the density after it, it is the largest change of a mean or a deviation,

    e = 4 / 3 (E L(x_s) phi(x_s) / E L(x_s) - E L(x_2s) phi(x_2s) / E L(x_2s)),      phi = z_a, z_a z_b

No build is needed: points take the filter's own substeps.  With another linearisation of the noise, or flows of one Runge-Kutta
step, their error was a third of that of the filter, or four times as large, after long gaps.  Each point moves with four noises,
of both signs and with both halves of each substep in both orders: what is odd, or says nothing about the time step, cancels in
their sum.

What chance leaves is part of the error: of several numbers of substeps that are tried the smallest one would be taken whose error
chance hides.  Where noise drives a state through cos(2 x), eleven substeps were measured at a ninth of their error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from zakai.methods.frame.chain import Chain
from zakai.methods.frame.errors import Error, hermite, monomials, root_of
from zakai.methods.frame.placement import Mass
from zakai.methods.particles.programs import Array
from zakai.numerics.trains.carried import Likelihood
from zakai.numerics.trains.train import Train

# Points, each with four noises, for a tolerance below this one, and for another: their chance is .2 to .5 of it.
POINTS, FEWER_POINTS, SMALL = 512, 128, 1e-2
FEW = 100.0  # effective points that a likelihood must leave, or a power of it is taken
FLOW = 0.1  # error of a flow in tolerances of a build, as in `Chain`


class TimeError(NamedTuple):
    """The error of a number of substeps after the observation, and its size."""

    substeps: int
    size: float
    error: Error


def measured(chain: Chain, u: Train, count: int, likelihood: Likelihood) -> TimeError | None:
    """Return the error of so many substeps from a density; None where no point stays finite."""
    prepared, motion = chain.prepared, chain.prepared.motion
    angles = prepared.system.base.angles
    number = POINTS if chain.builder.allowed < SMALL else FEWER_POINTS
    before = Mass(*u.cloud(number)).unwrapped(angles)
    (x, gained), (y, finer) = _moved(chain, before, count)
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
    moved, terms = (hermite(np.linalg.solve(root, part.points - mean[:, None])) for part in (one, other))
    average = (terms @ other.weights)[:, None]
    each = one.weights * (moved - average) - other.weights * (terms - average)
    parts = 4.0 / 3.0 * each.reshape(len(each), 4, number).sum(axis=1)
    change, random = parts.sum(axis=1), (parts**2).sum(axis=1)
    square = change**2 + random
    square[n:] *= 0.5
    if not np.isfinite(square).all():
        return None
    largest = float(square[: monomials(n).low].max())
    error = Error.between(change, random, n)._replace(spread=parts[:n] @ parts[:n].T)
    return TimeError(count, math.sqrt(largest), error)


@dataclass(frozen=True)
class _Points:
    """Points x (n, P) at a time t with weights (P,), the integrals of their log weights (P,), and the steps of the last flow."""

    chain: Chain
    t: float
    x: Array
    weights: Array
    gained: Array
    steps: int = 1

    def at(self, t: float, steps: int | None = None) -> _Points:
        """Return the points after the flow to a time, in so many Runge-Kutta steps, or as many as the filter would take."""
        motion, interval, values = self.chain.prepared.motion, self.chain.interval, self.chain.values
        if steps is None:
            steps = motion.steps(interval, self.x, (self.t, t), values, FLOW * self.chain.builder.rule.tolerance)
        x, gained = motion.ends(self.x, motion.path(interval, self.t, t, values, steps))
        return replace(self, t=t, x=x, gained=self.gained + gained, steps=steps)

    def noise(self, length: float) -> tuple[Array, Array]:
        """Return the noise (n, n) of a substep about its middle, and df/dx (n, n), as `Chain` takes them."""
        prepared = self.chain.prepared
        finite = np.isfinite(self.x).all(axis=0) & np.isfinite(self.gained)
        mass = Mass(self.x[:, finite], self.weights[finite] / max(self.weights[finite].sum(), 1e-300))
        if prepared.system.weighted and finite.any():
            mass = mass.reweighted(self.gained[finite])
        mean, P = mass.unwrapped(prepared.system.base.angles).moments()
        about = mean, np.maximum(np.sqrt(np.diag(P)), 1e-12)
        return prepared.motion.noise(self.chain.interval, self.chain.values, self.t, length, about)

    def after(self, noise: Array) -> _Points:
        """Return the points after noise (n, P)."""
        return replace(self, x=self.x + noise)

    def kicked(self, length: float, normals: Array) -> _Points:
        """Return the points after the noise of a substep that depends on the state, for normal numbers (kicks, P)."""
        motion, interval, values, x = self.chain.prepared.motion, self.chain.interval, self.chain.values, self.x
        for c, normal in zip(motion.kicks(interval, self.t, length), normals, strict=True):
            x = motion.kicked(interval, values, (self.t, length), c[:, None] * normal, x)
        return replace(self, x=x)


def _moved(chain: Chain, before: Mass, count: int) -> list[tuple[Array, Array]]:
    """Return the ends (n, 4 P) of points by so many substeps, with the integrals of their log weights, and by twice as many."""
    interval, number = chain.interval, len(before.weights)
    length, rng = (interval.stop - interval.start) / count, np.random.default_rng(count)
    points = _Points(chain, interval.start, np.tile(before.points, 4), np.tile(before.weights, 4), np.zeros(4 * number))
    coarse = fine = points
    substep = _kicked if chain.prepared.system.kicked else _noisy
    for j in range(count):
        coarse, fine = substep(coarse.at(interval.start + (j + 0.5) * length), fine, length, rng)
    coarse = coarse.at(interval.stop)
    return [(part.x, part.gained) for part in (coarse, fine.at(interval.stop, coarse.steps))]


def _halves(rng: np.random.Generator, rows: int, number: int) -> list[tuple[float, Array]]:
    """Return the sign and the normal numbers (rows, 4 P) of both halves of a substep, of both signs and in both orders."""
    one, other = rng.standard_normal((2, rows, number))
    first, second = [one, -one, other, -other], [other, -other, one, -one]
    return [(-1.0, np.concatenate(first, axis=1)), (1.0, np.concatenate(second, axis=1))]


def _noisy(coarse: _Points, fine: _Points, length: float, rng: np.random.Generator) -> tuple[_Points, _Points]:
    """Return points after the noise of a substep, which begins at its middle, and others after that of its halves.

    The noise of a substep is that of its halves, carried to its middle by the linearised flow, after the linear map that gives it
    the covariance which a substep has.
    """
    n, points = fine.x.shape
    Q, A = coarse.noise(length)
    C, both, P = 0.25 * length * A, np.zeros_like(fine.x), np.zeros_like(Q)
    for sign, normals in _halves(rng, n, points // 4):
        fine = fine.at(coarse.t + 0.25 * sign * length, coarse.steps)
        half, _ = fine.noise(0.5 * length)
        scale, root = _root(half)
        noise = scale * (root @ normals)
        to_middle = np.eye(n) - sign * C + 0.5 * C @ C
        fine, both, P = fine.after(noise), both + to_middle @ noise, P + to_middle @ half @ to_middle.T
    (scale, root), (own, other) = _root(Q), _root(P)
    return coarse.after(scale * (root @ np.linalg.solve(other, both / np.where(own > 0, own, 1.0)))), fine


def _kicked(coarse: _Points, fine: _Points, length: float, rng: np.random.Generator) -> tuple[_Points, _Points]:
    """Return what `_noisy` returns, for noise that depends on the state."""
    kicks, total = len(coarse.chain.prepared.motion.kicks(coarse.chain.interval, coarse.t, length)), 0.0
    for sign, normals in _halves(rng, kicks, fine.x.shape[1] // 4):
        fine, total = fine.at(coarse.t + 0.25 * sign * length, coarse.steps).kicked(0.5 * length, normals), total + normals
    return coarse.kicked(length, math.sqrt(0.5) * total), fine


def _root(Q: Array) -> tuple[Array, Array]:
    """Return deviations (n, 1) and the Cholesky factor of the correlations; a state without noise has the deviation zero."""
    scale = np.sqrt(np.maximum(np.diag(Q), 0.0))[:, None]
    unit = np.where(scale > 0, scale, 1.0)
    return scale, np.linalg.cholesky(Q / unit / unit.T + 1e-9 * np.eye(len(Q)))
