"""A density on a grid, the errors that a grid makes, and what a finer grid would leave of them."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.compiled import kernel
from zakai.numerics.space.grid import Grid, rounded_size
from zakai.numerics.space.resample import refined
from zakai.numerics.space.survey import Survey, survey
from zakai.numerics.space.window import Bounds

Array = NDArray[Any]
ACCEPTED = 3.0  # times the bound on tails, from a density that had such tails before
HARMFUL = 100.0  # times the bound on tails
NEGLIGIBLE = 1e-40  # of the maximum
NOISE = 2.0  # the largest noise, as a multiple of the most negative value


class _Fields(NamedTuple):
    values: Array
    grid: Grid
    log_scale: Any


class Field(_Fields):
    """A density `values` (*sizes), but for exp(`log_scale`), on a grid.

    Its moments are wrong by `removed` because values were set to zero: means in deviations, variances relative to them.
    """

    removed: float = 0.0

    def survey(self, bounds: Bounds) -> Survey:
        """Return the survey with the limit of some bounds, which is kept."""
        kept: dict[Any, Survey] = self.__dict__
        if bounds.edge not in kept:
            kept[bounds.edge] = survey(self.values, self.grid, bounds.edge)
        return kept[bounds.edge]

    @property
    def log_mass(self) -> Any:
        """The logarithm of the integral."""
        return np.log(self.values.sum() * self.grid.cell) + self.log_scale


class Report(NamedTuple):
    """The errors of an interval, relative to the density.

    Those of the splitting in time, of interpolation, at the edges, in the tails of the spectrum, the negative mass, and what
    values that were set to zero change.
    """

    splitting: float
    interpolation: float
    edges: float
    tails: float
    negative: float
    removed: float = 0.0

    def of_grid(self, reach: float) -> float:
        """Return the error that the grid makes; a Gaussian has fallen to the bound on edges at `reach` deviations."""
        return self.interpolation + 0.1 * reach**2 * self.edges + self.tails

    def worst(self, other: Report) -> Report:
        """Return the total of the errors of methods, and the largest of those of grids."""
        return Report(
            self.splitting + other.splitting,
            # The error of interpolation changes its sign with the phase of a point between two others.
            float(np.hypot(self.interpolation, other.interpolation)),
            max(self.edges, other.edges),
            max(self.tails, other.tails),
            max(self.negative, other.negative),
            math.hypot(self.removed, other.removed),
        )


def spline_error(tail: float, finer: float = 1.0) -> float:
    """Return the error of splines in the moments of a Gaussian whose spectrum has a tail, on a `finer` grid: 1e-4 / s^6.

    s is the standard deviation in spacings of the finer grid.
    """
    return 1e-4 / (-2 * finer**2 * math.log(min(max(tail, 1e-15), 0.9)) / math.pi**2) ** 3


def grid_report(found: Survey, finer: float = 1.0) -> Report:
    """Return the errors that a grid shows, whose densities were interpolated on a `finer` one."""
    edges, tails = found.edges.tolist(), found.tails.tolist()
    return Report(0.0, sum(spline_error(tail, finer) for tail in tails), max(edges), max(tails), found.negative)


def finer_field(field: Field, finer: Array, bounds: Bounds) -> Field:
    """Return the band-limited interpolant of a density on a grid over the same window, with `finer` (n,) times the points."""
    sizes = tuple(
        size if r == 1.0 else rounded_size(size * r, size, 2 * bounds.most)
        for size, r in zip(field.grid.sizes, finer, strict=True)
    )
    return Field(*refined(field.values, field.grid, sizes), field.log_scale)


NOTHING = Report(0.0, 0.0, 0.0, 0.0, 0.0)


def cut_off(values: Array, product: Array, closed: tuple[bool, ...]) -> float:
    """Return the largest of a product with a density at the border of its support, relative to the largest of all.

    It shows what the product lacks because the density is zero beyond, where its values were too small to be known.
    """
    support, inner = values.real > 0.0, np.ones(values.shape, bool)
    for d, circle in enumerate(closed):
        lines, known = np.moveaxis(inner, d, 0), np.moveaxis(support, d, 0)
        lines[1:] &= known[:-1]
        lines[:-1] &= known[1:]
        lines[0] &= known[-1] & circle
        lines[-1] &= known[0] & circle
    real = product.real
    return float(np.max(real, where=support & ~inner, initial=0.0) / np.max(real, initial=1e-300))


def refinable(tails: Array, before: Array, ratio: Array, start: Any, bounds: Bounds) -> Array:
    """Return along which axes (n,) a finer grid leaves smaller tails of the spectrum; `before` are those of the last grid.

    Small tails that the density had at the `start` need none.  `ratio` is that of the spacings of the last grid to those of this.
    """
    if tails.max() <= 3 * bounds.tail:
        return np.zeros(len(tails), bool)
    return np.asarray((tails > 3 * np.clip(start, bounds.tail, ACCEPTED * bounds.tail)) & better(tails, before, ratio, bounds))


def better(tails: Any, before: Any, ratio: Any, bounds: Bounds) -> Array:
    """Return along which axes spacings that are smaller by a ratio make the tails of the spectrum as small as they should.

    The logarithm of those of a Gaussian grows as the square of the ratio, of an analytic density as the ratio.  What a kink adds
    to the spectrum decreases as a power of the spacing, which is enough while it is `HARMFUL`; what interpolation adds does not.
    """
    logs, last = (np.log(np.clip(t, 1e-300, 0.99)) for t in (tails, before))
    return np.asarray(logs < np.maximum(ratio, 1.0) ** np.where(tails > HARMFUL * bounds.tail, 0.2, 0.5) * last)


def finer_by(grid: Grid, last: Grid) -> Array:
    """Return the ratio of the spacings of the last grid to those of a grid along each axis (n,)."""
    return np.asarray(np.linalg.norm(last.basis, axis=0) / np.linalg.norm(grid.basis, axis=0))


@kernel("float64(float64[::1], int64[::1], float64)", "float64(complex128[::1], int64[::1], float64)")
def _make_positive(values: Any, sizes: Any, edge: float) -> float:
    """Set negative and negligible values to zero, and those that are not larger than the noise.

    Returns:
        The change of the moments: the largest of the means, in deviations, and of the variances, relative to them; -1.0 where
        no value changed.
    """
    top, low = 0.0, 0.0
    for j in range(values.size):
        if values[j].real > top:
            top = values[j].real
        elif values[j].real < low:
            low = values[j].real
    least, changed, n = max(NEGLIGIBLE * top, min(-NOISE * low, edge * top)), False, sizes.size
    # Sums of the values and of those that are set to zero, times one, the index, and its square.
    whole, removed, last = np.zeros((3, n)), np.zeros((3, n)), sizes[n - 1]
    for line in range(values.size // last):
        total, first, second, gone = 0.0, 0.0, 0.0, 0.0
        for i in range(last):
            j, z = line * last + i, float(i - last // 2)
            value = values[j].real
            total += value
            first += value * z
            second += value * z * z
            if not value > least and values[j] != 0.0:
                gone += value
                removed[1, n - 1] += value * z
                removed[2, n - 1] += value * z * z
                values[j] = 0.0
                changed = True
        whole[0, n - 1] += total
        whole[1, n - 1] += first
        whole[2, n - 1] += second
        removed[0, n - 1] += gone
        rest = line
        for d in range(n - 2, -1, -1):
            z = float(rest % sizes[d] - sizes[d] // 2)
            rest //= sizes[d]
            for k in range(3):
                whole[k, d] += total * z**k
                removed[k, d] += gone * z**k
    if not changed:
        return -1.0
    change = 0.0
    for d in range(n):
        before, after = whole[:, d] / whole[0, d], (whole[:, d] - removed[:, d]) / (whole[0, d] - removed[0, d])
        variance = max(before[2] - before[1] ** 2, 1e-12)
        change = max(change, abs(after[1] - before[1]) / math.sqrt(variance))
        change = max(change, abs((after[2] - after[1] ** 2) / variance - 1.0))
    return change


def positive(field: Field, bounds: Bounds) -> Field:
    """Return the density without negative values, those of denormal size, and the noise of interpolation.

    The noise is what is not larger than a few times the most negative value, and not larger than the bound on edges.  What that
    changes is `removed`.
    """
    values = np.array(field.values, order="C")
    changed = _make_positive(values.reshape(-1), field.grid.shape, 0.0 if bounds.band_limited else bounds.edge)
    if changed < 0.0:
        return field
    found = field._replace(values=values)
    found.removed = changed
    return found


def extrapolated(fine: Array, coarse: Array, log_ratio: Any) -> tuple[Array, float]:
    """Return fine (fine / coarse)^(1/3), the extrapolation of an error of order two, and the relative difference."""
    coarse = coarse * np.exp(log_ratio)
    difference = float(np.abs(fine.real - coarse.real).sum() / np.abs(fine.real).sum())
    good = (fine.real > 0) & (coarse.real > 0.2 * fine.real) & (coarse.real < 5.0 * fine.real)
    ratio = np.where(good, fine, 1.0) / np.where(good, coarse, 1.0)
    return np.where(fine.real > 0, fine * np.exp(np.log(ratio) / 3), 0.0), difference


def moments_difference(fine: Array, coarse: Array, grid: Grid) -> float:
    """Return the largest difference of two densities on a grid: of means in deviations, and of variances, relative to them."""
    # Rounding far from the mean has a large variance.
    one, two = (survey(np.where(u.real > 1e-12 * u.real.max(), u.real, 0.0), grid) for u in (fine, coarse))
    variances = np.maximum(np.diagonal(one.cov), 1e-6 * np.diagonal(grid.basis @ grid.basis.T))
    means = np.abs(one.mean - two.mean) / np.sqrt(variances)
    return float(max(means.max(), (np.abs(np.diagonal(one.cov - two.cov)) / variances).max()))
