"""The product of a density with a likelihood that has kinks or jumps.

The spectrum of such a product at the highest frequencies of its grid does not show how wrong sums over its points are: the kinks
of a table may lie as far apart as the points.  The sums over the points of a grid that is shifted have other errors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.space.field import HARMFUL, Field, positive
from zakai.numerics.space.grid import Grid
from zakai.numerics.space.spline import resampled
from zakai.numerics.space.splitting import weighed
from zakai.numerics.space.survey import survey
from zakai.numerics.space.update import Update
from zakai.numerics.space.window import Bounds, adjusted

Array = NDArray[Any]
ALLOWED = 50.0  # times the bound on edges, for the difference of the sums
MOST_POINTS = 2**16  # of a grid that becomes finer for it
FINEST = 2.0  # ratio of spacings by which a grid becomes finer at once
TRIES = 6
# Spacings by which axes are shifted: no wave of few periods a spacing, along an axis or across, has the same sum on both grids.
SHIFTS: Array = np.array([0.5, 0.309, 0.191, 0.118])


def for_rough(bounds: Bounds) -> Bounds:
    """Return the requirements for the first grid of a product, which need not resolve kinks."""
    return bounds._replace(tail=HARMFUL * bounds.tail)


def checked(field: Field, update: Update, log_factor: Callable[[Grid], Array], bounds: Bounds) -> Update:
    """Return the product of a density and a factor on a grid over which its sums are right, and what they are wrong by.

    Args:
        field: the density.
        update: the product on a grid that would do for a smooth factor.
        log_factor: the logarithm of the factor at the points of a grid (J,).
        bounds: the requirements for a grid.
    """
    if not np.isfinite(update.depth):
        return update
    product, difference = update.field, 0.0
    for _ in range(TRIES):
        grid = product.grid
        shifted = Grid(grid.centre + grid.basis @ SHIFTS[: grid.n], grid.basis, grid.sizes, grid.closed)
        difference = _difference(product, _product(field, shifted, log_factor, bounds))
        finer = min(math.sqrt(difference / (ALLOWED * bounds.edge)), FINEST)
        if not finer > 1.0 or math.prod(grid.sizes) * finer**grid.n > MOST_POINTS:
            break
        zero = np.zeros(grid.n)
        changed = adjusted(grid, zero, zero, np.full(grid.n, max(finer, 1.2)), bounds)
        if changed is None:
            break
        product = _product(field, changed, log_factor, bounds)
    # The tails of the spectrum of kinks are those of its sums.
    tails = min(update.tails, max(difference, bounds.tail))
    return update._replace(field=product, tails=tails, interpolation=update.interpolation + difference)


def _product(field: Field, grid: Grid, log_factor: Callable[[Grid], Array], bounds: Bounds) -> Field:
    """Return the product on a grid."""
    logs = log_factor(grid).reshape(grid.sizes)
    values = positive(Field(resampled(field.values, field.grid, grid, bounds.periodic), grid, 0.0), bounds).values
    values, top = weighed(values, np.where(np.isnan(logs.real), -1e300, logs))
    return positive(Field(values, grid, field.log_scale + top), bounds)


def _difference(one: Field, two: Field) -> float:
    """Return the largest difference of the sums: of the masses and variances relative to them, of the means in deviations."""
    first, second = (survey(field.values.real, field.grid) for field in (one, two))
    deviations = np.sqrt(np.maximum(np.diagonal(first.cov), 1e-300))
    mean = (one.grid.centre + first.mean - two.grid.centre - second.mean) / deviations
    mass = (one.log_mass - two.log_mass).real
    found = [np.abs(mean).max(), np.abs(np.diagonal(second.cov) / deviations**2 - 1.0).max(), abs(mass)]
    return float(min(np.nan_to_num(max(found), nan=1.0), 1.0))
