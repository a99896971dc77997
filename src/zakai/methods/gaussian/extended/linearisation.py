"""How far a system is from linear over a Gaussian, by the cubature rule of degree three.

With the 2 n points m +- sqrt(n) L_i, P = L L', the means and covariances of f and h over N(m, P) replace those of their
linearisations at m.  The figure is the largest change that this makes: of a predicted mean in standard deviations, of a variance
relative to it.  It is zero for a linear system.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import expm

from zakai.densities._values import wrap
from zakai.methods.gaussian.extended.linearised_system import Formulas, Part, part_of
from zakai.numerics.transition import Array

if TYPE_CHECKING:
    from zakai.methods.gaussian.extended.filter import Prepared, State


def linearisation(prepared: Prepared, k: int, before: State, predicted: State, end_noise: Array) -> float:
    """Return how far the system is from linear over the density, in the motion of interval k and what is observed then.

    `end_noise` (m, m) is the covariance of what is observed at the end.
    """
    formulas, theta, schedule = prepared.formulas, prepared.theta.real, prepared.schedule
    (mean, cov), (later, after) = ((one.mean.real, one.cov.real) for one in (before, predicted))
    if not np.isfinite(cov).all() or not np.isfinite(after).all():
        return np.inf
    curved, j = 0.0, prepared.first[k]
    if schedule.stops[k] > schedule.starts[k]:
        part = part_of(prepared.parts, j)
        curved = _of_motion(formulas, mean, cov, after, part, float(schedule.lengths[k]), theta)
        if prepared.inside[k].any():
            spans, noise = prepared.inside[k].astype(float), 0.5 * prepared.rate_noise[j][0].real
            curved = max(curved, _of_sensor(formulas, mean, cov, spans, noise, part.start, theta, part.u))
    if prepared.at_end[k].any():
        spans, noise, u = prepared.spans[k], end_noise.real, prepared.end_inputs[k]
        curved = max(curved, _of_sensor(formulas, later, after, spans, noise, float(schedule.stops[k]), theta, u))
    return curved


def _of_motion(formulas: Formulas, mean: Array, cov: Array, after: Array, part: Part, length: float, theta: Array) -> float:
    """Return the figure of the motion over a length of time, with the covariance `after` it."""
    points = _points(mean, cov)
    f, slope, _, _ = formulas.drift(mean, part.start, theta, part.u, part.rate)
    apart = formulas.motion(points, np.asarray(part.start), theta, part.u)[:, : len(f)] - f
    shift = _gathered(slope, apart.mean(axis=0), length)
    across = (points - mean).T @ apart / len(points) - cov @ slope.T
    spread = _gathered(2.0 * slope, 2.0 * np.diagonal(across), length)
    return _largest(shift, spread, np.diagonal(after))


def _of_sensor(
    formulas: Formulas, mean: Array, cov: Array, spans: Array, noise: Array, t: float, theta: Array, u: Array | None
) -> float:
    """Return the figure of `spans` (m,) times h with a noise (m, m), relative to what is expected to be observed."""
    value, slope = formulas.observe(mean, t, theta, u)
    apart = spans * (formulas.sensor(_points(mean, cov), np.asarray(t), theta, u)[:, : len(value)] - value)
    apart = np.where(formulas.angles, wrap(apart), apart)
    bias, H = apart.mean(axis=0), spans[:, None] * slope
    linear = np.einsum("in,nk,ik->i", H, cov, H)
    return _largest(bias, np.mean((apart - bias) ** 2, axis=0) - linear, linear + np.diagonal(noise))


def _gathered(matrix: Array, rate: Array, length: float) -> Array:
    """Return x (n,) after a time from zero, dx = (A x + rate) dt."""
    n = len(rate)
    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n], whole[:n, n] = matrix, rate
    return np.asarray(expm(length * whole)[:n, n])


def _points(mean: Array, cov: Array) -> Array:
    steps = np.sqrt(len(mean)) * _root(cov).T
    return np.concatenate([mean + steps, mean - steps])


def _root(cov: Array) -> Array:
    """Return Cholesky's factor, with a column of zeros where no variance is left."""
    factor = np.zeros_like(cov)
    for j in range(len(cov)):
        rest = cov[j:, j] - factor[j:, :j] @ factor[j, :j]
        if rest[0] > 1e-14 * cov[j, j]:
            factor[j:, j] = rest / np.sqrt(rest[0])
    return factor


def _largest(shift: Array, spread: Array, variance: Array) -> float:
    wide = variance > 0
    changes = np.concatenate([np.abs(shift[wide]) / np.sqrt(variance[wide]), np.abs(spread[wide]) / variance[wide]])
    return float(np.max(np.nan_to_num(changes, nan=np.inf), initial=0.0))
