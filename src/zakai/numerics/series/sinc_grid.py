"""exp(t L_0) on a uniform grid of function values, by sinc collocation and a Taylor polynomial.

    L_0 u = d.(G d u / 2 - f u) - V u

A smooth density that the grid resolves is band-limited, and its derivatives are those of its sinc interpolant, accurate to
rounding.  On the grid L_0 is a matrix of bounded size; exp(tau L_0) is its Taylor polynomial, with tau so short that the
polynomial is stable.  The axes are parallel to the coordinates, so that a derivative or a new grid is a product with one matrix
for each axis.

Rounding loses the tails below 1e-14 of the maximum, which are set to zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
DEGREE = 20  # of the Taylor polynomial
STABLE = 6.0  # largest tau |L_0| for which it is stable, with a margin
LOST = 1e-14  # of the maximum: rounding
NOISE = 5.0  # below what multiple of its most negative value a density is cut
SUPPORT = 1e-12  # of the maximum: what a grid covers
FILLED = 0.84  # share of an axis that the support takes on a new grid
_LEAST, _MOST = 0.70, 0.90  # shares between which a grid is kept
_OUTER = 1 / 48  # share of an axis on each side that counts as its edge, and at least two points


class Field(NamedTuple):
    """`values` (*sizes) at `low` (n,) + `spacing` (n,) * index."""

    values: Array
    low: Array
    spacing: Array

    @property
    def sizes(self) -> Array:
        """The points along each axis (n,)."""
        return np.array(self.values.shape)

    @property
    def points(self) -> Array:
        """The points (*sizes, n)."""
        axes = [self.low[d] + self.spacing[d] * np.arange(size) for d, size in enumerate(self.values.shape)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


class Generator(NamedTuple):
    """L_0 at the points of a grid: `covariance` G (n, n), `drift` n arrays (*sizes), and `potential` V (*sizes)."""

    covariance: Array
    drift: Sequence[Array]
    potential: Array

    def apply(self, values: Array, spacing: Array) -> Array:
        """Return L_0 u."""
        n = values.ndim
        slopes = [along(_derivative(values.shape[d]), values, d) / spacing[d] for d in range(n)]
        result = -self.potential * values
        for i in range(n):
            flux = -self.drift[i] * values
            for j in range(n):
                if self.covariance[i, j] != 0:
                    flux = flux + 0.5 * self.covariance[i, j] * slopes[j]
            result = result + along(_derivative(values.shape[i]), flux, i) / spacing[i]
        return result

    def size(self, spacing: Array) -> float:
        """Return a bound of |L_0| on the grid."""
        highest = np.pi / spacing
        diffusion = 0.5 * highest @ np.abs(self.covariance) @ highest
        transport = sum(np.max(np.abs(f)) * highest[i] for i, f in enumerate(self.drift))
        return float(diffusion + transport + np.max(np.abs(self.potential)))


def along(matrix: Array, values: Array, axis: int) -> Array:
    """Return a matrix applied to one axis of an array."""
    if axis == values.ndim - 1:
        return np.asarray(values @ matrix.T if values.ndim > 1 else matrix @ values)
    if axis == values.ndim - 2:
        return np.asarray(matrix @ values)
    # Many small products: one large product would wait for the threads of the linear algebra library.
    result = np.empty((len(matrix), *values.shape[1:]), np.result_type(matrix, values))
    np.matmul(matrix, np.swapaxes(values, 0, 1), out=np.swapaxes(result, 0, 1))
    return result


@lru_cache(maxsize=32)
def _derivative(size: int) -> Array:
    """Return the derivative of the sinc interpolant at the points, for a spacing of one."""
    distance = np.arange(size)[:, None] - np.arange(size)
    return np.where(distance == 0, 0.0, (1.0 - 2.0 * (distance % 2)) / np.where(distance == 0, 1, distance))


def exponential(generator: Generator, field: Field, tau: float) -> Field:
    """Return exp(tau L_0) u, by as many polynomials as are needed for stability."""
    parts = max(1, int(np.ceil(tau * generator.size(field.spacing) / STABLE - 1e-9)))
    total = field.values
    for _ in range(parts):
        term = total
        for k in range(1, DEGREE + 1):
            term = (tau / parts / k) * generator.apply(term, field.spacing)
            total = total + term
            if np.max(np.abs(term)) < 1e-17 * np.max(np.abs(total)):
                break
    return field._replace(values=total)


def cleaned(field: Field) -> tuple[Field, Any, float]:
    """Return the field without its tails below the noise, with a maximum of one; the logarithm of the maximum; and the noise.

    Negative values are noise.  If noise were taken for tails, the grid would grow to cover it, become coarser and make more.
    """
    top = field.values.real.max()
    values = field.values / top
    noise = max(LOST, -NOISE * float(values.real.min()))
    return field._replace(values=np.where(values.real < noise, 0.0, values)), np.log(top), noise


def fitted(field: Field, new: Array) -> Field:
    """Return the field on a grid of `new` (n,) sizes that fits its support; the same field where its own grid does."""
    real = field.values.real
    matters, sizes = real > SUPPORT * np.max(real), field.sizes
    if not matters.any():  # not a density any more
        return field
    lines = [np.flatnonzero(matters.any(axis=tuple(a for a in range(real.ndim) if a != d))) for d in range(real.ndim)]
    begin, end = (np.array([line[i] for line in lines]) for i in (0, -1))
    share, least = (end - begin + 1) / sizes, 0.5 * (1 - _MOST) * sizes
    if np.array_equal(sizes, new) and np.all((begin >= least) & (sizes - 1 - end >= least) & (share >= _LEAST)):
        return field
    spacing = field.spacing * np.maximum(share, 4 / sizes) * sizes / new / FILLED
    # Relative to the old grid, which may be far from zero.
    shift = field.spacing * 0.5 * (begin + end) - spacing * 0.5 * (new - 1)
    exact = shift - 1j * field.low.imag if np.iscomplexobj(field.low) else shift
    return resampled(field, field.low.real + shift, exact, spacing, new)


def resampled(field: Field, low: Array, shift: Array, spacing: Array, new: Array) -> Field:
    """Return the sinc interpolant of the field on a grid of `new` (n,) sizes at `low`, which is `shift` from the old one."""
    values = field.values
    for d, size in enumerate(field.values.shape):
        at = (shift[d] + spacing[d] * np.arange(new[d])) / field.spacing[d]
        values = along(np.sinc(at[:, None] - np.arange(size)), values, d)
    return Field(values, low, spacing)


class Moments(NamedTuple):
    """The logarithm of the mass, the mean (n,) and the covariance (n, n)."""

    log_mass: Any
    mean: Array
    cov: Array


def moments(field: Field) -> Moments:
    """Return the mass, the mean and the covariance of a field, without the imaginary parts of the latter two."""
    n, real = field.values.ndim, field.values.real
    total = real.sum()
    index = [np.arange(size) for size in real.shape]

    def expected(columns: dict[int, Array]) -> float:
        rest = real
        for d in reversed(range(n)):
            rest = rest @ columns[d] if d in columns else rest.sum(axis=-1)
        return float(rest / total)

    mean = np.array([expected({d: index[d]}) for d in range(n)])
    apart = [index[d] - mean[d] for d in range(n)]
    cov = [[expected({i: apart[i] ** 2} if i == j else {i: apart[i], j: apart[j]}) for j in range(n)] for i in range(n)]
    log_mass = np.log(field.values.sum()) + np.sum(np.log(field.spacing))
    return Moments(log_mass, field.low.real + field.spacing * mean, np.array(cov) * np.outer(field.spacing, field.spacing))


class Resolution(NamedTuple):
    """How much of the density is at the highest frequency of an axis, relative to its mass: `aliasing`; and `edge_mass`."""

    aliasing: float
    edge_mass: float


def resolution_of(values: Array) -> Resolution:
    """Return how well a grid resolves and covers the values (*sizes) of a density."""
    values = values.real
    aliasing = edge = 0.0
    mass = np.abs(values).sum()
    for d, size in enumerate(values.shape):
        lines = np.moveaxis(values, d, -1)
        index = np.arange(size)
        outer = np.minimum(index, index[::-1]) < max(2, int(size * _OUTER))
        aliasing = max(aliasing, float(np.abs(lines @ (1.0 - 2.0 * (index % 2))).sum() / mass))
        edge += float(np.abs(lines[..., outer]).sum() / mass)
    return Resolution(aliasing, edge)
