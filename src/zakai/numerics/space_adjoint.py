"""One substep of the backward Kolmogorov equation on grids: the adjoint of the splitting of `space_transport`.

    -b_t = f . grad b + G : Hess b / 2 + V b

    exp(v/6) D exp(v/3 - tau g/144) T exp(v/3 - tau g/144) D' exp(v/6),     v = integral of V,  g = grad v . G grad v

T evaluates a function where the characteristics of f end that begin in the points of the target grid.  D' and D spread by the
two halves of the noise.  A function need not decrease to the ends of its grid: it is c = exp(tilt.(x - middle)) c', and beyond
the ends log c' is continued by a straight line, or by a curve that rises a little.  Spreading by N(0, C) moves c' by C tilt.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.space_diffusion import diffused
from zakai.numerics.space_grid import Grid, filtered, rounded_size
from zakai.numerics.space_spline import gather, relative_index
from zakai.numerics.space_step import Potential
from zakai.numerics.space_transport import Dynamics, Factor, Linearisation, moved_points

Array = NDArray[Any]
TINY = 1e-300
LEAST = 1e-30  # of the maximum, below which values count as equal
HIGHEST = 12.0  # nats by which a function may be above its value where it counts most
REACH = 5.0  # deviations of the noise that a continued function covers at each end
MARGIN = 8  # points of a continued function, without noise
LARGEST, SPREAD_AT_ONCE = 2.0, 2**16  # ratio of its points along an axis to those of a function, and points for any ratio
COARSENED = 1.3  # conditional deviations, in spacings, that every second point resolves
ROUNDING = 1e-14  # of the maximum, of interpolated values
FARTHEST = 3.0  # deviations between neighbours up to which a grid resolves a function
STEEPEST, RISE = 2.0, 2.0  # nats a spacing, and spacings, of a logarithm that rises beyond a grid
FALL = 0.5  # nats a spacing by which a function decreases beyond the points to which it is continued
MOST = 2048  # points along an axis
SMALL = 0.3  # share of a grid that noise reaches within which a function is continued by its slopes
RESOLVED = 1.9  # spacings in a deviation of what is interpolated
TOGETHER = 2**15  # points that are moved together


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

    The values are one where the weights are largest, and much larger nowhere.
    """
    logs, share = np.where(np.isnan(logs), -np.inf, logs), weights.reshape(-1) / weights.sum()
    middle, tilt, n = grid.centre + share @ grid.offsets, np.zeros(grid.n), ~grid.circles
    if tilted and n.any():
        flat = logs.reshape(-1)
        used = (share > 0) & np.isfinite(flat)
        z, share, flat = (grid.points[used] - middle)[:, n], share[used], flat[used]
        tilt[n] = np.linalg.lstsq((z * share[:, None]).T @ z, share * (flat - share @ flat) @ z, rcond=1e-8)[0]
    values = logs - ((grid.points - middle) @ tilt).reshape(grid.sizes)
    top = float(values.flat[np.argmax(weights)])
    if not np.isfinite(top):
        top = float(values.max()) if np.isfinite(values.max()) else 0.0
    return Function(np.exp(np.minimum(values - top, HIGHEST)), grid, top, tilt, middle)


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


def _blurred(
    values: Array, grid: Grid, cov: Array, tilt: Array, spline: bool, noise: tuple[Array, float] | None, whole: bool = False
) -> tuple[Array, Grid]:
    """Return c' spread by N(0, cov), or by noise at the points of its grid; with `spline`, its coefficients.

    The result is on the grid, continued, or, unless it is wanted as a `whole`, on a coarser one where the noise is much wider.
    """
    inverse, values = grid.inverse, _least(values)
    if noise is not None:
        at, time = noise
        largest = at[np.argmax(np.trace(inverse @ at @ inverse.T, axis1=1, axis2=2))]
        sizes = _margins(grid, (0.0 if whole and spline else time) * inverse @ largest @ inverse.T)
        first = [new // 2 - old // 2 for old, new in zip(grid.sizes, sizes, strict=True)]
        ends = [(a, new - old - a) for a, old, new in zip(first, grid.sizes, sizes, strict=True)]
        wide = np.pad(at.reshape(*grid.sizes, grid.n, grid.n), [*ends, (0, 0), (0, 0)], mode="edge")
        grid, cov = grid._replace(sizes=sizes), np.zeros_like(cov)
        values = diffused(continued(values, sizes), grid, wide.reshape(-1, grid.n, grid.n), time, adjoint=True)
        return (filtered(values, cov, spline=True) if spline else values), grid
    shift, cov = cov @ tilt, inverse @ cov @ inverse.T
    if not spline and not np.any(cov):
        return values, grid
    if not whole:
        values, grid, cov = _narrow_spread(values, grid, cov)
    shift = grid.inverse @ shift
    sizes = _margins(grid, 0.0 * cov if whole and spline else cov, shift)
    return filtered(continued(values, sizes), cov, spline, shift), grid._replace(sizes=sizes)


def _cropped(values: Array, sizes: tuple[int, ...]) -> Array:
    first = [new // 2 - old // 2 for old, new in zip(sizes, values.shape, strict=True)]
    return values[tuple(slice(a, a + size) for a, size in zip(first, sizes, strict=True))]


def _weighed(values: Array, logs: Array) -> tuple[Array, float]:
    """Return positive values times exp(logs), of maximum one, and the logarithm of what was taken out."""
    logs = np.log(_least(values)) + np.where(np.isnan(logs), -np.inf, logs)
    top = float(logs.max())
    return (np.exp(logs - top), top) if np.isfinite(top) else (np.zeros_like(values), 0.0)


def _evaluated(coefficients: Array, grid: Grid, core: tuple[int, ...], z: Array, function: Function) -> Array:
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


def _resolves(target: Grid, grid: Grid, linear: Linearisation) -> bool:
    """Return whether neighbours on a target lead to points of a function's grid that are a few deviations apart at most."""
    steps, noise = grid.inverse @ linear.map @ target.basis, grid.inverse @ linear.noise @ grid.inverse.T
    apart = (steps * np.linalg.solve(noise + RESOLVED**2 * np.eye(grid.n), steps)).sum(axis=0)
    return bool(np.all((apart <= FARTHEST**2) | target.circles))


def wide_grid(target: Grid, cov: Array) -> Grid:
    """Return a grid around a target, for functions that are spread by N(0, cov) and then wanted there.

    It is the target itself where the noise reaches a small share of its width.
    """
    noise = target.inverse @ cov @ target.inverse.T
    reach = 2 * REACH * np.sqrt(np.maximum(np.diagonal(noise), 0.0)) * ~target.circles
    if np.all(reach <= SMALL * target.shape):
        return target
    effective = np.diagonal(np.linalg.inv(noise + RESOLVED**2 * np.eye(target.n)))
    coarser = np.where(target.circles, 1.0, 1.0 / (RESOLVED * np.sqrt(effective)))
    sizes = tuple(
        rounded_size((size + more) / ratio, 1, MOST) for size, more, ratio in zip(target.sizes, reach, coarser, strict=True)
    )
    return Grid(target.centre, target.basis * coarser, sizes, target.closed)


class Adjoint:
    """log E[c(X(t1)) exp(int V dt) | X(t0) = x] over one substep, at the points of any grid.

    Args:
        function: c.
        linear: the noise of the substep.
        times: t0 and t1.
        steps: Runge-Kutta steps of the characteristics.
        dynamics: the drift, and the noise where it depends on the state.
        potential: V.
        periodic: which coordinates are angles.
    """

    def __init__(
        self,
        function: Function,
        linear: Linearisation,
        times: tuple[float, float],
        steps: int,
        dynamics: Dynamics,
        potential: Potential | None,
        periodic: tuple[bool, ...],
    ):
        self.function, self.linear, self.times, self.steps = function, linear, times, steps
        self.dynamics, self.potential, self.periodic = dynamics, potential, periodic
        values, core, tilt, cov = function.values, function.grid, function.tilt, 0.5 * linear.noise
        self.top = function.log_scale + float(0.5 * tilt @ cov @ tilt)
        after = self._factor(core, True)
        if after is not None:
            values, gained = _weighed(values, after.log / 6)
            self.top += gained
            values, grid = _blurred(values, core, cov, tilt, False, self._noise(core))
            if np.array_equal(grid.basis, core.basis):
                values = _cropped(values, core.sizes)
            else:
                after, core = self._factor(grid, True), grid
            assert after is not None
            values, gained = _weighed(values, after.log / 3 + after.correction)
            self.top += gained
            self.coefficients, self.grid = _blurred(values, core, 0.0 * cov, tilt, True, None)
        else:
            self.coefficients, self.grid = _blurred(values, core, cov, tilt, True, self._noise(core))
        self.core = core.sizes if np.array_equal(core.basis, self.grid.basis) else self.grid.sizes

    def _factor(self, grid: Grid, end: bool) -> Factor | None:
        return None if self.potential is None else self.potential(grid, *self.times, end)

    def _noise(self, grid: Grid) -> tuple[Array, float] | None:
        diffusion, (t0, t1) = self.dynamics.diffusion, self.times
        return None if diffusion is None else (diffusion(grid.points, 0.5 * (t0 + t1)), 0.5 * (t1 - t0))

    def rough(self, grid: Grid) -> Array:
        """Return the logarithms (*sizes) without the first half of the noise and of the potential."""
        points = np.array_split(grid.points, -(-math.prod(grid.sizes) // TOGETHER))
        with np.errstate(all="ignore"):
            moved = np.concatenate([moved_points(self.dynamics, part, *self.times, self.steps) for part in points])
        z = relative_index(grid, self.grid, self.periodic, np.asfortranarray(moved[:, : grid.n]))
        return self.top + _evaluated(self.coefficients, self.grid, self.core, z, self.function).reshape(grid.sizes)

    def logs(self, target: Grid) -> Array:
        """Return the logarithms at the points of a grid (*sizes)."""
        cov = self.linear.before
        wide = wide_grid(target, cov)
        logs = self.rough(wide)
        same = np.array_equal(wide.basis, target.basis)
        if same and not _resolves(target, self.function.grid, self.linear):  # they show where a finer grid must be
            return logs
        tilt = np.where(target.circles, 0.0, self.linear.map.T @ self.function.tilt)
        before = self._factor(wide, False)
        if before is not None:
            logs = logs + before.log / 3 + before.correction
        values, top = _weighed(np.ones(wide.sizes), logs - (wide.offsets @ tilt).reshape(wide.sizes))
        values, wide = _blurred(values, wide, cov, tilt, not same, self._noise(wide), whole=True)
        if same:
            values = _cropped(values, target.sizes)
        else:
            values = gather(values, relative_index(target, wide, self.periodic), wide).reshape(target.sizes)
        before = self._factor(target, False)
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.where(values > 0, np.log(values), -np.inf) + top + float(0.5 * tilt @ cov @ tilt)
        return logs + (target.offsets @ tilt).reshape(target.sizes) + (0.0 if before is None else before.log / 6)


def interpolated(function: Function, target: Grid, periodic: tuple[bool, ...]) -> Array:
    """Return log c at the points of another grid (*sizes)."""
    grid = function.grid
    coefficients, wide = _blurred(function.values, grid, np.zeros((grid.n, grid.n)), function.tilt, True, None)
    z = relative_index(target, wide, periodic)
    return (_evaluated(coefficients, wide, grid.sizes, z, function) + function.log_scale).reshape(target.sizes)
