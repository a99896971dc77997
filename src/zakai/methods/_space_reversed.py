"""The equation of the backward pass for two to four states, as one that the steps of the filter solve.

Backward in time the message b(x) = p(observations after t | x) obeys the adjoint of the filter's equation,

    -b_t = f . grad b + G : Hess b / 2 + V b.

It need not decrease.  What a grid holds is psi = g b with a Gaussian g, an artificial prior (Bresler 1986; Briers, Doucet and
Maskell 2010), which obeys a Kolmogorov forward equation in -t: that of the process reversed under g, with another potential,

    -psi_t = -div(F psi) + sum_ij d_i d_j (G_ij psi) / 2 + U psi,    F = -f + div(G g) / g,    U = V + (L*g - g_t) / g.

All of U but V acts along the characteristics of F, exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from zakai.methods._space_observed import Observations
from zakai.numerics.space_grid import Grid
from zakai.numerics.space_step import Potential, Stepper
from zakai.numerics.space_transport import Dynamics
from zakai.numerics.space_window import Bounds

Array = Any
WIDER = 4.0  # variances of a new g relative to those of the density that it covers
WIDEST = 12.0  # and the largest of a g that is kept
MARGIN = 1.2  # and the least
LEAST = 2.0  # nats by which g may be below the density, both relative to their maxima
CUT = 0.8  # share of the depth at which psi is cut off, at which b has fallen to 1 / e
LOWEST = -299.0  # nats
MOST_SUBSTEPS = 16  # for the change of g
ANGLE = 16.0  # variance of an angle, for which g is constant


@dataclass(frozen=True, eq=False)
class Gauge:
    """g = exp(-(x - `mean`)' `precision` (x - `mean`) / 2) at one time, constant in angles; `motions` keeps those of grids."""

    mean: Array
    cov: Array
    straight: Array
    motions: dict[Any, Any] = field(default_factory=dict)

    @cached_property
    def precision(self) -> Array:
        """The inverse of the covariance, zero for angles."""
        return _inverse(self.cov, self.straight)

    def log(self, points: Array) -> Array:
        """Return log g (J,)."""
        away = points - self.mean
        return -0.5 * ((away @ self.precision) * away).sum(axis=-1)

    def covers(self, mean: Array, cov: Array) -> bool:
        """Return whether g is wider than N(mean, cov), but not by far, and nowhere much smaller relative to their maxima."""
        block = np.ix_(self.straight, self.straight)
        wider = self.cov[block] - MARGIN * cov[block]
        ratios = np.linalg.eigvals(np.linalg.solve(cov[block], self.cov[block])).real
        if ratios.min(initial=np.inf) <= MARGIN or ratios.max(initial=0.0) > WIDEST:
            return False
        apart = (mean - self.mean)[self.straight]
        return bool(0.5 * apart @ np.linalg.solve(wider, apart) <= LEAST)


def _inverse(cov: Array, straight: Array) -> Array:
    """Return the inverses of matrices (..., n, n) in some coordinates, zero in the others."""
    found, block = np.zeros_like(cov), (..., straight[:, None], straight)
    found[block] = np.linalg.inv(cov[block])
    return found


class Path(NamedTuple):
    """Gaussians that lead from `begin` to `end` over an interval: linear covariances, and cubic means with `slopes` (2, n)."""

    begin: Gauge
    end: Gauge
    start: float
    length: float
    slopes: Array

    def at(self, t: Any) -> tuple[Array, Array, Array, Array]:
        """Return the mean (..., n), the precision (..., n, n), and their derivatives in time."""
        first, last = self.begin, self.end
        if first is last:
            return first.mean, first.precision, np.zeros_like(first.mean), np.zeros_like(first.cov)
        a = np.asarray((t - self.start) / self.length)[..., None]
        v, w = self.slopes * self.length
        step = last.mean - first.mean
        mean = first.mean + a * (v + a * (3 * step - 2 * v - w + a * (v + w - 2 * step)))
        speed = v + a * (2 * (3 * step - 2 * v - w) + 3 * a * (v + w - 2 * step))
        a = a[..., None]
        precision = _inverse((1 - a) * first.cov + a * last.cov, first.straight)
        change = precision @ (first.cov - last.cov) @ precision
        return mean, precision, speed / self.length, change / self.length

    @property
    def substeps(self) -> int:
        """The substeps that resolve how g changes: the logarithm of its variances or its mean by half a deviation in each."""
        first, last, block = self.begin, self.end, np.ix_(self.begin.straight, self.begin.straight)
        if first is last or not len(first.straight):
            return 1
        ratios = np.log(np.linalg.eigvals(np.linalg.solve(last.cov[block], first.cov[block])).real)
        apart = np.sqrt(-2.0 * max(first.log(last.mean), last.log(first.mean)))
        return int(np.clip(np.ceil(2 * (np.abs(ratios).max() + apart)), 2, MOST_SUBSTEPS))


@dataclass(frozen=True, eq=False)
class Reversed:
    """The equation of psi over a part of an interval, in the time s = -t."""

    forward: Observations
    path: Path

    @cached_property
    def dynamics(self) -> Dynamics:
        """The drift F with the rate of -log psi along its characteristics, and the noise G."""
        ahead, system, theta, path = self.forward.dynamics, self.forward.system, self.forward.theta, self.path
        n, origin = system.n, np.zeros(system.n)

        def covariance(x: Array, t: Any) -> Array:
            return system.covariance(x if system.state_dependent else origin, t, theta)

        fixed = None if system.covariance_varies or system.state_dependent else covariance(origin, 0.0)

        def drift(x: Array, s: Any) -> Array:
            mean, precision, speed, change = path.at(-s)
            found, away = ahead.drift(x, -s), x - mean
            noise = covariance(x, -s) if fixed is None else fixed
            push = _times(precision, away)
            noisy = _times(noise, push)
            pulled = (found[..., :n] + 0.5 * noisy) * push
            if path.begin is not path.end:
                pulled += 0.5 * away * _times(change, away) - speed * push
            found[..., n] = -0.5 * np.einsum("...ij,...ij->...", noise, precision) - pulled @ np.ones(n)
            found[..., :n] = -found[..., :n] - noisy
            if system.spreading is not None:
                slopes = system.spreading(x, -s, theta)
                slopes[..., n] = 0.5 * slopes[..., n]
                found += slopes
            return found

        def jacobian(x: Array, s: float) -> Array:
            return -ahead.jacobian(x, -s) - (covariance(x, -s) if fixed is None else fixed) @ path.at(-s)[1]

        def noise(s0: float, s1: float) -> tuple[Array, Array]:
            whole, falling = ahead.noise(-s1, -s0)
            return whole, whole - falling

        diffusion = ahead.diffusion
        varying = ahead.varying or system.covariance_varies or path.begin is not path.end
        spread = None if diffusion is None else lambda x, s: diffusion(x, -s)
        return Dynamics(drift, jacobian, noise, varying, spread)

    def potential(self, ahead: Potential | None) -> Potential | None:
        """Return the factor of V over a substep in the time -t, from that in the time t."""
        return None if ahead is None else lambda grid, a, b, end: ahead(grid, -b, -a, not end)


def _times(matrix: Array, points: Array) -> Array:
    """Return one matrix or many (..., n, n) times points (..., n)."""
    return points @ matrix.T if matrix.ndim == 2 else (matrix @ points[..., None])[..., 0]


def _eighth_power(values: Array) -> Array:
    """Return values^8, at most 1e240; products are much faster than a power."""
    squares = np.square(np.minimum(values, 1e30))
    return np.square(np.square(squares))


class ReversedStepper(Stepper):
    """Substeps of psi.  Points that move beyond the reach of g stop there: what is there comes from the inside."""

    def __init__(self, part: Reversed, bounds: Bounds, tolerance: float):
        super().__init__(part.dynamics, bounds, tolerance)
        self.path = part.path

    def _far(self, x: Array, s: Any) -> Array:
        """Return -log g relative to the depth at which psi is cut off."""
        mean, precision, _, _ = self.path.at(-s)
        away = x - mean
        return np.asarray((_times(precision, away) * away) @ np.ones(away.shape[-1]) / self.bounds.reach**2)

    def _deciding(self) -> Dynamics:
        dynamics = super()._deciding()
        return dynamics._replace(drift=lambda x, t: dynamics.drift(x, t) / (1.0 + _eighth_power(self._far(x, t)))[..., None])

    def _within(self, moved: Array, goal: Grid, t0: float) -> Array:
        """Return displacements with a rate that lets b fall to zero where psi is cut off: exp of the rate may be large there."""
        far = self._far(goal.points + moved[:, : goal.n], t0)
        fall = _eighth_power(np.where(np.isfinite(far), far / CUT, 0.0))
        moved = moved.copy()
        moved[:, -1] = np.maximum(moved[:, -1] - fall, LOWEST)
        return moved


def gauge_of(mean: Array, cov: Array, periodic: tuple[bool, ...], more: Array | float = 0.0) -> Gauge:
    """Return the g of a density with these moments: a Gaussian wider than it, by `more` at least."""
    wide, angle = WIDER * cov + more, np.array(periodic)
    wide[angle, :], wide[:, angle], wide[angle, angle] = 0.0, 0.0, ANGLE
    return Gauge(mean, wide, np.flatnonzero(~angle))


def path_of(observations: Observations, k: int, mean: Array, cov: Array, periodic: tuple[bool, ...], end: Gauge) -> Path:
    """Return the Gaussians over interval k that cover a density with these moments at its start, and lead to a later one.

    They cover a bridge of the process from the one to the other: g may be far wider than a density, but not narrower.
    """
    parts, length, theta = observations.parts(k), float(observations.lengths[k]), observations.theta.real
    slopes, noise = np.zeros((2, len(mean))), np.zeros_like(cov)
    ends = (mean, parts[0], parts[0][0]), (end.mean, parts[-1], sum(parts[-1]))
    systems = [observations.over(*part).system for _, part, _ in ends]
    for system, (x, _, t) in zip(systems, ends, strict=True):
        noise += 0.5 * length * np.reshape(system.covariance(x, t, theta), cov.shape)
    if not len(end.straight) or end.covers(mean, cov + 0.25 * noise):
        return Path(end, end, parts[0][0], length, slopes)
    for i, (system, (x, _, t)) in enumerate(zip(systems, ends, strict=True)):
        slopes[i, end.straight] = np.nan_to_num(system.drift(x[None], t, theta)[0, end.straight])
    curved = (slopes[0] - slopes[1]) * length / 8  # what the cubic path differs from a straight line
    begin = gauge_of(mean, cov, periodic, noise + 0.5 * np.outer(curved, curved))
    return Path(begin, end, parts[0][0], length, slopes)
