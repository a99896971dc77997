"""The parts of a motion that the filter has made, each of which leads draws of the state at its end back to its start.

A flow leads back along its path.  Of noise, x_- + e = x with x_- of the density before it, u,

    p(x_- | x) ~ u(x_-) N(x - x_-; 0, Q),

which is a train with the ranks of u in a frame where Q is diagonal (`numerics/trains/conditional.py`).  After noise that depends
on the state the density at x is a sum over flows: a draw takes one of them, in proportion to its term.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np

from zakai.methods.frame.motion import Motion
from zakai.methods.particles.programs import Array
from zakai.numerics.trains.carried import Carried, Path
from zakai.numerics.trains.conditional import drawn_before
from zakai.numerics.trains.train import Train, tail_radius


class Led(NamedTuple):
    """Draws (n, P) at the start of a move, their means given those at its end (n, P), and the share that had no density there."""

    draws: Array
    means: Array
    unknown: float


class Move(Protocol):
    """A part of a motion."""

    def before(self, x: Array, rng: np.random.Generator) -> Led:
        """Return draws at the start of draws (n, P) at the end."""


def _finite(draws: Array, means: Array, unknown: Array, rng: np.random.Generator) -> Led:
    """Return draws of which those that are not finite are replaced by others: a drift as -x^3 leads back to infinity."""
    lost = ~(np.isfinite(draws).all(axis=0) & np.isfinite(means).all(axis=0))
    if lost.any() and not lost.all():
        others = rng.choice(np.flatnonzero(~lost), int(lost.sum()))
        draws, means = draws.copy(), means.copy()
        draws[:, lost], means[:, lost] = draws[:, others], means[:, others]
    return Led(draws, means, float(np.mean(unknown | lost)))


@dataclass(frozen=True)
class Flow:
    """A flow of the drift, by the path back."""

    motion: Motion
    path: Path

    def before(self, x: Array, rng: np.random.Generator) -> Led:
        """Return the starts."""
        ends, _ = self.motion.ends(x, self.path)
        return _finite(ends, ends, np.zeros(x.shape[1], bool), rng)


@dataclass(frozen=True)
class Noise:
    """Noise with the variances (n,) along the axes of a density, and the linear map (n, n) of its coordinates after it.

    A Gaussian stands for its `tails`, as in `Train`.
    """

    density: Train
    variances: Array
    turned: Array
    tails: float

    def before(self, x: Array, rng: np.random.Generator) -> Led:
        """Return states before the noise; far out, where a train is not accurate, those of the Gaussian that stands for it."""
        u, grid, (n, count) = self.density, self.density.grid, x.shape
        apart, period = x - grid.centre[:, None], u.periods[:, None]
        apart = np.where(period > 0, apart - period * np.floor(apart / np.where(period > 0, period, 1.0) + 0.5), apart)
        y = np.linalg.solve(grid.basis @ self.turned, apart)
        found = drawn_before(u, self.variances, y, rng.random((2 * n, count)))
        z, means, unknown = found.z, found.means, ~found.exists
        mean, P = u.moments()
        mean = np.linalg.solve(grid.basis, mean - grid.centre)
        P = np.linalg.solve(grid.basis, np.linalg.solve(grid.basis, P).T)
        away, total = y - mean[:, None], P + np.diag(self.variances)
        far = np.zeros(count, bool)
        if not grid.closed.any():
            far = (away * np.linalg.solve(total, away)).sum(axis=0) > tail_radius(n, self.tails)
        gaussian = far | unknown
        normal = rng.standard_normal((n, count))
        if gaussian.any():
            gain = np.linalg.solve(total, P).T
            values, vectors = np.linalg.eigh(P - gain @ P)
            root = vectors * np.sqrt(np.maximum(values, 0.0))
            means[:, gaussian] = mean[:, None] + gain @ away[:, gaussian]
            z[:, gaussian] = means[:, gaussian] + root @ normal[:, gaussian]
        return Led(grid.x_of(z), grid.x_of(means), float(np.mean(unknown)))


@dataclass(frozen=True)
class Kick:
    """Noise along one column of a root that depends on the state: the density after it, and the path back of each term."""

    motion: Motion
    function: Carried
    paths: tuple[Path, ...]

    def before(self, x: Array, rng: np.random.Generator) -> Led:
        """Return states before the noise."""
        return _chosen(self.function, x, [self.motion.ends(x, path)[0] for path in self.paths], rng)


@dataclass(frozen=True)
class Shift:
    """Noise along one direction: the density after it, and the shift (n, Q) of each term."""

    function: Carried
    shifts: Array

    def before(self, x: Array, rng: np.random.Generator) -> Led:
        """Return states before the noise."""
        return _chosen(self.function, x, [x - shift[:, None] for shift in self.shifts.T], rng)


def _chosen(function: Carried, x: Array, ends: list[Array], rng: np.random.Generator) -> Led:
    """Return for each draw x (n, P) its end by one of the terms of a density, in proportion to their values at x."""
    values = np.array([np.maximum(replace(function, terms=(term,))(x), 0.0) for term in function.terms])
    sums = np.cumsum(values, axis=0)
    unknown = ~(sums[-1] > 0)
    chosen = np.minimum((sums < rng.random(x.shape[1]) * sums[-1]).sum(axis=0), len(values) - 1)
    chosen[unknown] = len(values) // 2
    found, means = np.empty_like(x), np.zeros_like(x)
    for number, end in enumerate(ends):
        own, used = chosen == number, values[number] > 0
        found[:, own] = end[:, own]
        means[:, used] += (values[number] / np.maximum(sums[-1], 1e-300) * end)[:, used]
    means[:, unknown] = found[:, unknown]
    return _finite(found, means, unknown, rng)
