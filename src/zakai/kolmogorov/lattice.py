"""A density on a lattice, moved exactly by the affine Hamiltonian flow.

A lattice holds the logarithm of a density at x = centre + basis i.  One interval is equation (2) of `flow`: a Gaussian
convolution, an affine map, a quadratic exponent.  Two ways to convolve, both sums of positive terms and so accurate to
rounding in the tails too:

* `move_banded` (one state): the lattice moves along the flow, so the convolution is a short filter with the same taps at
  every point; the window slides by whole cells to stay over the mass.
* `move_dense` (one or two states): the target lattice is chosen anew each time, first over everything that the density can
  reach and then, a second time, over what the observation has left of it.  Angles are wrapped by adding the images of the
  source.  For two states the kernel is whitened, the source lattice made triangular, and the sum is done axis by axis.

A sum over a lattice replaces an integral with an error of 2 exp(-2 pi^2 s^2), s the standard deviation of the narrowest
feature in cells; `features` measures it and the filters watch it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from zakai import _float64  # noqa: F401
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from zakai.kolmogorov.flow import Flow, motion

REACH = 8.5  # standard deviations after which a Gaussian is zero in double precision
FAR = 12.0  # how far `move_dense` looks around the source: an observation may contradict it
SUPPORT = 36.0  # a point whose logarithm is lower than the maximum's by more than this does not matter

LogFunction = Callable[[jax.Array], jax.Array]


class Lattice(NamedTuple):
    """The logarithm of a density, `log_values` (sizes), at `centre` (n,) + `basis` (n, n) (index - sizes // 2)."""

    log_values: jax.Array
    centre: jax.Array
    basis: jax.Array

    @property
    def sizes(self) -> tuple[int, ...]:
        return self.log_values.shape

    def points(self) -> jax.Array:
        """The points (*sizes, n)."""
        return self.centre + _indices(self.sizes) @ self.basis.T

    def log_volume(self) -> jax.Array:
        """The logarithm of the volume of a cell."""
        return jnp.log(jnp.abs(determinant(self.basis)))


class Moved(NamedTuple):
    """A lattice after one interval, with the largest exponent range of its gauge and how finely the first look was."""

    lattice: Lattice
    exponent: jax.Array
    first_look: jax.Array


def determinant(matrix: jax.Array) -> jax.Array:
    """The determinant, written out for one and two states: a call into LAPACK would cost more than the rest of a step."""
    if matrix.shape[0] == 1:
        return matrix[0, 0]
    if matrix.shape[0] == 2:
        return matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    return jnp.linalg.det(matrix)


def inverse(matrix: jax.Array) -> jax.Array:
    """The inverse, written out for one and two states."""
    if matrix.shape[0] == 1:
        return 1.0 / matrix
    if matrix.shape[0] == 2:
        (a, b), (c, d) = matrix
        return jnp.array([[d, -b], [-c, a]]) / determinant(matrix)
    return jnp.linalg.inv(matrix)


def _indices(sizes: tuple[int, ...]) -> np.ndarray:
    axes = [np.arange(size) - size // 2 for size in sizes]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(float)


def log_mass(lattice: Lattice) -> jax.Array:
    """The logarithm of the integral of the density."""
    top = jnp.max(lattice.log_values)
    return top + jnp.log(jnp.sum(jnp.exp(lattice.log_values - top))) + lattice.log_volume()


def features(lattice: Lattice) -> jax.Array:
    """The standard deviation, in cells, of the narrowest feature along each axis (n,), where the density matters."""
    logs = lattice.log_values
    matters = logs > jnp.max(logs) - 14.0
    cells = []
    for axis in range(logs.ndim):
        middle = lax.slice_in_dim(logs, 1, -1, axis=axis)
        left = lax.slice_in_dim(logs, 0, -2, axis=axis)
        right = lax.slice_in_dim(logs, 2, None, axis=axis)
        curvature = 2.0 * middle - left - right
        used = lax.slice_in_dim(matters, 1, -1, axis=axis) & jnp.isfinite(curvature)
        cells.append(lax.rsqrt(jnp.maximum(jnp.max(jnp.where(used, curvature, 0.0)), 1e-12)))
    return jnp.stack(cells)


def edge_mass(lattice: Lattice, closed: jax.Array | None = None) -> jax.Array:
    """The share of the mass in the two outermost layers of cells, those of closed axes (n,) left out."""
    values = jnp.exp(lattice.log_values - jnp.max(lattice.log_values))
    total = 0.0
    for axis in range(values.ndim):
        outer = jnp.sum(lax.slice_in_dim(values, 0, 2, axis=axis)) + jnp.sum(
            lax.slice_in_dim(values, -2, None, axis=axis)
        )
        total = total + (outer if closed is None else jnp.where(closed[axis], 0.0, outer))
    return total / jnp.sum(values)


def closed_axes(lattice: Lattice, angles: tuple[int, ...]) -> jax.Array:
    """Which axes (n,) go once around the circle; axis d belongs to the state `angles[d]`, if there is one."""
    turns = jnp.array([lattice.basis[i, d] * lattice.sizes[d] for d, i in enumerate(angles)])
    closed = jnp.abs(jnp.abs(turns) - 2 * jnp.pi) < 1e-9
    return jnp.concatenate([closed, jnp.zeros(len(lattice.sizes) - len(angles), bool)])


def _exponent_range(log_values: jax.Array, gauged: jax.Array) -> jax.Array:
    """How far below the largest gauged value the density's own maximum lies; beyond 600 it would be lost."""
    at = jnp.argmax(log_values.ravel())
    return jnp.max(gauged) - gauged.ravel()[at]


def recentred(lattice: Lattice) -> Lattice:
    """The same density with its window slid, by whole cells, so that the mass is in the middle; one state."""
    logs = lattice.log_values
    size = logs.shape[0]
    used = logs > jnp.max(logs) - SUPPORT
    first, last = jnp.argmax(used), size - 1 - jnp.argmax(used[::-1])
    shift = jnp.clip((first + last) // 2 - size // 2, -(size // 4), size // 4)
    padded = jnp.pad(logs, size // 4, constant_values=-jnp.inf)
    moved = lax.dynamic_slice(padded, (size // 4 + shift,), (size,))
    return Lattice(moved, lattice.centre + lattice.basis[:, 0] * shift, lattice.basis)


def move_banded(
    lattice: Lattice, before: jax.Array, flow: Flow, inputs: jax.Array, after: LogFunction, taps: int
) -> Moved:
    """One interval for one state by a filter of 2 `taps` + 1 cells, which must reach `REACH` kernel deviations.

    `before` (size,) is the logarithm that multiplies the density at the start, `after(x)` that at the end.
    """
    gauged = lattice.log_values + before
    top = jnp.max(gauged)
    size = gauged.shape[0]
    cell = lattice.basis[0, 0]
    variance = flow.spread[0, 0]
    weights = lax.optimization_barrier(jnp.exp(-0.5 * (jnp.arange(-taps, taps + 1) * cell) ** 2 / variance))
    values = jnp.exp(gauged - top)
    if taps <= 40:  # a sum of shifted slices becomes one fused, vectorised loop
        padded = lax.optimization_barrier(jnp.pad(values, taps))
        total = sum(weights[j] * lax.slice(padded, (j,), (j + size,)) for j in range(2 * taps + 1))
        total = lax.optimization_barrier(total)
    else:
        total = jnp.maximum(jnp.convolve(values, weights, mode="full")[taps : taps + size], 0.0)
    moved = motion(flow, lattice.centre, inputs)
    offset = cell * _indices((size,))[:, 0]
    logs = (
        top
        + jnp.log(total)
        + 0.5 * jnp.log(cell**2 / (2 * jnp.pi * variance))
        + moved.log_mass
        + offset * (moved.tilt[0] + offset * flow.bend[0, 0])
    )
    target = Lattice(logs, moved.centre, flow.map @ lattice.basis)
    target = target._replace(log_values=logs + after(target.points()))
    return Moved(target, _exponent_range(lattice.log_values, gauged), jnp.array(1.0))


def move_dense(
    lattice: Lattice,
    before: jax.Array,
    flow: Flow,
    inputs: jax.Array,
    after: LogFunction,
    sizes: tuple[int, ...],
    angles: tuple[int, ...] = (),
    images: int = 0,
) -> Moved:
    """One interval for one or two states by sums over all pairs of points, onto a new lattice of `sizes`.

    `angles` names the states that axes 0, 1, ... of the lattice are angles of; `images` is how many turns on either side the
    kernel reaches.  Axis 0 of the lattice must then be parallel to the angle, and stays so.
    """
    n = len(sizes)
    gauged = lattice.log_values + before
    top = jnp.max(gauged)
    values = jnp.exp(gauged - top)
    # Whitened coordinates z = R i in which the kernel is a standard Gaussian and the source lattice is triangular.
    factor = jnp.linalg.cholesky(flow.spread)
    frame, triangle = jnp.linalg.qr(jax.scipy.linalg.solve_triangular(factor, lattice.basis, lower=True))
    signs = jnp.where(jnp.diag(triangle) < 0, -1.0, 1.0)
    frame, triangle = frame * signs, triangle * signs[:, None]
    source = _indices(lattice.sizes) @ triangle.T
    moved = motion(flow, lattice.centre, inputs)
    to_offset = factor @ frame
    log_scale = top + jnp.linalg.slogdet(triangle)[1] - 0.5 * n * np.log(2 * np.pi) + moved.log_mass
    turns = [triangle @ jnp.linalg.solve(lattice.basis, 2 * jnp.pi * jnp.eye(n)[i]) for i in angles]
    shifts = _image_shifts(turns, images, n)

    def axes(low, spacing):
        return [low[d] + spacing[d] * jnp.arange(sizes[d]) for d in range(n)]

    def evaluate(low, spacing):
        """The logarithm of the density, everything included, on the target lattice of whitened coordinates."""
        target = axes(low, spacing)
        total = sum(_sum_axes(target, source, triangle, values, shift) for shift in shifts)
        offset = jnp.stack(jnp.meshgrid(*target, indexing="ij"), axis=-1) @ to_offset.T
        exponent = offset @ moved.tilt + jnp.einsum("...i,ij,...j->...", offset, flow.bend, offset)
        logs = log_scale + jnp.log(total) + exponent
        return logs + after(moved.centre + offset @ flow.map.T)

    def lattice_over(low, high, closed):
        """The start and the spacing of a target lattice over [low, high], or around the whole circle."""
        spacing = jnp.where(closed, (high - low) / jnp.array(sizes), (high - low) / (jnp.array(sizes) - 1.0))
        return low, spacing

    circle = jnp.array([turns[d][d] if d < len(turns) else jnp.inf for d in range(n)])

    def limited(low, high):
        closed = high - low >= circle
        middle = 0.5 * (low + high)
        return (
            jnp.where(closed, middle - 0.5 * circle, low),
            jnp.where(closed, middle + 0.5 * circle, high),
            closed,
        )

    reached = gauged > top - SUPPORT
    low = jnp.stack([jnp.min(jnp.where(reached, source[..., d], jnp.inf)) for d in range(n)]) - FAR
    high = jnp.stack([jnp.max(jnp.where(reached, source[..., d], -jnp.inf)) for d in range(n)]) + FAR
    low, high, closed = limited(low, high)
    low, coarse = lattice_over(low, high, closed)
    logs = evaluate(low, coarse)
    if angles:  # cut the circle opposite to the maximum
        peak = jnp.unravel_index(jnp.argmax(logs), logs.shape)[0]
        roll = jnp.where(closed[0], peak - sizes[0] // 2, 0)
        logs = jnp.roll(logs, -roll, axis=0)
        low = low.at[0].add(roll * coarse[0])
    used = logs > jnp.max(logs) - SUPPORT
    low, high = _box(used, low, coarse, closed)
    low, high, closed = limited(low, high)
    low, fine = lattice_over(low, high, closed)
    logs = evaluate(low, fine)
    half = low + fine * (jnp.array(sizes) // 2)
    basis = flow.map @ to_offset * fine
    target = Lattice(logs, moved.centre + flow.map @ to_offset @ half, basis)
    first_look = jnp.max(coarse / fine)
    return Moved(target, _exponent_range(lattice.log_values, gauged), first_look)


def _image_shifts(turns: list[jax.Array], images: int, n: int) -> list[jax.Array]:
    shifts = [jnp.zeros(n)]
    for turn in turns:
        shifts = [shift + k * turn for shift in shifts for k in range(-images, images + 1)]
    return shifts


def _sum_axes(target, source, triangle, values, shift):
    """sum_i exp(-|z' - R i - shift|^2 / 2) values_i, one axis after the other; R is upper triangular."""
    if values.ndim == 1:
        return jnp.exp(-0.5 * (target[0][:, None] - shift[0] - source[:, 0]) ** 2) @ values
    # A kernel matrix for each row of the source, laid out so that exp runs over contiguous numbers.
    across = jnp.swapaxes(source[..., 0], 0, 1)[:, None, :]
    kernels = jnp.exp(-0.5 * (target[0][None, :, None] - shift[0] - across) ** 2)
    total = jnp.einsum("kji,ik->jk", kernels, values)
    size = values.shape[1]
    rows = (jnp.arange(size) - size // 2) * triangle[1, 1] + shift[1]
    return total @ jnp.exp(-0.5 * (target[1][:, None] - rows) ** 2).T


def _box(used, low, spacing, closed):
    """The corners of the box around the points in `used`, two cells wider on every side."""
    lows, highs = [], []
    for d in range(used.ndim):
        line = jnp.any(used, axis=tuple(a for a in range(used.ndim) if a != d))
        size = line.shape[0]
        first, last = jnp.argmax(line) - 2.0, size + 1.0 - jnp.argmax(line[::-1])
        # On a circle whose ends are both in use there is nothing to cut off.
        whole = closed[d] & (first <= 0) & (last >= size - 1)
        lows.append(low[d] + spacing[d] * jnp.where(whole, 0.0, first))
        highs.append(low[d] + spacing[d] * jnp.where(whole, float(size), last))
    return jnp.stack(lows), jnp.stack(highs)
