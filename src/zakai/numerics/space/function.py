"""Positive functions on grids that need not decrease to the ends of their grids.

They are c = exp(tilt.(x - middle)) c'.  Beyond the ends log c' is continued by a straight line, or by a curve that rises a
little.  Spreading by N(0, C) moves c' by C tilt.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.space.diffusion import diffused
from zakai.numerics.space.grid import Grid, filtered, rounded_size
from zakai.numerics.space.spline import gather, relative_index

Array = NDArray[Any]
TINY = 1e-300
LEAST = 1e-30  # of the maximum, below which values count as equal
HIGHEST = 12.0  # nats by which a function may be above its value where it counts most
COUNTS, TILTED = 1e-6, 5.0  # weights that count, of the largest, and nats by which a tilt may change between them
REACH = 5.0  # deviations of the noise that a continued function covers at each end
MARGIN = 8  # points of a continued function, without noise
LARGEST, SPREAD_AT_ONCE = 2.0, 2**16  # ratio of its points along an axis to those of a function, and points for any ratio
COARSENED = 1.3  # conditional deviations, in spacings, that every second point resolves
ROUNDING = 1e-14  # of the maximum, of interpolated values
STEEPEST, RISE = 2.0, 2.0  # nats a spacing, and spacings, of a logarithm that rises beyond a grid
FALL = 0.5  # nats a spacing by which a function decreases beyond the points to which it is continued
MOST = 2048  # points along an axis


class Function(NamedTuple):
    """c = exp(`log_scale` + `tilt` . (x - `middle`)) times positive `values` (*sizes) on a grid."""

    values: Array
    grid: Grid
    log_scale: float
    tilt: Array
    middle: Array

    def logs(self) -> Array:
        """Return log c at the points of the grid (*sizes)."""
        sloping = (self.grid.points - self.middle) @ self.tilt
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(self.values) + self.log_scale + sloping.reshape(self.grid.sizes))


def function_of(logs: Array, grid: Grid, weights: Array, tilted: bool) -> Function:
    """Return the function with these logarithms (*sizes), with the tilt that fits them best under weights (*sizes).

    The values are one where the weights are largest, and much larger nowhere, least of all where the weights are negligible:
    waves of the interpolation there would be as large as the values that count.
    """
    logs, share = np.where(np.isnan(logs), -np.inf, logs), weights.reshape(-1) / weights.sum()
    middle, tilt, n = grid.centre + share @ grid.offsets, np.zeros(grid.n), ~grid.circles
    if tilted and n.any():
        flat = logs.reshape(-1)
        used = (share > 0) & np.isfinite(flat)
        z, share, flat = (grid.points[used] - middle)[:, n], share[used], flat[used]
        tilt[n] = np.linalg.lstsq((z * share[:, None]).T @ z, share * (flat - share @ flat) @ z, rcond=1e-8)[0]
        tilt /= max(float(np.ptp(z[share > COUNTS * share.max()] @ tilt[n])) / TILTED, 1.0)
    values = logs - ((grid.points - middle) @ tilt).reshape(grid.sizes)
    top = float(values.flat[np.argmax(weights)])
    if not np.isfinite(top):
        top = float(values.max()) if np.isfinite(values.max()) else 0.0
    with np.errstate(divide="ignore"):
        highest = HIGHEST + np.log(np.minimum(weights / (COUNTS * weights.max()), 1.0))
    return Function(np.exp(np.minimum(values - top, highest)), grid, top, tilt, middle)


def continued(values: Array, sizes: tuple[int, ...]) -> Array:
    """Return positive values (*sizes) in the middle of an array of larger sizes that is smooth around its ends."""
    for d, new in enumerate(sizes):
        old = values.shape[d]
        gap, first = new - old, new // 2 - old // 2
        if not gap:
            continue
        shape = [-1 if axis == d else 1 for axis in range(len(sizes))]
        ends = np.log(np.maximum(values.take([0, 1, old - 2, old - 1], d), TINY))
        left, inner_left, inner_right, right = (ends.take([i], d) for i in range(4))
        steps = np.arange(1, gap + 1).reshape(shape)
        share = steps / (gap + 1)
        share = share * share * (3 - 2 * share)
        left = left + _risen(left - inner_left, gap + 1 - steps)
        right = right + _risen(right - inner_right, steps)
        between = np.exp((1 - share) * right + share * left)
        before, after = between.take(range(gap - first, gap), d), between.take(range(gap - first), d)
        values = np.concatenate([before, values, after], axis=d)
    return values


def _risen(slope: Array, steps: Array) -> Array:
    """Return the change of a logarithm that continues with a slope, whose rise ends after a few steps."""
    return np.asarray(np.minimum(slope, 0.0) * steps + np.clip(slope, 0.0, STEEPEST) * RISE * (1 - np.exp(-steps / RISE)))


def _margins(grid: Grid, cov: Array, shift: Array | float = 0.0) -> tuple[int, ...]:
    """Return the sizes that a function needs to be spread by N(0, cov), cov in index units, and interpolated."""
    reach = MARGIN + 2 * REACH * np.sqrt(np.maximum(np.diagonal(cov), 0.0)) + 2 * np.abs(shift)
    return tuple(
        size if closed else rounded_size(size + more, size, MOST)
        for size, closed, more in zip(grid.sizes, grid.closed, reach.tolist(), strict=True)
    )


def _least(values: Array) -> Array:
    return np.maximum(values, max(LEAST * float(values.max()), TINY))


def _coarser(values: Array, grid: Grid, axes: Array) -> tuple[Array, Grid]:
    """Return every second value along some axes."""
    basis, sizes = grid.basis.copy(), list(grid.sizes)
    for d in np.flatnonzero(axes):
        start = sizes[d] // 2 % 2
        values = np.take(values, np.arange(start, sizes[d], 2), d)
        basis[:, d], sizes[d] = 2 * basis[:, d], values.shape[d]
    return values, Grid(grid.centre, basis, tuple(sizes), grid.closed)


def _narrow_spread(values: Array, grid: Grid, cov: Array) -> tuple[Array, Grid, Array]:
    """Return a function that is much narrower than a noise spread by a part of it, on a coarser grid, and the rest."""
    for _ in range(40):
        sizes = _margins(grid, cov)
        wide = any(new - MARGIN > LARGEST * old for new, old in zip(sizes, grid.sizes, strict=True))
        if not wide or math.prod(sizes) <= SPREAD_AT_ONCE:
            break
        with np.errstate(divide="ignore"):
            share = float(((0.5 * (LARGEST - 1) / REACH * grid.shape) ** 2 / np.diagonal(cov))[~grid.circles].min())
        part = min(share, 1.0) * cov
        effective = part + COARSENED**2 * np.eye(grid.n)
        axes = ~grid.circles & (1.0 / np.diagonal(np.linalg.inv(effective)) > (2 * COARSENED) ** 2)
        if not axes.any():
            break
        sizes = _margins(grid, part)
        values = _least(filtered(continued(values, sizes), part))
        values, grid = _coarser(values, grid._replace(sizes=sizes), axes)
        scale = np.where(axes, 0.5, 1.0)
        cov = (1 - min(share, 1.0)) * cov * np.outer(scale, scale)
    return values, grid, cov


def blurred(
    values: Array, grid: Grid, cov: Array, tilt: Array, spline: bool, noise: Array | None, whole: bool = False
) -> tuple[Array, Grid]:
    """Return c' spread by N(0, cov), or by noise (J, n, n) at the points of its grid; with `spline`, its coefficients.

    The result is on the grid, continued, or, unless it is wanted as a `whole`, on a coarser one where the noise is much wider.
    """
    inverse, values = grid.inverse, _least(values)
    if noise is not None:
        largest = noise[np.argmax(np.trace(inverse @ noise @ inverse.T, axis1=1, axis2=2))]
        sizes = _margins(grid, (0.0 if whole and spline else 1.0) * inverse @ largest @ inverse.T)
        first = [new // 2 - old // 2 for old, new in zip(grid.sizes, sizes, strict=True)]
        ends = [(a, new - old - a) for a, old, new in zip(first, grid.sizes, sizes, strict=True)]
        wide = np.pad(noise.reshape(*grid.sizes, grid.n, grid.n), [*ends, (0, 0), (0, 0)], mode="edge")
        grid, cov = grid._replace(sizes=sizes), np.zeros_like(cov)
        values = diffused(continued(values, sizes), grid, wide.reshape(-1, grid.n, grid.n), adjoint=True)
        return (filtered(values, cov, spline=True) if spline else values), grid
    shift, cov = cov @ tilt, inverse @ cov @ inverse.T
    if not spline and not np.any(cov):
        return values, grid
    if not whole:
        values, grid, cov = _narrow_spread(values, grid, cov)
    shift = grid.inverse @ shift
    sizes = _margins(grid, 0.0 * cov if whole and spline else cov, shift)
    return filtered(continued(values, sizes), cov, spline, shift), grid._replace(sizes=sizes)


def cropped(values: Array, sizes: tuple[int, ...]) -> Array:
    """Return the values in the middle of a larger array."""
    first = [new // 2 - old // 2 for old, new in zip(sizes, values.shape, strict=True)]
    return values[tuple(slice(a, a + size) for a, size in zip(first, sizes, strict=True))]


def weighed(values: Array, logs: Array) -> tuple[Array, float]:
    """Return positive values times exp(logs), of maximum one, and the logarithm of what was taken out."""
    logs = np.log(_least(values)) + np.where(np.isnan(logs), -np.inf, logs)
    top = float(logs.max())
    return (np.exp(logs - top), top) if np.isfinite(top) else (np.zeros_like(values), 0.0)


def evaluated(coefficients: Array, grid: Grid, core: tuple[int, ...], z: Array, function: Function) -> Array:
    """Return log c, but for its scale, at indices of a spline of c'.

    Beyond half of the points by which the `core` is continued it decreases.
    """
    beyond = 0.25 * (grid.shape - core)
    low = grid.shape // 2 - np.array(core) // 2 - beyond
    high = low + np.array(core) - 1 + 2 * beyond
    known = np.asarray(np.isfinite(z).all(axis=1))
    z = np.where(known[:, None], z, 0.0)
    inside = np.where(grid.circles, z, np.clip(z, low, high))
    apart = np.abs(z - inside).sum(axis=1)
    tilt = function.tilt @ grid.basis
    middle = grid.shape // 2 + grid.inverse @ (function.middle - grid.centre)
    found = gather(coefficients, inside, grid)
    logs = np.log(np.maximum(found, ROUNDING * float(np.max(coefficients)))) - FALL * np.minimum(apart, 1e3)
    logs += np.minimum((z - middle) * tilt, (inside - middle) * tilt).sum(axis=1)
    return np.where(known, logs, -np.inf)


def interpolated(function: Function, target: Grid, periodic: tuple[bool, ...]) -> Array:
    """Return log c at the points of another grid (*sizes)."""
    grid = function.grid
    coefficients, wide = blurred(function.values, grid, np.zeros((grid.n, grid.n)), function.tilt, True, None)
    z = relative_index(target, wide, periodic)
    return (evaluated(coefficients, wide, grid.sizes, z, function) + function.log_scale).reshape(target.sizes)
