"""One draw from a prior that is given by its log density, on a grid that finds where the mass is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from zakai.errors import InputError
from zakai.models._errors import named
from zakai.models.domain import Interval
from zakai.models.numeric import explain_nonfinite, numpy_function
from zakai.models.prior import DensityPrior

if TYPE_CHECKING:
    from zakai.models.model import Model

NEGLIGIBLE = 40.0  # exp(-40) of the largest density
WIDEST = 2.0**20


def draw_from_density(model: Model, rng: np.random.Generator) -> np.ndarray:
    """One state, of shape (n,), drawn from a density prior with one or two states.

    Raises InputError for more states, for a density that is not finite, and for one that does not decay.
    """
    if model.n > 2:
        raise InputError(f"{model.source}: prior: a density over {model.n} states cannot be drawn from; give initial")
    assert isinstance(model.prior, DensityPrior)
    log_density = numpy_function([model.prior.log_density], model, ())
    points = 4001 if model.n == 1 else 401
    ends = np.array([model.domain.get(name, Interval())[:2] for name in model.state])
    bounds = np.array([[-np.pi, np.pi] if name in model.periodic else [-8.0, 8.0] for name in model.state])
    for axis, (low, high) in enumerate(ends):
        if np.isfinite([low, high]).any():
            bounds[axis] = [low if np.isfinite(low) else high - 16.0, high if np.isfinite(high) else low + 16.0]
    with named(f"{model.source}: prior"):
        for _ in range(60):
            axes = [low + (np.arange(points) + 0.5) * (high - low) / points for low, high in bounds]
            grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
            values = log_density(grid, model.start, model.theta())
            values = np.where(np.isnan(values) & on_edge(grid, ends), -np.inf, values)
            _refuse_nonfinite(model, values, grid)
            matters = values > values.max() - NEGLIGIBLE
            new = np.clip(_next_bounds(model, bounds, axes, matters, ends), ends[:, :1], ends[:, 1:])
            if np.allclose(new, bounds):
                break
            bounds = new
    weights = np.exp(values - values.max()).ravel()
    cell = np.unravel_index(rng.choice(weights.size, p=weights / weights.sum()), values.shape)
    width = (bounds[:, 1] - bounds[:, 0]) / points
    return np.array([axis[i] for axis, i in zip(axes, cell)]) + rng.uniform(-0.5, 0.5, size=model.n) * width


def _refuse_nonfinite(model: Model, values: np.ndarray, grid: np.ndarray) -> None:
    # A density may be zero somewhere (log of zero); it may not be infinite or without a value.
    assert isinstance(model.prior, DensityPrior)
    bad = np.isnan(values) | (values == np.inf)
    if bad.any():
        point = grid[np.unravel_index(np.argmax(bad), bad.shape)]
        raise InputError(explain_nonfinite(model, "log_density", model.prior.log_density, point, model.start))
    if not np.isfinite(values).any():
        raise InputError("log_density: the density is zero at all points that were tried")


def on_edge(grid: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Whether a point of the grid is at an end of the domain, where a density may have no value."""
    return ((grid == ends[:, 0]) | (grid == ends[:, 1])).any(axis=-1)


def _next_bounds(model: Model, bounds: np.ndarray, axes: list[np.ndarray], matters: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Wider where the density reaches the edge, narrower where it fills under a quarter, else unchanged."""
    new = bounds.copy()
    for axis, name in enumerate(model.state):
        if name in model.periodic:
            continue
        low, high = bounds[axis]
        used = np.flatnonzero(matters.any(axis=tuple(k for k in range(model.n) if k != axis)))
        below, above = used[0] == 0 and low > ends[axis, 0], used[-1] == len(axes[axis]) - 1 and high < ends[axis, 1]
        if below or above:
            new[axis] = low - (high - low) / 2, high + (high - low) / 2
            if high - low > 2 * WIDEST:
                raise InputError(f"log_density: does not decay in {name!r}, so it is not a density")
        elif used[-1] - used[0] < len(axes[axis]) / 4:
            width = (axes[axis][1] - axes[axis][0]) * max(used[-1] - used[0], 4)
            new[axis] = axes[axis][used[0]] - width / 4, axes[axis][used[-1]] + width / 4
    return new
