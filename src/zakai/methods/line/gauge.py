"""The operator of a message of one state on a grid, in a gauge in which it is symmetric.

A message b obeys -b_t = G b'' / 2 + f b'.  What is moved is psi = e^s b with s' = (mu - G'/2) / G, where mu is the drift of a
process that keeps to the grid: f in its middle, f + G F'/F towards its ends, with an F that falls to zero.  Where no coefficient
depends on t, the operator of psi has a decomposition (`numerics/line/operator.py`, Spectral).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from zakai.methods.line.message import FALL, HALF, PAD
from zakai.methods.line.system import Prepared
from zakai.methods.line.tables import covariance_at, covariance_between, drift_at, finite
from zakai.numerics.line import window as lw
from zakai.numerics.line.operator import Spectral, symmetric
from zakai.numerics.line.panels import GAUSS_NODES, GAUSS_WEIGHTS

Array = Any


@lru_cache(maxsize=64)
def fall(size: int, closed: bool) -> tuple[Array, Array, Array]:
    """Return F, F'/F and its derivative at the points of a grid (size,) with the spacing one."""
    if closed:
        return np.ones(size), np.zeros(size), np.zeros(size)
    from scipy.special import erfc, erfcx

    i = np.arange(size)
    y = (np.maximum(PAD - i, PAD - i[::-1]) - HALF) / FALL
    side = np.where(i < size / 2, -1.0, 1.0)
    with np.errstate(over="ignore"):
        slope = -2.0 / (np.sqrt(np.pi) * erfcx(y)) / FALL  # of log(erfc(y) / 2)
    return 0.5 * erfc(y), slope * side, -slope * (2.0 * y / FALL + slope)


class Gauge(NamedTuple):
    """s, s' and s'' at the points of a grid (N,), and the decomposition of the operator where no coefficient depends on t."""

    values: Array
    slope: Array
    curvature: Array
    modes: Spectral | None


def gauge_of(prepared: Prepared, window: lw.Window, t: float) -> Gauge:
    """Return the gauge for the coefficients at a time; that of F alone where f or G is not smooth, or s is not periodic."""
    system, theta, spacing = prepared.system, prepared.theta.real, window.spacing
    falling, slope, curvature = fall(window.size, window.closed)
    slope, curvature = slope / spacing, curvature / spacing**2
    with np.errstate(divide="ignore"):
        plain = Gauge(np.log(falling), slope, curvature, None)
    if system.slope is None or system.spread is None:
        return plain._replace(values=np.zeros(window.size))
    points = window.points[:, None]
    G, spread = covariance_at(system, window.points, t, theta) * np.ones(window.size), np.zeros(window.size)
    if system.state_dependent:
        spread = finite(system.spread(points, t, theta)[:, 0])
    if not (G > 0).all():
        return plain._replace(values=np.zeros(window.size))
    f, f_slope = drift_at(system, window, t, theta), finite(system.slope(points, t, theta)[:, 0])
    nodes = (points + spacing * GAUSS_NODES).reshape(-1, 1)
    inner = finite(system.drift(nodes, t, theta)[:, 0]) / (covariance_at(system, nodes[:, 0], t, theta) * np.ones(len(nodes)))
    steps = spacing * (inner.reshape(window.size, -1) @ GAUSS_WEIGHTS)
    if window.closed and abs(np.sum(steps)) > 1e-12 * max(1.0, float(np.sum(np.abs(steps)))):
        return plain._replace(values=np.zeros(window.size))
    s = np.concatenate([np.zeros(1), np.cumsum(steps[:-1])]) - 0.5 * np.log(G)
    s = s - s[window.size // 2]
    mu, mu_slope = f + G * slope, f_slope + spread * slope + G * curvature
    own = (mu - 0.5 * spread) / G
    modes = None
    if not system.varying and window.size <= lw.SIZES[-1]:
        potential, between = 0.5 * ((mu - 0.5 * spread) ** 2 / G + mu_slope), float(G[0])
        if system.state_dependent:
            potential = potential - 0.25 * finite(system.spread(points, t, theta)[:, 1])
            between = covariance_between(system, window, t, theta)
        modes = Spectral(symmetric(window.closed, spacing, between, potential), s)
    change = mu_slope / G - mu * spread / G**2
    if system.state_dependent:
        change = derivative(own, spacing, window.closed)
    return Gauge(s, own, change, modes)


def derivative(values: Array, spacing: float, closed: bool) -> Array:
    """Return the derivative of a function on a grid by differences of order six."""
    found = np.gradient(values, spacing, edge_order=2)
    inner = sum(c * (np.roll(values, -j) - np.roll(values, j)) for j, c in ((1, 0.75), (2, -0.15), (3, 1 / 60))) / spacing
    return inner if closed else np.concatenate([found[:3], inner[3:-3], found[-3:]])
