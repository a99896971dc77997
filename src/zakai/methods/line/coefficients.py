"""The coefficients of the equation of one state at the points of a grid, and the decomposition of its operator there.

    u_t = (G u)'' / 2 - (f u)' + (h'S^-1 dy/dt - h'S^-1 h / 2) u

Where the noises are correlated, E dv dw' = C dt, with a = g C, K = S^-1 and y linear between observations,

    u_t = ((G - a K a') u)'' / 2 - ((f - a K h - a_x K a' / 2 + a K dy/dt) u)' + (h'K dy/dt - h'K h / 2 - h_x'K a' / 2) u,

which is u_t = L u - sum K_ij M_i M_j u / 2 + sum K_ij (dy_j/dt) M_i u with M_i u = h_i u - (a_i u)', the Zakai equation in the
sense of Stratonovich.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai.methods.line.cache import Derived
from zakai.methods.line.model import System, finite, within
from zakai.methods.line.prepared import Prepared, TimeInterval
from zakai.numerics.arrays import Array, Number
from zakai.numerics.line import window as lw
from zakai.numerics.line.averages import GAUSS_NODES, GAUSS_WEIGHTS, Panels, panels
from zakai.numerics.line.grid_choice import PER, PROFILE, REACH
from zakai.numerics.line.operator import Spectral, symmetric
from zakai.numerics.line.product import NODES_OF_SPACING, at_nodes, nodes, places_of_nodes, weak

_MIDPOINTS = (np.arange(32) + 0.5) / 32.0 - 0.5


class Tables(NamedTuple):
    """f and h at the points of a grid where they do not depend on t: (N,), (m, N); and G, (N,) where it depends on x."""

    drift: Array
    observation: Array
    covariance: Array


def tables(prepared: Prepared, window: lw.Points) -> Tables:
    """Return the tables of a grid."""
    system, theta, start = prepared.system, prepared.theta, prepared.model.start

    def make() -> Tables:
        points = window.points[:, None]
        drift = drift_at(system, window, start, theta)
        observation = system.observation(points, start, theta).T
        return Tables(drift, observation, covariance_at(system, window.points, start, theta))

    result: Tables = prepared.once(Derived.TABLES, window, make)
    return result


def spectral(prepared: Prepared, window: lw.Window) -> Spectral | None:
    """Return the decomposition of the operator on a grid, if it has one."""
    result: tuple[Spectral | None] = prepared.once(Derived.MODES, window, lambda: (decomposed(prepared, window, lw.LARGEST),))
    return result[0]


def sensor_at_nodes(prepared: Prepared, points: Array, spacing: float) -> Array:
    """Return an h with kinks or jumps (m, F, P) at the places of the nodes of a grid."""
    system, start = prepared.system, prepared.model.start
    values = system.observation(nodes(points, spacing)[:, None], start, prepared.theta).T
    return places_of_nodes(values, system.jumping_observation)


def profile_of(prepared: Prepared, window: lw.Window) -> Array:
    """Return f, f' and G (3, L) at offsets from the origin that are unit / PER apart, of kinked systems the largest G alone."""
    if prepared.kinked:
        return np.full((3, 1), np.max(tables(prepared, window).covariance))

    def make() -> Array:
        system, start, theta = prepared.system, prepared.model.start, prepared.theta
        x = window.origin + window.unit / PER * (np.arange(PROFILE) - PROFILE // 2.0)
        f = finite(system.drift(x[:, None], start, theta)[:, 0])
        return np.stack([f, np.gradient(f, x), covariance_at(system, x, start, theta) * np.ones(len(x))])

    result: Array = prepared.once(Derived.PROFILE, (window.origin, window.unit), make)
    return result


def drift_at(system: System, window: lw.Points, t: Array | float, theta: Array) -> Array:
    """Return f at the points of a grid and times (...), (..., N).

    Of an f with jumps it is the mean over the spacing around a point, less the second difference that a smooth f adds to it.
    """
    times = np.asarray(t)[..., None]
    if system.slope is not None or not isinstance(window, lw.Window):
        return finite(system.drift(window.points[:, None], times, theta)[..., 0])
    around = window.origin + window.centre + window.spacing * (np.arange(-1, window.size + 1) - window.size // 2)
    nodes = (around[:, None] + window.spacing * _MIDPOINTS).reshape(-1, 1)
    means = finite(system.drift(nodes, times, theta)[..., 0]).reshape(*times.shape[:-1], window.size + 2, -1).mean(axis=-1)
    return np.asarray(means[..., 1:-1] - (means[..., 2:] - 2.0 * means[..., 1:-1] + means[..., :-2]) / 24.0)


def covariance_at(system: System, points: Array, t: Array | float, theta: Array) -> Array:
    """Return G at points (..., N) and times (...): (..., N), or (...) if it is constant; zero where g has no value."""
    if system.state_dependent:
        result = finite(system.covariance(points[..., None], np.asarray(t)[..., None], theta)[..., 0, 0])
        return np.where(result.real > 0.0, result, 0.0)
    return system.covariance(np.zeros((*np.shape(t), 1)), t, theta)[..., 0, 0]


def covariance_between(system: System, window: lw.Window, t: Array | float, theta: Array) -> Array:
    """Return G half a spacing below each point of a grid, on the line also above the last one."""
    ends = np.concatenate([window.points - 0.5 * window.spacing, window.points[-1:] + 0.5 * window.spacing])
    return covariance_at(system, ends[:-1] if window.closed else ends, t, theta)


def gauge_at(prepared: Prepared, points: Array, parts: int = 1) -> Array:
    """Return int f / G from the first of increasing points (J,) to each, by Gauss' rule in equal parts of the steps between."""
    start, theta, steps = prepared.model.start, prepared.theta, np.diff(points) / parts
    nodes = (points[:-1, None] + steps[:, None] * (np.arange(parts)[:, None] + GAUSS_NODES).reshape(-1)).reshape(-1)
    slopes = prepared.system.drift(nodes[:, None], start, theta)[:, 0] / covariance_at(prepared.system, nodes, start, theta)
    return np.append(0.0, np.cumsum(steps * (slopes.reshape(len(steps), parts, -1) @ GAUSS_WEIGHTS).sum(axis=1)))


def decomposed(prepared: Prepared, window: lw.Window, largest: int, ends: tuple[Array, Array] | None = None) -> Spectral | None:
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
    points, parts = window.points[:, None], NODES_OF_SPACING if system.rough else 1
    spread = curvature = np.zeros(1)
    scale = np.ones(1)
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


GROWTH = 12.0  # largest growth by the potential in one substep where there is no mass, as a logarithm


class Coefficients(NamedTuple):
    """f (T, N), G (T,) or (T, N), V less a constant (T, N) and the constant (T,), at T times and N points."""

    drift: Array
    covariance: Array
    potential: Array
    constant: Array


def coefficients(
    prepared: Prepared, window: lw.Points, times: np.ndarray, inside: np.ndarray, rates: np.ndarray, values: Array,
    shifts: Array | None = None,
) -> Coefficients:  # fmt: skip
    """Return the coefficients at times (T,), at which the points of the grid are displaced by `shifts` (T,) or (T, N)."""
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
        return Coefficients(drift, covariance, np.zeros(drift.shape), np.zeros(len(times)))
    if system.steady_observation and system.steady_noise and system.cross is None and shifts is None:
        h = tables(prepared, window).observation
        value, constant = potential_of(h, precision_of(prepared, times, inside), rates, values)
        return Coefficients(drift, covariance, np.broadcast_to(value, (len(times), len(value))), np.full(len(times), constant))
    if system.steady_observation and shifts is None:
        h = np.broadcast_to(tables(prepared, window).observation, (len(times), system.m, drift.shape[1]))
    else:
        h = np.moveaxis(system.observation(points, times[:, None], theta), -1, 1)
    precision = np.broadcast_to(precision_of(prepared, times, inside), (len(times), system.m, system.m))
    potentials, constants = zip(*[potential_of(*pair, rates, values) for pair in zip(h, precision, strict=True)], strict=True)
    result = Coefficients(drift, covariance, np.stack(potentials), np.array(constants))
    return result if system.cross is None else with_cross_noise(prepared, points, times, rates, h, precision, result)


def precision_of(prepared: Prepared, times: Array | float, inside: np.ndarray) -> Array:
    """Return the inverse of the block of S of the coordinates that act inside, zero elsewhere, (..., m, m)."""
    system = prepared.system
    both = inside[:, None] & inside

    def make(times: Array | float) -> Array:
        noise = system.noise(np.zeros((*np.shape(times), 1)), times, prepared.theta)
        return np.where(both, np.linalg.inv(np.where(both, noise, 0.0) + np.diag(1.0 * ~inside)), 0.0)

    if system.steady_noise:
        return prepared.once(Derived.PRECISION, inside.tobytes(), lambda: make(prepared.model.start))
    return make(times)


def potential_of(h: Array, precision: Array, rates: np.ndarray, values: Array) -> tuple[Array, Number]:
    """Return h'S^-1 (dy/dt - h / 2) less its value at the maximum of the density (N,), and that value.

    Large numbers cancel before they are squared.  Where h has no value the potential is a large negative number.
    """
    centre = finite(h[:, int(np.argmax(values.real))])
    rest, weighted = h - centre[:, None], precision @ (rates - centre)
    with np.errstate(all="ignore"):
        value = np.sum(finite(rest) * (weighted[:, None] - 0.5 * (precision @ finite(rest))), axis=0)
    value = np.where(np.isfinite(h.real).all(axis=0) & (value.real > -1e8), value, -1e8)
    return value, np.dot(centre, precision @ (rates - 0.5 * centre))


def offset_of(potential: Array, values: Array) -> tuple[float, float]:
    """Return the largest integral of V where there is mass, and how much larger it is where there is none."""
    mass = values.real > 1e-6 * values.real.max()
    if not mass.any() or not np.isfinite(potential.real).all():
        return 0.0, 0.0
    top = float(np.max(potential.real[mass]))
    return top, float(np.max(potential.real)) - top


def resolved_parts(prepared: Prepared, values: Array, window: lw.Points, interval: TimeInterval) -> Panels:
    """Return parts of the interval in each of which the coefficients are polynomials of time, nearly."""
    system, theta, (_, start, length, inside, _) = prepared.system, prepared.theta.real, interval
    check = lw.grid_check(values, window.closed)
    first, last = check.first, check.last
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

        result = panels(at, low - start, length if high == start + length else high - start)
        error += result.error
        bounds += result.bounds
    return Panels(bounds, error)


def with_cross_noise(
    prepared: Prepared, points: Array, times: Array, rates: Array, h: Array, precision: Array, coefficients: Coefficients
) -> Coefficients:
    """Return the coefficients of the equation with correlated noise from those with independent noise.

    Args:
        points: the points (N, 1) or (T, N, 1).
        times: (T,).
        rates: dy/dt (m,).
        h: (T, m, N).
        precision: K (T, m, m), zero for coordinates that do not act inside of the interval.
        coefficients: those with independent noise.
    """
    drift, covariance, potential, constant = coefficients
    parts = prepared.system.cross(points, times[:, None], prepared.theta)  # type: ignore[misc]
    cross, slope, h_slope = np.moveaxis(finite(parts), (2, 3), (0, 2))
    gain = precision @ cross
    covariance = np.broadcast_to(covariance[..., None] if covariance.ndim == 1 else covariance, drift.shape)
    rest = covariance - np.sum(gain * cross, axis=1)
    rest = np.where(rest.real > 1e-13 * covariance.real, rest, 0.0)
    drift = drift - np.sum(gain * (finite(h) - rates[:, None] + 0.5 * slope), axis=1)
    return Coefficients(drift, rest, potential - 0.5 * np.sum(gain * h_slope, axis=1), constant)


HIDDEN = 0.05  # share of the drift that interpolation between the points may miss: a wave has at least five points
SLIGHT = 1e-4  # of the largest drift: less is rounding
BETWEEN = 0.5 * (np.sqrt(5.0) - 1.0)  # place in a spacing: the golden ratio is far from every fraction of a period
_CUBIC = np.array([np.prod([(BETWEEN - m) / (j - m) for m in range(-1, 3) if m != j]) for j in range(-1, 3)])


def on_grid_for_drift(
    prepared: Prepared, values: Array, window: lw.Window, start: float, length: float
) -> tuple[Array, lw.Window]:
    """Return a density at the start of an interval on a grid that shows the drift, and this grid.

    The density alone does not tell its grid: a broad prior is resolved by spacings of a period of f = sin(x), at which f is zero
    everywhere.  Where f has kinks or jumps other bounds hold.
    """
    if prepared.kinked or prepared.system.rough or not length > 0.0:
        return values, window
    deviation = float(np.sqrt(lw.moments(values.real, window)[1]))
    while window.size < lw.SIZES[-1]:
        hidden, whole = _hidden(prepared, window, start)
        share, size = (float(np.abs(values.real) @ one) for one in (hidden, whole))
        if share <= HIDDEN * size or HIDDEN * length * size <= prepared.tolerance * deviation:
            break
        new = lw.refined(window, 2.0)
        values = lw.resampled(values, window, new)
        values, window = values / np.sum(values), new
    return values, window


def misses_drift(prepared: Prepared, window: lw.Window) -> bool:
    """Return whether a density may be on this grid that does not show a drift without time."""
    steady = not (prepared.kinked or prepared.system.rough or prepared.system.varying)
    return steady and bool(_hidden(prepared, window, prepared.model.start)[0].any())


def _hidden(prepared: Prepared, window: lw.Window, start: float) -> tuple[Array, Array]:
    """Return the error of f after each point, by cubic interpolation, where it counts, and the size of f there, (N,) each."""

    def make() -> tuple[Array, Array]:
        around = window.origin + window.centre + window.spacing * (np.arange(-1, window.size + 2) - window.size // 2)
        theta = prepared.theta.real
        known, between = (
            finite(prepared.system.drift(x[:, None], start, theta)[:, 0])
            for x in (around, around[1:-2] + BETWEEN * window.spacing)
        )
        result = np.array(sum(c * known[j : j + window.size] for j, c in enumerate(_CUBIC)))
        error, whole = np.abs(between - result), np.maximum(np.abs(between), np.abs(result))
        return np.where(error > np.maximum(HIDDEN * whole, SLIGHT * np.max(whole)), error, 0.0), whole

    if prepared.system.varying:
        return make()
    pair: tuple[Array, Array] = prepared.once(Derived.HIDDEN_DRIFT, window, make)
    return pair


CONTRACTED = -2.0  # f' times the length of an interval, below which other grids hold a density that becomes much sharper


def travel(prepared: Prepared, values: Array, window: lw.Window, start: float, length: float) -> float:
    """Return by how many of its ranges the drift moves a density in an interval, zero where grids do not move with it.

    They do not where noise moves the state as far, or the density becomes much sharper.
    """
    system = prepared.system
    if window.closed or prepared.kinked or system.kinks is not None or system.cross is not None or system.reflecting:
        return 0.0
    check, (carried, growth) = lw.grid_check(values, False), displaced(prepared, values, window, start, length)
    G = covariance_at(system, window.points[[check.first, check.last]], start, prepared.theta.real)
    noise = float(np.sqrt(np.max(G.real) * length))
    if growth < CONTRACTED or abs(carried) < noise:
        return 0.0
    return abs(carried) / (window.spacing * (check.last - check.first + 1) + 2.0 * REACH * noise)


def speed_of(prepared: Prepared, values: Array, window: lw.Window, start: float, length: float) -> float:
    """Return the speed with which a grid follows a density in a substep: a whole number of its spacings in that time."""
    carried, _ = displaced(prepared, values, window, start, length)
    return window.spacing * float(np.round(carried / window.spacing)) / length


def displaced(prepared: Prepared, values: Array, window: lw.Window, start: float, length: float) -> tuple[float, float]:
    """Return about how far the drift carries the mean of a density, by its linearisation there, and f' times the length."""
    mean, variance = lw.moments(values, window)
    x = window.origin + float(mean.real) + float(np.sqrt(variance.real)) * np.array([0.0, -0.1, 0.1])
    here, below, above = finite(prepared.system.drift(x[:, None], start, prepared.theta.real)[:, 0]).tolist()
    growth = length * (above - below) / (x[2] - x[1])
    result = length * here * (np.expm1(min(growth, 3.0)) / growth if abs(growth) > 1e-8 else 1.0)
    return (float(result), float(growth)) if np.isfinite(result) else (0.0, 0.0)
