"""Figures of a density of one state on its grid, and the density on another grid."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.methods.line.domain import variable_of
from zakai.methods.line.system import Prepared
from zakai.methods.line.tables import covariance_at
from zakai.numerics.line import window as lw
from zakai.numerics.line.density import support
from zakai.numerics.line.weak import at_nodes, nodes, weak

Array = Any

RESOLVED = 1e-11  # spectrum at the highest frequencies that does not ask for a large grid
UNRESOLVED = 1e-6  # spectrum at the highest frequencies from which waves around a density hide where it ends


def resampled(prepared: Prepared, values: Array, window: lw.Window, new: lw.Window) -> Array:
    """Return probabilities on another grid, in the weak sense on a coarser one where densities have kinks."""
    if not prepared.weak or new.spacing <= window.spacing:
        return lw.resampled(values, window, new)
    density = at_nodes(lw.density_at(values, window, nodes(new.offsets, new.spacing)))
    found = weak(density, new.spacing)[0] * (new.spacing / window.spacing)
    return np.where(found > 0, found, 0.0)


def figures(prepared: Prepared, values: Array, window: lw.Window) -> lw.Figures:
    """Return the figures of a density.

    A spectrum that falls slowly, of kinks and of what the largest grid does not resolve, does not tell where a density ends.  Of
    kinks of likelihoods a coarser grid would fold it, and a finer one has no more of it.
    """
    look = lw.figures(values, window.closed, prepared.negligible, prepared.cut)
    if prepared.kinked or look.aliasing > UNRESOLVED:
        noise = 0.0 if prepared.weak else 1e-2 * look.aliasing  # of waves that the transition leaves everywhere
        first, last = support(np.ascontiguousarray(values.real), max(prepared.cut, noise))
        look = look._replace(first=first, last=last)
    return look._replace(resolving=1.0) if prepared.weak else look


def refitted(
    prepared: Prepared, values: Array, window: lw.Window, look: lw.Figures, generous: int = 64, large: bool = True
) -> tuple[Array, lw.Window]:
    """Return a density on the grid for its next substep, and this grid.

    Args:
        prepared: what is known without data.
        values: probabilities (N,).
        window: their grid.
        look: figures of the density by its spectrum.
        generous: a grid of up to so many points is kept though fewer would do.
        large: whether it may have more points than a matrix of the operator.
    """
    large = large and prepared.largest_for(look, window.size) > prepared.largest
    look = look._replace(resolving=1.0) if prepared.smoothing else look
    new = lw.fitted(look, window, lw.SIZES[-1] if large else lw.LARGEST, generous)
    moved = resampled(prepared, values, window, new)
    return moved / np.sum(moved) if prepared.smoothing else moved, new  # an imaginary part need not have the sum zero


def on_fitting_grid(
    prepared: Prepared, values: Array, window: lw.Window, look: lw.Figures, generous: int, margin: float = 0.12
) -> tuple[Array, lw.Window, float]:
    """Return a density on the grid for the next interval, this grid, and the spectrum that it does not resolve.

    The grid is large only where one on which matrices act does not resolve the density.  For the arguments see `fitted` of
    `numerics/line/window.py`.
    """
    most, large = prepared.largest, prepared.largest_for(look, window.size)
    while True:
        new = lw.fitted(look, window, most, generous, margin)
        if new == window:
            return values, window, look.aliasing
        moved = resampled(prepared, values, window, new)
        moved = moved / np.sum(moved)
        coarse = 0.0 if prepared.weak else lw.figures(moved, new.closed, prepared.negligible, prepared.cut).aliasing
        if coarse <= RESOLVED or most >= large:
            return moved, new, coarse
        most = large


def outside_tables(prepared: Prepared, values: Array, window: lw.Window, t: float) -> float:
    """Return the share of the mass where a table is constant beyond its range."""
    return float(values.real @ prepared.system.outside(window.points, t, prepared.theta) / np.sum(values.real))


def state_moments(prepared: Prepared, values: Array, window: lw.Window, mean: Any, variance: Any) -> tuple[Any, Any]:
    """Return the mean and variance of the state from those of the variable of the grid, relative to its origin."""
    variable = variable_of(prepared.model)
    if variable is None:
        return window.origin + mean, variance
    offsets = variable.offset(window.points)
    mean = offsets @ values
    apart = offsets - mean
    return variable.end + mean, (apart * apart) @ values


def edge_of_moments(prepared: Prepared, values: Array, window: lw.Window) -> float:
    """Return the share of the second moment of the state at the ends of the grid, where the state has a domain."""
    variable = variable_of(prepared.model)
    if variable is None:
        return 0.0
    offsets = variable.offset(window.points)
    parts = (offsets - offsets[int(np.argmax(values.real))]) ** 2 * values.real
    return float(max(parts[0], parts[-1]) / np.sum(parts))


def forgetting(before: Any, predicted: Any, after: Any, spread: float) -> float:
    """Return the remainder of an old relative error after a step, from the variances: that of an error of the mean in deviations.

    `spread` is the integral of G over the interval, which counts where the observation acts inside.
    """
    ratio = np.sqrt(max(before.real * after.real, 0.0)) / max(predicted.real, 1e-300)
    return float(np.clip(ratio * np.exp(-min(0.5 * spread / max(before.real, 1e-300), 5.0)), 0.3, 1.0))


def spread(prepared: Prepared, k: int, length: float, mean: float) -> float:
    """Return about the integral of G over interval k where increments act inside."""
    if not prepared.inside[k].any():
        return 0.0
    middle = float(prepared.schedule.starts[k]) + 0.5 * length
    return length * float(np.max(covariance_at(prepared.system, np.array([mean]), middle, prepared.theta).real))
