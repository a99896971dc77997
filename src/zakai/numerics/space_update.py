"""Multiplication of a density on a grid by a likelihood, on a grid that fits the product."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.space_field import Field, better, finer_by, positive, refinable
from zakai.numerics.space_grid import Grid, filtered, gaussian_response
from zakai.numerics.space_resample import triangular_resampled
from zakai.numerics.space_spline import gather, relative_index
from zakai.numerics.space_survey import deviations_in_spacings, narrowest, survey
from zakai.numerics.space_window import Bounds, adjusted, fitted_grid, whitened_grid

Array = NDArray[Any]
_STEEP = 4.0  # change of the log-likelihood between neighbours that a grid may have before it is refined
_TRIES = 16
POINT = 0.1  # deviations in spacings of a product that is one point: rounding of the likelihood


class Update(NamedTuple):
    """The product of a prediction and a likelihood, and its errors.

    The edges and tails of its grid, how many nats below its maximum the prediction is where the product is largest, and whether
    the product reaches the end of the predicted window.
    """

    field: Field
    edges: float
    tails: float
    depth: float
    truncated: bool


def updated(field: Field, log_factor: Callable[[Grid], Array], bounds: Bounds, tails: float) -> Update:
    """Return the product of a density and a factor that is given by its logarithm at the points of a grid (J,).

    A factor that is narrower than the grid's spacing is found on a sequence of finer grids, with a power of it below one as long
    as neighbours differ by many nats.  `tails` are those of the spectrum of the density.  A product that is zero, or one point,
    leaves the density as it is; its mass on the grid of the density is that of the result.
    """
    grid, values = field.grid, field.values
    coefficients: Array | None = None
    inverse_previous = last = grid
    logs = log_factor(grid).reshape(grid.sizes)
    found, before = None, np.ones(grid.n)
    best: Any = None  # the smallest grid with the smallest edges and tails so far: a later one may be worse
    for attempt in range(_TRIES):
        real = np.where(values.real > 0, values.real, 0.0)
        with np.errstate(divide="ignore"):
            product = np.log(real) + np.where(np.isnan(logs.real), -np.inf, logs.real)
        top = float(product.max())
        if not np.isfinite(top):
            return _unchanged(field, log_factor)
        power = _power(logs.real, product, grid)
        if power == 1.0:
            found = survey(_exp(product - top), grid, bounds.edge)
            worst = float(max(found.tails.max(), found.edges.max()))
            span = (found.used[:, 1] - found.used[:, 0] + 4) / np.array(grid.sizes)
            wide = found.edges > 3 * bounds.edge
            coarse = refinable(found.tails, before, finer_by(grid, last), tails, bounds)
            good = not wide.any() and found.tails.max() <= 3 * bounds.tail
            if best is not None and not good and not (best[-1].edges > 3 * bounds.edge).any():
                good = bool(better(worst, best[0], float((best[1].cell / grid.cell) ** (1 / grid.n)), bounds))
            elif best is not None and not good:
                good = worst < best[0]
            if best is None or good:
                best = worst, grid, values, logs, product, top, found
            before, last = np.where(coarse & (attempt > 0), found.tails, before), grid
            sparse = np.array([attempt < 2 and np.prod(np.minimum(span, 1.0)) < 0.35 and grid.n > 1])
            if not (wide.any() or coarse.any() or sparse.any()):
                break
        if attempt == _TRIES - 1:
            break
        new = _next(grid, product, logs.real, power, found, bounds, attempt > 1)
        if new is None or new.same(grid):
            break
        if bounds.band_limited:
            grid, values = new, triangular_resampled(field.values, field.grid, new)
            logs, found = log_factor(grid).reshape(grid.sizes), None
            continue
        if coefficients is None:
            inverse_previous = field.grid
            zero = np.zeros((grid.n, grid.n))
            coefficients = filtered(field.values, gaussian_response(zero, field.grid.sizes, spline=True))
        at = relative_index(new.offsets, new.centre, inverse_previous, bounds.periodic)
        values = gather(coefficients, at, inverse_previous).reshape(new.sizes)
        grid, values = new, positive(Field(values, new, 0.0), bounds).values
        logs, found = log_factor(grid).reshape(grid.sizes), None
    if found is None:
        found = survey(_exp(product - top), grid, bounds.edge)
    if best is not None:
        _, grid, values, logs, product, top, found = best
    inverse = grid.inverse
    if not np.diagonal(inverse @ found.cov @ inverse.T).min() > POINT**2:
        return _unchanged(field, log_factor)
    peak = int(np.argmax(product))
    ratio = float(values.real.flat[peak] / max(field.values.real.max(), values.real.max()))
    shift = float(logs.real.flat[peak])
    good = np.isfinite(logs.real) & (values.real > 0)
    result = np.where(good, values, 0.0) * np.exp(np.where(good, np.where((logs.real - shift) > 600, 600, logs - shift), 0.0))
    truncated = _at_end(_exp(product - top), grid, field.grid, bounds)
    return Update(
        positive(Field(result, grid, field.log_scale + shift), bounds),
        float(found.edges.max()),
        float(found.tails.max()),
        max(-np.log(max(ratio, 1e-300)), 0.0),
        truncated,
    )


def _unchanged(field: Field, log_factor: Callable[[Grid], Array]) -> Update:
    """Return the density itself with the mass of its product with a factor that no point of the grid resolves."""
    logs = log_factor(field.grid).real.reshape(field.grid.sizes)
    with np.errstate(divide="ignore", invalid="ignore"):
        product = np.log(np.maximum(field.values.real, 0.0)) + np.where(np.isnan(logs), -np.inf, logs)
        top = float(product.max())
        mass = top + np.log(_exp(product - top).sum() / field.values.real.sum()) if np.isfinite(top) else -np.inf
    return Update(field._replace(log_scale=field.log_scale + mass), 1.0, 1.0, np.inf, True)


def _exp(logs: Array) -> Array:
    """Return exponentials, zero where they are so small that arithmetic with them is slow."""
    return np.where(logs > -100.0, np.exp(np.maximum(logs, -100.0)), 0.0)


def _power(logs: Array, product: Array, grid: Grid) -> float:
    """Return the power of the factor that changes by few nats between the neighbours of the largest product."""
    at = np.unravel_index(int(np.argmax(product)), product.shape)
    steepest = 0.0
    for d, size in enumerate(grid.sizes):
        for step in (-1, 1):
            beside = list(at)
            beside[d] += step
            if grid.closed[d]:
                beside[d] %= size
            if 0 <= beside[d] < size and np.isfinite(logs[tuple(beside)]):
                steepest = max(steepest, abs(float(logs[tuple(beside)] - logs[at])))
    return 1.0 if steepest <= _STEEP else _STEEP / steepest


def _next(
    grid: Grid, product: Array, logs: Array, power: float, found: Any, bounds: Bounds, late: bool
) -> Grid | None:
    """Return the next grid: around the product with a power of the factor, or one that mends what the checks found."""
    if power < 1.0:
        with np.errstate(invalid="ignore"):
            tempered = product - (1 - power) * np.where(np.isfinite(logs), logs, 0.0)
        tempered = np.where(np.isnan(tempered), -np.inf, tempered)
        noise = 0.25 * grid.basis @ grid.basis.T
        narrow = np.ones(grid.n)
    else:
        tempered, noise = product, np.zeros((grid.n, grid.n))
        narrow, _ = narrowest(survey(_exp(product - product.max()), grid, bounds.edge, bounds.tail), grid, bounds.tail)
        if late and (found.tails > bounds.tail).any() and not (found.edges > 3 * bounds.edge).any():
            ratio = np.clip(bounds.spacings / deviations_in_spacings(found.tails), 1.1, 2)
            finer = np.where(found.tails > bounds.tail, ratio, 1.0)
            return adjusted(grid, np.zeros(grid.n), np.zeros(grid.n), finer, bounds)
    levels = (tempered - tempered.max()).reshape(-1)  # equal, where logarithms are too large to subtract
    if bounds.band_limited:
        used = np.flatnonzero(levels >= np.log(bounds.edge))
        return whitened_grid(grid.offsets[used], levels[used], noise, narrow, bounds, grid)
    return fitted_grid(grid.offsets, levels, grid.centre, noise, narrow, bounds, grid, least=math.log(bounds.edge))


def _at_end(product: Array, grid: Grid, predicted: Grid, bounds: Bounds) -> bool:
    """Return whether the product has mass where the predicted window ends."""
    z = relative_index(grid.offsets, grid.centre, predicted, bounds.periodic)
    sizes = np.array(predicted.sizes)
    outer = ((z < 1.5) | (z > sizes - 2.5)) & ~np.array(predicted.closed)
    return bool(product.reshape(-1)[outer.any(axis=1)].sum() > 1e-4 * product.sum())
