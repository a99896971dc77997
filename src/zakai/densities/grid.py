"""A density that is known by its logarithm on a grid."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from zakai.densities._density import WeightedPoints
from zakai.densities._values import as_states, coordinate_numbers, generator, probabilities, sample_size, wrap

_FINER = 8  # points of a distribution function for each of a grid
_BLOCK = 4_000_000  # numbers held at once while a density is interpolated


@dataclass(frozen=True, repr=False)
class GridDensity(WeightedPoints):
    """A density by its `log_values` on the grid x = `centre` + `basis` (i - size // 2), i the index (n,).

    A smooth density that the grid resolves is band-limited, so its sums over the grid are integrals and its values
    between the points are those of the sinc interpolant, both to nearly machine precision.  A grid that covers the whole
    circle in a coordinate of `periodic` closes on itself.  Outside of the grid the density is zero.
    """

    log_values: np.ndarray
    centre: np.ndarray
    basis: np.ndarray
    names: tuple[str, ...]
    periodic: tuple[bool, ...]

    @cached_property
    def points(self) -> np.ndarray:
        """The grid (size_1, ..., size_n, n); angles are not wrapped."""
        axes = [np.arange(size) - size // 2 for size in self.log_values.shape]
        return self.centre + np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) @ self.basis.T

    @cached_property
    def weights(self) -> np.ndarray:
        """The probability of each grid point."""
        values = np.exp(self.log_values - np.max(self.log_values))
        return values / values.sum()

    @cached_property
    def _log_scale(self) -> float:
        """What normalises `log_values`."""
        top = np.max(self.log_values)
        volume = abs(np.linalg.det(self.basis))
        return float(top + np.log(np.sum(np.exp(self.log_values - top)) * volume))

    @cached_property
    def _closed(self) -> tuple[bool, ...]:
        """Which axes of the grid go once around the circle."""
        if not any(self.periodic):
            return (False,) * len(self.periodic)
        turn = self.basis @ np.diag(self.log_values.shape)
        return tuple(
            angle and np.allclose(turn[:, i], 2 * np.pi * np.eye(len(self.names))[i], atol=1e-9)
            for i, angle in enumerate(self.periodic)
        )

    def log_density(self, x: np.ndarray) -> np.ndarray:
        n = len(self.names)
        x = as_states(x, n)
        offset = x - self.centre
        index = (np.where(self.periodic, wrap(offset), offset) @ np.linalg.inv(self.basis).T).reshape(-1, n)
        interpolate = self._interpolate if n < 3 else self._interpolate_three
        block = max(1, _BLOCK // (self.log_values.size if n < 3 else self.log_values[0].size))
        parts = [interpolate(index[i : i + block]) for i in range(0, len(index), block)]
        return (np.concatenate(parts) if parts else np.empty(0)).reshape(x.shape[:-1]) - self._log_scale

    def _interpolate(self, index: np.ndarray) -> np.ndarray:
        """The sinc interpolant of exp(log value); in the far tails of one whose local exponential slope is taken out first."""
        shape = np.array(self.log_values.shape)
        nearest = np.rint(index).astype(int) + shape // 2
        inside = np.all((nearest >= 0) & (nearest < shape) | np.array(self._closed), axis=1)
        nearest = np.where(self._closed, np.mod(nearest, shape), np.clip(nearest, 0, shape - 1))
        top = np.max(self.log_values)
        floor = top - 700.0
        logs = np.maximum(self.log_values, floor)
        level = logs[tuple(nearest.T)]
        kernels = [interpolation(column, size, closed) for column, size, closed in zip(index.T, shape, self._closed, strict=True)]
        # Rounding of the largest term matters only where the density is below 1e-11 of it; there the slope is taken out.
        deep = inside & (level > floor) & (top - level > 25.0)
        total = kernels[0] @ np.exp(logs - top)
        if len(kernels) == 2:
            total = np.einsum("pj,pj->p", total, kernels[1])
        with np.errstate(divide="ignore", invalid="ignore"):
            result = top + np.log(np.where(total > 0, total, np.nan))
        if deep.any():
            tail = [kernel[deep] for kernel in kernels]
            result[deep] = self._in_tails(logs, nearest[deep], index[deep], level[deep], tail)
        return np.where(inside & (level > floor), np.where(np.isfinite(result), result, level), -np.inf)

    def _in_tails(
        self, logs: np.ndarray, nearest: np.ndarray, index: np.ndarray, level: np.ndarray, kernels: list[np.ndarray]
    ) -> np.ndarray:
        """The interpolant relative to the nearest value, after the slope there was taken out if that lowers the largest term."""
        shape, at = logs.shape, tuple(nearest.T)
        plain = np.broadcast_to(logs, (len(index), *shape)) - level.reshape(-1, *([1] * len(shape)))
        tilted, views = plain, []
        for axis, size in enumerate(shape):
            views.append([-1] + [size if a == axis else 1 for a in range(len(shape))])
            if size > 1 and not self._closed[axis]:
                slope = np.gradient(logs, axis=axis)[at]
                distance = np.arange(size) - size // 2 - index[:, axis][:, None]
                tilted = tilted - (slope[:, None] * distance).reshape(views[axis])
        axes = tuple(range(1, plain.ndim))
        better = (tilted.max(axis=axes) < plain.max(axis=axes)).reshape(-1, *([1] * len(shape)))
        values = np.exp(np.minimum(np.where(better, tilted, plain), 600.0))
        for kernel, view in zip(kernels, views, strict=True):
            values = values * kernel.reshape(view)
        total = values.reshape(len(index), -1).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            result = level + np.log(np.where(total > 0, total, np.nan))
        return self._bounded(logs, nearest, index, level, np.where(np.isfinite(result), result, level))

    def _bounded(
        self, logs: np.ndarray, nearest: np.ndarray, index: np.ndarray, level: np.ndarray, result: np.ndarray
    ) -> np.ndarray:
        """The result in the far tails where it is near the parabola through the neighbours, else the parabola.

        The sum is wrong there where the density ends at the edge of the grid.
        """
        shape = np.array(logs.shape)
        local, change, top = level.copy(), np.full(len(level), 0.02), np.zeros(len(level))
        for axis, size in enumerate(shape):
            distance = index[:, axis] + size // 2 - nearest[:, axis]
            if self._closed[axis]:
                distance = distance - size * np.round(distance / size)
            sides = []
            for step in (-1, 1):
                beside = nearest.copy()
                beside[:, axis] += step
                beside[:, axis] = np.mod(beside[:, axis], size) if self._closed[axis] else np.clip(beside[:, axis], 0, size - 1)
                sides.append(logs[tuple(beside.T)] - level)
            top = np.maximum(top, np.maximum(sides[0], sides[1]))
            slope, curvature = 0.5 * (sides[1] - sides[0]), sides[0] + sides[1]
            local += distance * slope + 0.5 * distance**2 * curvature
            change += 0.1 * (np.abs(slope) + np.abs(curvature))
        # A neighbour where the density is zero says nothing of the slope.
        return np.minimum(np.where(np.abs(result - local) <= change, result, local), level + top + 1.0)

    def _interpolate_three(self, index: np.ndarray) -> np.ndarray:
        """The sinc interpolant for three axes, one after the other; below 1e-10 of the maximum, linear in the logarithm."""
        shape = np.array(self.log_values.shape)
        inside = np.all((index > -0.5 - shape // 2) & (index < shape - shape // 2 - 0.5) | np.array(self._closed), axis=1)
        index = np.where(inside[:, None], index, 0.0)
        kernels = [interpolation(column, size, closed) for column, size, closed in zip(index.T, shape, self._closed, strict=True)]
        top = np.max(self.log_values)
        values = np.exp(self.log_values - top).reshape(shape[0], -1)
        plane = (kernels[0] @ values).reshape(-1, *shape[1:])
        total = np.einsum("pij,pj,pi->p", plane, kernels[2], kernels[1], optimize=True)
        # Rounding of the largest term matters only far below it.
        high = total > 1e-10
        logs = np.empty(len(index))
        logs[high] = np.log(total[high]) + top
        floor = top - 700.0
        if not high.all():
            from scipy.ndimage import map_coordinates

            modes = ["grid-wrap" if closed else "nearest" for closed in self._closed]
            at = (index[~high] + shape // 2).T
            logs[~high] = map_coordinates(np.maximum(self.log_values, floor), at, order=1, mode=modes)
        return np.where(inside & (logs > floor), logs, -np.inf)

    def mode(self) -> np.ndarray:
        at = np.array(np.unravel_index(np.argmax(self.log_values), self.log_values.shape))
        step = np.zeros(len(at))
        for axis, size in enumerate(self.log_values.shape):  # the vertex of the parabola through three points
            if 0 < at[axis] < size - 1:
                left, right = at.copy(), at.copy()
                left[axis] -= 1
                right[axis] += 1
                a, b, c = (self.log_values[tuple(i)] for i in (left, at, right))
                if np.isfinite(a + c) and a - 2 * b + c < 0:
                    step[axis] = 0.5 * (a - c) / (a - 2 * b + c)
        x = self.centre + self.basis @ (at - np.array(self.log_values.shape) // 2 + step)
        return np.where(self.periodic, wrap(x), x)

    def quantile(self, q: Sequence[float]) -> np.ndarray:
        """Quantiles of each marginal; those of an angle are counted from the point opposite to its mean."""
        wanted = probabilities(q)
        columns = []
        for i, angle in enumerate(self.periodic):
            line = self.marginal(i) if len(self.names) > 1 else self
            grid = line.points[:, 0]
            mass = line.weights
            if angle:
                mean = line.mean()[0]
                grid = mean + wrap(grid - mean)
                order = np.argsort(grid)
                grid, mass = grid[order], mass[order]
            half = 0.5 * np.median(np.diff(grid))
            cumulative = np.concatenate([[0.0], np.cumsum(mass)])
            edges = np.concatenate([grid - half, [grid[-1] + half]])
            keep = np.concatenate([[True], np.diff(cumulative) > 1e-18])
            columns.append(np.interp(wanted, cumulative[keep], edges[keep]))
        return np.stack(columns, axis=1)

    def marginal(self, coordinates) -> GridDensity:
        keep = coordinate_numbers(self.names, coordinates)
        count = len(self.names)
        if keep == list(range(count)):
            return self
        names, periodic = tuple(self.names[i] for i in keep), tuple(self.periodic[i] for i in keep)
        if len(keep) == count:
            # The same coordinates in another order, on the same grid; angles have the first axes.
            axes = keep if any(self.periodic) else list(range(count))
            basis = self.basis[np.ix_(keep, axes)]
            return GridDensity(np.transpose(self.log_values, axes), self.centre[keep], basis, names, periodic)
        values, centre, basis = self._projected(keep)
        with np.errstate(divide="ignore"):
            logs = np.log(np.maximum(values, 0.0) / abs(np.linalg.det(basis)))
        if len(keep) == 1 and basis[0, 0] < 0:
            # An axis of even length has its centre right of the middle.
            centre = centre + basis[:, 0] * (len(logs) - 1 - 2 * (len(logs) // 2))
            logs, basis = logs[::-1], -basis
        return GridDensity(logs, centre, basis, names, periodic)

    def _projected(self, keep: list[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The weights, centre and basis of the marginal of some coordinates: the slanted grid is summed along its other axes.

        Grid points with equal coordinates lie on slanted planes.  A sum over one of them of a band-limited function equals
        the sum after each row was shifted by a fraction of a cell, which a Fourier transform does exactly.
        """
        count = self.log_values.ndim
        spreads = self._spread_along
        choices = list(itertools.combinations(range(count), len(keep)))
        volume = [abs(np.linalg.det((self.basis[keep] * spreads)[:, list(axes)])) for axes in choices]
        along = list(choices[int(np.argmax(volume))])
        across = [a for a in range(count) if a not in along]
        basis = self.basis[np.ix_(keep, along)]
        slant = np.linalg.solve(basis, self.basis[np.ix_(keep, across)])
        slant = np.where(np.abs(slant) < 1e-12, 0.0, slant)
        values = np.moveaxis(self.weights, along, range(len(along)))
        rows = np.stack(
            np.meshgrid(*[np.arange(s) - s // 2 for s in values.shape[len(along) :]], indexing="ij"), axis=-1
        ).reshape(-1, len(across))
        shift = rows @ slant.T
        # A circle shifts into itself; elsewhere there must be a margin.
        margin = np.where([self._closed[a] for a in along], 0, np.ceil(np.abs(shift).max(axis=0)) + 2).astype(int)
        margin = np.where(np.any(slant != 0, axis=1), margin, 0)
        values = values.reshape(*values.shape[: len(along)], -1)
        values = np.pad(values, [*((r, r) for r in margin), (0, 0)])
        spectrum = np.fft.fftn(values, axes=range(len(along)))
        for d, size in enumerate(values.shape[:-1]):
            phase = np.exp(-2j * np.pi * np.fft.fftfreq(size)[:, None] * shift[:, d])
            spectrum = spectrum * phase.reshape(*[size if a == d else 1 for a in range(len(along))], -1)
        values = np.real(np.fft.ifftn(spectrum.sum(axis=-1)))
        sizes = np.array(self.log_values.shape)[along]
        centre = self.centre[keep] + basis @ (np.array(values.shape) // 2 - (sizes // 2 + margin))
        return values, centre, basis

    @cached_property
    def _spread_along(self) -> np.ndarray:
        """The standard deviation of the index along each axis of the grid."""
        out = []
        for axis, size in enumerate(self.log_values.shape):
            mass = self.weights.sum(axis=tuple(a for a in range(self.weights.ndim) if a != axis))
            index = np.arange(size)
            out.append(np.sqrt(max(mass @ index**2 - (mass @ index) ** 2, 1.0)))
        return np.array(out)

    def sample(self, key: object, count: int) -> np.ndarray:
        rng, count = generator(key), sample_size(count)
        if len(self.names) == 1:
            return self._sample_of_line(rng, count)
        which = rng.choice(self.weights.size, size=count, p=self.weights.ravel())
        x = self.points.reshape(-1, len(self.names))[which]
        x = x + (rng.random((count, len(self.names))) - 0.5) @ self.basis.T
        return np.where(self.periodic, wrap(x), x)

    def _sample_of_line(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draws by the distribution function on points that are closer than those of the grid, linear between them."""
        spacing = self.basis[0, 0] / _FINER
        fine = self.points[0, 0] + spacing * (np.arange(len(self.points) * _FINER) - _FINER // 2)
        steps = np.maximum(np.exp(self.log_density(fine[:, None])), 0.0)
        distribution = np.concatenate([[0.0], np.cumsum(steps)])
        edges = fine[0] + spacing * (np.arange(len(distribution)) - 0.5)
        x = np.interp(rng.random(count) * distribution[-1], distribution, edges)[:, None]
        return np.where(self.periodic, wrap(x), x)


def interpolation(index: np.ndarray, size: int, closed: bool) -> np.ndarray:
    """Return the interpolation kernel at places (P,) of the points -(size // 2), ..., as (P, size).

    It is that of trigonometric polynomials on a circle, and sin(pi d) / (pi d) on a line.
    """
    nearest = np.rint(index)
    rest = (index - nearest)[:, None]
    # The sine of pi times a distance, of whole cells and a rest, is that of the rest but for its sign.
    if closed:
        cells = np.mod(np.arange(size) + size // 2, size) - size // 2
        to_point = np.arange(size) - np.mod(nearest.astype(int) + size // 2, size)[:, None]  # negative ones count from the end
        angle = np.pi / size * (cells[to_point] - rest)
        signs, length = np.where(cells % 2, 1.0, -1.0)[to_point], size * (np.sin(angle) if size % 2 else np.tan(angle))
    else:
        signs = np.where((np.arange(size) - size // 2) % 2, 1.0, -1.0) * np.where(nearest % 2, -1.0, 1.0)[:, None]
        length = np.pi * (np.arange(size) - size // 2 - index[:, None])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(length == 0.0, 1.0, signs * np.sin(np.pi * rest) / length)
