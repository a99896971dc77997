"""The logarithm of a density of one state on nested uniform grids x = origin + unit 2^-level i."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

SUPPORT = 36.0  # nats below the maximum at which a density is negligible
Array = NDArray[Any]


class Grid(NamedTuple):
    """The points origin + unit 2^-level (first + j), j < size."""

    origin: float
    unit: float
    level: int
    first: int
    size: int

    @property
    def spacing(self) -> float:
        """The distance of two points."""
        return float(self.unit * 2.0**-self.level)

    @property
    def points(self) -> Array:
        """The points (size,)."""
        return self.origin + self.offsets

    @property
    def offsets(self) -> Array:
        """The points (size,) relative to the origin."""
        return self.spacing * (self.first + np.arange(self.size))


class Field(NamedTuple):
    """The logarithm of a density, not normalised, on a grid."""

    grid: Grid
    logs: Array

    @property
    def cells(self) -> float:
        """The smallest standard deviation, in spacings, of a Gaussian that is as curved as the density somewhere."""
        logs = self.logs.real
        with np.errstate(invalid="ignore"):
            curvature = 2 * logs[1:-1] - logs[:-2] - logs[2:]
        used = (logs[1:-1] > np.max(logs) - 14.0) & np.isfinite(curvature)
        return float(1 / np.sqrt(max(np.max(curvature[used], initial=0.0), 1e-12)))

    @property
    def moments(self) -> tuple[Any, float, float]:
        """The logarithm of the mass, the mean relative to the origin, and the standard deviation; the latter two real."""
        top = np.max(self.logs.real)
        values = np.exp(self.logs - top)
        total = values.sum()
        weights = (values / total).real
        offsets = self.grid.offsets
        middle = offsets[int(np.argmax(weights))]
        apart = offsets - middle
        mean = weights @ apart
        deviation = np.sqrt(weights @ (apart - mean) ** 2)
        return np.log(total) + top + np.log(self.grid.spacing), float(middle + mean), float(deviation)

    @property
    def support(self) -> tuple[int, int]:
        """The indices of the first and the last point that matters."""
        used = np.flatnonzero(self.logs.real > np.max(self.logs.real) - SUPPORT)
        return int(used[0]), int(used[-1])

    def on(self, grid: Grid) -> Field:
        """Interpolate on another grid with the same origin; zero outside.

        The sinc interpolant is exact where the density is resolved; in the tails, below its rounding, a polynomial of the
        logarithm is used.
        """
        if grid == self.grid:
            return self
        ratio = 2.0 ** (self.grid.level - grid.level)
        at = ratio * (grid.first + np.arange(grid.size)) - self.grid.first
        size, logs = self.grid.size, np.full(grid.size, -np.inf, self.logs.dtype)
        exact = (at == np.round(at)) & (at >= 0) & (at <= size - 1)
        logs[exact] = self.logs[at[exact].astype(int)]
        between = np.flatnonzero(~exact & (at > 0) & (at < size - 1))
        if not len(between):
            return Field(grid, logs)
        at = at[between]
        top = np.max(self.logs.real)
        values = np.sinc(at[:, None] - np.arange(size)) @ np.exp(self.logs - top)
        left = np.clip(np.floor(at).astype(int) - 2, 0, size - 6)
        stencil = left[:, None] + np.arange(6)
        weights = np.prod(
            [np.where(np.arange(6) == j, 1.0, (at[:, None] - left[:, None] - j) / (np.arange(6) - j + (np.arange(6) == j)))
             for j in range(6)], axis=0)  # fmt: skip
        near = self.logs[stencil]
        finite = np.isfinite(near).all(axis=1)
        tail = np.where(finite, np.sum(weights * np.where(finite[:, None], near, 0.0), axis=1), -np.inf)
        good = values.real > 1e-11
        logs[between] = np.where(good, np.log(np.where(good, values, 1.0)) + top, tail)
        return Field(grid, logs)


def edge_masses(logs: Array) -> tuple[float, float]:
    """Return the share of the mass in the outermost points on each side."""
    weights = np.exp((logs - np.max(logs.real)).real)
    outer = max(2, len(weights) // 48)
    total = weights.sum()
    return float(weights[:outer].sum() / total), float(weights[-outer:].sum() / total)


def quadrature_error(cells: float) -> float:
    """Return the error of a sum over a grid on which a standard deviation has so many spacings."""
    return float(2 * np.exp(-2 * np.pi**2 * cells**2))
