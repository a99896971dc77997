"""One substep of the backward Kolmogorov equation on grids: the adjoint of the splitting of `space/splitting.py`.

    -b_t = f . grad b + G : Hess b / 2 + V b

    exp(v/6) D exp(v/3 - tau g/144) T exp(v/3 - tau g/144) D' exp(v/6),     v = integral of V,  g = grad v . G grad v

T evaluates a function where the characteristics of f end that begin in the points of the target grid.  D' and D spread by the
two halves of the noise.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.space.function import MOST, REACH, Function, blurred, cropped, evaluated, weighed
from zakai.numerics.space.grid import Grid, rounded_size
from zakai.numerics.space.spline import gather, relative_index
from zakai.numerics.space.splitting import Factor, Potential, noise_of
from zakai.numerics.space.transport import Dynamics, Linearisation, moved_points

Array = NDArray[Any]
FARTHEST = 3.0  # deviations between neighbours up to which a grid resolves a function
SMALL = 0.3  # share of a grid that noise reaches within which a function is continued by its slopes
RESOLVED = 1.9  # spacings in a deviation of what is interpolated
TOGETHER = 2**15  # points that are moved together


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
            values, gained = weighed(values, after.log / 6)
            self.top += gained
            values, grid = blurred(values, core, cov, tilt, False, self._noise(core, True))
            if np.array_equal(grid.basis, core.basis):
                values = cropped(values, core.sizes)
            else:
                after, core = self._factor(grid, True), grid
            assert after is not None
            values, gained = weighed(values, after.log / 3 + after.correction)
            self.top += gained
            self.coefficients, self.grid = blurred(values, core, 0.0 * cov, tilt, True, None)
        else:
            self.coefficients, self.grid = blurred(values, core, cov, tilt, True, self._noise(core, True))
        self.core = core.sizes if np.array_equal(core.basis, self.grid.basis) else self.grid.sizes

    def _factor(self, grid: Grid, end: bool) -> Factor | None:
        return None if self.potential is None else self.potential(grid, *self.times, end)

    def _noise(self, grid: Grid, end: bool) -> Array | None:
        noise = noise_of(self.dynamics, self.linear, self.times, end)
        return None if noise is None else noise(grid.points)

    def rough(self, grid: Grid) -> Array:
        """Return the logarithms (*sizes) without the first half of the noise and of the potential."""
        points = np.array_split(grid.points, -(-math.prod(grid.sizes) // TOGETHER))
        with np.errstate(all="ignore"):
            moved = np.concatenate([moved_points(self.dynamics, part, *self.times, self.steps) for part in points])
        z = relative_index(grid, self.grid, self.periodic, np.asfortranarray(moved[:, : grid.n]))
        return self.top + evaluated(self.coefficients, self.grid, self.core, z, self.function).reshape(grid.sizes)

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
        values, top = weighed(np.ones(wide.sizes), logs - (wide.offsets @ tilt).reshape(wide.sizes))
        values, wide = blurred(values, wide, cov, tilt, not same, self._noise(wide, False), whole=True)
        if same:
            values = cropped(values, target.sizes)
        else:
            values = gather(values, relative_index(target, wide, self.periodic), wide).reshape(target.sizes)
        before = self._factor(target, False)
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.where(values > 0, np.log(values), -np.inf) + top + float(0.5 * tilt @ cov @ tilt)
        return logs + (target.offsets @ tilt).reshape(target.sizes) + (0.0 if before is None else before.log / 6)
