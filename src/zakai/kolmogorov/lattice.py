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

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy.special import erfc

from zakai import _float64  # noqa: F401
from zakai.kolmogorov.flow import Array, Flow, motion

REACH = 8.5  # standard deviations after which a Gaussian is zero in double precision
FAR = 12.0  # how far `move_dense` looks around the source: an observation may contradict it
SUPPORT = 36.0  # a point whose logarithm is lower than the maximum's by more than this does not matter

SUMMED = 1.0 / 0.75**2  # variance, in cells, from which a Gaussian may be summed on a lattice
CUT = 1e-13  # what rounding leaves of a sharpened density
_AT_ONCE = 2**22  # pairs of points whose kernel is held in memory at once

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


class Summary(NamedTuple):
    """Of a density on a lattice: `log_mass`, `mean` and `cov` (n,) and (n, n) of its points, the share of the mass in the two
    outermost layers of cells and beside cells that hold nothing (`edge_mass`), and where the middle of its support is, as an
    index (n,) from the centre.
    """

    log_mass: jax.Array
    mean: jax.Array
    cov: jax.Array
    edge_mass: jax.Array
    middle: jax.Array


def summary(lattice: Lattice, angles: tuple[int, ...] = ()) -> Summary:
    """One pass over the values; sums are written as products of matrices, which are vectorised where plain sums are not.

    The mean of an angle is the argument of E exp(i theta), and its deviations are wrapped.
    """
    logs = lattice.log_values
    top = jnp.max(logs)
    values = jnp.exp(logs - top)
    index = _indices(lattice.sizes).reshape(-1, logs.ndim)
    columns = np.concatenate([np.ones((len(index), 1)), index], axis=1)
    total, *first = values.ravel() @ columns
    used = (logs > top - SUPPORT).astype(float).ravel() @ columns
    closed = closed_axes(lattice, angles)
    outer = jnp.zeros(())
    for axis in range(logs.ndim):
        two = jnp.sum(lax.slice_in_dim(values, 0, min(2, lattice.sizes[axis]), axis=axis))
        two = two + jnp.sum(lax.slice_in_dim(values, max(lattice.sizes[axis] - 2, 0), None, axis=axis))
        if lattice.sizes[axis] < 4:  # a point mass has no edge
            continue
        outer = outer + (jnp.where(closed[axis], 0.0, two) if angles else two)
    if logs.ndim > 1 or angles:
        outer = outer + _beside_nothing(values)
    mean = jnp.stack(first) / total
    if angles:
        mean, cov = _wrapped_moments(lattice, values / total, angles)
    else:
        # Deviations are taken from the mean before they are squared: no difference of large numbers.
        weighted = (values.ravel()[:, None] * (index - mean)) / total
        cov = lattice.basis @ (weighted.T @ (index - mean)) @ lattice.basis.T
        mean = lattice.centre + lattice.basis @ mean
    return Summary(top + jnp.log(total) + lattice.log_volume(), mean, cov, outer / total, used[1:] / used[0])


def _beside_nothing(values: jax.Array) -> jax.Array:
    """The mass in cells that have a neighbour without any: where tails were cut, it must not matter."""
    beside = jnp.zeros(values.shape, bool)
    for axis in range(values.ndim):
        inner = [slice(1, -1) if a == axis else slice(None) for a in range(values.ndim)]
        left = lax.slice_in_dim(values, 0, values.shape[axis] - 2, axis=axis) == 0
        right = lax.slice_in_dim(values, 2, values.shape[axis], axis=axis) == 0
        if values.shape[axis] > 3:
            beside = beside.at[tuple(inner)].max(left | right)
    return jnp.sum(jnp.where(beside, values, 0.0))


def _wrapped_moments(lattice: Lattice, weights: jax.Array, angles: tuple[int, ...]) -> tuple[jax.Array, jax.Array]:
    points = lattice.points().reshape(-1, weights.ndim)
    weights = weights.ravel()
    at = jnp.array(angles)
    circular = jnp.arctan2(weights @ jnp.sin(points[:, at]), weights @ jnp.cos(points[:, at]))
    # Of an angle that could be anything, rounding would make up a direction.
    undirected = weights @ jnp.cos(points[:, at] - circular) < 1e-9
    mean = (weights @ points).at[at].set(jnp.where(undirected, 0.0, circular))
    deviation = points - mean
    deviation = deviation.at[:, at].set(jnp.pi - jnp.mod(jnp.pi - deviation[:, at], 2 * jnp.pi))
    return mean, (weights[:, None] * deviation).T @ deviation


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


def closed_axes(lattice: Lattice, angles: tuple[int, ...]) -> jax.Array:
    """Which axes (n,) go once around the circle; axis d belongs to the state `angles[d]`, if there is one."""
    turns = jnp.array([lattice.basis[i, d] * lattice.sizes[d] for d, i in enumerate(angles)])
    closed = jnp.abs(jnp.abs(turns) - 2 * jnp.pi) < 1e-9
    return jnp.concatenate([closed, jnp.zeros(len(lattice.sizes) - len(angles), bool)])


def exponent_range(log_values: jax.Array, gauged: jax.Array) -> jax.Array:
    """How far below the largest gauged value the density's own maximum lies; beyond 600 it would be lost."""
    at = jnp.argmax(log_values.ravel())
    return jnp.max(gauged) - gauged.ravel()[at]


def slid(values: jax.Array, shift: jax.Array, fill: float) -> jax.Array:
    """Values (size,) on a window that moved by `shift` cells; what comes in is `fill`."""
    size = values.shape[0]
    padded = jnp.pad(values, size // 4, constant_values=fill)
    return lax.dynamic_slice(padded, (size // 4 + shift,), (size,))


def move_banded(
    lattice: Lattice, before: jax.Array, flow: Flow, inputs: Array, taps: int
) -> tuple[Lattice, jax.Array]:
    """One interval for one state by a filter of 2 `taps` + 1 cells, which must reach `REACH` kernel deviations.

    `before` (size,) is the logarithm that multiplies the density at the start. Also given is the logarithm of what was only
    spread, up to a constant: `reach` needs it.
    """
    gauged = lattice.log_values + before
    top = jnp.max(gauged)
    size = gauged.shape[0]
    cell = lattice.basis[0, 0]
    variance = flow.spread[0, 0]
    weights = jnp.exp(-0.5 * (jnp.arange(taps + 1) * cell) ** 2 / variance)
    values = jnp.exp(gauged - top)
    if taps <= 48:  # a sum of shifted slices becomes one fused, vectorised loop
        padded = jnp.pad(values, taps)
        total = values
        for j in range(1, taps + 1):
            pair = lax.slice(padded, (taps - j,), (taps - j + size,)) + lax.slice(padded, (taps + j,), (taps + j + size,))
            total = total + weights[j] * pair
    else:
        both = jnp.concatenate([weights[:0:-1], weights])
        total = jnp.maximum(jnp.convolve(values, both, mode="full")[taps : taps + size], 0.0)
    moved = motion(flow, lattice.centre, inputs)
    offset = cell * _indices((size,))[:, 0]
    spread = jnp.log(total)
    logs = (
        top
        + spread
        + 0.5 * jnp.log(cell**2 / (2 * jnp.pi * variance))
        + moved.log_mass
        + offset * (moved.tilt[0] + offset * flow.bend[0, 0])
    )
    return Lattice(logs, moved.centre, flow.map @ lattice.basis), spread


def reach(lattice: Lattice, spread: jax.Array) -> jax.Array:
    """How deep in the tails of what was only spread, in units of the logarithm, the mass lies now, on average."""
    values = jnp.exp(lattice.log_values - jnp.max(lattice.log_values))
    depth = jnp.where(values > 0, jnp.max(spread) - spread, 0.0)
    return (depth.ravel() @ values.ravel()) / jnp.sum(values)


def move_dense(
    lattice: Lattice,
    before: jax.Array,
    flow: Flow,
    inputs: Array,
    after: LogFunction,
    sizes: tuple[int, ...],
    angles: tuple[int, ...] = (),
    images: int = 0,
    sharpen: bool = False,
) -> tuple[Lattice, jax.Array, jax.Array]:
    """One interval for one or two states by sums over all pairs of points, onto a new lattice of `sizes`.

    `after(x)` is the logarithm that multiplies the density at the end; where it leaves mass decides the second lattice. Also
    given is how much coarser the first was, along each axis (n,), and the logarithm of what was only spread, for `reach`.
    `angles` names the states that axes 0, 1, ... of the lattice are angles of; `images` is how many turns beyond the
    nearest the kernel reaches.  Axis 0 of the lattice must then be parallel to the angle, and stays so.

    A kernel narrower than a cell cannot be summed.  With `sharpen`, a Gaussian of about a cell is taken out of the density, by a
    Fourier transform on the lattice, and added to the kernel: exact for a density that the lattice resolves, but rounding then
    leaves nothing of the tails below 1e-13 of the maximum.
    """
    n = len(sizes)
    gauged = lattice.log_values + before
    top = jnp.max(gauged)
    values = jnp.exp(gauged - top)
    covariance = flow.spread
    if sharpen:
        extra = added_variance(lattice, flow)
        values = _sharpened(values, extra)
        covariance = covariance + lattice.basis * extra @ lattice.basis.T
    # Whitened coordinates z = R i in which the kernel is a standard Gaussian and the source lattice is triangular.
    factor = jnp.linalg.cholesky(covariance)
    frame, triangle = jnp.linalg.qr(jax.scipy.linalg.solve_triangular(factor, lattice.basis, lower=True))
    signs = jnp.where(jnp.diag(triangle) < 0, -1.0, 1.0)
    frame, triangle = frame * signs, triangle * signs[:, None]
    source = _indices(lattice.sizes) @ triangle.T
    moved = motion(flow, lattice.centre, inputs)
    to_offset = factor @ frame
    log_scale = top + jnp.linalg.slogdet(triangle)[1] - 0.5 * n * np.log(2 * np.pi) + moved.log_mass
    turns = [triangle @ jnp.linalg.solve(lattice.basis, 2 * jnp.pi * jnp.eye(n)[i]) for i in angles]
    # A turn of the first angle is along the first axis and is wrapped there; one of a second angle moves both coordinates.
    turn = turns[0][0] if turns else None
    shifts = [k * turns[1] for k in range(-images - 1, images + 2)] if len(turns) > 1 else [jnp.zeros(n)]

    def axes(low, spacing):
        return [low[d] + spacing[d] * jnp.arange(sizes[d]) for d in range(n)]

    def evaluate(low, spacing):
        """The logarithm of the density, everything included, on the target lattice of whitened coordinates."""
        target = axes(low, spacing)
        total = sum(_sum_axes(target, source, triangle, values, shift, turn, images) for shift in shifts)
        if sharpen:
            total = jnp.where(total > CUT * jnp.max(total), total, 0.0)
        offset = jnp.stack(jnp.meshgrid(*target, indexing="ij"), axis=-1) @ to_offset.T
        exponent = offset @ moved.tilt + jnp.einsum("...i,ij,...j->...", offset, flow.bend, offset)
        logs = log_scale + jnp.log(total) + exponent
        return logs + after(moved.centre + offset @ flow.map.T), jnp.log(total)

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
    logs, _ = evaluate(low, coarse)
    if angles:  # cut the circle opposite to the maximum
        peak = jnp.unravel_index(jnp.argmax(logs), logs.shape)[0]
        roll = jnp.where(closed[0], peak - sizes[0] // 2, 0)
        logs = jnp.roll(logs, -roll, axis=0)
        low = low.at[0].add(roll * coarse[0])
    used = logs > jnp.max(logs) - SUPPORT
    low, high = _box(used, low, coarse, closed)
    low, high, closed = limited(low, high)
    low, fine = lattice_over(low, high, closed)
    logs, spread = evaluate(low, fine)
    half = low + fine * (jnp.array(sizes) // 2)
    basis = flow.map @ to_offset * fine
    target = Lattice(logs, moved.centre + flow.map @ to_offset @ half, basis)
    return target, coarse / fine, spread


def added_variance(lattice: Lattice, flow: Flow) -> jax.Array:
    """The variances (n,), in cells, that make the kernel wide enough to be summed; zero where it is."""
    kernel = jnp.sum(lattice.basis * (inverse(flow.spread) @ lattice.basis), axis=0)
    return jnp.maximum(0.0, SUMMED - 1.0 / kernel)


def _sharpened(values: jax.Array, variances: jax.Array) -> jax.Array:
    """Values on a lattice with Gaussians of these variances, in cells, taken out.

    Frequencies above 0.8 of the highest, in which a density that the lattice resolves has nothing, are taken out too: the
    sum that follows would fold their rounding errors back and let them grow from step to step.
    """
    factor = jnp.ones(())
    for axis, size in enumerate(values.shape):
        share = 2 * (np.fft.rfftfreq(size) if axis == values.ndim - 1 else np.fft.fftfreq(size))
        passed = 0.5 * erfc((np.abs(share) - 0.8) / 0.04)
        view = [-1 if a == axis else 1 for a in range(values.ndim)]
        symbol = jnp.where(variances[axis] > 0, passed, 1.0) * jnp.exp(0.5 * variances[axis] * (np.pi * share) ** 2)
        factor = factor * symbol.reshape(view)
    return jnp.fft.irfftn(jnp.fft.rfftn(values) * factor, values.shape)


def _sum_axes(target, source, triangle, values, shift, turn, images):
    """sum_i exp(-|z' - R i - shift|^2 / 2) values_i, one axis after the other; R is upper triangular."""

    def kernel(distance):
        if turn is None:
            return jnp.exp(-0.5 * distance**2)
        nearest = distance - turn * jnp.rint(distance / turn)
        return sum(jnp.exp(-0.5 * (nearest + k * turn) ** 2) for k in range(-images, images + 1))

    first = target[0] - shift[0]
    if values.ndim == 1:
        return kernel(first[:, None] - source[:, 0]) @ values
    across = source[..., 0].T
    if first.size * values.size <= _AT_ONCE:
        # A kernel matrix for each row of the source, laid out so that exp runs over contiguous numbers.
        total = jnp.einsum("kji,ik->jk", kernel(first[None, :, None] - across[:, None, :]), values)
    else:
        total = lax.map(lambda row: kernel(first[:, None] - row[0]) @ row[1], (across, values.T)).T
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
