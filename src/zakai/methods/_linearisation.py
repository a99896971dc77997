"""How far a system is from linear over a Gaussian, by the cubature rule of degree three.

With the 2 n points m +- sqrt(n) L_i, P = L L', the means and covariances of f and h over N(m, P) replace those of their
linearisations at m.  The figure is the largest change that this makes: of a predicted mean in standard deviations, of a variance
relative to it.  It is zero for a linear system.
"""

from __future__ import annotations

import numpy as np

from zakai.methods._linearised_system import Formulas, Part
from zakai.numerics.linear_flow import linear_flow
from zakai.numerics.transition import Array


def of_motion(formulas: Formulas, mean: Array, cov: Array, after: Array, part: Part, length: float, theta: Array) -> float:
    """Return the figure of the motion over a length of time, with the covariance `after` it."""
    n = len(mean)
    points = _points(mean, cov)
    f, slope, change, _ = formulas.drift(mean, part.start, theta, part.u, part.rate)
    apart = formulas.motion(points, np.asarray(part.start), theta, part.u)[:, :n] - f
    _, shift, _ = linear_flow(slope, 0.0 * change, apart.mean(axis=0), np.zeros((n, n)), length, 0.0)
    across = (points - mean).T @ apart / len(points) - cov @ slope.T
    _, spread, _ = linear_flow(2.0 * slope, 0.0 * change, 2.0 * np.diagonal(across), np.zeros((n, n)), length, 0.0)
    return _largest(shift, spread, np.diagonal(after))


def of_sensor(
    formulas: Formulas, mean: Array, cov: Array, spans: Array, noise: Array, t: float, theta: Array, u: Array | None
) -> float:
    """Return the figure of `spans` (m,) times h with a noise (m, m), relative to what is expected to be observed."""
    value, slope = formulas.observe(mean, t, theta, u)
    apart = spans * (formulas.sensor(_points(mean, cov), np.asarray(t), theta, u)[:, : len(value)] - value)
    bias, H = apart.mean(axis=0), spans[:, None] * slope
    linear = np.einsum("in,nk,ik->i", H, cov, H)
    return _largest(bias, np.mean((apart - bias) ** 2, axis=0) - linear, linear + np.diagonal(noise))


def _points(mean: Array, cov: Array) -> Array:
    values, vectors = np.linalg.eigh(cov)
    steps = np.sqrt(len(mean) * np.maximum(values, 0.0))[:, None] * vectors.T
    return np.concatenate([mean + steps, mean - steps])


def _largest(shift: Array, spread: Array, variance: Array) -> float:
    wide = variance > 0
    changes = np.concatenate([np.abs(shift[wide]) / np.sqrt(variance[wide]), np.abs(spread[wide]) / variance[wide]])
    return float(np.max(changes, initial=0.0))
