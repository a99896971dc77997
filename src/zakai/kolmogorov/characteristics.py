"""The Kolmogorov forward equation along characteristics, in the logarithm, for systems of weak noise in one to three states.

    u_t = -div(f u) + G : Hess u / 2,        x in R^n, f(x, t), G(t) positive semidefinite

Without noise log u is carried along the paths x' = f(x, t) and loses the integral of div f on the way.  Each point of the lattice
at the end of a step is traced back, and log u is read there off a cubic spline: of a density near a Gaussian it is near a
quadratic, which a spline reproduces whatever its cells, so that the lattice need resolve sums alone (semi-Lagrangian advection,
Staniforth and Cote 1991).  What noise adds is a convolution on either side of the flow: tau G / 2 before, and after it what
makes the covariance that of the linearised flow along the path of the mean, so that of affine systems nothing is split.

The lattice of the end is laid around the points of the old one, moved forwards and weighted by the density and, where a
reading is about to come, by its likelihood: what the reading will rule out needs no points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from zakai import _float64  # noqa: F401
from zakai.kolmogorov import comoving
from zakai.kolmogorov.comoving import Covariance, Drift, Field
from zakai.kolmogorov.resolution import along

STEPS = 4  # of Runge and Kutta's formula along a path
MARGIN = 3  # cells around the lattice, so that a convolution brings nothing from one edge to the other
NOTHING = 1e-14  # of the maximum
OVERSHOOT = 0.3  # of a spline above the points around, which a maximum between them may need
_SPARSE = 3  # the paths that are traced twice are every third along each axis

Ahead = Callable[[jax.Array], jax.Array]


def moved(
    field: Field, drift: Drift, covariance: Covariance, time: Any, tau: Any, reach: Any, ahead: Ahead, left: Any
) -> tuple[Field, jax.Array, jax.Array]:
    """The density after the time `tau`, on a lattice of its own of the same even sizes, `reach` deviations on each side; and two
    errors, relative: of paths and noise, and of the spline.

    `drift(x, t)` gives n arrays for x (..., n), `covariance(t)` is G (n, n).  `ahead(x)` is the logarithm of the likelihood to
    come for states x (..., n) after another `left` steps of the time `tau`.  The values sum to what mass the new lattice holds.
    """
    still, n = lax.stop_gradient, field.values.ndim
    path, onwards = _path(drift), _path(lambda x, t: [still(f) for f in drift(x, t)], divergence=False)
    # Where the paths lead is but a choice of the lattice: every second point along each axis, and one step for each that is left.
    half = (slice(None, None, 2),) * n
    points, values = field.points()[half], field.values[half]
    first = still(onwards(points, time, tau, STEPS))[0]
    later = lax.fori_loop(0, left, lambda k, x: onwards(x, time + (k + 1) * tau, tau, 1)[0], first)
    likely = still(ahead(later))
    weights, first = _finite(still(_tilted(values, likely)), first)
    mean, cov = _weighted(weights, first)
    start, cov_before = _weighted(weights, still(points))

    # Noise before the flow and after it.
    before = 0.5 * tau * covariance(time)
    added = _added(drift, covariance, start, cov_before, time, tau)
    after = _positive(added[0])
    logs = _spread(_logs(field.values), field.basis, before, reach)
    fourth = _fourth(logs, weights)

    centre, basis = still(mean), still(_frame(cov + after, field.values.shape, reach))
    end = comoving.points_of(field.values.shape, centre, basis)
    back = comoving.inverse(field.basis)

    def read(x: jax.Array, steps: int) -> jax.Array:
        """log u at the end of the flow, at the points x there."""
        begin, gathered = path(x, time + tau, -tau, steps)
        good = jnp.all(jnp.isfinite(begin), axis=-1) & jnp.isfinite(gathered)
        inside = jnp.where(good[..., None], begin, field.centre)
        value = _spline(logs, (inside - field.centre) @ back.T, reach) + gathered
        return jnp.maximum(jnp.where(good, value, -jnp.inf), jnp.max(logs) - 60.0)

    result = read(end, STEPS)
    sparse = (slice(None, None, _SPARSE),) * n
    heavy = jnp.exp(result - jnp.max(result))[sparse]
    paths = jnp.sum(heavy * jnp.minimum(jnp.abs(result[sparse] - read(end[sparse], 2 * STEPS)), 1.0)) / jnp.sum(heavy)
    result = _spread(result, basis, after, reach)
    volume = jnp.log(jnp.abs(jnp.linalg.det(basis) / jnp.linalg.det(field.basis)))
    noise = _unlike(added[1:] - after, cov + after)
    return Field(jnp.exp(result + volume), centre, basis), still(paths + noise), still(fourth)


def relaid(field: Field, sizes: tuple[int, ...], reach: Any) -> Field:
    """The density on a lattice of other sizes on which it has no correlations, `reach` deviations on each side."""
    values = field.values / jnp.sum(field.values)
    mean, cov = lax.stop_gradient(_weighted(values, field.points()))
    basis = _frame(cov, sizes, reach)
    z = (comoving.points_of(sizes, mean, basis) - field.centre) @ comoving.inverse(field.basis).T
    logs = _spline(_logs(values), z, reach)
    values = jnp.exp(logs - jnp.max(logs))
    return Field(values / jnp.sum(values), mean, basis)


def _path(drift: Drift, divergence: bool = True) -> Callable[[jax.Array, Any, Any, int], tuple[jax.Array, jax.Array]]:
    """Where paths from x lead in the time tau, which may be negative, and the integral of div f along them."""

    def flow(x: Sequence[jax.Array], t: Any) -> list[jax.Array]:
        return [jnp.broadcast_to(f, x[0].shape) for f in drift(jnp.stack(x, axis=-1), t)]

    def rate(x: Sequence[jax.Array], t: Any) -> list[jax.Array]:
        total = jnp.zeros(x[0].shape)
        for d in range(len(x) if divergence else 0):

            def along_axis(coordinate: jax.Array, d: int = d) -> jax.Array:
                return flow([*x[:d], coordinate, *x[d + 1 :]], t)[d]

            total = total + jax.jvp(along_axis, (x[d],), (jnp.ones(x[d].shape),))[1]
        return [*flow(x, t), total]

    def path(x: jax.Array, time: Any, tau: Any, steps: int) -> tuple[jax.Array, jax.Array]:
        h = tau / steps

        def one(k: Any, y: list[jax.Array]) -> list[jax.Array]:
            def at(share: float, slope: Sequence[jax.Array]) -> list[jax.Array]:
                moved = [a + share * h * b for a, b in zip(y[:-1], slope, strict=False)]
                return rate(moved, time + (k + share) * h)

            k1 = rate(y[:-1], time + k * h)
            k2 = at(0.5, k1)
            k3 = at(0.5, k2)
            k4 = at(1.0, k3)
            return [a + h / 6 * (b + 2 * c + 2 * d + e) for a, b, c, d, e in zip(y, k1, k2, k3, k4, strict=True)]

        # An array for each coordinate: stacked ones would be taken apart again at every stage.
        *end, gathered = lax.fori_loop(0, steps, one, [*jnp.moveaxis(x, -1, 0), jnp.zeros(x.shape[:-1])])
        return jnp.stack(end, axis=-1), gathered

    return path


def _linearised(drift: Drift, covariance: Covariance, x: jax.Array, time: Any, tau: Any) -> tuple[Any, Any, Any]:
    """Along the path from x (n,): its end, the covariance of what noise adds, and the derivative of the end by x."""
    n, h = len(x), tau / STEPS

    def flow(y: jax.Array, t: Any) -> jax.Array:
        return jnp.stack([jnp.reshape(f, ()) for f in drift(y, t)])

    def rate(y: Any, t: Any) -> Any:
        x, P, J = y
        A = jax.jacfwd(flow)(x, t)
        return flow(x, t), A @ P + P @ A.T + covariance(t), A @ J

    def plus(y: Any, h: Any, k: Any) -> Any:
        return jax.tree.map(lambda a, b: a + h * b, y, k)

    def one(k: Any, y: Any) -> Any:
        t = time + k * h
        k1 = rate(y, t)
        k2 = rate(plus(y, 0.5 * h, k1), t + 0.5 * h)
        k3 = rate(plus(y, 0.5 * h, k2), t + 0.5 * h)
        k4 = rate(plus(y, h, k3), t + h)
        return jax.tree.map(lambda a, b, c, d, e: a + h / 6 * (b + 2 * c + 2 * d + e), y, k1, k2, k3, k4)

    return lax.fori_loop(0, STEPS, one, (x, jnp.zeros((n, n)), jnp.eye(n)))


def _added(drift: Drift, covariance: Covariance, mean: Any, cov: Any, time: Any, tau: Any) -> jax.Array:
    """What noise adds after the flow (1 + 2 n, n, n), along the paths from the mean and from a deviation to each side of it."""
    roots = jnp.linalg.cholesky(cov + 1e-300 * jnp.eye(len(mean))).T
    starts = jnp.concatenate([mean[None], mean + roots, mean - roots])
    _, whole, turned = jax.vmap(lambda x: _linearised(drift, covariance, x, time, tau))(starts)
    return whole - turned @ (0.5 * tau * covariance(time)) @ jnp.swapaxes(turned, 1, 2)


def _unlike(apart: jax.Array, scale: Any) -> jax.Array:
    """How far what noise adds differs from point to point, by `apart` (2 n, n, n), relative to the covariance at the end."""
    weight = comoving.inverse(scale)
    return 0.5 * jnp.mean(jnp.sqrt(jnp.maximum(jnp.einsum("aij,jk,akl,li->a", apart, weight, apart, weight), 0.0)))


def _positive(matrix: jax.Array) -> jax.Array:
    """The symmetric matrix without what is negative of it."""
    values, vectors = jnp.linalg.eigh(lax.stop_gradient(matrix))
    rest = vectors @ (jnp.minimum(values, 0.0)[:, None] * vectors.T)
    return matrix - rest


def _finite(weights: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """No weight and no place for paths that end nowhere."""
    good = jnp.all(jnp.isfinite(x), axis=-1)
    weights = jnp.where(good, weights, 0.0)
    return weights / jnp.sum(weights), jnp.where(good[..., None], x, 0.0)


def _tilted(values: jax.Array, logs: jax.Array) -> jax.Array:
    """The values times exp(logs), summing to one."""
    total = _logs(values) + jnp.where(jnp.isfinite(logs), logs, -jnp.inf)
    tilted = jnp.exp(total - jnp.max(total))
    return tilted / jnp.sum(tilted)


def _weighted(weights: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    n = x.shape[-1]
    flat, points = weights.reshape(-1), x.reshape(-1, n)
    mean = flat @ points
    apart = points - mean
    return mean, (flat[:, None] * apart).T @ apart


def _frame(cov: jax.Array, sizes: tuple[int, ...], reach: Any) -> jax.Array:
    """The axes of the covariance, the longest first."""
    values, vectors = jnp.linalg.eigh(cov)
    values = jnp.maximum(values, 1e-24 * values[-1])
    return vectors[:, ::-1] * jnp.sqrt(values[::-1]) * _cells(sizes, reach)


def _cells(sizes: tuple[int, ...], reach: Any) -> jax.Array:
    """The cells in deviations."""
    return reach / (0.5 * jnp.array(sizes, float) - 1.0)


def _logs(values: jax.Array) -> jax.Array:
    """The logarithm, which goes over to a floor where rounding leaves nothing: a smaller kink rings less in a spline."""
    return jnp.log(jnp.maximum(values, 0.0) + NOTHING * lax.stop_gradient(jnp.max(values)))


def _beyond(far: Any, cell: Any, reach: Any) -> Any:
    """How far a Gaussian has fallen `far` cells beyond the edge."""
    return reach * cell * far + 0.5 * (cell * far) ** 2


def _spread(logs: jax.Array, basis: jax.Array, cov: jax.Array, reach: Any) -> jax.Array:
    """The logarithm of the density convolved with a Gaussian of covariance `cov`, in frequency."""
    sizes, n = logs.shape, logs.ndim
    back = comoving.inverse(basis)
    spread = back @ cov @ back.T
    padded = jnp.pad(logs, MARGIN, mode="edge")
    for d, size in enumerate(sizes):
        z = np.arange(size + 2 * MARGIN) - MARGIN
        far = np.maximum(np.maximum(-z, z - size + 1), 0).reshape([-1 if a == d else 1 for a in range(n)])
        padded = padded - _beyond(far, _cells(sizes, reach)[d], reach)
    top, shape = lax.stop_gradient(jnp.max(padded)), padded.shape
    frequencies = [2 * np.pi * np.fft.fftfreq(size) for size in shape[:-1]] + [2 * np.pi * np.fft.rfftfreq(shape[-1])]
    k = [axis.reshape([-1 if a == d else 1 for a in range(n)]) for d, axis in enumerate(frequencies)]
    decay = jnp.exp(-0.5 * sum(spread[d, e] * k[d] * k[e] for d in range(n) for e in range(n)))
    values = jnp.fft.irfftn(jnp.fft.rfftn(jnp.exp(padded - top)) * decay, s=shape)[(slice(MARGIN, -MARGIN),) * n]
    return top + _logs(values)


@lru_cache(maxsize=64)
def _coefficients(size: int) -> np.ndarray:
    """Of the cubic B-splines from values (size,): (size + 2, size), at each edge a quadratic."""
    matrix = np.zeros((size + 2, size + 2))
    for i in range(size):
        matrix[i, i : i + 3] = 1 / 6, 4 / 6, 1 / 6
    matrix[size, :4] = matrix[size + 1, -4:] = 1, -3, 3, -1
    return np.linalg.inv(matrix)[:, :size]


def _spline(logs: jax.Array, z: jax.Array, reach: Any) -> jax.Array:
    """The spline through `logs` (*sizes) at indices z (..., n) from the centre; beyond the edges it falls as a Gaussian."""
    sizes, n = logs.shape, logs.ndim
    table, cells = logs, _cells(sizes, reach)
    for d, size in enumerate(sizes):
        table = along(jnp.asarray(_coefficients(size)), table, d)
    table = table.reshape(-1)
    place = corner = jnp.zeros(z.shape[:-1], jnp.int32)
    beyond, weights = 0.0, []
    for d, size in enumerate(sizes):
        at = z[..., d] + size // 2
        inside = jnp.clip(at, 0.0, size - 1.0)
        beyond = beyond + _beyond(jnp.abs(at - inside), cells[d], reach)
        whole = jnp.clip(jnp.floor(lax.stop_gradient(inside)), 0, size - 2)
        s = inside - whole
        weights.append(((1 - s) ** 3 / 6, (3 * s**3 - 6 * s**2 + 4) / 6, (1 + 3 * s + 3 * s**2 - 3 * s**3) / 6, s**3 / 6))
        place = place * (size + 2) + whole.astype(jnp.int32)
        corner = corner * size + whole.astype(jnp.int32)
    strides = [int(np.prod([size + 2 for size in sizes[d + 1 :]])) for d in range(n)]
    # A loop, for the compiler takes its time for each of 4^n terms.
    outer = np.array(list(product(range(4), repeat=n - 1)), int).reshape(4 ** (n - 1), n - 1)
    stacked = [jnp.stack(four) for four in weights[:-1]]

    def row(total: jax.Array, at: Any) -> tuple[jax.Array, None]:
        which, offset = at
        line = sum(weights[-1][a] * table.at[place + offset + a].get(mode="promise_in_bounds") for a in range(4))
        for d in range(n - 1):
            line = line * stacked[d][which[d]]
        return total + line, None

    offsets = outer @ np.array(strides[:-1], int)
    value = lax.scan(row, jnp.zeros(z.shape[:-1]), (outer, offsets))[0]
    # Where the logarithm has a kink the spline would ring, and a ringing logarithm is mass from nowhere.
    highest = logs
    for d in range(n):
        highest = jnp.maximum(highest, jnp.roll(highest, -1, axis=d))
    return jnp.minimum(value, highest.reshape(-1)[corner] + OVERSHOOT) - beyond


def _fourth(logs: jax.Array, weights: jax.Array) -> jax.Array:
    """What a cubic spline leaves between its points, h^4 L'''' / 384 an axis: the mean by weights of every second point."""
    total, n = jnp.zeros(()), logs.ndim
    for d in range(n):
        fourth = jnp.diff(logs, n=4, axis=d)[(slice(None, None, 2),) * n]
        total = total + jnp.sum(lax.slice_in_dim(weights, 1, weights.shape[d] - 1, axis=d) * jnp.abs(fourth)) / 384
    return total
