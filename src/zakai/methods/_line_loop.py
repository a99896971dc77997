"""Many steps in one compiled loop (`numerics/line_loop.py`), for `_line`.

A step that the loop does not take (an error above the tolerance, a gap in a path) is taken by `_line.step`, which asks this loop
for its one interval first: whether steps are taken one by one or together makes no difference.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.methods._line_system import Prepared, State, edge_of_moments, outside_tables, spectral, state_moments, tables
from zakai.methods._line_yau import Kernels
from zakai.methods._protocol import Info, Infos
from zakai.numerics import line_window as lw
from zakai.numerics.line_channel import Channels
from zakai.numerics.line_loop import (
    AFTER,
    COLUMNS,
    FACTOR,
    KERNEL,
    RANGE,
    SPLIT,
    SUBSTEPS,
    Grid,
    Limits,
    Steps,
    advance,
    narrow,
)
from zakai.numerics.line_transition import BAND, support

MARGIN = 0.2  # of a new grid, relative to the range of the density
KERNEL_SHARE = 2e-2  # of the promised error that the splitting of one increment with Gaussian kernels may leave
SHARE = 5e-3  # of the tolerance that the splitting of one increment may leave
BLOCK = 2048  # points by which the tables of a spacing are apart; a table has twice as many
TOGETHER = 4  # parts of which the kernels of all intervals are computed where one interval needs them
FINEST = 1024  # points of the largest grid
SHARED = 128  # points of the largest grid on which many steps share a decomposition
HEALTH = {
    "edge_mass": "edge",
    "negative_mass": "negative",
    "aliasing": "aliasing",
    "time_error": "time",
    "tail_depth": "depth",
    "error_estimate": "error",
}
_AT = {name: i for i, name in enumerate(COLUMNS)}


def grid_of(prepared: Prepared, window: lw.Window) -> Grid | None:
    """Return what the loop knows of a grid, None where the operator has no decomposition or a formula no value."""
    if not prepared.gaussian or prepared.yau is None:
        found: tuple[Grid | None] = prepared.once(("grid", window), lambda: (_decomposed_grid(prepared, window),))
        return found[0]
    offset = window.origin - prepared.origin
    if window.closed:
        table = prepared.once(("table", window), lambda: _table(prepared, window.points, True))
        start, first = 0, float(window.offsets[0])
    else:
        index = round(window.centre / window.spacing)
        block = BLOCK * round(index / BLOCK)
        begin = block - BLOCK
        points = window.origin + window.spacing * (begin + np.arange(2.0 * BLOCK))
        key = ("table", window.origin, window.spacing, block)
        table = prepared.once(key, lambda: _table(prepared, points, True))
        start, first = index - window.size // 2 - begin, window.spacing * begin
    if not np.isfinite(table[:, start : start + window.size]).all():
        return None
    covariance = float(tables_covariance(prepared))
    return Grid(np.zeros((0, 0)), np.zeros(0), table, start, offset + first, covariance, window.spacing, window.closed)


def tables_covariance(prepared: Prepared) -> Any:
    """Return G at the model's start."""
    return prepared.once("G", lambda: prepared.system.covariance(np.zeros(1), prepared.model.start, prepared.theta)[0, 0])


def _decomposed_grid(prepared: Prepared, window: lw.Window) -> Grid | None:
    if window.size > SHARED and not window.closed:  # the decomposition takes longer than steps on a coarser grid
        return None
    decomposed = spectral(prepared, window)
    if decomposed is None or not (decomposed.scale > 0).all():
        return None
    table = _table(prepared, window.points, False)
    table[0], table[1] = np.log(decomposed.scale), tables(prepared, window).drift
    if not np.isfinite(table).all():
        return None
    modes = np.ascontiguousarray(decomposed.modes)
    # Only the splitting of increments asks for G, which is constant there.
    covariance = float(np.max(tables(prepared, window).covariance))
    return Grid(modes, decomposed.rates, table, 0, 0.0, covariance, window.spacing, window.closed)


def _table(prepared: Prepared, x: np.ndarray, gauge: bool) -> np.ndarray:
    """Return phi, phi', h, h' and h'' at points (T,) as rows (2 + 3 m, T)."""
    system, theta, start, m = prepared.system, prepared.theta, prepared.model.start, prepared.system.m
    points, table = x[:, None], np.zeros((2 + 3 * prepared.system.m, len(x)))
    table[2 : 2 + m] = system.observation(points, start, theta).T
    if gauge and prepared.yau is not None:
        table[0] = prepared.yau.potential(x, start, theta)
        table[1] = prepared.yau.gauge_slope(points, start, theta)[:, 0]
    if not system.samples and system.observation_slope is not None and system.curvature is not None:
        table[2 + m : 2 + 2 * m] = system.observation_slope(points, start, theta).T
        table[2 + 2 * m :] = system.curvature(points, start, theta).T
    return table


def precisions_of(prepared: Prepared) -> tuple[np.ndarray, np.ndarray]:
    """Return the inverses of the observed blocks of S (K, m, m), and the constants of the log-likelihoods (K,)."""
    schedule, system = prepared.schedule, prepared.system
    seen = schedule.seen
    if system.general:  # the loop takes only intervals without observations
        return np.zeros((len(seen), system.m, system.m)), np.zeros(len(seen))
    if system.steady_noise:
        noise = np.broadcast_to(system.noise(np.zeros(1), prepared.model.start, prepared.theta), (len(seen), system.m, system.m))
    else:
        noise = system.noise(np.zeros((len(seen), 1)), schedule.stops, prepared.theta)
    both = seen[:, :, None] & seen[:, None]
    block = np.where(both, noise, 0.0) + np.eye(system.m) * ~seen[:, None]
    constants = np.zeros(len(seen))
    if system.samples:
        constants = -0.5 * (np.linalg.slogdet(block)[1] + np.log(2 * np.pi) * seen.sum(axis=1))
    precisions = np.where(both, np.linalg.inv(block), 0.0)
    if prepared.gaussian:
        precisions = np.where((prepared.kinds == KERNEL)[:, None, None], 0.0, precisions)
    return precisions, constants


def channels_of(prepared: Prepared) -> np.ndarray:
    """Return the kernels (K, P, 6) of intervals and of their halves without rates of observations, NaN where there are none."""
    kinds = prepared.kinds
    split = bool((kinds == SPLIT).any())
    found = np.full((len(kinds), 3 if split else 1, 6), np.nan)
    _write(found, prepared.kernels, slice(0, len(kinds)), 1)
    if split:
        _write(found, prepared.parts(2), slice(0, len(kinds)), 2)
    return found


def _write(found: np.ndarray, kernels: Kernels | None, rows: slice, count: int) -> None:
    """Write the kernels of `count` parts of some intervals."""
    if kernels is not None:
        place = kernels.place[rows]
        here = np.flatnonzero(place >= 0)
        which = (place[here, None] * count + np.arange(count)).reshape(-1)
        numbers = _numbers(Channels(*(part[which] for part in kernels.channels)), np.zeros((len(which), 0)))
        found[here, count - 1 : 2 * count - 1] = numbers.reshape(len(here), count, 6)


def _numbers(c: Channels, rates: np.ndarray) -> np.ndarray:
    """Return a, b, V, k0, k1, k2 (K, 6) of kernels for rates of observations (K, m)."""
    inputs = [np.ones(len(c.scale)), *rates.T]
    shift, slope, constant = np.zeros(len(c.scale)), np.zeros(len(c.scale)), np.zeros(len(c.scale))
    for i, one in enumerate(inputs):
        shift, slope = shift + c.shift[:, i] * one, slope + c.slope[:, i] * one
        for j, other in enumerate(inputs):
            constant = constant + c.constant[:, i, j] * one * other
    return np.stack([c.scale, shift, c.variance, constant, slope, c.curvature], axis=1)


def steps_of(prepared: Prepared, rows: slice, observed: np.ndarray) -> Steps:
    """Return the steps of some intervals."""
    kinds, lengths = prepared.kinds[rows], prepared.lengths[rows]
    precisions, constants = prepared.precisions
    channels = np.zeros((len(kinds), 0, 6))
    if prepared.gaussian:
        channels = prepared.channels[rows]
        here = np.flatnonzero(kinds == KERNEL)
        if len(here) and prepared.kernels is not None:
            which = prepared.kernels.place[rows][here]
            rates = observed[here] / lengths[here, None]
            channels = channels.copy()
            channels[here, 0] = _numbers(Channels(*(part[which] for part in prepared.kernels.channels)), rates)
    observed = np.ascontiguousarray(observed, float)
    return Steps(kinds, np.ascontiguousarray(lengths), observed, precisions[rows], constants[rows], channels)


def _with_parts(prepared: Prepared, rows: slice, channels: np.ndarray, count: int) -> np.ndarray:
    """Return the kernels (K, P, 6) of some intervals with those of `count` parts, at least of the first interval."""
    found = np.full((len(channels), max(channels.shape[1], 2 * count - 1), 6), np.nan)
    found[:, : channels.shape[1]] = channels
    if count <= TOGETHER:
        _write(found, prepared.parts(count), rows, count)
    else:
        kernels = prepared.parts_of(rows.start, count)
        _write(found[:1], kernels, slice(0, 1), count)
    return found


def run(prepared: Prepared, rows: slice, state: State, observed: np.ndarray) -> tuple[list[State], Infos] | None:
    """Return the states after the first intervals of `rows`, as many as the loop takes, and their reports; None for none."""
    splitting = KERNEL_SHARE * prepared.promised if prepared.gaussian else SHARE * prepared.tolerance
    limits = Limits(prepared.negligible, prepared.promised, splitting, prepared.cut, prepared.generous, prepared.finest)
    steps = steps_of(prepared, rows, observed)
    states: list[State] = []
    parts: list[Infos] = []
    attempts = 0
    while len(states) < rows.stop - rows.start and attempts < 8:
        if not prepared.gaussian and _narrow(prepared, rows.start + len(states), state, limits.cut):
            break
        grid = grid_of(prepared, state.window)
        if grid is None:
            break
        found = advance(np.asarray(state.values), grid, steps, float(state.error), float(state.log_floor), limits)
        centres = state.centre + state.spacing * (found.starts - grid.start)
        for values, centre, row in zip(found.densities, centres.tolist(), found.reports, strict=True):
            states.append(state._replace(values=values, centre=centre, error=float(row[10]), log_floor=float(row[11])))
        if len(found.reports):
            done = states[-len(centres) :]
            stops = prepared.schedule.stops[rows.start + len(states) - len(centres) :].tolist()
            parts.append(_infos(prepared, state.window, np.array(centres), found.reports, done, stops))
            state, steps, attempts = states[-1], steps.after(len(found.reports)), 0
        attempts += 1
        if found.why == AFTER:
            states[-1] = state = regridded(prepared, state)
        elif found.why == SUBSTEPS:
            rest = slice(rows.start + len(states), rows.stop)
            channels = _with_parts(prepared, rest, steps.channels, int(found.answer[0]))
            steps = steps._replace(channels=channels)
        elif found.why == RANGE:
            larger = _covering(state, *found.answer[:3])
            if larger is None:
                break
            state = larger
        else:
            break
    if not states:
        return None
    return states, joined(parts)


def _narrow(prepared: Prepared, k: int, state: State, cut: float) -> bool:
    """Return whether the loop leaves interval k to another grid, before the present one is decomposed."""
    if prepared.kinds[k] != FACTOR or state.closed:
        return False
    covariance = float(np.max(tables(prepared, state.window).covariance))
    low, high = support(np.ascontiguousarray(state.values), max(cut, min(30.0 * np.exp(state.log_floor), lw.CUT)))
    return narrow(high - low, state.spacing, covariance * prepared.lengths[k])


def joined(parts: list[Infos]) -> Infos:
    """Return the reports of consecutive steps as one."""
    health = {name: np.concatenate([part.health[name] for part in parts]) for name in parts[0].health}
    increments, means, covs = (np.concatenate([part[i] for part in parts]) for i in range(3))
    return Infos(increments, means, covs, health)


def _covering(state: State, low: float, high: float, spacing: float) -> State | None:
    """Return a state on a grid for a range relative to the centre of its grid, None if that needs too many points."""
    window = state.window
    if window.closed:
        size = lw.size_for(2 * np.pi / spacing)
        new = window._replace(size=size, spacing=2 * np.pi / size)
    else:
        new = lw.quantized(window, low + window.centre, high + window.centre, spacing, MARGIN, FINEST)
        if new.spacing * new.size < high - low:
            return None
    return None if new == window else moved_to(state, new)


def moved_to(state: State, new: lw.Window) -> State:
    """Return a state on another grid."""
    window = state.window
    moved, floor = lw.resampled(np.asarray(state.values), window, new), float(state.log_floor)
    return state._replace(values=moved / np.sum(moved), centre=new.centre, spacing=new.spacing, log_floor=floor)


def regridded(prepared: Prepared, state: State) -> State:
    """Return a state on a grid that fits it, with a margin for the next steps."""
    window, values = state.window, state.values
    look = lw.figures(values, window.closed, prepared.negligible, prepared.cut)
    if prepared.gaussian:
        look = look._replace(resolving=look.resolving * BAND / 0.92)
    new = lw.fitted(look, window, FINEST if prepared.gaussian else prepared.largest, prepared.generous, MARGIN)
    return state if new == window else moved_to(state, new)


def _infos(
    prepared: Prepared, window: lw.Window, centres: np.ndarray, out: np.ndarray, states: list[State], stops: list[float]
) -> Infos:
    column = {name: out[:, i] for name, i in _AT.items()}
    mean = window.origin + (centres + window.spacing * column["mean"])
    variance = window.spacing**2 * column["variance"]
    if prepared.model.domain:
        pairs = [state_moments(prepared, one.values, one.window, 0.0, 0.0) for one in states]
        mean, variance = (np.array(part) for part in zip(*pairs, strict=True))
    health = {name: column[source] for name, source in HEALTH.items()}
    health["tolerance_ratio"] = column["made"] / prepared.promised
    health["std_in_spacings"] = np.sqrt(column["variance"])
    if prepared.model.domain:
        edges = np.array([edge_of_moments(prepared, one.values, one.window) for one in states])
        health["edge_mass"] = np.maximum(health["edge_mass"], edges)
        health["tolerance_ratio"] = np.maximum(health["tolerance_ratio"], 10.0 * edges / prepared.promised)
        health["error_estimate"] = np.maximum(health["error_estimate"], 10.0 * edges)
    if prepared.system.general:
        health["without_law"] = np.zeros(len(out))
    if prepared.system.tabulated:
        shares = [outside_tables(prepared, one.values, one.window, stop) for one, stop in zip(states, stops)]
        health["outside_tables"] = np.array(shares)
    return Infos(column["gained"], mean[:, None], variance[:, None, None], health)


def one_of(infos: Infos, k: int) -> Info:
    """Return the report of one step."""
    health: dict[str, Any] = {name: float(values[k]) for name, values in infos.health.items()}
    return Info(infos.log_likelihood_increment[k], infos.mean[k], infos.cov[k], health)
