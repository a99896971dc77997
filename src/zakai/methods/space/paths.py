"""Draws of the state at the start of an interval given that at its end, for two to four states on a grid.

They go back through the substeps of the filter (`numerics/space/splitting.py`).  A characteristic leads back without noise.  Of
y in z = y + N(0, C), z with density w, the conditional mean and covariance are (Tweedie's formula)

    E[y | z] = z + C grad log w(z),      Cov[y | z] = C + C (Hess log w)(z) C,

and the third cumulant is the third derivative of log w times C^3, which falls with the length of a substep.

References:
    Efron 2011, Tweedie's formula and selection bias.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.densities._values import wrap
from zakai.numerics.space.field import Field
from zakai.numerics.space.grid import filtered
from zakai.numerics.space.resample import padded
from zakai.numerics.space.spline import gather
from zakai.numerics.space.splitting import noise_of, spread_before, weighed
from zakai.numerics.space.step import Stepper, Substep
from zakai.numerics.space.transport import moved_points
from zakai.numerics.space.window import Bounds, padded_sizes

Array = Any
TRIES = 20  # of a draw to which a characteristic leads from the grid
RELIABLE = 0.999  # share of the draws for which one is found
NEAR = 0.5  # spacings between the points at which a logarithm is differentiated


def drawn(substeps: list[tuple[Stepper, Substep]], begin: Field, z: Array, rng: np.random.Generator) -> tuple[Array, float]:
    """Return draws (P, n) of the state at the start of substeps given those at their end, and how far from normal the law is."""
    fields = [begin]
    for stepper, one in substeps:
        fields.append(stepper.replayed(fields[-1], one))
    departure = 0.0
    for number in reversed(range(len(substeps))):
        z, more = _through(*substeps[number], fields[number], fields[number + 1], z, rng)
        departure = max(departure, more)
    return z, departure


def _through(
    stepper: Stepper, one: Substep, begin: Field, end: Field, z: Array, rng: np.random.Generator
) -> tuple[Array, float]:
    """Return draws at the start of a substep between two densities given those at its end."""
    dynamics, (t0, t1), bounds = stepper.dynamics, one.times, stepper.bounds
    values, grid = begin.values, begin.grid
    if dynamics.diffusion is None:
        values, grid = padded(values, grid, padded_sizes(values, grid, one.linear.before.real, bounds))
    after = end.values
    if one.potential is not None:
        after, _ = weighed(after, -one.potential(end.grid, t0, t1, True).log / 6)
        values, _ = weighed(values, one.potential(grid, t0, t1, False).log / 6)
    before = Field(*spread_before(values, grid, dynamics, one.linear, one.times, bounds), 0.0)
    inside, moved = np.zeros(len(z), bool), np.zeros_like(z)
    centre, root, last = _law(stepper, one, True, end._replace(values=after), z)
    for _ in range(TRIES):  # no characteristic leads from the grid to the others
        rest = np.flatnonzero(~inside)
        z[rest] = _drawn(centre[rest], root[rest], rng)
        moved[rest] = z[rest] + moved_points(dynamics, z[rest], t1, t0, one.steps)[:, : before.grid.n]
        index = wrapped(moved[rest] - before.grid.centre, bounds.periodic) @ before.grid.inverse.T
        inside[rest] = ((np.abs(index) <= 0.5 * before.grid.shape) | before.grid.circles).all(axis=1)
        if inside.all():
            break
    moved[~inside] = begin.grid.centre + begin.survey(bounds).mean
    centre, root, first = _law(stepper, one, False, before, moved)
    departure = max(first, last) if np.mean(inside) > RELIABLE else np.inf
    return wrapped(_drawn(centre, root, rng), bounds.periodic), departure


def _drawn(centre: Array, root: Array, rng: np.random.Generator) -> Array:
    return centre + np.einsum("pij,pj->pi", root, rng.standard_normal(centre.shape))


def _law(stepper: Stepper, one: Substep, last: bool, w: Field, z: Array) -> tuple[Array, Array, float]:
    """Return the means (P, n) and the roots of the covariances (P, n, n) of y given z = y + noise of density w.

    The third is the root mean square of the skewness.
    """
    bounds = stepper.bounds
    z, change, shift = wrapped(z, bounds.periodic), 0.0, np.zeros_like(z)
    noise = noise_of(stepper.dynamics, one.linear, one.times, last)
    if noise is None:
        cov = 0.5 * one.linear.noise if last else one.linear.before
        root = np.broadcast_to(_root(cov), (len(z), *cov.shape))
    else:
        root = _root(noise(z).real)
        steps = np.diag(NEAR * np.linalg.norm(w.grid.basis, axis=1))
        slopes = np.stack([(noise(z + h) - noise(z - h)).real / (2 * h.sum()) for h in steps], axis=-1)
        shift, inverse = np.einsum("pijj->pi", slopes), np.linalg.pinv(root, rcond=1e-6)
        change = np.sum(np.einsum("pki,pijd,pdk,pkj->pk", inverse, slopes, root, inverse) ** 2, axis=1)
    slope, curvature, third = _derivatives(w, z, root, bounds)
    values, vectors = np.linalg.eigh(np.eye(z.shape[1]) + curvature)
    skewness = np.sum(np.minimum(third**2, 1.0), axis=1) + np.minimum(change, 1.0)
    conditional = root @ (vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :])
    return z + shift + np.einsum("pij,pj->pi", root, slope), conditional, float(np.sqrt(np.mean(skewness)))


def _root(cov: Array) -> Array:
    """Return R with R R' = cov for matrices (..., n, n) that may be singular."""
    values, vectors = np.linalg.eigh(cov)
    return vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]


def _derivatives(w: Field, z: Array, root: Array, bounds: Bounds) -> tuple[Array, Array, Array]:
    """Return the first (P, n), second (P, n, n) and third (P, n) derivatives of log w at z along the columns of a root.

    Where w is not known they are those of the Gaussian with its moments, and the third ones, of which nothing is known, are one.
    """
    grid, n = w.grid, w.grid.n
    coefficients = filtered(w.values, np.zeros((n, n)), spline=True)
    index = wrapped(z - grid.centre, bounds.periodic) @ grid.inverse.T + grid.shape // 2
    along = grid.inverse @ root
    length = np.maximum(np.linalg.norm(along, axis=1), 1e-300) / NEAR  # (P, n)
    unit = np.swapaxes(along / length[:, None, :], 1, 2)  # (P, columns, n)
    # Along each axis at -2, -1, 1 and 2 steps, then on the diagonals of each pair.
    pairs = [(i, j) for i in range(n) for j in range(i)]
    offsets = [np.zeros_like(z)] + [t * unit[:, i] for i in range(n) for t in (-2, -1, 1, 2)]
    for i, j in pairs:
        plus, minus = unit[:, i] + unit[:, j], unit[:, i] - unit[:, j]
        offsets += [plus, -plus, minus, -minus]
    least = bounds.edge * w.values.max()
    values = gather(coefficients, (index + np.stack(offsets)).reshape(-1, n), grid).reshape(-1, len(z))
    middle, *logs = np.log(np.maximum(values, least))
    a, b, c, d = (np.stack(logs[first : 4 * n : 4], axis=1) for first in range(4))
    slope, third = ((c - b) * 2 / 3 - (d - a) / 12) * length, (0.5 * (d - a) - (c - b)) * length**3
    curvature = np.empty((len(z), n, n))
    curvature[:, range(n), range(n)] = (4 * (b + c) / 3 - (a + d) / 12 - 2.5 * middle[:, None]) * length**2
    for (i, j), (a, b, c, d) in zip(pairs, np.reshape(logs[4 * n :], (-1, 4, len(z))), strict=True):
        curvature[:, i, j] = curvature[:, j, i] = (a + b - c - d) / 4 * length[:, i] * length[:, j]
    found = w.survey(bounds)
    precision = np.linalg.pinv(found.cov)
    offset = wrapped(z - grid.centre - found.mean, bounds.periodic)
    unknown = ~(values.min(axis=0) > least)
    slope[unknown] = -np.einsum("pij,pi->pj", root[unknown], offset[unknown] @ precision)
    curvature[unknown] = -np.swapaxes(root[unknown], 1, 2) @ precision @ root[unknown]
    third[unknown] = 1.0
    return slope, curvature, third


def wrapped(x: Array, periodic: tuple[bool, ...]) -> Array:
    """Return points (P, n) with angles in (-pi, pi]."""
    return np.where(periodic, wrap(x), x)
