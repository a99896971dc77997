"""Frames and grids for a density of which weighted points are known.

The basis of a frame is a Cholesky factor: x_2 relative to its regression on x_1, and so on.  Triangular bases keep the ranks of
trains small (24 with the symmetric root, 9 with the factor, for a track seen by bearings alone).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from zakai.numerics.trains.grid import Grid

Array = Any
# Difference of noise, in variances of the density, up to which two axes have one triangular block: at most .03, and this many
# tolerances of a build.  Noise off the diagonal becomes a linear map of the frame instead of a convolution, which is wrong for
# a density that is not Gaussian; with .03 alone that adds up over substeps (a robot with a wide heading: .007 deviations).
TOGETHER, TOGETHER_TOLERANCES = 0.03, 1.0
LEFT_OUT = 1e-3  # share of the tolerance that a box may leave out: every separated part with more mass is kept
FAR = 8  # control points that are the farthest of the heavy ones
CHANCE = 2.0  # standard errors of a correlation that chance explains
REACH = 1.3  # of the extreme of the mass
MOST_POINTS = 160  # along an axis: two modes with twenty deviations between them
FEWEST_POINTS = 10  # along an axis: six splines and two points beyond both ends
LINES = 3  # through the mass, and one more through the point that counts most for fourth moments
FIRST_LINE = 40  # points along a line at first; doubled where the spectrum fills half of them
TAIL = 0.3  # share of the tolerance below which the spectrum of a line is left out
FINER = 0.7  # factor of the spacing that the lines ask for: they do not see every direction
HALF_TURN = 0.45  # reach of an angle in turns, from which its axis is closed


@dataclass(frozen=True, eq=False)
class Mass:
    """Points x (n, P) of a density, with weights (P,) that sum to one."""

    points: Array
    weights: Array

    def moments(self) -> tuple[Array, Array]:
        """Return the mean (n,) and the covariance (n, n)."""
        return self._moments

    @cached_property
    def _moments(self) -> tuple[Array, Array]:
        mean = self.points @ self.weights
        apart = self.points - mean[:, None]
        return mean, (apart * self.weights) @ apart.T

    def part(self, count: int) -> tuple[Array, Array]:
        """Return an even number of points of a cloud, and their weights: the first ones of both of its halves."""
        chosen = np.arange(count // 2)
        chosen = np.concatenate([chosen, chosen + len(self.weights) // 2])
        weights = self.weights[chosen]
        return np.ascontiguousarray(self.points[:, chosen]), weights / weights.sum()

    def slope(self, ends: Array) -> Array:
        """Return the matrix (n, n) of the linear regression of other points (n, P), with the same weights, on these."""
        mean, P = self.moments()
        scale = np.maximum(np.sqrt(P.diagonal()), 1e-300)
        apart = (self.points - mean[:, None]) / scale[:, None]
        moved = ends - (ends @ self.weights)[:, None]
        unit = P / np.outer(scale, scale) + 1e-9 * np.eye(len(P))
        return np.asarray(np.linalg.solve(unit, (apart * self.weights) @ moved.T).T / scale)

    def reweighted(self, logs: Array) -> Mass:
        """Return the points with weights times the exponentials of numbers (P,)."""
        weights = self.weights * np.exp(logs - logs.max())
        return Mass(self.points, weights / weights.sum())

    def power(self, logs: Array, few: float) -> float:
        """Return the largest power of a likelihood that leaves enough effective points, or most of them."""
        target = min(few, 0.7 * self.effective)
        low, high = -12.0, 0.0  # of log10: powers may be very small at first
        for _ in range(24):
            middle = 0.5 * (low + high)
            if self.reweighted(10.0**middle * logs).effective > target:
                low = middle
            else:
                high = middle
        return float(10.0**low)

    @property
    def effective(self) -> float:
        """The effective number of points."""
        return float(1.0 / np.sum(self.weights**2))

    def depth(self, logs: Array) -> float:
        """Return how far into the tails of a Gaussian with these moments a likelihood leads, in nats; zero for equal moments."""
        if not np.isfinite(logs).any():
            return math.inf
        seen = self.reweighted(np.maximum(logs, np.max(logs) - 1e6))
        return 0.5 * len(self.points) * (float(self.distances**2 @ seen.weights) - 1.0)

    def heavy(self, tolerance: float) -> Array:
        """Return which points (P,) cannot be left out: the others have together a small share of the mass."""
        order, below = self._ascending
        keep = np.ones(len(order), bool)
        keep[order[below < LEFT_OUT * tolerance]] = False
        return keep

    @cached_property
    def _ascending(self) -> tuple[Array, Array]:
        """The points (P,) in the order of their weights, and the sums of the weights up to each."""
        order = np.argsort(self.weights, kind="stable")
        return order, np.cumsum(self.weights[order])

    def unwrapped(self, angles: Array) -> Mass:
        """Return the points with angles (n,) on the turn about their mean direction, so that moments are those of a line."""
        if not angles.any():
            return self
        known = self._unwrapped.get(angles.tobytes())
        if known is not None:
            return known
        points = self.points.copy()
        for d in np.flatnonzero(angles):
            c = math.atan2(np.sin(points[d]) @ self.weights, np.cos(points[d]) @ self.weights)
            points[d] = c + np.remainder(points[d] - c + math.pi, 2 * math.pi) - math.pi
        found = self._unwrapped[angles.tobytes()] = Mass(points, self.weights)
        return found

    @cached_property
    def _unwrapped(self) -> dict[bytes, Mass]:
        """The points on one turn, by which states are angles."""
        return {}

    @cached_property
    def distances(self) -> Array:
        """The distances (P,) from the mean in deviations, those of a Gaussian about one."""
        mean, P = self.moments()
        scale = np.maximum(np.sqrt(P.diagonal()), 1e-300)
        apart = (self.points - mean[:, None]) / scale[:, None]
        unit = P / np.outer(scale, scale) + 1e-9 * np.eye(len(P))
        return np.asarray(np.sqrt(np.sum(apart * (np.linalg.inv(unit) @ apart), axis=0) / len(P)))

    @cached_property
    def moving(self) -> Array:
        """How much the points (P,) count for the mean: their mass, times their distance in deviations where that is above one."""
        return np.asarray(self.weights * np.maximum(self.distances, 1.0))

    def control(self, count: int, tolerance: float) -> Mass:
        """Return points for checks, with weights: most in proportion to what they move the mean, the others to root of the mass.

        They are drawn in the order of their distance from the mean, so that a part of little mass far from the others has its
        share of them; the farthest of the heavy ones are among them.
        """
        moving, root = self.moving, np.sqrt(self.weights)
        chance = 0.7 * moving / moving.sum() + 0.3 * root / root.sum()
        order = np.argsort(self.distances, kind="stable")
        places = (np.arange(count) + 0.5) / count
        drawn = order[np.minimum(np.searchsorted(np.cumsum(chance[order]), places), len(chance) - 1)]
        far = order[self.heavy(tolerance)[order]][-FAR:]
        chosen = np.concatenate([drawn, far])
        weights = np.concatenate([self.weights[drawn] / (count * chance[drawn]), self.weights[far]])
        return Mass(np.ascontiguousarray(self.points[:, chosen]), weights / weights.sum())


class Rule(NamedTuple):
    """The accuracy of a build: its relative error, the half width of a box in deviations, and the most points along an axis."""

    tolerance: float
    width: float
    most_points: int

    @classmethod
    def of(cls, tolerance: float) -> Rule:
        """Return the rule for a tolerance: a Gaussian is below it beyond the width."""
        return cls(tolerance, math.sqrt(2 * math.log(1 / tolerance)) + 0.7, MOST_POINTS)


def frame_of(P: Array, Q: Array | None, together: float) -> tuple[Array, Array]:
    """Return B with B B' = P, triangular where the noise leaves it free, and D = B^-1 Q B^-T, nearly diagonal.

    Axes whose noise differs by less than `together` form a group, inside of which B is triangular.
    """
    d, n = np.sqrt(np.maximum(P.diagonal(), 1e-300)), len(P)
    C = d[:, None] * np.linalg.cholesky(P / d / d[:, None] + 1e-9 * np.eye(n))
    if Q is None:
        return C, np.zeros((n, n))
    T = np.linalg.solve(C, np.linalg.solve(C, Q).T)
    noise, W = np.linalg.eigh(0.5 * (T + T.T))
    free, V, start = list(range(n)), np.zeros((n, n)), 0
    for stop in range(1, n + 1):
        if stop < n and noise[stop] - noise[stop - 1] < together * (1 + noise[stop]):
            continue
        group = W[:, start:stop]
        sizes = (group**2).sum(axis=1)
        rows = sorted(sorted(free, key=lambda i: -sizes[i])[: stop - start])
        q, r = np.eye(1), group[rows].T
        if len(rows) > 1:
            q, r = np.linalg.qr(r)  # group[rows] = r' q': the group times q is triangular there
        V[:, rows] = group @ (q * np.where(r.diagonal() < 0, -1.0, 1.0))
        free, start = [i for i in free if i not in rows], stop
    return C @ V, V.T @ T @ V


def without_chance(P: Array, count: float) -> Array:
    """Return a covariance without correlations between groups of states, where chance may explain all between two groups.

    With chance correlations in its frame, a density of 2^6 modes on the axes has twenty times the ranks.
    """
    d = np.sqrt(np.maximum(P.diagonal(), 1e-300))
    linked = np.abs(P / d / d[:, None]) >= CHANCE / math.sqrt(count)
    for _ in range(len(P)):  # paths of any length
        linked = linked @ linked
    return np.where(linked, P, 0.0)


def closed_axes(mass: Mass, angles: Array, rule: Rule) -> Array:
    """Return which angles (n,) are so wide that their axis goes once around the circle."""
    if not angles.any():
        return np.zeros(len(angles), bool)
    mean, P = mass.moments()
    far = np.abs(mass.points - mean[:, None])[:, mass.heavy(rule.tolerance)].max(axis=1)
    reach = np.maximum(rule.width * np.sqrt(P.diagonal()), REACH * far)
    return np.asarray(angles & (reach > HALF_TURN * 2 * np.pi))


class Placed(NamedTuple):
    """A grid, and the noise D (n, n) in its frame."""

    grid: Grid
    noise: Array


def place(
    function: Callable[[Array], Array], mass: Mass, closed: Array, rule: Rule, noise: Array | None, stretch: float, order: Array
) -> Placed:
    """Return the grid for a function.

    Args:
        function: of points (n, P).
        mass: points of its mass; angles are unwrapped.
        closed: which axes go once around the circle (n,).
        rule: the accuracy.
        noise: the covariance (n, n) that the frame is to make diagonal, None where there is none.
        stretch: a factor of the box.
        order: of the states (n,), in which the frame is triangular.
    """
    mean, P = mass.moments()
    P = without_chance(P, mass.effective)
    # An angle that goes around has an axis of its own; noise between it and the others is not in the frame: see `Chain`.
    B, D, free = np.eye(len(mean)), np.diag(np.zeros(len(mean)) if noise is None else np.diag(noise)), np.flatnonzero(~closed)
    if len(free):
        rows = order[~closed[order]]
        block, together = np.ix_(rows, rows), min(TOGETHER, TOGETHER_TOLERANCES * rule.tolerance)
        found = frame_of(P[block], None if noise is None else noise[block], together)
        B[np.ix_(free, free)] = 0.0
        B[np.ix_(rows, free)], D[np.ix_(free, free)] = found
    z = np.linalg.inv(B) @ (mass.points - mean[:, None])
    heavy = z[:, mass.heavy(rule.tolerance)]
    low = -stretch * np.maximum(rule.width, -REACH * heavy.min(axis=1))
    high = stretch * np.maximum(rule.width, REACH * heavy.max(axis=1))
    low[closed], high[closed] = -math.pi, math.pi
    frame = Grid(mean, B, low, high - low, np.ones(len(mean), np.int64), closed)
    return Placed(with_spacing(frame, low, high, _spacing(function, Mass(z, mass.weights), frame, high, rule), rule), D)


def with_spacing(grid: Grid, low: Array, high: Array, step: Array, rule: Rule) -> Grid:
    """Return the grid from `low` to `high` (n,) with at most this spacing (n,)."""
    closed = grid.closed
    sizes = np.ceil((high - low) / step) + ~closed
    sizes = np.clip(sizes, FEWEST_POINTS, rule.most_points).astype(np.int64)
    step = (high - low) / np.where(closed, sizes, sizes - 1)
    return grid._replace(low=np.ascontiguousarray(low), step=step, sizes=sizes)


def _spacing(function: Callable[[Array], Array], mass: Mass, frame: Grid, high: Array, rule: Rule) -> Array:
    """Return the spacing (n,) that resolves a function along lines through its mass, from the tails of their spectra."""
    z, weights, low, n = mass.points, mass.weights, frame.low, frame.n
    order, square = np.argsort(-weights, kind="stable"), (z**2).sum(axis=0)
    middle = order[np.linspace(0, max(1, int(0.7 * len(order))) - 1, LINES).astype(int)]
    farthest = int(np.argmax(weights * square**2))
    through = z[:, [*middle, farthest]]
    used, rest, count = np.zeros(n), np.arange(n), FIRST_LINE
    while len(rest) and count <= 2 * rule.most_points:
        Z = np.repeat(through[:, None, :, None], len(rest), axis=1).repeat(count, axis=3)  # coordinate, axis, line, point
        for i, k in enumerate(rest):
            Z[k, i] = low[k] + (high[k] - low[k]) * (np.arange(count) + 0.5) / count
        values = function(frame.x_of(Z.reshape(n, -1))).reshape(len(rest), LINES + 1, count)
        values[:, -1] *= 1.0 + square[farthest] / n  # what is far away counts more for the moments
        spectrum = np.abs(np.fft.rfft(values, axis=2)).max(axis=1)
        for i, k in enumerate(rest):
            seen = np.flatnonzero(spectrum[i] > TAIL * rule.tolerance * spectrum[i].max())
            used[k] = 1 + np.max(seen, initial=1)
        rest, count = rest[used[rest] >= count // 2 - 2], 2 * count
    return np.asarray(FINER * (high - low) / (2 * used))
