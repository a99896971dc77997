"""A density that is known by its logarithm on a lattice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from zakai.densities._density import coordinate_numbers, generator, probabilities, wrap

_BLOCK = 4_000_000  # numbers held at once while a density is interpolated


@dataclass(frozen=True, repr=False)
class GridDensity:
    """A density by its `log_values` on the lattice x = `centre` + `basis` (i - size // 2), i the index (n,).

    A smooth density that the lattice resolves is band-limited, so its sums over the lattice are integrals and its values
    between the points are those of the sinc interpolant, both to nearly machine precision.  A lattice that covers the whole
    circle in a coordinate of `periodic` closes on itself.  Outside of the lattice the density is zero.
    """

    log_values: np.ndarray
    centre: np.ndarray
    basis: np.ndarray
    names: tuple[str, ...]
    periodic: tuple[bool, ...]

    def __repr__(self) -> str:
        size = " x ".join(map(str, self.log_values.shape))
        return f"GridDensity({', '.join(self.names)}: {size} points, mean {self.mean().tolist()})"

    @cached_property
    def points(self) -> np.ndarray:
        """The lattice (size_1, ..., size_n, n); angles are not wrapped."""
        axes = [np.arange(size) - size // 2 for size in self.log_values.shape]
        return self.centre + np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) @ self.basis.T

    @cached_property
    def weights(self) -> np.ndarray:
        """The probability of each lattice point."""
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
        """Which axes of the lattice go once around the circle."""
        turn = self.basis @ np.diag(self.log_values.shape)
        return tuple(
            angle and np.allclose(turn[:, i], 2 * np.pi * np.eye(len(self.names))[i], atol=1e-9)
            for i, angle in enumerate(self.periodic)
        )

    def log_density(self, x: np.ndarray) -> np.ndarray:
        x = np.asarray(x, float)
        n = len(self.names)
        if n == 1 and x.shape[-1:] != (1,):
            x = x[..., None]
        offset = x - self.centre
        index = (np.where(self.periodic, wrap(offset), offset) @ np.linalg.inv(self.basis).T).reshape(-1, n)
        block = max(1, _BLOCK // self.log_values.size)
        parts = [self._interpolate(index[i : i + block]) for i in range(0, len(index), block)]
        return (np.concatenate(parts) if parts else np.empty(0)).reshape(x.shape[:-1]) - self._log_scale

    def _interpolate(self, index: np.ndarray) -> np.ndarray:
        """The sinc interpolant of exp(log value); in the far tails of one whose local exponential slope is taken out first."""
        shape = np.array(self.log_values.shape)
        nearest = np.rint(index).astype(int) + shape // 2
        inside = np.all((nearest >= 0) & (nearest < shape) | np.array(self._closed), axis=1)
        nearest = np.where(self._closed, np.mod(nearest, shape), np.clip(nearest, 0, shape - 1))
        at = tuple(nearest.T)
        floor = np.max(self.log_values) - 700.0
        logs = np.maximum(self.log_values, floor)
        level = logs[at]
        plain = np.broadcast_to(logs, (len(index), *shape)) - level.reshape(-1, *([1] * len(shape)))
        tilted = plain
        kernels = []
        for axis, size in enumerate(shape):
            distance = np.arange(size) - size // 2 - index[:, axis][:, None]
            view = [-1] + [size if a == axis else 1 for a in range(len(shape))]
            if self._closed[axis]:
                kernels.append(dirichlet(distance, size).reshape(view))
                continue
            kernels.append(np.sinc(distance).reshape(view))
            if size > 1:
                slope = np.gradient(logs, axis=axis)[at]
                tilted = tilted - (slope[:, None] * distance).reshape(view)
        # Rounding of the largest term matters only where the density is below 1e-11 of it; there the slope is taken out.
        axes = tuple(range(1, plain.ndim))
        deep = plain.max(axis=axes) > 25.0
        better = (deep & (tilted.max(axis=axes) < plain.max(axis=axes))).reshape(-1, *([1] * len(shape)))
        values = np.exp(np.minimum(np.where(better, tilted, plain), 600.0))
        for kernel in kernels:
            values = values * kernel
        total = values.reshape(len(index), -1).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            result = level + np.log(np.where(total > 0, total, np.nan))
        result = np.where(np.isfinite(result), result, level)
        return np.where(inside & (level > floor), result, -np.inf)

    def mean(self) -> np.ndarray:
        flat = self.points.reshape(-1, len(self.names))
        weights = self.weights.ravel()
        resultant = weights @ np.exp(1j * np.where(self.periodic, flat, 0.0))
        # Of an angle that could be anything, rounding would make up a direction.
        circular = np.where(np.abs(resultant) < 1e-9, 0.0, np.angle(resultant))
        return np.where(self.periodic, circular, weights @ flat)

    def cov(self) -> np.ndarray:
        deviation = self.points.reshape(-1, len(self.names)) - self.mean()
        deviation = np.where(self.periodic, wrap(deviation), deviation)
        return np.einsum("k,ki,kj->ij", self.weights.ravel(), deviation, deviation)

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
        if keep == list(range(len(self.names))):
            return self
        if keep != [keep[0]] or len(self.names) != 2:
            flipped = GridDensity(
                np.moveaxis(self.log_values, 0, -1),
                self.centre[keep],
                self.basis[np.ix_(keep, keep)],
                tuple(self.names[i] for i in keep),
                tuple(self.periodic[i] for i in keep),
            )
            return flipped
        return self._line(keep[0])

    def _line(self, i: int) -> GridDensity:
        """The marginal of coordinate i of two: the sheared lattice is summed along its other axis by Fourier's shift."""
        # Lattice points with equal x_i lie on slanted lines.  A sum over a slanted line of a band-limited function equals
        # the sum after each row was shifted by a fraction of a cell, which a Fourier transform does exactly.
        along = int(np.argmax(np.abs(self.basis[i]) * self._spread_along))
        values = self.weights if along == 0 else self.weights.T
        pitch, slant = self.basis[i, along], self.basis[i, 1 - along]
        rows = np.arange(values.shape[1]) - values.shape[1] // 2
        shift = rows * slant / pitch
        pad = int(np.ceil(np.max(np.abs(shift)))) + 2
        closed = self._closed[along] and abs(slant) < 1e-12
        padded = values if closed else np.pad(values, ((pad, pad), (0, 0)))
        frequency = np.fft.rfftfreq(padded.shape[0])
        spectrum = np.fft.rfft(padded, axis=0) * np.exp(-2j * np.pi * frequency[:, None] * shift)
        line = np.maximum(np.fft.irfft(spectrum.sum(axis=1), padded.shape[0]), 0.0)
        with np.errstate(divide="ignore"):
            logs = np.log(line / abs(pitch))
        size = len(line)
        origin = self.centre[i] + pitch * (size // 2 - (values.shape[0] // 2 + (0 if closed else pad)))
        if pitch < 0:
            logs, pitch = logs[::-1], -pitch
            origin = origin + pitch * (size - 1 - 2 * (size // 2)) * -1.0
        return GridDensity(logs, np.array([origin]), np.array([[pitch]]), (self.names[i],), (self.periodic[i],))

    @cached_property
    def _spread_along(self) -> np.ndarray:
        """The standard deviation of the index along each axis of the lattice."""
        out = []
        for axis, size in enumerate(self.log_values.shape):
            mass = self.weights.sum(axis=tuple(a for a in range(self.weights.ndim) if a != axis))
            index = np.arange(size)
            out.append(np.sqrt(max(mass @ index**2 - (mass @ index) ** 2, 1.0)))
        return np.array(out)

    def sample(self, key: object, count: int) -> np.ndarray:
        rng = generator(key)
        which = rng.choice(self.weights.size, size=count, p=self.weights.ravel())
        x = self.points.reshape(-1, len(self.names))[which]
        x = x + (rng.random((count, len(self.names))) - 0.5) @ self.basis.T
        return np.where(self.periodic, wrap(x), x)


def dirichlet(distance: np.ndarray, size: int) -> np.ndarray:
    """The trigonometric interpolation kernel of `size` points on a circle, at a distance in cells."""
    angle = np.pi * distance / size
    with np.errstate(divide="ignore", invalid="ignore"):
        if size % 2:
            value = np.sin(np.pi * distance) / (size * np.sin(angle))
        else:
            value = np.sin(np.pi * distance) / (size * np.tan(angle))
    return np.where(np.abs(np.sin(angle)) < 1e-14, 1.0, value)
