"""One substep of the Kolmogorov forward equation on grids, with a potential: a symmetric splitting.

    u_t = -div(f u) + G : Hess u / 2 + V u

    exp(b/6) D' exp(b/3 - tau g/144) T exp(b/3 - tau g/144) D exp(b/6),     b = integral of V,  g = grad b . G grad b

T moves along the characteristics of f, exactly but for the interpolation.  D' and D spread by the two halves of the noise of the
system that is linearised at the mean, so that the splitting is exact for linear f and V = 0, singular G included; the factors
are Chin's (1997), of fourth order where diffusion and V alone do not commute.  The splitting is symmetric, of order two.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.space.diffusion import diffused, spread_out
from zakai.numerics.space.field import ACCEPTED, Field, finer_field
from zakai.numerics.space.grid import Grid, filtered, spread
from zakai.numerics.space.resample import padded
from zakai.numerics.space.spline import gather, relative_index
from zakai.numerics.space.transport import Dynamics, Linearisation, characteristics
from zakai.numerics.space.window import Bounds, padded_sizes

Array = NDArray[Any]
_LARGEST_VOLUME = 300.0  # nats; points beyond come from outside of the grid


class Factor(NamedTuple):
    """The logarithms b and -tau g / 144 of a potential's factor at the points of a grid (*sizes)."""

    log: Array
    correction: Array


Potential = Callable[[Grid, float, float, bool], Factor]  # at the start (False) or the end (True) of a substep


class Source(NamedTuple):
    """A density after the first half of a substep, but for exp(`log_scale`), as the coefficients of its spline on a grid.

    What is below `least` is unknown.
    """

    coefficients: Array
    grid: Grid
    least: float
    log_scale: Any


class Move(NamedTuple):
    """The linearised system, the steps of the characteristics and the target grid of a substep."""

    linear: Linearisation
    steps: int
    target: Grid


def weighed(values: Array, logs: Array) -> tuple[Array, Any]:
    """Return the values times exp(logs - top), and top, the largest logarithm where there is mass."""
    real = values.real
    top = float(np.max(logs.real, where=real > 1e-14 * real.max(), initial=-np.inf))
    if not np.isfinite(top):
        top = 0.0
    shifted = logs - top
    return values * np.exp(np.where(shifted.real > 30.0, 30.0, shifted)), top


def _faintest(values: Array) -> float:
    """Return a value below the smallest of a density that is not zero: smaller ones are unknown."""
    real = values.real
    return 0.5 * float(np.min(real, where=real > 0, initial=np.inf))


def noise_of(
    dynamics: Dynamics, linear: Linearisation, times: tuple[float, float], end: bool
) -> Callable[[Array], Array] | None:
    """Return the covariance (J, n, n) that noise before (False) or after (True) the motion adds at points (J, n).

    It is None where the noise does not depend on the state.
    """
    diffusion, middle = dynamics.diffusion, 0.5 * (times[0] + times[1])
    return None if diffusion is None else lambda x: linear.halves(diffusion(x, middle), end)


def spread_before(
    values: Array, grid: Grid, dynamics: Dynamics, linear: Linearisation, times: tuple[float, float], bounds: Bounds
) -> tuple[Array, Grid]:
    """Return a density after the half of the noise that acts before the motion, and its grid."""
    noise = noise_of(dynamics, linear, times, False)
    return (spread(values, grid, linear.before), grid) if noise is None else spread_out(values, grid, noise, bounds)


def before_motion(
    field: Field,
    dynamics: Dynamics,
    linear: Linearisation,
    times: tuple[float, float],
    potential: Potential | None,
    bounds: Bounds,
) -> Source:
    """Return a density after the first half of a substep: the potential and the noise before the motion."""
    tails, zero = field.survey(bounds).tails, np.zeros((field.grid.n, field.grid.n))
    if dynamics.diffusion is None:
        sizes = padded_sizes(field.values, field.grid, linear.before.real, bounds)
        field = Field(*padded(field.values, field.grid, sizes), field.log_scale)
    if bounds.finer > 1.0:
        field = finer_field(field, np.where(tails > ACCEPTED * bounds.tail, 1.0, bounds.finer), bounds)
    values, grid, log_scale = field
    least = _faintest(values)
    if potential is None and dynamics.diffusion is None:
        half = grid.inverse @ linear.before @ grid.inverse.T
        return Source(filtered(values, half, spline=True), grid, least, log_scale)
    factor = potential(grid, *times, False) if potential else None
    if factor is not None:
        values, top = weighed(values, factor.log / 6)
        least, log_scale = _faintest(values), log_scale + top
    values, new = spread_before(values, grid, dynamics, linear, times, bounds)
    if potential and factor is not None:
        factor = factor if new is grid else potential(new, *times, False)
        values, top = weighed(values, factor.log / 3 + factor.correction)
        log_scale = log_scale + top
    return Source(filtered(values, zero, spline=True), new, least, log_scale)


def after_motion(
    source: Source,
    move: Move,
    dynamics: Dynamics,
    times: tuple[float, float],
    potential: Potential | None,
    bounds: Bounds,
    begun: tuple[float, Array] | None = None,
) -> tuple[Field, Array]:
    """Return the density after the second half of a substep, and the displacement along the characteristics to its points.

    Args:
        source: the density after the first half.
        move: the linearised system, the steps of the characteristics, and the grid of the result.
        dynamics: the drift and the noise.
        times: the start and the end of the substep.
        potential: the potential.
        bounds: which coordinates are angles.
        begun: a time in between, and the displacement from the end to it.
    """
    linear, steps, target = move
    moved = characteristics(dynamics, source.grid, target, *times, steps, bounds.periodic, begun)
    factor, log_scale = potential(target, *times, True) if potential else None, source.log_scale
    at = relative_index(target, source.grid, bounds.periodic, moved)
    volume = np.exp(np.where(np.abs(moved[:, -1].real) < _LARGEST_VOLUME, moved[:, -1], 0.0))
    values = (gather(source.coefficients, at, source.grid, source.least) * volume).reshape(target.sizes)
    if factor is not None:
        values, top = weighed(values, factor.log / 3 + factor.correction)
        log_scale = log_scale + top
    noise = noise_of(dynamics, linear, times, True)
    values = spread(values, target, 0.5 * linear.noise) if noise is None else diffused(values, target, noise(target.points))
    if factor is not None:
        values, top = weighed(values, factor.log / 6)
        log_scale = log_scale + top
    return Field(values, target, log_scale), moved
