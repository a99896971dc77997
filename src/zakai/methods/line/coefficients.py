"""The coefficients of the equation of one state at the points of a grid and times of an interval."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.methods.line.cross import with_cross_noise
from zakai.methods.line.model import within
from zakai.methods.line.system import Prepared
from zakai.methods.line.tables import covariance_at, drift_at, finite, tables
from zakai.numerics.line import window as lw
from zakai.numerics.line.panels import Panels, panels

Array = Any

GROWTH = 12.0  # largest growth by the potential in one substep where there is no mass, as a logarithm


def coefficients(
    prepared: Prepared, window: lw.Window, times: np.ndarray, inside: np.ndarray, rates: np.ndarray, values: Array,
    shifts: Array | None = None,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Return f (T, N), G (T,) or (T, N), V less a constant (T, N) and the constant (T,).

    At the times the points of the grid are displaced by `shifts` (T,) or (T, N).
    """
    system, theta = prepared.system, prepared.theta
    points = window.points[:, None] if shifts is None else (window.points + shifts.reshape(len(times), -1))[..., None]
    if shifts is not None:
        drift = finite(system.drift(points, times[:, None], theta)[..., 0])
        covariance = covariance_at(system, points[..., 0], times, theta)
    elif system.moving:
        drift = drift_at(system, window, times, theta)
        covariance = covariance_at(system, window.points, times, theta)
    else:
        known = tables(prepared, window)
        drift = np.broadcast_to(known.drift, (len(times), len(known.drift)))
        covariance = np.broadcast_to(known.covariance, (len(times), *np.shape(known.covariance)))
    if not inside.any():
        return drift, covariance, np.zeros(drift.shape), np.zeros(len(times))
    if system.steady_observation and system.steady_noise and system.cross is None and shifts is None:
        h = tables(prepared, window).observation
        value, constant = potential_of(h, precision_of(prepared, times, inside), rates, values)
        return drift, covariance, np.broadcast_to(value, (len(times), len(value))), np.full(len(times), constant)
    if system.steady_observation and shifts is None:
        h = np.broadcast_to(tables(prepared, window).observation, (len(times), system.m, drift.shape[1]))
    else:
        h = np.moveaxis(system.observation(points, times[:, None], theta), -1, 1)
    precision = np.broadcast_to(precision_of(prepared, times, inside), (len(times), system.m, system.m))
    potentials, constants = zip(*[potential_of(*pair, rates, values) for pair in zip(h, precision, strict=True)], strict=True)
    found = drift, covariance, np.stack(potentials), np.array(constants)
    return found if system.cross is None else with_cross_noise(prepared, points, times, rates, h, precision, found)


def precision_of(prepared: Prepared, times: Any, inside: np.ndarray) -> Array:
    """Return the inverse of the block of S of the coordinates that act inside, zero elsewhere, (..., m, m)."""
    system = prepared.system
    both = inside[:, None] & inside

    def make(times: Any) -> Array:
        noise = system.noise(np.zeros((*np.shape(times), 1)), times, prepared.theta)
        return np.where(both, np.linalg.inv(np.where(both, noise, 0.0) + np.diag(1.0 * ~inside)), 0.0)

    if system.steady_noise:
        return prepared.once(("inside", inside.tobytes()), lambda: make(prepared.model.start))
    return make(times)


def potential_of(h: Array, precision: Array, rates: np.ndarray, values: Array) -> tuple[Array, Any]:
    """Return h'S^-1 (dy/dt - h / 2) less its value at the maximum of the density (N,), and that value.

    Large numbers cancel before they are squared.  Where h has no value the potential is a large negative number.
    """
    centre = finite(h[:, int(np.argmax(values.real))])
    rest, weighted = h - centre[:, None], precision @ (rates - centre)
    with np.errstate(all="ignore"):
        value = np.sum(finite(rest) * (weighted[:, None] - 0.5 * (precision @ finite(rest))), axis=0)
    value = np.where(np.isfinite(h.real).all(axis=0) & (value.real > -1e8), value, -1e8)
    return value, centre @ (precision @ (rates - 0.5 * centre))


def offset_of(potential: Array, values: Array) -> tuple[float, float]:
    """Return the largest integral of V where there is mass, and how much larger it is where there is none."""
    mass = values.real > 1e-6 * values.real.max()
    if not mass.any() or not np.isfinite(potential.real).all():
        return 0.0, 0.0
    top = float(np.max(potential.real[mass]))
    return top, float(np.max(potential.real)) - top


def resolved_parts(
    prepared: Prepared, values: Array, window: lw.Window, start: float, length: float, inside: np.ndarray
) -> Panels:
    """Return parts of the interval in each of which the coefficients are polynomials of time, nearly."""
    system, theta = prepared.system, prepared.theta.real
    look = lw.figures(values, window.closed)
    first, last = look.first, look.last
    x = window.points[np.unique(np.linspace(first, last, 7).astype(int))]

    bounds, error = [], 0.0
    for low, high in system.pieces(start, start + length):

        def at(times: Array, low: float = low, high: float = high) -> Array:
            t = within(start + times, low, high)
            columns = []
            if system.moving:
                columns.append(system.drift(x[:, None], t[:, None], theta)[..., 0])
                columns.append(covariance_at(system, x, t, theta).reshape(len(t), -1))
            if inside.any() and not system.steady_observation:
                columns.append(system.observation(x[:, None], t[:, None], theta)[..., inside].reshape(len(t), -1))
            if inside.any() and not system.steady_noise:
                noise = system.noise(np.zeros((len(t), 1)), t, theta)[:, inside][..., inside]
                columns.append(np.linalg.inv(noise).reshape(len(t), -1))
            if inside.any() and system.cross is not None and not system.steady_cross:
                columns.append(system.cross(x[:, None], t[:, None], theta).reshape(len(t), -1))
            return finite(np.concatenate(columns, axis=1)) if columns else np.zeros((len(t), 1))

        found = panels(at, low - start, length if high == start + length else high - start)
        error += found.error
        bounds += found.bounds
    return Panels(bounds, error)
