"""Multiplication of a density on a grid by a likelihood, on a grid that fits the product."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc

from zakai.numerics.compiled import kernel
from zakai.numerics.complex_step import is_complex
from zakai.numerics.space.field import ACCEPTED, Field, better, finer_by, finer_field, positive, refinable
from zakai.numerics.space.grid import Grid, filtered
from zakai.numerics.space.resample import refined, triangular_resampled
from zakai.numerics.space.spline import gather, relative_index, resampled
from zakai.numerics.space.survey import Survey, deviations_in_spacings, narrowest
from zakai.numerics.space.window import Bounds, Points, adjusted, fitted_grid, whitened_grid

Array = NDArray[Any]
_STEEP = 4.0  # change of the log-likelihood between neighbours that a grid may have before it is refined
_TRIES = 16
_RESOLVED = 3  # grids on which neighbours differ by few nats that are tried from a grid that was chosen for the product
LOWEST = -100.0  # logarithm of a product, relative to its largest, below which it is zero
SMALLER = 0.8  # ratio of cells, above which a grid around a power of a factor is refined instead
MOST_REFINED = 2.0  # ratio of spacings by which a grid is refined at once
SPLINE = 5e-4  # error of the spline of a Gaussian, times the sixth power of its standard deviation in spacings
ACCURATE = 10.0  # times the bound on edges, for the error of the spline, and of the cut, that is small
FAR = 3.0  # deviations from the mean beyond which mass counts by its distance
POINT = 0.1  # deviations in spacings of a product that is one point: rounding of the likelihood


class Update(NamedTuple):
    """The product of a prediction and a likelihood, and its errors.

    The edges and tails of its grid, how many nats below its maximum the prediction is where the product is largest, whether the
    product reaches the end of the predicted window, by how much an error of the prediction may be larger in the moments of the
    product, the errors of these by the interpolation between the grids and by the cut of the density before the interval, and
    what values of the prediction that were set to zero change in its own moments.
    """

    field: Field
    edges: float
    tails: float
    depth: float
    truncated: bool
    growth: float = 1.0
    interpolation: float = 0.0
    cut: float = 0.0
    removed: float = 0.0


class _Product(NamedTuple):
    """The product of a density `values` and a factor on a grid, with the logarithm of the factor (*sizes).

    `levels` are the logarithms of the product, but for its largest, `top`, which is at the index `peak`; `field` is the product
    but for exp(top); between `peak` and its neighbours along each axis the log of the factor changes by at most `steep` (n,).
    """

    values: Array
    logs: Array
    levels: Array
    field: Field
    top: float
    peak: int
    steep: Array


@kernel("Tuple((float64, int64))(float64[::1], float64[::1], int64[::1], boolean[::1], float64[::1], float64[::1], float64[::1])")
def _multiply(values: Any, logs: Any, sizes: Any, closed: Any, levels: Any, product: Any, steep: Any) -> tuple[float, int]:
    """Write the logarithms of a product, but for the largest, the product and the changes; return the largest and its place.

    Where the product is so small that arithmetic with it is slow it is zero.
    """
    top, peak = -np.inf, 0
    for j in range(values.size):
        levels[j] = math.log(values[j]) + logs[j] if values[j] > 0.0 and not math.isnan(logs[j]) else -np.inf
        if levels[j] > top:
            top, peak = levels[j], j
    for j in range(values.size):
        levels[j] -= top
        product[j] = math.exp(levels[j]) if levels[j] > LOWEST else 0.0
    stride = 1
    for d in range(sizes.size - 1, -1, -1):
        index = peak // stride % sizes[d]
        for step in (-1, 1):
            beside = index + step
            if closed[d]:
                beside = beside % sizes[d]
            if 0 <= beside < sizes[d]:
                change = abs(logs[peak + (beside - index) * stride] - logs[peak])
                if math.isfinite(change):
                    steep[d] = max(steep[d], change)
        stride *= sizes[d]
    return top, peak


def _multiplied(values: Array, grid: Grid, log_factor: Callable[[Grid], Array]) -> _Product:
    """Return the product of a density and a factor on a grid."""
    logs = log_factor(grid).reshape(grid.sizes)
    levels, product, steep = np.empty(grid.sizes), np.empty(grid.sizes), np.zeros(grid.n)
    flat = [np.array(a.real, order="C").reshape(-1) for a in (values, logs)]
    found = _multiply(*flat, grid.shape, grid.circles, levels.reshape(-1), product.reshape(-1), steep)
    return _Product(values, logs, levels, Field(product, grid, 0.0), *found, steep)


def updated(
    field: Field,
    log_factor: Callable[[Grid], Array],
    bounds: Bounds,
    tails: float,
    start: Grid | None = None,
    wider: Callable[[], float] | None = None,
) -> Update:
    """Return the product of a density and a factor that is given by its logarithm at the points of a grid (J,).

    A factor that is narrower than the grid's spacing is found on a sequence of finer grids, with a power of it below one as long
    as neighbours differ by many nats.  `tails` are those of the spectrum of the density.  `start` is the first grid, which the
    product may fill as it will; without it that is the grid of the density.  `wider` returns the ratio of the variances of the
    density to those that it has without the noise of the interval before.  A product that is zero, or one point, leaves the
    density as it is; its mass on the grid of the density is that of the result.
    """
    grid, here = field.grid, field
    if start is not None:
        grid, here = start, positive(Field(resampled(here.values, grid, start, bounds.periodic), start, 0.0), bounds)
    coefficients, last, before = None, grid, np.ones(grid.n)
    between, sparse, resolved = grid, False, 0
    best: tuple[float, _Product, Survey, float] | None = None  # the smallest edges and tails so far: a later grid may be worse
    for attempt in range(_TRIES):
        product = _multiplied(here.values, grid, log_factor)
        if not np.isfinite(product.top):
            return _unchanged(field, log_factor)
        if product.steep.max() <= _STEEP:
            found = product.field.survey(bounds)
            worst = float(max(found.tails.max(), found.edges.max()))
            wide = found.edges > 3 * bounds.edge
            coarse = refinable(found.tails, before, finer_by(grid, last), tails, bounds)
            good = not wide.any() and found.tails.max() <= 3 * bounds.tail
            if best is not None and not good and not (best[2].edges > 3 * bounds.edge).any():
                ratio = float((best[1].field.grid.cell / grid.cell) ** (1 / grid.n))
                good = bool(better(worst, best[0], ratio, bounds))
            elif best is not None and not good:
                good = worst < best[0]
            if best is None or good:
                best = worst, product, found, here.removed
            before, last = np.where(coarse & (attempt > 0), found.tails, before), grid
            span = (found.used[:, 1] - found.used[:, 0] + 4) / grid.shape
            sparse = bool(start is None and attempt < 2 and np.prod(np.minimum(span, 1.0)) < 0.35 and grid.n > 1)
            resolved += 1
            if not (wide.any() or coarse.any() or sparse) or (start is not None and resolved > _RESOLVED):
                break
        if attempt == _TRIES - 1:
            break
        new = _next(product, bounds, sparse, attempt > 1)
        if new is None or new.same(grid):
            break
        grid = new
        if grid.refines(field.grid):
            here = positive(Field(*refined(field.values, field.grid, grid.sizes), 0.0), bounds)
            continue
        if bounds.band_limited:
            here = Field(triangular_resampled(field.values, field.grid, grid), grid, 0.0)
            continue
        if coefficients is None:
            finer = _interpolable(field, product, bounds)
            coefficients, between = filtered(finer.values, np.zeros((grid.n, grid.n)), spline=True), finer.grid
        values = gather(coefficients, relative_index(grid, between, bounds.periodic), between).reshape(grid.sizes)
        here = positive(Field(values, grid, 0.0), bounds)
    _, product, found, removed = best or (0.0, product, product.field.survey(bounds), here.removed)
    grid, values = product.field.grid, product.values
    inverse = grid.inverse
    if not np.diagonal(inverse @ found.cov @ inverse.T).min() > POINT**2:
        return _unchanged(field, log_factor)
    result = product.field.values
    if is_complex(values, product.logs):  # the derivative of the logarithm of the product
        change = values.imag / np.where(result > 0, values.real, 1.0) + product.logs.imag
        result = result + 1j * result * np.where(result > 0, change, 0.0)
    new_field = product.field._replace(log_scale=field.log_scale + product.top)
    if result is not product.field.values:
        new_field = new_field._replace(values=result)
    depth, growth, of_spline, cut = _growths(field, product, bounds, wider)
    between = grid if grid.refines(field.grid) else between
    return Update(
        positive(new_field, bounds),
        float(found.edges.max()),
        float(found.tails.max()),
        depth,
        _at_end(product.field, field.grid, bounds),
        growth,
        0.0 if between is grid or bounds.band_limited else min(float(_of_spline(field, between, bounds).sum()) * of_spline, 1.0),
        cut,
        0.0 if product.values is field.values else removed,
    )


def _growths(
    field: Field, product: _Product, bounds: Bounds, wider: Callable[[], float] | None = None
) -> tuple[float, float, float, float]:
    """Return the depth of a product, by how much errors of the density are larger in its moments, and the error of the cut.

    At x deviations a Gaussian is d = x^2 / 2 nats below its maximum, in the mean n / 2, and the error of its spline, relative to
    itself, is as the sixth derivative He_6(x), where other errors grow as d.  Mass far from the mean counts by its distance.
    What is d nats below the maximum of a Gaussian that noise has made `wider` was about d / wider below it before; the cut is the
    share that comes from below the bound on edges, where the density was zero.
    """
    values, result, grid = product.values.real.reshape(-1), product.field.values.reshape(-1), product.field.grid
    highest = max(field.values.real.max(), values.max())
    peak = max(-math.log(max(float(values[product.peak] / highest), 1e-300)), 0.0)
    used = np.flatnonzero((result > 1e-9) & (values > 0.0))
    below, weights = np.log(highest / values[used]), result[used] / result[used].sum()
    depths, deepest, cut = np.maximum(below - 0.5 * grid.n, 0.0), 0.5 * bounds.reach**2, 0.0
    z = grid.offsets[used] - weights @ grid.offsets[used]
    z = np.abs(z) / np.sqrt(np.maximum(weights @ z**2, 1e-300))
    weights = weights * np.maximum(z.max(axis=1) / FAR, 1.0)
    if wider is not None:
        cut = float(weights @ erfc(np.sqrt(np.maximum(deepest - below, 0.0))))  # the largest, for any noise
        if cut > ACCURATE * bounds.edge:
            ratio = wider()
            cut = float(weights @ erfc((np.sqrt(deepest * ratio) - np.sqrt(below)) / np.sqrt(max(ratio - 1.0, 1e-3))))
    return peak, float(weights @ (1.0 + depths)), float(weights @ (1.0 + (2.0 * depths) ** 3 / 15.0)), cut


def _of_spline(field: Field, grid: Grid, bounds: Bounds) -> Array:
    """Return the error along each axis (n,) of the spline of a Gaussian with the spectrum of a density, on a finer grid."""
    deviations = deviations_in_spacings(field.survey(bounds).tails)
    return np.asarray(SPLINE / (deviations * grid.shape / field.grid.shape) ** 6)


def _interpolable(field: Field, product: _Product, bounds: Bounds) -> Field:
    """Return a density on a grid on which its spline is accurate where its product is."""
    grid, tails = field.grid, field.survey(bounds).tails
    finer = _of_spline(field, grid, bounds) * _growths(field, product, bounds)[2] / (ACCURATE * bounds.edge)
    finer = np.clip(finer ** (1 / 6), 1.0, MOST_REFINED)
    # The waves of a grid that does not resolve a density are less accurate than splines.
    finer = np.where(tails > ACCEPTED * bounds.tail, 1.0, finer)
    return finer_field(field, finer, bounds)


def _unchanged(field: Field, log_factor: Callable[[Grid], Array]) -> Update:
    """Return the density itself with the mass of its product with a factor that no point of the grid resolves."""
    product, mass = _multiplied(field.values, field.grid, log_factor), -np.inf
    if np.isfinite(product.top):
        mass = product.top + float(np.log(product.field.values.sum() / field.values.real.sum()))
    return Update(field._replace(log_scale=field.log_scale + mass), 1.0, 1.0, np.inf, True)


def _next(product: _Product, bounds: Bounds, sparse: bool, late: bool) -> Grid | None:
    """Return the next grid: around the product with a power of the factor, or one that mends what the checks found."""
    grid, levels = product.field.grid, product.levels.reshape(-1)
    noise, narrow = np.zeros((grid.n, grid.n)), np.ones(grid.n)
    least = math.log(bounds.edge)
    if product.steep.max() > _STEEP:
        logs = product.logs.real.reshape(-1)
        with np.errstate(invalid="ignore"):
            levels = levels - (1 - _STEEP / product.steep.max()) * np.where(np.isfinite(logs), logs, 0.0)
        levels = np.where(np.isnan(levels), -np.inf, levels)
        levels = levels - levels.max()
        noise = 0.25 * grid.basis @ grid.basis.T
    else:
        found = product.field.survey(bounds)
        narrow, _ = narrowest(found, product.field.values, bounds.tail)
        ratio = bounds.spacings / deviations_in_spacings(found.tails)
        near = late or (not sparse and ratio.max() < MOST_REFINED)
        if near and (found.tails > bounds.tail).any() and not (found.edges > 3 * bounds.edge).any():
            finer = np.where(found.tails > bounds.tail, np.clip(ratio, 1.1, MOST_REFINED), 1.0)
            return adjusted(grid, np.zeros(grid.n), np.zeros(grid.n), finer, bounds)
        cut = found.edges > 3 * bounds.edge
        if cut.any():
            # The product falls below the bound between two points, and the spectrum of what its window cuts off is not its own.
            narrow = np.where(cut, 1.0, narrow)
    levels = np.where(_beside(levels.reshape(grid.sizes) >= least).reshape(-1), np.maximum(levels, least), -np.inf)
    if bounds.band_limited:
        used = np.flatnonzero(levels >= least)
        return whitened_grid(grid.offsets[used], levels[used], noise, narrow, bounds, grid)
    new = fitted_grid(Points(grid.offsets, levels, grid.centre, least), noise, narrow, bounds, grid)
    if product.steep.max() > _STEEP and new.cell > SMALLER * grid.cell:  # of several peaks
        return adjusted(grid, np.zeros(grid.n), np.zeros(grid.n), np.where(product.steep > _STEEP, MOST_REFINED, 1.0), bounds)
    return new


def _beside(used: Array) -> Array:
    """Return which points of a grid are used or beside one that is."""
    out = used.copy()
    for d in range(used.ndim):
        lines, of_used = np.moveaxis(out, d, 0), np.moveaxis(used, d, 0)
        lines[1:] |= of_used[:-1]
        lines[:-1] |= of_used[1:]
    return out


def _at_end(product: Field, predicted: Grid, bounds: Bounds) -> bool:
    """Return whether a product has mass where the predicted window ends."""
    if product.grid is predicted and product.survey(bounds).edges.max() <= bounds.edge:
        return False
    z = relative_index(product.grid, predicted, bounds.periodic)
    outer = ((z < 1.5) | (z > predicted.shape - 2.5)) & ~predicted.circles
    values = product.values.reshape(-1)
    return bool(values[outer.any(axis=1)].sum() > 1e-4 * values.sum())
