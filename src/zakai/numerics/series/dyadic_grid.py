"""The logarithm of a density of one state on nested uniform grids x = origin + unit 2^-level i."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.line import window as lw

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
        """Interpolate on another grid with the same origin; zero outside."""
        if grid == self.grid:
            return self
        own, top = self.grid, np.max(self.logs.real)
        window = lw.Window(0.0, own.spacing * (own.first + own.size // 2), own.spacing, own.size, False, own.spacing)
        values = lw.density_at(np.exp(self.logs - top), window, grid.offsets)
        with np.errstate(divide="ignore"):
            return Field(grid, np.log(values) + top)


def edge_masses(logs: Array) -> tuple[float, float]:
    """Return the share of the mass in the outermost points on each side."""
    weights = np.exp((logs - np.max(logs.real)).real)
    outer = max(2, len(weights) // 48)
    total = weights.sum()
    return float(weights[:outer].sum() / total), float(weights[-outer:].sum() / total)


def quadrature_error(cells: float) -> float:
    """Return the error of a sum over a grid on which a standard deviation has so many spacings."""
    return float(2 * np.exp(-2 * np.pi**2 * cells**2))
