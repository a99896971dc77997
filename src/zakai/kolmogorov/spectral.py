"""exp(t L_0) on a lattice of function values, by sinc collocation and a Taylor polynomial.

    L_0 u = d.(G d u / 2 - f u) - V u,         V = h'S^-1 h / 2

A smooth density that the lattice resolves is band-limited, and its derivatives are those of its sinc interpolant, accurate to
rounding.  On the lattice L_0 is a matrix of bounded size; exp(tau L_0) is its Taylor polynomial, with tau so short that the
polynomial is stable.  The axes are parallel to the coordinates, so that a derivative or a new lattice is a product with a matrix
for each axis.

Rounding leaves nothing of the tails below 1e-14 of the maximum, which are set to zero.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from zakai import _float64  # noqa: F401
from zakai.kolmogorov.resolution import along

DEGREE = 20  # of the Taylor polynomial
STABLE = 6.0  # largest tau |L_0| for which it is stable, with something to spare
LOST = 1e-14  # of the maximum: what rounding leaves
NOISE = 5.0  # below what multiple of its most negative value a density is cut
SUPPORT = 1e-12  # of the maximum: what a window holds
FILLED = 0.84  # share of an axis that the support takes on a new lattice
_LEAST, _MOST = 0.70, 0.90  # shares between which a lattice is kept


class Field(NamedTuple):
    """`values` (*sizes) at `low` (n,) + `cell` (n,) * index."""

    values: Any
    low: Any
    cell: Any

    def points(self) -> jax.Array:
        """The points (*sizes, n)."""
        axes = [self.low[d] + self.cell[d] * np.arange(size) for d, size in enumerate(self.values.shape)]
        return jnp.stack(jnp.meshgrid(*axes, indexing="ij"), axis=-1)


class Generator(NamedTuple):
    """L_0 at the points of a lattice: `covariance` G (n, n), and for each point `drift` n arrays and `potential` V."""

    covariance: Any
    drift: Sequence[Any]
    potential: Any

    def apply(self, values: jax.Array, cell: jax.Array) -> jax.Array:
        """L_0 u."""
        n = values.ndim
        slopes = [along(_derivative(values.shape[d]), values, d) / cell[d] for d in range(n)]
        result = -self.potential * values
        for i in range(n):
            flux = 0.5 * sum(self.covariance[i, j] * slopes[j] for j in range(n)) - self.drift[i] * values
            result = result + along(_derivative(values.shape[i]), flux, i) / cell[i]
        return result

    def size(self, cell: jax.Array) -> jax.Array:
        """A bound of |L_0| on the lattice."""
        highest = np.pi / cell
        diffusion = 0.5 * highest @ jnp.abs(self.covariance) @ highest
        transport = sum(jnp.max(jnp.abs(f)) * highest[i] for i, f in enumerate(self.drift))
        return diffusion + transport + jnp.max(jnp.abs(self.potential))


def _derivative(size: int) -> np.ndarray:
    """The derivative of the sinc interpolant at the points, in cells."""
    distance = np.arange(size)[:, None] - np.arange(size)
    return np.where(distance == 0, 0.0, (1.0 - 2.0 * (distance % 2)) / np.where(distance == 0, 1, distance))


def exponential(generator: Generator, field: Field, tau: jax.Array) -> Field:
    """exp(tau L_0) u; tau times the size of L_0 must not exceed `STABLE`."""

    def add(carry: Any, k: jax.Array) -> tuple[Any, None]:
        term, total = carry
        term = tau / k * generator.apply(term, field.cell)
        return (term, total + term), None

    (_, total), _ = lax.scan(add, (field.values, field.values), jnp.arange(1.0, DEGREE + 1))
    return field._replace(values=total)


def cleaned(field: Field) -> tuple[Field, jax.Array, jax.Array]:
    """The field without its tails below the noise, with a maximum of one; the logarithm of what that was; and the noise.

    What is negative is noise.  If noise were taken for tails, the lattice would grow to hold it, become coarser and make more.
    """
    top = lax.stop_gradient(jnp.max(field.values))
    values = field.values / top
    noise = lax.stop_gradient(jnp.maximum(LOST, -NOISE * jnp.min(values)))
    return field._replace(values=jnp.where(values < noise, 0.0, values)), jnp.log(top), noise


def fitted(field: Field) -> Field:
    """The field on a lattice of the same size that fits its support: on its own where that does."""
    values = lax.stop_gradient(field.values)
    matters = values > SUPPORT * jnp.max(values)
    first, last = [], []
    for d, size in enumerate(values.shape):
        line = jnp.any(matters, axis=tuple(a for a in range(values.ndim) if a != d))
        first.append(jnp.argmax(line))
        last.append(size - 1 - jnp.argmax(line[::-1]))
    sizes, begin, end = np.array(values.shape), jnp.stack(first), jnp.stack(last)
    taken = (end - begin + 1) / sizes
    least = 0.5 * (1 - _MOST) * sizes
    good = jnp.all((begin >= least) & (sizes - 1 - end >= least) & (taken >= _LEAST))
    old_low, old_cell = lax.stop_gradient((field.low, field.cell))
    cell = old_cell * jnp.maximum(taken, 4 / sizes) / FILLED
    low = old_low + old_cell * 0.5 * (begin + end) - cell * 0.5 * (sizes - 1)
    return lax.cond(good, lambda: field, lambda: resampled(field, low, cell))


def resampled(field: Field, low: Any, cell: Any) -> Field:
    """The sinc interpolant of the field at the points of another lattice of the same size."""
    values = field.values
    for d, size in enumerate(values.shape):
        at = (low[d] + cell[d] * np.arange(size) - field.low[d]) / field.cell[d]
        values = along(jnp.sinc(at[:, None] - np.arange(size)), values, d)
    return Field(values, jnp.asarray(low), jnp.asarray(cell))


def moments(field: Field) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The logarithm of the mass, the mean (n,) and the covariance (n, n)."""
    values, n = field.values, field.values.ndim
    total = jnp.sum(values)
    axes = [field.cell[d] * np.arange(size) for d, size in enumerate(values.shape)]

    def expected(columns: dict[int, jax.Array]) -> jax.Array:
        rest = values
        for d in reversed(range(n)):
            rest = jnp.tensordot(rest, columns.get(d, jnp.ones(values.shape[d])), axes=([d], [0]))
        return rest / total

    mean = jnp.stack([expected({d: axes[d]}) for d in range(n)])
    apart = [axes[d] - mean[d] for d in range(n)]
    cov = [[expected({i: apart[i] ** 2} if i == j else {i: apart[i], j: apart[j]}) for j in range(n)] for i in range(n)]
    log_mass = jnp.log(total) + jnp.sum(jnp.log(field.cell))
    return log_mass, field.low + mean, jnp.stack([jnp.stack(row) for row in cov])


def laid_around(log_values: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray, sizes: Sequence[int]) -> Field:
    """A function on a lattice whose support, from `low` to `high` (n,), takes the usual share; the largest value is one."""
    size = np.array(sizes)
    cell = (high - low) / (FILLED * size)
    field = Field(np.zeros(tuple(sizes)), 0.5 * (low + high) - 0.5 * cell * (size - 1), cell)
    logs = log_values(np.asarray(field.points()))
    return field._replace(values=np.exp(logs - logs.max()))
