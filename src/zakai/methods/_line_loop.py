"""Many steps in one compiled loop (`numerics/line_loop.py`), for `_line`.

A step that the loop does not take (an error above the tolerance, a gap in a path) is taken by `_line.step`, which asks this loop
for its one interval first: whether steps are taken one by one or together makes no difference.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.methods._line_system import (
    FINEST,
    Coefficients,
    Prepared,
    State,
    edge_of_moments,
    figures,
    outside_tables,
    resampled,
    spectral,
    state_moments,
    tables,
)
from zakai.methods._protocol import Info, Infos
from zakai.numerics import line_window as lw
from zakai.numerics.line_channel import Channels
from zakai.numerics.line_density import support
from zakai.numerics.line_filters import BAND
from zakai.numerics.line_loop import (
    AFTER,
    COLUMNS,
    FACTOR,
    FAILED,
    KERNEL,
    MARGIN,
    RANGE,
    Grid,
    Limits,
    Steps,
    advance,
)
from zakai.numerics.line_modes import narrow
from zakai.numerics.line_panels import GAUSS_NODES, interpolation
from zakai.numerics.line_terms import CELL, DRIFT, OBSERVED, PHI, SLOPE
from zakai.numerics.line_weak import at_nodes, nodes

LARGER = 0.2  # margin of a new grid, relative to the range of the density
KERNEL_SHARE = 2e-2  # of the promised error that the splitting of one interval may leave in `limited-direct`
SHARE = 5e-3  # of the tolerance that the splitting of one interval may leave
BLOCK = 2048  # points by which the tables of a spacing are apart; a table has twice as many
TOGETHER = 32  # intervals whose tables of coefficients in time are computed together
SHARED = 128  # points of the largest grid on which many steps share a decomposition
RESOLVED = 1e-8  # relative error of the interpolants of coefficients in time
PROBES = np.linspace(0.0, 1.0, 129)  # parts of an interval at which coefficients are compared with their interpolants
LOBATTO = np.array([0.0, 0.5 - 0.5 / np.sqrt(5.0), 0.5 + 0.5 / np.sqrt(5.0)])  # nodes within a spacing
HEALTH = {
    "edge_mass": "edge",
    "negative_mass": "negative",
    "aliasing": "aliasing",
    "time_error": "time",
    "tail_depth": "depth",
    "error_estimate": "error",
}
_AT = {name: i for i, name in enumerate(COLUMNS)}


def grid_of(prepared: Prepared, window: lw.Window, rows: slice) -> Grid | None:
    """Return what the loop knows of a grid, None where the operator has no decomposition or a formula no value."""
    if not prepared.gaussian:
        found: tuple[Grid | None] = prepared.once(("grid", window), lambda: (_decomposed_grid(prepared, window),))
        return found[0]
    index, size = round(window.centre / window.spacing), window.size
    if window.closed:
        begin, length = 0, size
    elif prepared.mixed:
        begin, length = index - size // 2 - MARGIN, size + 2 * MARGIN
    else:
        begin, length = BLOCK * round(index / BLOCK) - BLOCK, 2 * BLOCK
    start = 0 if window.closed else index - size // 2 - begin
    offsets = window.offsets if window.closed else window.spacing * (begin + np.arange(float(length)))
    if prepared.mixed:
        table = _mixed(prepared, window, window.origin + offsets, rows)
    else:
        key = ("table", window.origin, window.spacing, begin, length)
        table = prepared.once(key, lambda: _separated(prepared, window, window.origin + offsets))
    if not np.isfinite(table[:, :, OBSERVED:, start : start + size]).all():
        return None
    offset = window.origin - prepared.origin + float(offsets[0])
    fine = _fine(prepared, window, window.origin + offsets)
    return Grid(_NONE[None], _NONE[None], _NONE, table, 0.0, start, offset, window.spacing, window.closed, fine)


_NONE = np.zeros(0)


def _decomposed_grid(prepared: Prepared, window: lw.Window) -> Grid | None:
    # The decomposition of a large grid takes longer than steps on a coarser one.
    if window.size > SHARED and not window.closed and not prepared.kinked:
        return None
    decomposed = spectral(prepared, window)
    if decomposed is None or not (decomposed.scale > 0).all():
        return None
    table = _separated(prepared, window, window.points)
    table[0, 0, PHI] = np.log(decomposed.scale)
    if not np.isfinite(table[0, 0, [PHI, *range(OBSERVED, table.shape[2])]]).all():
        return None
    modes, covariance = np.ascontiguousarray(decomposed.modes), float(np.max(tables(prepared, window).covariance))
    fine = _fine(prepared, window, window.points)
    return Grid(
        modes, np.ascontiguousarray(modes.T), decomposed.rates, table, covariance, 0, 0.0, window.spacing, window.closed, fine
    )


def _separated(prepared: Prepared, window: lw.Window, x: np.ndarray) -> np.ndarray:
    """Return the terms (1, R, 4 + m, T) of f and h at points (T,)."""
    system, start, theta = prepared.system, prepared.model.start, prepared.theta
    assert system.separated is not None
    parts = np.moveaxis(system.separated[1](_nodes(window, x), start, theta), 0, -1)
    table = np.zeros((1, len(parts), OBSERVED + system.m, len(x)))
    table[0, :, CELL] = _cells(window, parts[:, 0])
    table[0, :, DRIFT:] = parts[..., :-1:3]
    if prepared.yau is not None:
        table[0, 0, PHI] = prepared.yau.potential(x, start, theta)
    return table


def _fine(prepared: Prepared, window: lw.Window, x: np.ndarray) -> np.ndarray:
    """Return an h with kinks, of samples, at the nodes of points (m, F), else nothing."""
    system = prepared.system
    if not prepared.weak:
        return _NONE[None]

    def make() -> np.ndarray:
        points = nodes(x, window.spacing)[:, None]
        return at_nodes(system.observation(points, prepared.model.start, prepared.theta).T)

    found: np.ndarray = prepared.once(("fine", window.origin, window.spacing, float(x[0]), len(x)), make)
    return found


def _nodes(window: lw.Window, x: np.ndarray) -> np.ndarray:
    """Return Lobatto's nodes (3 T + 1, 1) of the spacings above points (T,)."""
    return np.append((x[:, None] + window.spacing * LOBATTO).reshape(-1), x[-1] + window.spacing)[:, None]


def _cells(window: lw.Window, f: np.ndarray) -> np.ndarray:
    """Return the integrals (..., T) of f over spacings from values at Lobatto's nodes (..., 3 T + 1)."""
    ends, inner = f[..., ::3], f[..., 1::3] + f[..., 2::3]
    return np.asarray(window.spacing / 12.0 * (ends[..., :-1] + 5.0 * inner + ends[..., 1:]))


def _mixed(prepared: Prepared, window: lw.Window, x: np.ndarray, rows: slice) -> np.ndarray:
    """Return terms (K, 7, 4 + m, T) at points (T,): f and h at the Gauss nodes of intervals and, for samples, at their ends.

    Those of intervals in which the nodes do not resolve the coefficients are NaN.
    """
    system, theta, count = prepared.system, prepared.theta, len(GAUSS_NODES)
    starts, lengths = prepared.schedule.starts[rows, None], prepared.lengths[rows, None]
    times = np.concatenate([starts + lengths * GAUSS_NODES, starts + lengths], axis=1)
    table = np.zeros((*times.shape, OBSERVED + system.m, len(x)))
    f = system.drift(_nodes(window, x), times[..., None], theta)[..., 0]
    table[..., CELL, :], table[..., DRIFT, :] = _cells(window, f), f[..., :-1:3]
    assert system.slope is not None
    table[..., SLOPE, :] = system.slope(x[:, None], times[..., None], theta)[..., 0]
    table[..., OBSERVED:, :] = np.moveaxis(system.observation(x[:, None], times[..., None], theta), -1, 2)
    at = window.points[:: max(1, window.size // 8), None]

    def coefficients(t: np.ndarray) -> np.ndarray:
        f: np.ndarray = system.drift(at, t[..., None], theta)[..., 0]
        if system.samples:
            return f
        return np.concatenate([f, system.observation(at, t[..., None], theta).reshape(*t.shape, -1)], axis=-1)

    known = coefficients(times[:, :count])
    table[~resolved(coefficients(probed(starts, lengths)), known), :, :OBSERVED] = np.nan
    return table


def coefficients_of(prepared: Prepared) -> Coefficients:
    """Return what the loop needs of the coefficients in time of all intervals."""
    schedule, system, theta = prepared.schedule, prepared.system, prepared.theta
    count, seen, m = len(schedule), schedule.seen, system.m
    starts, lengths, stops = schedule.starts[:, None], prepared.lengths[:, None], schedule.stops[:, None]
    nodes = starts + lengths * GAUSS_NODES if prepared.timed else np.full((count, 1), prepared.model.start)
    nodes = np.clip(nodes, starts, np.nextafter(stops, starts)) if prepared.timed else nodes
    ends = stops if system.samples else nodes
    if not system.samples and prepared.timed and system.steady_observation and system.steady_noise:
        ends = nodes[:, :1]

    def covariance(t: np.ndarray) -> np.ndarray:
        G = system.covariance(np.zeros((1, 1, 1)), t, theta)[..., 0, 0] if prepared.divides else np.zeros(1)
        return np.array(np.broadcast_to(G, t.shape))

    def factors(t: np.ndarray) -> np.ndarray:
        if prepared.mixed:  # the terms of the table are those at the nodes and at the end
            rows = [len(GAUSS_NODES)] if system.samples and t.shape[1] == 1 else range(t.shape[1])
            return np.broadcast_to(np.eye(len(GAUSS_NODES) + 1)[rows], (count, t.shape[1], len(GAUSS_NODES) + 1)).copy()
        assert system.separated is not None
        found: np.ndarray = system.separated[0](_X, t, theta)
        return np.array(np.broadcast_to(found, (*t.shape, found.shape[-1])))

    def precision(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if system.general:  # the loop takes only intervals without observations
            return np.zeros((*t.shape, m, m)), np.zeros(count)
        noise = np.broadcast_to(system.noise(_X, t, theta), (*t.shape, m, m))
        both = (seen[:, :, None] & seen[:, None])[:, None]
        block = np.where(both, noise, 0.0) + np.eye(m) * ~seen[:, None, :, None]
        constant = np.zeros(count)
        if system.samples:
            constant = -0.5 * (np.linalg.slogdet(block[:, 0])[1] + np.log(2 * np.pi) * seen.sum(axis=1))
        return np.where(both, np.linalg.inv(block), 0.0), constant

    drifts, outputs, covariances, (precisions, constants) = factors(nodes), factors(ends), covariance(nodes), precision(ends)
    good = np.ones(count, bool)
    if prepared.timed and count:
        t = probed(starts, lengths)
        good &= resolved(covariance(t)[..., None], covariances[..., None])
        if not prepared.mixed:
            good &= resolved(factors(t), factors(nodes))
        if not system.samples and not system.steady_noise:
            good &= resolved(precision(t)[0], precisions)
    return Coefficients(drifts, outputs, covariances, precisions, constants, good)


_X = np.zeros((1, 1, 1))


def probed(starts: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return times (K, P) at which coefficients are compared with their interpolants, of which the last are before the ends."""
    return np.clip(starts + lengths * PROBES, starts, np.nextafter(starts + lengths, starts))


def resolved(exact: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return whether the interpolants of values at the nodes (K, Q, ...) agree with those at the probes (K, P, ...)."""
    exact, nodes = exact.reshape(*exact.shape[:2], -1), nodes.reshape(*nodes.shape[:2], -1)
    scale = np.maximum(np.abs(exact).max(axis=1), 1e-300)
    rest = np.abs(_TO_PROBES @ nodes - exact).max(axis=1) / scale
    return np.asarray(rest.max(axis=1) <= RESOLVED)


_TO_PROBES = interpolation(PROBES)


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
    kinds, lengths, kernels = prepared.kinds[rows], prepared.lengths[rows], prepared.kernels
    channels = np.full((len(kinds), 6), np.nan)
    here = np.flatnonzero((kinds == KERNEL) | (kinds == FACTOR))
    if prepared.gaussian and kernels is not None and len(here):
        which = kernels.place[rows][here]
        rates = np.where((kinds == KERNEL)[:, None], observed / lengths[:, None], 0.0)[here]
        channels[here] = _numbers(Channels(*(part[which] for part in kernels.channels)), rates)
    observed = np.ascontiguousarray(observed, float)
    c = Coefficients(*(part[rows] for part in prepared.coefficients))
    precisions = np.where((kinds == KERNEL)[:, None, None, None], 0.0, c.precisions)
    lengths = np.ascontiguousarray(lengths)
    return Steps(kinds, lengths, observed, precisions, c.constants, channels, c.drifts, c.outputs, c.covariances)


def run(prepared: Prepared, rows: slice, state: State, observed: np.ndarray) -> tuple[list[State], Infos] | None:
    """Return the states after the first intervals of `rows`, as many as the loop takes, and their reports; None for none."""
    splitting = SHARE * prepared.tolerance if prepared.yau is None else KERNEL_SHARE * prepared.promised
    generous = FINEST if prepared.timed and prepared.model.periodic else prepared.generous
    limits = Limits(prepared.negligible, prepared.promised, splitting, prepared.cut, generous, prepared.finest)
    states: list[State] = []
    parts: list[Infos] = []
    attempts, first = 0, rows.start
    steps = steps_of(prepared, rows, observed)
    while first < rows.stop and attempts < 8:
        if not prepared.gaussian and _narrow(prepared, first, state, limits.cut):
            break
        here = slice(first, min(rows.stop, first + TOGETHER) if prepared.mixed else rows.stop)
        grid = grid_of(prepared, state.window, here)
        if grid is None:
            break
        some = Steps(*(part[: here.stop - first] for part in steps))
        found = advance(
            prepared.mechanisms, np.asarray(state.values), grid, some, float(state.error), float(state.log_floor), limits
        )
        taken = len(found.reports)
        if taken:
            centres = state.centre + state.spacing * (found.starts - grid.start)
            done = [
                State(values, state.origin, centre, state.spacing, state.unit, state.closed, error, log_floor)
                for values, centre, error, log_floor in zip(
                    found.densities, centres.tolist(), found.reports[:, 10].tolist(), found.reports[:, 11].tolist(), strict=True
                )
            ]
            stops = prepared.schedule.stops[first : first + taken].tolist()
            parts.append(_infos(prepared, state.window, centres, found.reports, done, stops))
            states += done
            state, steps, attempts, first = done[-1], steps.after(taken), 0, first + taken
        attempts += 1
        if found.why == AFTER:
            states[-1] = state = regridded(prepared, state)
        elif found.why == RANGE:
            larger = _covering(prepared, state, *found.answer[:3])
            if larger is None:
                break
            state = larger
        elif found.why == FAILED:
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


def _covering(prepared: Prepared, state: State, low: float, high: float, spacing: float) -> State | None:
    """Return a state on a grid for a range relative to the centre of its grid, None if that needs too many points."""
    window = state.window
    if window.closed:
        size = lw.size_for(2 * np.pi / spacing)
        new = window._replace(size=size, spacing=2 * np.pi / size)
    else:
        new = lw.quantized(window, low + window.centre, high + window.centre, spacing, LARGER, _most(prepared))
        if new.spacing * new.size < high - low:
            return None
    return None if new == window else moved_to(prepared, state, new)


def _most(prepared: Prepared) -> int:
    """Return the points of the largest grid of the loop."""
    return FINEST if prepared.gaussian else lw.LARGEST


def moved_to(prepared: Prepared, state: State, new: lw.Window) -> State:
    """Return a state on another grid."""
    window = state.window
    moved, floor = resampled(prepared, np.asarray(state.values), window, new), float(state.log_floor)
    return state._replace(values=moved / np.sum(moved), centre=new.centre, spacing=new.spacing, log_floor=floor)


def regridded(prepared: Prepared, state: State) -> State:
    """Return a state on a grid that fits it, with a margin for the next steps."""
    window, values = state.window, state.values
    look = figures(prepared, values, window)
    if prepared.gaussian:
        look = look._replace(resolving=look.resolving * BAND / 0.92)
    new = lw.fitted(look, window, _most(prepared), prepared.generous, LARGER)
    return state if new == window else moved_to(prepared, state, new)


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
