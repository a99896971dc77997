"""The Kolmogorov forward equation of any smooth system, on a lattice that moves with the density.

    u_t = -div(f u) + G : Hess u / 2,        x in R^n, f(x, t), G(t) positive semidefinite

On x = c(t) + B(t) z the density of z obeys the same equation with the drift B^-1 (f - c') - B^-1 B' z and the covariance
B^-1 G B^-T.  The centre c follows the mean, and with `follow` the basis B follows the affine map that is nearest to f where the
density is, and its growth by diffusion; what is left of the drift is small, so that singular and vanishing G, steep drifts and
long intervals need no finer lattice than the density itself.

A smooth density that the lattice resolves is band-limited: its derivatives are those of its trigonometric interpolant,
accurate to rounding.  Diffusion along the axes and the translation are diagonal in frequency and done exactly; the rest is
stepped by the classical Runge-Kutta formula between them (Lawson 1967), of order four.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from zakai import _float64  # noqa: F401
from zakai.kolmogorov.reductions import highest, lowest, summed
from zakai.kolmogorov.resolution import along

LOST = 1e-14  # of the maximum: what rounding leaves
_TERMS = 10  # of the exponential of the basis' motion

Drift = Callable[[jax.Array, Any], Sequence[jax.Array]]
Covariance = Callable[[Any], jax.Array]


class Field(NamedTuple):
    """`values` (*sizes) of a density, but for a factor, at `centre` (n,) + `basis` (n, n) (index - size // 2)."""

    values: Any
    centre: Any
    basis: Any

    def points(self, aligned: bool = False) -> Any:
        """The points (*sizes, n); `Points` of a lattice whose axes are `aligned` with the coordinates."""
        return points_of(self.values.shape, self.centre, self.basis, aligned)


class Points:
    """The points of a lattice whose axes are aligned with the coordinates, an array for each: `points[..., i]` has length one
    along all axes but its own, so that a function of one coordinate takes its time on a line and not on the whole lattice.

    Of all else that an array (*sizes, n) can do there is its `shape`, and slices of the lattice.
    """

    def __init__(self, coordinates: Sequence[Any]):
        self.coordinates = list(coordinates)
        self.shape = (*(x.shape[d] for d, x in enumerate(coordinates)), len(coordinates))

    def __getitem__(self, key: tuple[Any, ...]) -> Any:
        if key[0] is Ellipsis:
            return self.coordinates[key[1]]
        n = len(self.coordinates)
        own = [tuple(part if a == d else slice(None) for a, part in enumerate(key)) for d in range(n)]
        return Points([x[of] for x, of in zip(self.coordinates, own, strict=True)])


def axes_of(sizes: Sequence[int]) -> list[np.ndarray]:
    """The indices along each axis, counted from the centre."""
    return [np.arange(size, dtype=float) - size // 2 for size in sizes]


def _view(axis: Any, d: int, n: int) -> Any:
    return axis.reshape([-1 if a == d else 1 for a in range(n)])


def combined(matrix: Any, sizes: Sequence[int]) -> list[Any]:
    """The n components of `matrix` z, arrays (*sizes)."""
    n = len(sizes)
    views = _views(sizes)
    return [sum(matrix[i, d] * views[d] for d in range(n)) for i in range(n)]


def points_of(sizes: Sequence[int], centre: Any, basis: Any, aligned: bool = False) -> Any:
    """centre + basis z (*sizes, n), or `Points` where the basis is diagonal."""
    if aligned:
        return Points([centre[d] + basis[d, d] * z for d, z in enumerate(_views(sizes))])
    return centre + jnp.stack(combined(basis, sizes), axis=-1)


@lru_cache(maxsize=64)
def derivative(size: int) -> np.ndarray:
    """The derivative of the trigonometric interpolant at the points, in cells; `size` is even."""
    distance = np.arange(size)[:, None] - np.arange(size)
    with np.errstate(divide="ignore"):
        entries = np.pi / size * (1.0 - 2.0 * (distance % 2)) / np.tan(np.pi * distance / size)
    return np.where(distance == 0, 0.0, entries)


@lru_cache(maxsize=64)
def frequencies(size: int) -> np.ndarray:
    return 2 * np.pi * np.fft.fftfreq(size)


@lru_cache(maxsize=64)
def _hartley(size: int) -> np.ndarray:
    angle = np.outer(frequencies(size), np.arange(size))
    return (np.cos(angle) + np.sin(angle)) / np.sqrt(size)


@lru_cache(maxsize=64)
def _circle(size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The frequencies k >= 0 (size / 2 + 1,); cos(k i) and sin(k i) beside each other, times the share of k and -k; and
    (i - j) mod size."""
    i = np.arange(size)
    k = 2 * np.pi * np.arange(size // 2 + 1) / size
    often = np.where((k == 0) | (np.arange(len(k)) == size // 2), 1.0, 2.0) / size
    waves = np.concatenate([np.cos(np.outer(i, k)) * often, np.sin(np.outer(i, k)) * often], axis=1)
    return k, waves, (i[:, None] - i) % size


class Transport:
    """exp(variance d^2/2 - shift d) along every axis of a lattice: `variances` (n,) and `shifts` (n,), in cells, zero along those
    in `quiet`."""

    def __init__(self, variances: Any, shifts: Any, sizes: Sequence[int], quiet: Sequence[int] = ()):
        self.variances, self.shifts = variances, shifts
        loud = [d for d in range(len(sizes)) if d not in quiet]
        self.matrices = {d: self._matrix(d, sizes[d]) for d in loud} if len(sizes) > 1 else {}

    def __call__(self, arrays: Sequence[jax.Array]) -> list[jax.Array]:
        """Several arrays, diffused and translated."""
        if arrays[0].ndim == 1:
            return [self._line(values) for values in arrays]
        for d, matrix in self.matrices.items():
            arrays = [along(matrix, values, d) for values in arrays]
        return list(arrays)

    def _decay(self, d: int, k: np.ndarray) -> tuple[jax.Array, jax.Array, jax.Array]:
        decay = jnp.exp(-0.5 * self.variances[d] * k**2)
        return decay, jnp.cos(k * self.shifts[d]), jnp.sin(k * self.shifts[d])

    def _line(self, values: jax.Array) -> jax.Array:
        """In frequency, where a translation mixes k and -k: two products with a matrix and none to make."""
        size = values.shape[0]
        hartley = _hartley(size)
        spectrum = hartley @ values
        decay, cos, sin = self._decay(0, frequencies(size))
        mirrored = jnp.concatenate([spectrum[:1], spectrum[:0:-1]])
        return jnp.matmul(hartley, decay * (cos * spectrum + sin * mirrored))

    def _matrix(self, d: int, size: int) -> jax.Array:
        # The sum over k of decay cos(k (i - j - shift)): an entry for every distance on the circle.
        k, waves, distance = _circle(size)
        decay, cos, sin = self._decay(d, k)
        line = jnp.matmul(waves, jnp.concatenate([decay * cos, decay * sin]))
        return line.at[distance].get(mode="promise_in_bounds")


class Moments(NamedTuple):
    """The sum of the values, and the mean (n,) and covariance (n, n) of z."""

    total: jax.Array
    mean: jax.Array
    cov: jax.Array


def moments(values: jax.Array) -> Moments:
    """By products with a matrix for each axis; deviations are taken from the mean before they are squared."""
    n, axes = values.ndim, axes_of(values.shape)

    def reduced(columns: Sequence[Any]) -> jax.Array:
        rest = values
        for d in reversed(range(n)):
            rest = jnp.tensordot(rest, columns[d], axes=([d], [0]))
        return rest  # the power of axis n - 1 first

    first = reduced([np.stack([np.ones(len(z)), z], axis=1) for z in axes])
    unit = np.eye(n, dtype=int)[:, ::-1]
    total = first[(0,) * n]
    mean = jnp.stack([first[tuple(unit[d])] for d in range(n)]) / total
    apart = [z - mean[d] for d, z in enumerate(axes)]
    second = reduced([jnp.stack([jnp.ones(len(z)), z, z**2], axis=1) for z in apart]) / total
    cov = jnp.stack([jnp.stack([second[tuple(unit[i] + unit[j])] for j in range(n)]) for i in range(n)])
    return Moments(total, mean, cov)


def inverse(matrix: jax.Array) -> jax.Array:
    """Written out for one and two states: a call into LAPACK would cost more than the rest of a step."""
    n = matrix.shape[0]
    if n == 1:
        return 1.0 / matrix
    if n == 2:
        (a, b), (c, d) = matrix
        return jnp.array([[d, -b], [-c, a]]) / (a * d - b * c)
    return jnp.linalg.inv(matrix)


def _exponential(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """exp(M) and the integral of exp(s M) over s from 0 to 1, for a matrix that is not large."""
    n = matrix.shape[0]
    total, integral, term = jnp.eye(n), jnp.eye(n), jnp.eye(n)
    for k in range(1, _TERMS + 1):
        term = term @ matrix / k
        total, integral = total + term, integral + term / (k + 1)
    return total, integral


def moved(
    field: Field,
    drift: Drift,
    covariance: Covariance,
    time: Any,
    tau: Any,
    order: int = 4,
    follow: bool = False,
    cross: bool = False,
    aligned: bool = False,
    quiet: Sequence[int] = (),
) -> tuple[Field, jax.Array]:
    """The density after the time `tau`, on the lattice that moved with it; and an estimate of the relative error in time.

    `drift(x, t)` gives n arrays for x (*sizes, n), `covariance(t)` is G (n, n); `order` is 2 or 4.  With `follow` the basis moves
    too.  With `cross` the covariance may couple axes of the lattice; without, it must not.  With `aligned` the basis is diagonal,
    and `drift` is given `Points`; not with `follow`.  Along the axes in `quiet`, which no noise moves, the lattice goes with
    the mean flow and by whole cells, since a translation by a part of one would be all that is left to do; only with `aligned`.
    """
    values, sizes, n = field.values, field.values.shape, field.values.ndim
    still = lax.stop_gradient  # the lattice is a choice: of its motion nothing is differentiated
    weights = values / summed(values)
    start = drift(field.points(aligned), time)
    total, mean, cov = still(moments(values))
    by_cells = {d: jnp.round(mean[d]) for d in quiet}
    mean = jnp.stack([jnp.zeros(()) if d in quiet else mean[d] for d in range(n)]) if quiet else mean
    velocity = still(jnp.stack([summed(weights * f) for f in start]))
    back_to = inverse(field.basis)
    motion = jnp.zeros((n, n))
    if follow:
        apart = [z - mean[d] for d, z in enumerate(_views(sizes))]
        slopes = still(jnp.stack([jnp.stack([summed(weights * f * z) for z in apart]) for f in start]))
        spread = back_to @ covariance(time) @ back_to.T
        motion = still((back_to @ slopes + 0.5 * spread) @ inverse(cov))

    def frame(share: float) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Centre, basis and its inverse at the time + share tau."""
        if not follow:
            return field.centre + share * (tau * velocity + field.basis @ mean), field.basis, back_to
        stretched, integral = _exponential(share * tau * motion)
        centre = field.centre + share * (tau * velocity + field.basis @ integral @ mean)
        return centre, field.basis @ stretched, _exponential(-share * tau * motion)[0] @ back_to

    def spread_at(share: float) -> jax.Array:
        back = frame(share)[2]
        return back @ covariance(time + share * tau) @ back.T

    # The mean goes to the centre: a translation by a part of a cell costs nothing in frequency.
    spreads = [spread_at(share) for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
    halves = [tau / 12 * jnp.diagonal(a + 4 * b + c) for a, b, c in (spreads[:3], spreads[2:])]
    taken = combined(motion, sizes)
    # Where rounding leaves nothing of the density there is nothing to move but noise, and the drift may be anything.
    floor = (3 * noise(values) * still(highest(values))) ** 2

    def residual(share: float) -> list[Any]:
        centre, basis, back = frame(share)
        f = start if share == 0 else drift(points_of(sizes, centre, basis, aligned), time + share * tau)
        apart = [f[i] - velocity[i] for i in range(n)]
        flows = [sum(back[d, i] * apart[i] for i in ([d] if aligned else range(n))) for d in range(n)]
        return [flow - part for flow, part in zip(flows, taken, strict=True)] if follow else flows

    def slope(flows: list[Any], spread: jax.Array, u: jax.Array) -> jax.Array:
        result, there = jnp.zeros(sizes), u * u**2 / (u**2 + floor)
        for d in range(n):
            flux = flows[d] * there
            if cross:
                flux = flux - sum(spread[d, e] * along(derivative(sizes[e]), u, e) for e in range(d))
            result = result - along(derivative(sizes[d]), flux, d)
        return result

    k1 = slope(residual(0.0), spreads[0], values)
    end_centre, end_basis, _ = frame(1.0)

    def at_end(u: jax.Array) -> Field:
        centre = end_centre
        for d, cells in by_cells.items():
            u, centre = jnp.roll(u, -cells.astype(int), axis=d), centre + end_basis[:, d] * cells
        return Field(u, centre, end_basis)

    if order == 2:
        a, b = Transport(halves[0] + halves[1], -mean, sizes, quiet)([values, k1])
        k2 = slope(residual(1.0), spreads[4], a + tau * b)
        # k2 - b is of second order in tau; what Heun's formula leaves is of third.
        second = tau * summed(jnp.abs(k2 - b)) / total
        return at_end(a + 0.5 * tau * (b + k2)), still(second**1.5 / 12)
    middle = residual(0.5)
    first, second_half = (Transport(variances, -0.5 * mean, sizes, quiet) for variances in halves)
    a, b = first([values, k1])
    k2 = slope(middle, spreads[2], a + 0.5 * tau * b)
    k3 = slope(middle, spreads[2], a + 0.5 * tau * k2)
    (end,) = second_half([a + tau * k3])
    k4 = slope(residual(1.0), spreads[4], end)
    (after,) = second_half([a + tau / 6 * b + tau / 3 * (k2 + k3)])
    after = after + tau / 6 * k4
    # k3 - k2 is of third order in tau; what the formula leaves is of fifth.
    third = 4 * tau * summed(jnp.abs(k3 - k2)) / total
    error = still(third ** (5 / 3) / 120)
    return at_end(after), error


def _views(sizes: Sequence[int]) -> list[np.ndarray]:
    return [_view(axis, d, len(sizes)) for d, axis in enumerate(axes_of(sizes))]


def resampled(fields: Field, middle: np.ndarray, ratio: np.ndarray, sizes: Sequence[int]) -> Field:
    """The sinc interpolants of fields with a leading axis of records on lattices around the indices `middle` (records, n) from
    the centres, their cells `ratio` (records, n) of the old; in NumPy for a Field of NumPy arrays, which compiles nothing."""
    values = fields.values
    xp = np if isinstance(values, np.ndarray) else jnp
    for d, (old, new) in enumerate(zip(axes_of(values.shape[1:]), axes_of(sizes), strict=True)):
        # Records that share both lattices share the matrix.
        cuts = np.stack([middle[:, d], ratio[:, d]], axis=1)
        cuts = cuts[:1] if np.array_equal(cuts, np.broadcast_to(cuts[:1], cuts.shape)) else cuts
        at = cuts[:, :1] + cuts[:, 1:] * new
        # sin(pi (at - old)) from one sine for each point.
        whole = np.round(at)
        sine = np.sin(np.pi * (at - whole)) * (1.0 - 2.0 * (whole % 2))
        apart = at[..., None] - old
        close = np.abs(apart) < 1e-9
        signs = 1.0 - 2.0 * (old % 2)
        sinc = np.where(close, 1.0, sine[..., None] * signs / (np.pi * np.where(close, 1.0, apart)))
        lines = xp.moveaxis(values, d + 1, 1)
        product = xp.matmul(cuts[:, 1, None, None] * sinc, lines.reshape(*lines.shape[:2], -1))
        values = xp.moveaxis(product.reshape(len(lines), len(new), *lines.shape[2:]), 1, d + 1)
    values = xp.maximum(values, 0.0)
    total = values.sum(axis=tuple(range(1, values.ndim)), keepdims=True)
    moved = xp.matmul(fields.basis, middle[..., None])[..., 0]
    return Field(values / total, fields.centre + moved, fields.basis * ratio[:, None, :])


def relaid(field: Field, reach: float) -> Field:
    """The density on a lattice of the same sizes on which it has no correlations and `reach` deviations on each side."""
    values, sizes, n = field.values, field.values.shape, field.values.ndim
    still = lax.stop_gradient
    _, mean, cov = still(moments(values))
    factor = jnp.linalg.cholesky(cov) if n > 1 else jnp.sqrt(cov)
    width = reach / (0.5 * jnp.array(sizes, float) - 1.0)
    matrix = factor * width  # the new z' in the old: z = mean + matrix z', a lower triangle
    for d in reversed(range(n)):
        # First each line is shifted by what the axes before it say, then all are scaled alike.
        if d:
            before = jnp.linalg.solve(matrix[:d, :d].T, matrix[d, :d])
            shift = sum(before[e] * (_view(axes_of(sizes)[e], e, n) - mean[e]) for e in range(d))
            values = _shifted(values, d, jnp.broadcast_to(shift, [1 if e >= d else sizes[e] for e in range(n)]))
        z = axes_of(sizes)[d]
        values = matrix[d, d] * along(jnp.sinc(mean[d] + matrix[d, d] * z[:, None] - z), values, d)
    values = jnp.maximum(values, 0.0)
    return Field(values / jnp.sum(values), field.centre + field.basis @ mean, field.basis @ matrix)


def _shifted(values: jax.Array, axis: int, shift: jax.Array) -> jax.Array:
    """u(z + shift) along an axis; `shift` has length one along it and may differ from line to line."""
    size, n = values.shape[axis], values.ndim
    hartley = _hartley(size)
    spectrum = along(hartley, values, axis)
    mirrored = jnp.take(spectrum, (-np.arange(size)) % size, axis=axis)
    angle = _view(frequencies(size), axis, n) * shift
    return along(hartley, jnp.cos(angle) * spectrum - jnp.sin(angle) * mirrored, axis)


def noise(values: jax.Array) -> jax.Array:
    """What is not known of the values, as a share of their maximum: what is negative is noise, as is what rounding leaves."""
    return lax.stop_gradient(jnp.maximum(LOST, -lowest(values) / highest(values)))
