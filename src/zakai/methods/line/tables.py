"""The formulas of a model with one state at the points of a grid, and the decomposition of its operator there."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.methods.line.model import System
from zakai.methods.line.system import Prepared
from zakai.numerics.line import window as lw
from zakai.numerics.line.operator import Spectral, symmetric
from zakai.numerics.line.outlook import PROFILE
from zakai.numerics.line.panels import GAUSS_NODES, GAUSS_WEIGHTS
from zakai.numerics.line.place import PER
from zakai.numerics.line.weak import PARTS, at_nodes, nodes, weak

Array = Any

_MIDPOINTS = (np.arange(32) + 0.5) / 32.0 - 0.5


class Tables(NamedTuple):
    """f and h at the points of a grid where they do not depend on t: (N,), (m, N); and G, (N,) where it depends on x."""

    drift: Array
    observation: Array
    covariance: Any


def finite(values: Array) -> Array:
    """Return the values with zero where a formula has no value."""
    return np.where(np.isfinite(values.real), values, 0.0)


def tables(prepared: Prepared, window: lw.Window) -> Tables:
    """Return the tables of a grid."""
    system, theta, start = prepared.system, prepared.theta, prepared.model.start

    def make() -> Tables:
        points = window.points[:, None]
        drift = drift_at(system, window, start, theta)
        observation = system.observation(points, start, theta).T
        return Tables(drift, observation, covariance_at(system, window.points, start, theta))

    found: Tables = prepared.once(window, make)
    return found


def spectral(prepared: Prepared, window: lw.Window) -> Spectral | None:
    """Return the decomposition of the operator on a grid, if it has one."""
    found: tuple[Spectral | None] = prepared.once(("spectral", window), lambda: (decomposed(prepared, window, lw.LARGEST),))
    return found[0]


def profile_of(prepared: Prepared, window: lw.Window) -> Array:
    """Return f, f' and G (3, L) at offsets from the origin that are unit / PER apart, of kinked systems the largest G alone."""
    if prepared.kinked:
        return np.full((3, 1), np.max(tables(prepared, window).covariance))

    def make() -> Array:
        system, start, theta = prepared.system, prepared.model.start, prepared.theta
        x = window.origin + window.unit / PER * (np.arange(PROFILE) - PROFILE // 2.0)
        f = finite(system.drift(x[:, None], start, theta)[:, 0])
        return np.stack([f, np.gradient(f, x), covariance_at(system, x, start, theta) * np.ones(len(x))])

    found: Array = prepared.once(("profile", window.origin, window.unit), make)
    return found


def drift_at(system: System, window: lw.Window, t: Array, theta: Array) -> Array:
    """Return f at the points of a grid and times (...), (..., N).

    Of an f with jumps it is the mean over the spacing around a point, less the second difference that a smooth f adds to it.
    """
    times = np.asarray(t)[..., None]
    if system.slope is not None or not isinstance(window, lw.Window):
        return finite(system.drift(window.points[:, None], times, theta)[..., 0])
    around = window.origin + window.centre + window.spacing * (np.arange(-1, window.size + 1) - window.size // 2)
    nodes = (around[:, None] + window.spacing * _MIDPOINTS).reshape(-1, 1)
    means = finite(system.drift(nodes, times, theta)[..., 0]).reshape(*times.shape[:-1], window.size + 2, -1).mean(axis=-1)
    return means[..., 1:-1] - (means[..., 2:] - 2.0 * means[..., 1:-1] + means[..., :-2]) / 24.0


def covariance_at(system: System, points: Array, t: Array, theta: Array) -> Array:
    """Return G at points (..., N) and times (...): (..., N), or (...) if it is constant; zero where g has no value."""
    if system.state_dependent:
        found = finite(system.covariance(points[..., None], np.asarray(t)[..., None], theta)[..., 0, 0])
        return np.where(found.real > 0.0, found, 0.0)
    return system.covariance(np.zeros((*np.shape(t), 1)), t, theta)[..., 0, 0]


def covariance_between(system: System, window: lw.Window, t: Array, theta: Array) -> Array:
    """Return G half a spacing below each point of a grid, on the line also above the last one."""
    ends = np.concatenate([window.points - 0.5 * window.spacing, window.points[-1:] + 0.5 * window.spacing])
    return covariance_at(system, ends[:-1] if window.closed else ends, t, theta)


def gauge_at(prepared: Prepared, points: Array, parts: int = 1) -> Array:
    """Return int f / G from the first of increasing points (J,) to each, by Gauss' rule in equal parts of the steps between."""
    start, theta, steps = prepared.model.start, prepared.theta, np.diff(points) / parts
    nodes = (points[:-1, None] + steps[:, None] * (np.arange(parts)[:, None] + GAUSS_NODES).reshape(-1)).reshape(-1)
    slopes = prepared.system.drift(nodes[:, None], start, theta)[:, 0] / covariance_at(prepared.system, nodes, start, theta)
    return np.append(0.0, np.cumsum(steps * (slopes.reshape(len(steps), parts, -1) @ GAUSS_WEIGHTS).sum(axis=1)))


def decomposed(
    prepared: Prepared, window: lw.Window, largest: int, ends: tuple[Array, Array] | None = None
) -> Spectral | None:
    """Return the decomposition of the operator on a grid of at most so many points, None where there is none.

    With `ends`, F'/F and its derivative (N,) of a function F, the drift in the symmetric operator is f + G F'/F.
    """
    known = tables(prepared, window)
    drift, covariance = known.drift, known.covariance
    system, theta, start = prepared.system, prepared.theta, prepared.model.start
    if system.moving or system.slope is None or system.spread is None or window.size > largest:
        return None
    if not (covariance.real > 0).all():
        return None
    points, parts, spread, curvature, scale = window.points[:, None], PARTS if system.rough else 1, 0.0, 0.0, 1.0
    gauge = gauge_at(prepared, np.append(window.points, window.points[-1] + window.spacing), parts)
    if system.rough and not window.closed:
        x = nodes(window.points, window.spacing)
        drift, covariance = system.drift(x[:, None], start, theta)[:, 0], covariance_at(system, x, start, theta)
        drift = drift - (0.5 * system.spread(x[:, None], start, theta)[:, 0] if system.state_dependent else 0.0)
        drift, covariance = at_nodes(drift), at_nodes(np.broadcast_to(covariance, x.shape))
        potential = 0.5 * (weak(drift**2 / covariance, window.spacing)[0] + weak(drift, window.spacing)[1])
    else:
        slope = system.slope(points, start, theta)[:, 0]
        if system.state_dependent:
            spread, curvature = np.moveaxis(system.spread(points, start, theta), -1, 0)
        if ends is not None:
            drift, slope = drift + covariance * ends[0], slope + spread * ends[0] + covariance * ends[1]
        potential = 0.5 * ((drift - 0.5 * spread) ** 2 / covariance + slope - 0.5 * curvature)
    covariance = known.covariance
    if system.state_dependent:
        scale = 1.0 / np.sqrt(covariance)
        covariance = covariance_between(system, window, start, theta)
    if not np.isfinite(potential.real).all() or not np.isfinite(gauge.real).all():
        return None
    if window.closed and abs(gauge[-1].real) > 1e-12 * max(1.0, float(np.sum(np.abs(np.diff(gauge.real))))):
        return None
    modes = spectral(prepared.real, window) if np.iscomplexobj(theta) else None
    return Spectral(symmetric(window.closed, window.spacing, covariance, potential), gauge[:-1], scale, modes)
