"""Short substeps on a grid that stays where it is: the splitting of `space/splitting.py`, without its linearised noise.

What depends on the grid alone is prepared once, for intervals of any length: along the characteristics that end in a point the
displacement and the change of volume are polynomials in the length, of degree five, that interpolate two Runge-Kutta steps.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.space.field import Field
from zakai.numerics.space.grid import Grid, filtered, gaussian_response, indices
from zakai.numerics.space.spline import gather, resampled
from zakai.numerics.space.survey import Survey, narrowest, survey
from zakai.numerics.space.transport import Dynamics, moved_points
from zakai.numerics.space.window import LEAST, Bounds, Points, fitted_grid

Array = NDArray[Any]
STEEPEST = 0.6  # largest tau |L|
SHORT = 0.15  # largest |L| times a Runge-Kutta step
STEEP_AT = 0.25  # share of the width of a grid from its centre at which L is taken too
MARGIN = 0.07  # share of its width by which a grid that is to stay is wider at each end
LARGEST_NOISE = 0.2  # of the variance of a density that fills its grid
LARGEST_RANGE = 300.0  # nats between the largest and the smallest factor of a potential
# The coefficients of s, ..., s^5 of a polynomial from its slope at 0, its values and slopes at 1/2, and those at 1.
_POWERS = np.arange(1, 6)
EXTENSION: Array = np.linalg.inv(np.stack([s**_POWERS if value else _POWERS * s ** (_POWERS - 1.0) for s, value in (
    (0.0, False), (0.5, True), (0.5, False), (1.0, True), (1.0, False))]))  # fmt: skip


class Motion(NamedTuple):
    """The motion of the points of a grid along characteristics backward in time.

    `coefficients` (5, (n + 1) J) of tau / `unit`, ... of the displacement in spacings and of the log of the change of volume; the
    indices `start` (n, J) of the points; the noise `variances` (n, n) per unit of time, in spacings; the `longest` time for which
    a density that fills the grid can stay on it. What `over` returned last is `kept`.
    """

    coefficients: Array
    unit: float
    start: Array
    variances: Array
    longest: float
    kept: dict[float, tuple[Array, Array]]

    def over(self, tau: float) -> tuple[Array, Array]:
        """Return where the characteristics begin that end in the points after a time (J, n), and the change of volume (J,)."""
        found = self.kept.get(tau)
        if found is None:
            change = ((tau / self.unit) ** np.arange(1, 6) @ self.coefficients).reshape(len(self.start) + 1, -1)
            found = (self.start + change[:-1]).T, np.exp(change[-1])
            self.kept.clear()
            self.kept[tau] = found
        return found


def motion(dynamics: Dynamics, grid: Grid, tau: float) -> Motion:
    """Return the motion of a grid for lengths up to the power of two that is not below tau, without points if tau is too long."""
    unit = math.ldexp(1.0, math.ceil(math.log2(tau)))
    n, inverse = grid.n, grid.inverse
    away = STEEP_AT * grid.basis * grid.shape
    inside = grid.centre + np.concatenate([np.zeros((1, n)), away.T, -away.T])
    variances = inverse @ dynamics.noise(0.0, 1.0)[0] @ inverse.T
    noise = float((np.diagonal(variances).real / (grid.shape / 11.0) ** 2).max())
    rate = np.inf
    if noise * tau <= LARGEST_NOISE:
        with np.errstate(all="ignore"):
            matrices = inverse @ dynamics.jacobian(inside, 0.0).real @ grid.basis
            rate = float(np.abs(matrices).sum(axis=2).max())
    longest = 1.0 / max(rate / STEEPEST, noise / LARGEST_NOISE, 1e-300)
    if not np.isfinite(rate) or longest < tau:
        return Motion(np.zeros((5, 0)), unit, np.zeros((n, 0)), variances, 0.0, {})
    points = np.asfortranarray(grid.points)
    with np.errstate(all="ignore"):
        steps = math.ceil(0.5 * unit * rate / SHORT) or 1
        half = moved_points(dynamics, points, 0.0, -0.5 * unit, steps)
        whole = half + moved_points(dynamics, points + half[:, :n], -0.5 * unit, -unit, steps)
        slopes = [-unit * dynamics.drift(points + moved, 0.0) for moved in (0.0, half[:, :n], whole[:, :n])]
    moved = np.stack([part.T for part in (slopes[0], half, slopes[1], whole, slopes[2])])
    moved[:, :n] = inverse @ moved[:, :n]
    moved[:, n] = np.where(np.abs(moved[:, n].real) < LARGEST_RANGE, moved[:, n], 0.0)
    start = indices(grid.sizes).T + (grid.shape // 2)[:, None]
    return Motion(EXTENSION @ moved.reshape(5, -1), unit, start, variances, longest, {})


@lru_cache(maxsize=64)
def _fourier(size: int) -> tuple[Array, Array]:
    """Return the orthonormal real Fourier basis (size, size) in its columns, and the numbers of their frequencies."""
    number = (np.arange(size) + 1) // 2
    angle = 2 * np.pi / size * np.arange(size)[:, None] * number
    basis = np.where(np.arange(size) % 2 == 1, np.cos(angle), np.sin(angle))
    basis[:, 0] = 1.0
    return basis / np.sqrt((basis**2).sum(axis=0)), number


@lru_cache(maxsize=256)
def _circulant(variance: complex, size: int, spline: bool) -> Array:
    """Return the matrix of spreading by a variance in index units, or of the coefficients of a spline."""
    basis, number = _fourier(size)
    return np.asarray((basis * gaussian_response(np.array([[variance]]), (size,), spline)[number]) @ basis.T)


def _spread(values: Array, cov: Array, separate: bool, spline: bool = False) -> Array:
    """Return values (*sizes) after spreading by a covariance in index units; with `spline`, the coefficients of their spline."""
    shape = values.shape
    if not separate:
        return filtered(values, cov, spline)
    for d, size in enumerate(shape):
        if not spline and cov[d, d] == 0.0:
            continue
        matrix = _circulant(cov[d, d].item(), size, spline)
        if d == values.ndim - 1:
            values = values.reshape(-1, size) @ matrix
        else:
            values = matrix @ values.reshape(-1, size, math.prod(shape[d + 1 :]))
    return values.reshape(shape)


def fixed_step(values: Array, grid: Grid, moved: Motion, tau: float, factors: tuple[Array, Array] | None) -> Array:
    """Return the density after a substep; `factors` are exp(b / 6) and exp(b / 3 - tau g / 144)."""
    half = 0.5 * tau * moved.variances
    separate = np.count_nonzero(half) == np.count_nonzero(half.diagonal())
    at, volume = moved.over(tau)
    if factors is None:
        values = gather(_spread(values, half, separate, True), at, grid) * volume
        return _spread(values.reshape(grid.sizes), half, separate)
    outer, inner = factors
    values = _spread(_spread(values * outer, half, separate) * inner, 0.0 * half, True, True)
    values = (gather(values, at, grid) * volume).reshape(grid.sizes)
    return _spread(values * inner, half, separate) * outer


def fits(found: Survey, grid: Grid, bounds: Bounds) -> bool:
    """Return whether a density that a grid covers and resolves can stay on it: it will soon move and change its width."""
    needed = np.maximum(found.used[:, 1] - found.used[:, 0] + 4, LEAST[grid.n])
    return bool(
        found.edges.max() <= 0.5 * bounds.edge
        and found.tails.max() <= 0.5 * bounds.tail
        and np.prod(np.minimum(needed / grid.shape, 1.0)) > 0.4
    )


def refitted(field: Field, bounds: Bounds) -> Field:
    """Return a density, of the same mass, on a grid that fits it with a margin for many short substeps.

    Along other axes a density may need smaller spacings than along its own; where it does, it stays on its grid.
    """
    grid, real = field.grid, field.values.real
    found = field.survey(bounds)
    narrow, _ = narrowest(found, real, bounds.tail)
    used = np.flatnonzero(real > 0.3 * bounds.edge * real.max())
    logs = np.log(real.reshape(-1)[used] / real.max())
    new = fitted_grid(
        Points(grid.offsets[used], logs, grid.centre), np.zeros((grid.n, grid.n)), narrow, bounds, grid, MARGIN
    )
    values = resampled(field.values, grid, new, bounds.periodic)
    if survey(values, new).tails.max() > max(3 * bounds.tail, found.tails.max()):
        return field
    return Field(values * (field.values.sum() * grid.cell / (values.sum() * new.cell)), new, field.log_scale)
