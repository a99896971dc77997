"""Regions of highest density: the smallest sets that hold a probability."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from zakai.densities._values import wrap
from zakai.errors import InputError

if TYPE_CHECKING:
    from zakai.densities import Density

POINTS, ACROSS = 4001, 401  # of a line, and along each axis of a plane
TAIL = 1e-4  # of the probability outside of the region that may lie beyond the points


def highest_density_region(density: Density, level: float) -> list[tuple[float, float]] | float:
    """Return the intervals of one coordinate, or the level of the density of two; see `Density.highest_density_region`."""
    if isinstance(level, bool) or not isinstance(level, int | float | np.number) or not 0.0 < level < 1.0:
        raise InputError(f"highest_density_region: level is {level!r}; give a probability between 0 and 1")
    if len(density.names) > 2:
        raise InputError(
            f"highest_density_region: {len(density.names)} states; take the marginal of one or two, as in "
            f'density.marginal(["{density.names[0]}"])'
        )
    if len(density.names) == 1:
        return _intervals(density, float(level))
    x, y = (_line(density, i, float(level), ACROSS) for i in range(2))
    values = np.nan_to_num(density.pdf(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)))
    return _threshold(values.ravel(), np.outer(_widths(x), _widths(y)).ravel(), float(level))


def _line(density: Density, coordinate: int, level: float, count: int) -> NDArray[np.float64]:
    """Return points of a coordinate, rising: half of them evenly spaced, half at equal steps of probability."""
    tail = TAIL * (1.0 - level)
    shares = np.concatenate([[tail], np.linspace(0.0, 1.0, count // 2 + 2)[1:-1], [1.0 - tail]])
    likely = density.quantile(shares.tolist())[:, coordinate]
    if density.periodic[coordinate]:
        return np.unique(np.concatenate([wrap(likely), np.linspace(-np.pi, np.pi, count)]))
    return np.unique(np.concatenate([likely, np.linspace(likely[0], likely[-1], count)]))


def _widths(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights of the trapezoidal rule."""
    steps = np.diff(x)
    return np.concatenate([[0.0], steps]) / 2 + np.concatenate([steps, [0.0]]) / 2


def _threshold(values: NDArray[np.float64], widths: NDArray[np.float64], level: float) -> float:
    """Return the value of the density above which the probability is `level`."""
    order = np.argsort(-values)
    mass = np.cumsum((values * widths)[order])
    return float(np.interp(level, mass / mass[-1], values[order]))


def _intervals(density: Density, level: float) -> list[tuple[float, float]]:
    x = _line(density, 0, level, POINTS)
    values = np.nan_to_num(density.pdf(x[:, None]))
    bound = _threshold(values, _widths(x), level)
    inside = values >= bound
    rises, falls = np.flatnonzero(~inside[:-1] & inside[1:]), np.flatnonzero(inside[:-1] & ~inside[1:])

    def crossing(i: np.intp) -> float:
        return float(x[i] + (x[i + 1] - x[i]) * (bound - values[i]) / (values[i + 1] - values[i]))

    lows = [float(x[0])] * bool(inside[0]) + [crossing(i) for i in rises]
    highs = [crossing(i) for i in falls] + [float(x[-1])] * bool(inside[-1])
    found = list(zip(lows, highs, strict=True))
    if density.periodic[0] and len(found) > 1 and inside[0] and inside[-1]:  # one interval through pi
        found = [*found[1:-1], (found[-1][0], found[0][1] + 2 * np.pi)]
    return found
