"""A density on a lattice, moved exactly by the affine Hamiltonian flow.

A lattice holds the logarithm of a density at x = centre + basis i.  One interval is equation (2) of `flow`: a Gaussian
convolution, an affine map, a quadratic exponent.  Two ways to convolve, both sums of positive terms and so accurate to
rounding in the tails too:

* `move_banded` (one state): the lattice moves along the flow, so the convolution is a short filter with the same taps at
  every point; the window slides by whole cells to stay over the mass.
* `move_dense` (one to three states): the target lattice is chosen anew each time, first over everything that the density can
  reach and then, a second time, over what the observation has left of it.  Angles are wrapped by adding the images of the
  source.  The kernel is whitened, the source lattice made triangular, and the sum is done axis by axis, each a product of two
  matrices.

A sum over a lattice replaces an integral with an error of 2 exp(-2 pi^2 s^2), s the standard deviation of the narrowest
feature in cells; `features` measures it and the filters watch it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

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
FUSED = 16  # taps of a filter that are added in one round
_LARGEST = 700.0  # an exponent whose exponential still exists

LogFunction = Callable[[jax.Array], jax.Array]


class Lattice(NamedTuple):
    """The logarithm of a density, `log_values` (sizes), at `centre` (n,) + `basis` (n, n) (index - sizes // 2)."""

    log_values: Array
    centre: Array
    basis: Array

    @property
    def sizes(self) -> tuple[int, ...]:
        return self.log_values.shape

    def points(self) -> jax.Array:
        """The points (*sizes, n)."""
        return self.centre + _combined(_axes(self.sizes), self.basis)

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


def _axes(sizes: tuple[int, ...]) -> list[np.ndarray]:
    """The indices along each axis, counted from the centre."""
    return [np.arange(size, dtype=float) - size // 2 for size in sizes]


def _combined(axes: Sequence[Array], matrix: jax.Array) -> jax.Array:
    """`matrix` z (*sizes, n) for all z of the product of `axes`, which is never formed."""
    n = len(axes)
    if n == 1:
        return matrix[0, 0] * jnp.asarray(axes[0])[:, None]
    views = [jnp.reshape(axis, [-1 if a == d else 1 for a in range(n)]) for d, axis in enumerate(axes)]
    return jnp.stack([sum(matrix[i, d] * views[d] for d in range(n)) for i in range(n)], axis=-1)


class Summary(NamedTuple):
    """Of a density on a lattice: `log_mass`, `mean` and `cov` (n,) and (n, n) of its points, the share of the mass in the two
    outermost layers of cells and beside cells that hold nothing (`edge_mass`), and, for one state, where the middle of its
    support is, as an index (n,) from the centre.
    """

    log_mass: jax.Array
    mean: jax.Array
    cov: jax.Array
    edge_mass: jax.Array
    middle: jax.Array


def summary(lattice: Lattice, angles: tuple[int, ...] = ()) -> Summary:
    """A pass over the values, or two; sums are written as products of matrices, which are vectorised where plain sums are not.

    The mean of an angle is the argument of E exp(i theta), and its deviations are wrapped.
    """
    logs = lattice.log_values
    n = logs.ndim
    top = lax.stop_gradient(jnp.max(logs))
    values = jnp.exp(logs - top)
    axes = _axes(lattice.sizes)
    first = _moments(values, [jnp.stack([jnp.ones(len(i)), i], axis=1) for i in axes])
    total, mean = first[(0,) * n], jnp.stack([first[_unit(n, d)] for d in range(n)])
    middle = jnp.zeros(n)
    if n == 1:
        used = (logs > top - SUPPORT).astype(float) @ np.stack([np.ones(len(logs)), axes[0]], axis=1)
        middle = used[1:] / used[0]
    closed = closed_axes(lattice, angles)
    outer = jnp.zeros(())
    for axis in range(n):
        two = jnp.sum(lax.slice_in_dim(values, 0, min(2, lattice.sizes[axis]), axis=axis))
        two = two + jnp.sum(lax.slice_in_dim(values, max(lattice.sizes[axis] - 2, 0), None, axis=axis))
        if lattice.sizes[axis] < 4:  # a point mass has no edge
            continue
        outer = outer + (jnp.where(closed[axis], 0.0, two) if angles else two)
    if n > 1 or angles:
        outer = outer + _beside_nothing(values)
    mean = mean / total
    if angles:
        mean, cov = _wrapped_moments(lattice, values / total, angles)
    else:
        # Deviations are taken from the mean before they are squared: no difference of large numbers.
        deviations = [i - mean[d] for d, i in enumerate(axes)]
        if n == 1:
            square = (_sum(values * deviations[0] ** 2) / total).reshape(1, 1)
        else:
            second = _moments(values, [jnp.stack([jnp.ones(len(i)), i, i**2], axis=1) for i in deviations]) / total
            square = jnp.stack([jnp.stack([second[_unit(n, d, e)] for e in range(n)]) for d in range(n)])
        cov = lattice.basis @ square @ lattice.basis.T
        mean = lattice.centre + lattice.basis @ mean
    return Summary(top + jnp.log(total) + lattice.log_volume(), mean, cov, outer / total, middle)


def _moments(values: jax.Array, columns: Sequence[jax.Array]) -> jax.Array:
    """sum_i values_i columns_0[i_0, a] columns_1[i_1, b] ..., an array (a, b, ...)."""
    for axis in reversed(range(values.ndim)):
        values = jnp.tensordot(values, columns[axis], axes=([axis], [0]))
    return jnp.transpose(values)


def _unit(n: int, *axes: int) -> tuple[int, ...]:
    """The powers of the axes in their product."""
    return tuple(axes.count(d) for d in range(n))


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


def features(lattice: Lattice, top: Any = None) -> jax.Array:
    """The standard deviation, in cells, of the narrowest feature along each axis (n,), where the density matters; `top` is the
    largest logarithm, if that is known."""
    logs = lattice.log_values
    matters = logs > (jnp.max(logs) if top is None else top) - 14.0
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


@jax.custom_jvp
def log(values: jax.Array) -> jax.Array:
    """The logarithm, with a gradient of zero where it is -inf."""
    return jnp.log(values)


@log.defjvp
def _log_jvp(primals, tangents):
    (values,), (tangent,) = primals, tangents
    positive = values > 0
    return jnp.log(values), jnp.where(positive, tangent / jnp.where(positive, values, 1.0), 0.0)


def _sum(values: jax.Array) -> jax.Array:
    """The sum as a product with a constant: vectorised, for many records too."""
    return values.ravel() @ np.ones(values.size)


def exponent_range(log_values: jax.Array, gauged: jax.Array) -> jax.Array:
    """How far below the largest gauged value the density's own maximum lies; beyond 600 it would be lost."""
    at = jnp.argmax(log_values.ravel())
    return jnp.max(gauged) - gauged.ravel()[at]


def slid(values: jax.Array, shift: jax.Array, fill: float) -> jax.Array:
    """Values (size,) on a window that moved by `shift` cells; what comes in is `fill`."""
    size = values.shape[0]
    padded = jnp.pad(values, size // 4, constant_values=fill)
    return lax.dynamic_slice(padded, (size // 4 + shift,), (size,))


def filtered(values: jax.Array, weights: jax.Array) -> jax.Array:
    """sum_j weights[|j|] values[i - j] over |j| <= taps, for `weights` (taps + 1,)."""
    return filtered_all((jnp.pad(values, weights.shape[0] - 1),), ((0, weights),))[0]


def filtered_all(padded: Sequence[jax.Array], filters: Sequence[tuple[int, jax.Array]]) -> list[jax.Array]:
    """`filtered` for each pair (which of the values, its weights), of one number of taps, of values `padded` with as many zeros
    on both sides.

    A sum of shifted slices becomes one fused, vectorised loop, for many records at once too, where a convolution of the
    library does not; what is positive stays so.
    """
    taps = filters[0][1].shape[0] - 1
    size = padded[0].shape[0] - 2 * taps

    def add(totals: list[jax.Array], first: Any, count: int) -> list[jax.Array]:
        for j in range(count):
            starts = taps - first - j, taps + first + j
            pairs = [[lax.dynamic_slice(each, (start,), (size,)) for start in starts] for each in padded]
            both = [left + right for left, right in pairs]
            totals = [total + weights[first + j] * both[k] for total, (k, weights) in zip(totals, filters, strict=True)]
        return totals

    # Short filters are one loop; longer ones go in rounds, which keeps the program small.
    rounds, rest = divmod(taps, FUSED) if taps > 2 * FUSED else (0, taps)
    middle = [lax.dynamic_slice(each, (taps,), (size,)) for each in padded]
    totals = add([weights[0] * middle[k] for k, weights in filters], 1, rest)
    if rounds == 0:
        return totals
    starts = 1 + rest + FUSED * jnp.arange(rounds)
    return lax.scan(lambda totals, start: (add(totals, start, FUSED), None), totals, starts)[0]


def move_banded(
    lattice: Lattice, before: jax.Array, flow: Flow, inputs: Array, taps: int
) -> tuple[Lattice, jax.Array]:
    """One interval for one state by a filter of 2 `taps` + 1 cells, which must reach `REACH` kernel deviations.

    `before` (size,) is the logarithm that multiplies the density at the start. Also given is the logarithm of what was only
    spread, up to a constant: `reach` needs it.
    """
    gauged = lattice.log_values + before
    top = lax.stop_gradient(jnp.max(gauged))
    size = gauged.shape[0]
    cell = lattice.basis[0, 0]
    variance = flow.spread[0, 0]
    weights = jnp.exp(-0.5 * (jnp.arange(taps + 1) * cell) ** 2 / variance)
    values = jnp.exp(gauged - top)
    total = filtered(values, weights)
    moved = motion(flow, lattice.centre, inputs)
    offset = cell * _axes((size,))[0]
    spread = log(total)
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
    return _sum(depth * values) / _sum(values)


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
    room: float = 2.0,
) -> tuple[Lattice, jax.Array, jax.Array, jax.Array]:
    """One interval for one to three states by sums over all pairs of points, onto a new lattice of `sizes`.

    `after(x)` is the logarithm that multiplies the density at the end; where it leaves mass decides the second lattice. Also
    given is how much coarser the first was, along each axis (n,), the logarithm of what was only spread, for `reach`, and
    how much `room` a source that is slanted against the kernel took: more than there was loses mass.
    `angles` names the states that axes 0, 1, ... of the lattice are angles of; `images` is how many turns beyond the
    nearest the kernel reaches.  Axis 0 of the lattice must then be parallel to the angle, and stays so.

    A kernel narrower than a cell cannot be summed.  With `sharpen`, a Gaussian of about a cell is taken out of the density, by a
    Fourier transform on the lattice, and added to the kernel: exact for a density that the lattice resolves, but rounding then
    leaves nothing of the tails below 1e-13 of the maximum.
    """
    n = len(sizes)
    gauged = lattice.log_values + before
    top = lax.stop_gradient(jnp.max(gauged))
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
    reached = gauged > top - SUPPORT
    source = Source(values, triangle, reached, room)
    moved = motion(flow, lattice.centre, inputs)
    to_offset = factor @ frame
    log_scale = top + jnp.linalg.slogdet(triangle)[1] - 0.5 * n * np.log(2 * np.pi) + moved.log_mass
    turns = [triangle @ jnp.linalg.solve(lattice.basis, 2 * jnp.pi * jnp.eye(n)[i]) for i in angles]
    # A turn of the first angle is along the first axis and is wrapped there; one of another moves several coordinates.
    turn = turns[0][0] if turns else None
    counts = itertools.product(range(-images - 1, images + 2), repeat=max(len(turns) - 1, 0))
    shifts = [sum((k * other for k, other in zip(count, turns[1:], strict=True)), jnp.zeros(n)) for count in counts]

    def axes(low, spacing):
        return [low[d] + spacing[d] * jnp.arange(sizes[d]) for d in range(n)]

    def evaluate(low, spacing):
        """The logarithm of the density, everything included, on the target lattice of whitened coordinates."""
        target = axes(low, spacing)
        total = sum(source.spread([z - shift[d] for d, z in enumerate(target)], turn, images) for shift in shifts)
        if sharpen:
            total = jnp.where(total > CUT * lax.stop_gradient(jnp.max(total)), total, 0.0)
        spread = log(total)
        offset = _combined(target, to_offset)
        exponent = offset @ moved.tilt + jnp.sum(offset * (offset @ flow.bend), axis=-1)
        return log_scale + spread + exponent + after(moved.centre + offset @ flow.map.T), spread

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

    low, high = source.low - FAR, source.high + FAR
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
    return target, coarse / fine, spread, source.taken


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


class Source:
    """What is spread: `values` at the points z = R i of whitened coordinates, R the upper `triangle`; `reached` marks those that
    matter, `low` and `high` (n,) is the box around them.

    The sum of exp(-|t - R i|^2 / 2) values_i over i is done axis after axis.  Along axis d a row of the source, given by the
    indices of the later axes, begins at some s.  With s = R_dd k + r, k whole,

        exp(-(t - R_dd i - s)^2 / 2) = exp(r (t - R_dd k) - r^2 / 2) exp(-(t - R_dd (i + k))^2 / 2) exp(-r R_dd i):

    rows that are shifted by whole cells, tilted, and multiplied by one matrix.  No exponential is taken of a pair of points.
    `room` is the length of the shifted rows, in sizes of the axis, and `taken` the largest that was needed.
    """

    def __init__(self, values: jax.Array, triangle: jax.Array, reached: jax.Array, room: float):
        self.values, self.triangle, self.room = values, triangle, room
        n = values.ndim
        indices = _axes(values.shape)
        self.reached = [jnp.any(reached, axis=tuple(range(d))) if d else reached for d in range(n)]
        self.rows: list[Any] = []
        lows, highs, taken = [], [], [jnp.ones(())]
        for d in range(n):
            later = indices[d + 1 :]
            begin = sum(
                (triangle[d, e] * jnp.reshape(i, [-1 if a == e else 1 for a in range(d + 1, n)])
                 for e, i in enumerate(later, d + 1)),
                jnp.zeros((1,) * (n - d - 1)),
            )  # fmt: skip
            whole = lax.stop_gradient(jnp.rint(begin / triangle[d, d]))
            begins = jnp.broadcast_to(whole, values.shape[d + 1 :])
            used = self.reached[d]
            cells = indices[d].reshape(-1, *[1] * (n - d - 1)) + begins
            first = jnp.min(jnp.where(used, cells, jnp.inf))
            last = jnp.max(jnp.where(used, cells, -jnp.inf))
            self.rows.append((begins, jnp.broadcast_to(begin, values.shape[d + 1 :]) - triangle[d, d] * begins, first, last))
            lows.append(triangle[d, d] * (first - 0.5))
            highs.append(triangle[d, d] * (last + 0.5))
            if d < n - 1:
                taken.append((last - first + 1.0) / values.shape[d])
        self.low, self.high, self.taken = jnp.stack(lows), jnp.stack(highs), jnp.max(jnp.stack(taken))
        self._first: Any = None

    def spread(self, target: Sequence[jax.Array], turn: Any = None, images: int = 0) -> jax.Array:
        """The sum at the product of the axes `target`; with a `turn`, axis 0 is wrapped."""
        n = self.values.ndim
        if turn is not None:
            total = self._wrapped(target[0], turn, images)
        else:
            if self._first is None:
                self._first = self._shifted(self.values, 0)
            total = self._matrix(0, target[0], self._first, 0)
        for d in range(1, n):
            total = self._matrix(d, target[d], self._shifted(total, d), d)
        return total

    def _shifted(self, values: jax.Array, d: int) -> Any:
        """The rows along axis d tilted and shifted by whole cells, and the cell of the first."""
        size, cell = values.shape[d], self.triangle[d, d]
        whole, rest, first, last = self.rows[d]
        index = np.arange(size) - size // 2
        if whole.ndim == 0:
            return values, float(index[0])
        tilted = values * jnp.exp(-jnp.reshape(cell * index, (-1, *[1] * rest.ndim)) * rest)
        length = int(np.ceil(self.room * size))
        origin = jnp.floor(0.5 * (first + last)) - length // 2
        at = jnp.arange(length).reshape(-1, *[1] * whole.ndim) + (origin - whole + size // 2).astype(int)
        inside = (at >= 0) & (at < size)
        at = jnp.broadcast_to(jnp.clip(at, 0, size - 1), (*values.shape[:d], *at.shape))
        return jnp.where(inside, jnp.take_along_axis(tilted, at, axis=d), 0.0), origin

    def _matrix(self, d: int, target: jax.Array, shifted: Any, axis: int) -> jax.Array:
        rows, origin = shifted
        cell = self.triangle[d, d]
        whole, rest, _, _ = self.rows[d]
        kernel = jnp.exp(-0.5 * (target[:, None] - cell * (origin + jnp.arange(rows.shape[axis]))) ** 2)
        total = jnp.moveaxis(jnp.tensordot(kernel, rows, axes=([1], [axis])), 0, axis)
        if whole.ndim == 0:
            return total
        distance = jnp.reshape(target, (-1, *[1] * rest.ndim)) - cell * whole
        return total * jnp.exp(jnp.minimum(rest * distance - 0.5 * rest**2, _LARGEST))

    def _wrapped(self, target: jax.Array, turn: jax.Array, images: int) -> jax.Array:
        """The first axis where it is an angle: the kernel of every pair of points, with its images."""

        def kernel(distance):
            nearest = distance - turn * lax.stop_gradient(jnp.rint(distance / turn))
            return sum(jnp.exp(-0.5 * (nearest + k * turn) ** 2) for k in range(-images, images + 1))

        values, cell = self.values, self.triangle[0, 0]
        index = _axes(values.shape)[0]
        whole, rest, _, _ = self.rows[0]
        begin = rest + cell * whole
        if values.ndim == 1:
            return kernel(target[:, None] - cell * index - begin) @ values
        rows, begin = values.reshape(len(index), -1), begin.ravel()
        if target.size * values.size <= _AT_ONCE:
            # A kernel matrix for each row of the source, laid out so that exp runs over contiguous numbers.
            distance = target[None, :, None] - cell * index[None, None, :] - begin[:, None, None]
            total = jnp.einsum("kji,ik->jk", kernel(distance), rows)
        else:
            total = lax.map(
                lambda row: kernel(target[:, None] - cell * index - row[0]) @ row[1], (begin, rows.T)
            ).T
        return total.reshape(target.size, *values.shape[1:])


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
