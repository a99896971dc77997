"""The choice of a grid that covers and resolves a density of which points and weights are known."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.space.fit import Fitted, Previous, Rule, Weighted, fit
from zakai.numerics.space.grid import Grid, rounded_size

Array = NDArray[Any]
LEAST = {1: 32, 2: 20, 3: 16, 4: 12}
MOST = {1: 1024, 2: 512, 3: 128, 4: 40}
POINTS = {1: 2**10, 2: 2**18, 3: 2**18, 4: 2**19}  # of a grid; the work of a substep is proportional to them


class Bounds(NamedTuple):
    """The requirements for a grid.

    `edge` is the share of the maximum that counts as zero; `tail` the share of the mass in the spectrum at the highest
    frequencies with which a grid is used; `most` points along an axis; which coordinates are `periodic`. With `band_limited`
    interpolation is exact for a density that its grid resolves, and what remains is rounding. Splines of a motion are those of
    a grid that is `finer`.
    """

    edge: float
    tail: float
    most: int
    periodic: tuple[bool, ...]
    band_limited: bool = False
    finer: float = 1.0

    @property
    def reach(self) -> float:
        """Deviations at which a Gaussian has fallen to `edge`."""
        return math.sqrt(-2 * math.log(self.edge))

    @property
    def spacings(self) -> float:
        """Spacings in a standard deviation that leave `tail` with a margin."""
        margin = 30 if self.band_limited else 100
        return math.sqrt(-2 * math.log(self.tail / margin)) / math.pi


class Points(NamedTuple):
    """Points with densities: `offsets` (J, n) from a point `start` (n,) nearby, and logarithms of densities (J,), at most 0.

    Those with logarithms below `least` do not count.
    """

    offsets: Array
    logs: Array
    start: Array
    least: float = -np.inf


def fitted_grid(
    points: Points, noise: Array, narrowness: Array, bounds: Bounds, previous: Grid, extra: float = 0.0
) -> Grid:
    """Return a grid for points with a Gaussian N(0, noise) added.

    Args:
        points: the points.
        noise: covariance that is added (n, n).
        narrowness: smallest standard deviation along each axis, in conditional deviations of a Gaussian (n,), at most 1.
        bounds: what the grid must keep.
        previous: the grid of the points; its axes are kept where they still fit.
        extra: share of its width by which the grid is wider at each end.
    """
    offsets, logs, start, least = points
    n = len(start)
    centre, basis = np.zeros(n), np.empty((n, n))
    sizes, closed = np.empty(n, np.int64), np.empty(n, bool)
    fit(
        Weighted(np.array(offsets.T, order="C"), np.ascontiguousarray(logs), start, float(least)),
        np.ascontiguousarray(noise),
        narrowness,
        Previous(np.ascontiguousarray(previous.basis), previous.circles, np.array(bounds.periodic)),
        Rule(bounds.reach, bounds.spacings, float(extra), LEAST[n], bounds.most, float(POINTS[n])),
        Fitted(centre, basis, sizes, closed),
    )
    return Grid(centre, basis, tuple(sizes.tolist()), tuple(closed.tolist()))


def _coarser(sizes: Array, bounds: Bounds) -> float:
    """Return the factor of all spacings by which a grid of so many points (n,) has no more than it may."""
    n, count = len(sizes), float(np.prod(np.minimum(sizes, bounds.most)))
    return max(count / POINTS[n], 1.0) ** (1 / n)


def adjusted(grid: Grid, below: Array, above: Array, finer: Array, bounds: Bounds) -> Grid | None:
    """Return a wider or finer grid; None where nothing can be changed.

    Its ends are moved outwards by `below` and `above` (n,), shares of its width, and its spacings divided by `finer` (n,).
    """
    n = grid.n
    sizes, basis, centre = [], grid.basis.copy(), grid.centre
    changed = False
    growth = np.array([(1.0 if grid.closed[d] else 1.0 + below[d] + above[d]) * finer[d] for d in range(n)])
    margin, wanted = np.log(POINTS[n] / np.prod(grid.sizes)), np.log(growth).sum()
    growth = growth ** min(max(margin / max(wanted, 1e-300), 0.0), 1.0)
    for d, size in enumerate(grid.sizes):
        wider = 0.0 if grid.closed[d] else below[d] + above[d]
        new = rounded_size(size * growth[d], min(LEAST[n], size), bounds.most)
        factor = size * (1 + wider) / new
        if grid.closed[d]:
            factor = size / new
        sizes.append(new)
        changed |= new != size or wider > 0
        centre = centre + grid.basis[:, d] * (0.5 * size * (0.0 if grid.closed[d] else above[d] - below[d]))
        basis[:, d] *= factor
    return Grid(centre, basis, tuple(sizes), grid.closed) if changed else None


def padded_sizes(values: Array, grid: Grid, noise: Array, bounds: Bounds) -> tuple[int, ...]:
    """Return the sizes that a density needs to be spread by N(0, noise) without running over the ends of its grid."""
    variances, sizes = _variances(grid, noise), list(grid.sizes)
    halves = _spread_halves(grid, variances, bounds)
    for d, size in enumerate(grid.sizes):
        if grid.closed[d] or not variances[d] > 0:
            continue
        # A second mode at an end is spread farther than the end of a Gaussian that fills the grid.
        highest = values.real.max(axis=tuple(e for e in range(grid.n) if e != d))
        least = bounds.edge * highest.max()
        used = np.flatnonzero(highest > least)
        ends = np.abs(used - size // 2) + np.sqrt(2 * np.log(highest[used] / least) * variances[d])
        half = max(halves[d], float(ends.max(initial=0.0)))
        if half >= 0.5 * size + 1:
            sizes[d] = max(rounded_size(2 * half, LEAST[grid.n], 4 * bounds.most), size)
    return tuple(sizes)


def _variances(grid: Grid, noise: Array) -> list[float]:
    """Return the variances of N(0, noise) along the axes, in squared spacings."""
    inverse = grid.inverse
    variances: list[float] = ((inverse @ noise) * inverse).sum(axis=1).tolist()
    return variances


def _spread_halves(grid: Grid, variances: list[float], bounds: Bounds) -> list[float]:
    """Return half of the widths that a density that fills its grid needs after spreading by `variances`, in spacings."""
    return [math.sqrt(0.25 * size**2 + bounds.reach**2 * v) for size, v in zip(grid.sizes, variances, strict=True)]


def enlargement(grid: Grid, noise: Array, bounds: Bounds) -> float:
    """Return the ratio of the volume that a density needs to be spread by N(0, noise) to that of its grid."""
    halves = _spread_halves(grid, _variances(grid, noise), bounds)
    return math.prod(1.0 if grid.closed[d] else halves[d] / (0.5 * size) for d, size in enumerate(grid.sizes))


def whitened_grid(offsets: Array, logs: Array, noise: Array, narrowness: Array, bounds: Bounds, grid: Grid) -> Grid:
    """Return a grid whose axes are those of `grid` times the Cholesky factor of the covariance of some of its points.

    The old axes in terms of the new are a lower triangle, so that band-limited interpolation takes one axis after the other.

    Args:
        offsets: the points relative to the centre of the grid (J, n).
        logs, noise, narrowness, bounds: as for `fitted_grid`.
        grid: the grid of the points.
    """
    n = grid.n
    inverse = grid.inverse
    z, added = offsets @ inverse.T, inverse @ noise @ inverse.T
    weights = np.exp(logs)
    weights = weights / weights.sum()
    mean = weights @ z
    cov = ((z - mean) * weights[:, None]).T @ (z - mean) + added
    factor = np.linalg.cholesky(cov + 1e-12 * np.diag(np.diagonal(cov)) + 1e-20 * np.eye(n))
    white = (z - mean) @ np.linalg.inv(factor).T
    spread = np.linalg.inv(factor) @ added @ np.linalg.inv(factor).T
    extra = np.sqrt(np.maximum(bounds.reach**2 + 2 * np.minimum(logs, 0.0), 0.0))[:, None] * np.sqrt(np.diagonal(spread))
    low, high = (white - extra).min(axis=0), (white + extra).max(axis=0)
    spacing = np.full(n, max(float(np.min(narrowness)), 1e-3) / bounds.spacings)
    spacing = spacing * _coarser((high - low) / spacing + 3, bounds)
    sizes = tuple(rounded_size((high[d] - low[d]) / spacing[d] + 3, LEAST[n], bounds.most) for d in range(n))
    width = high - low + 3 * spacing
    steps = np.maximum(width / np.array(sizes), np.sqrt(width / np.array(sizes) * spacing))
    centre = grid.centre + grid.basis @ (mean + factor @ (0.5 * (low + high)))
    return Grid(centre, grid.basis @ factor * steps, sizes, grid.closed)
