"""Many steps on one grid in one compiled loop (`numerics/line_splitting.py`), for `_line`.

A step that the loop does not take (another grid, an error above the tolerance, a gap in a path) is taken by `_line.step`, which
asks this loop for its one interval first: whether steps are taken one by one or together makes no difference.
"""

from __future__ import annotations

from functools import lru_cache, partial
from itertools import chain
from typing import Any

import numpy as np

from zakai.methods._line_system import Prepared, State, spectral, tables
from zakai.methods._protocol import Info, Infos
from zakai.numerics import line_window as lw
from zakai.numerics.line_channel import Channels
from zakai.numerics.line_operator import derivatives
from zakai.numerics.line_splitting import COLUMNS, KERNEL, SPLIT, Grid, Limits, Steps, advance

REACH = 4.5  # standard deviations of a kernel by which a grid is enlarged
FINER = 0.72  # spacing of an enlarged grid
MARGIN = 0.2  # of a new grid, relative to the range of the density
KERNEL_SHARE = 2e-2  # of the promised error that the splitting of one increment with Gaussian kernels may leave
SHARE = 5e-3  # of the tolerance that the splitting of one increment may leave
HEALTH = {
    "edge_mass": "edge",
    "negative_mass": "negative",
    "aliasing": "aliasing",
    "time_error": "time",
    "error_estimate": "error",
}
_AT = {name: i for i, name in enumerate(COLUMNS)}


def grid_of(prepared: Prepared, window: lw.Window) -> Grid | None:
    """Return what the loop knows of a grid, None where the operator has no decomposition or a formula no value."""
    found: tuple[Grid | None] = prepared.once(("grid", prepared.gaussian, window), lambda: (_grid(prepared, window),))
    return found[0]


def _grid(prepared: Prepared, window: lw.Window) -> Grid | None:
    system, theta, start = prepared.system, prepared.theta, prepared.model.start
    known, points, yau = tables(prepared, window), window.points[:, None], prepared.yau
    if prepared.gaussian and yau is not None:
        modes, rates = second_derivative(window.size)
        rates = rates / window.spacing**2
        gauge = yau.potential(window.points, start, theta)
        scale, drift = np.exp(gauge - np.max(gauge)), yau.gauge_slope(points, start, theta)[:, 0]
    else:
        decomposed = spectral(prepared, window)
        if decomposed is None:
            return None
        modes, rates, scale, drift = np.ascontiguousarray(decomposed.modes), decomposed.rates, decomposed.scale, known.drift
    h = np.ascontiguousarray(known.observation)
    slope = curvature = np.zeros_like(h)
    if not system.samples and system.curvature is not None:
        slope = np.ascontiguousarray(system.observation_slope(points, start, theta).T)
        curvature = np.ascontiguousarray(system.curvature(points, start, theta).T)
    if not (scale > 0).all() or not all(np.isfinite(table).all() for table in (h, slope, curvature, scale, drift)):
        return None
    return Grid(
        modes, np.ascontiguousarray(modes.T), rates, scale, np.ascontiguousarray(drift), h, slope, curvature,
        float(known.covariance), window.spacing,
    )  # fmt: skip


@lru_cache(maxsize=16)
def second_derivative(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return U and the rates of -1/2 d^2/dx^2 = U diag(rates) U' on the line, for the spacing one."""
    rates, modes = np.linalg.eigh(-0.5 * derivatives(size, False)[1])
    return np.ascontiguousarray(modes), rates


def precisions_of(prepared: Prepared, rows: slice) -> tuple[np.ndarray, np.ndarray]:
    """Return the inverses of the observed blocks of S (K, m, m), and the constants of the log-likelihoods (K,)."""
    schedule, system = prepared.schedule, prepared.system

    def make(seen: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, float]:
        both = seen[:, None] & seen
        block = np.where(both, noise, 0.0) + np.diag(1.0 * ~seen)
        precision = np.where(both, np.linalg.inv(block), 0.0)
        constant = -0.5 * (float(np.linalg.slogdet(block)[1]) + np.log(2 * np.pi) * seen.sum())
        return precision, constant if system.samples else 0.0

    def steady(seen: np.ndarray) -> tuple[np.ndarray, float]:
        return make(seen, system.noise(np.zeros(1), prepared.model.start, prepared.theta))

    seen = schedule.seen[rows]
    if system.steady_noise:
        known: dict[bytes, tuple[np.ndarray, float]] = {}
        found = []
        for mask in seen:
            key = mask.tobytes()
            if key not in known:
                known[key] = prepared.once(("precision", key), partial(steady, mask))
            found.append(known[key])
    else:
        noise = system.noise(np.zeros((len(seen), 1)), schedule.stops[rows], prepared.theta)
        found = [make(*pair) for pair in zip(seen, noise, strict=True)]
    return np.array([one[0] for one in found]), np.array([one[1] for one in found])


def steps_of(prepared: Prepared, rows: slice, observed: np.ndarray, window: lw.Window, parts: int) -> Steps:
    """Return the steps of some intervals, with the kernels of up to `parts` parts of each."""
    kinds, lengths = prepared.kinds[rows], prepared.lengths[rows]
    precisions, constants = precisions_of(prepared, rows)
    channels = _NOTHING
    if prepared.gaussian:
        precisions = np.where((kinds == KERNEL)[:, None, None], 0.0, precisions)
        channels = _channels(prepared, rows, observed, window, parts)
    return Steps(kinds, np.ascontiguousarray(lengths), np.ascontiguousarray(observed, float), precisions, constants, channels)


_NOTHING = np.zeros((0, 0, 6))


def _channels(prepared: Prepared, rows: slice, observed: np.ndarray, window: lw.Window, parts: int) -> np.ndarray:
    """Return the kernels (K, 2 parts - 1, 6) of intervals, of their halves, and so on, relative to the centre of the grid."""
    kinds, lengths = prepared.kinds[rows], prepared.lengths[rows]
    found = np.full((len(kinds), 2 * parts - 1, 6), np.nan)
    count = 1
    while count <= parts:
        kernels = prepared.kernels if count == 1 else prepared.parts(count)
        if kernels is not None:
            place = kernels.place[rows]
            here = np.flatnonzero(place >= 0)
            which = (place[here, None] * count + np.arange(count)).reshape(-1)
            c = Channels(*(part[which] for part in kernels.channels))
            inputs = [np.ones(len(which))]
            if count == 1:
                rates = np.where(kinds == KERNEL, 1.0 / lengths, 0.0)[here, None] * observed[here]
                inputs += list(rates.T)
            shift, slope, constant = np.zeros(len(which)), np.zeros(len(which)), np.zeros(len(which))
            for i, one in enumerate(inputs):
                shift, slope = shift + c.shift[:, i] * one, slope + c.slope[:, i] * one
                for j, other in enumerate(inputs):
                    constant = constant + c.constant[:, i, j] * one * other
            apart = (window.origin - kernels.origin) + window.centre
            shift, constant = shift + (c.scale - 1.0) * apart, constant + (slope + c.curvature * apart) * apart
            numbers = (c.scale, shift, c.variance, constant, slope + 2.0 * c.curvature * apart, c.curvature)
            found[here, count - 1 : 2 * count - 1] = np.stack(numbers, axis=1).reshape(len(here), count, 6)
        count *= 2
    return found


def run(
    prepared: Prepared, rows: slice, state: State, observed: np.ndarray, retry: bool = True
) -> tuple[list[State], Infos] | None:
    """Return the states after the first intervals of `rows`, as many as the loop takes, and their reports; None for none.

    With `retry` a step that Gaussian kernels do not take on the grid of the state is tried on a larger and finer one.
    """
    window = state.window
    grid = grid_of(prepared, window)
    if grid is None:
        return None
    splitting = KERNEL_SHARE * prepared.promised if prepared.gaussian else SHARE * prepared.tolerance
    limits = Limits(prepared.negligible, prepared.promised, splitting, prepared.generous)
    parts = max([2, *prepared.divided]) if prepared.gaussian and bool((prepared.kinds[rows] == SPLIT).any()) else 1
    densities, out = [], []
    values, error, first, substeps = np.asarray(state.values), float(state.error), rows.start, 0
    while first < rows.stop:
        rest = slice(first, rows.stop)
        steps = steps_of(prepared, rest, observed[first - rows.start :], window, parts)
        found, reports, substeps = advance(values, grid, steps, error, limits)
        densities.append(found)
        out.append(reports)
        first += len(found)
        if len(found):
            values, error = found[-1], float(reports[-1, _AT["error"]])
        if substeps <= 0:
            break
        parts = 2 * substeps
    numbers = np.concatenate(out) if len(out) > 1 else out[0]
    if not len(numbers):
        larger = enlarged(prepared, state, steps.channels[0]) if retry and prepared.gaussian else None
        return None if larger is None else run(prepared, rows, larger, observed, False)
    states = [
        state._replace(values=own, error=float(row[_AT["error"]])) for own, row in zip(chain(*densities), numbers, strict=True)
    ]
    if substeps < 0:
        states[-1] = regridded(prepared, states[-1])
    return states, _infos(prepared, window, numbers)


def enlarged(prepared: Prepared, state: State, channels: np.ndarray) -> State | None:
    """Return a state on a finer grid that holds it after a transition with these kernels too, None if there is none."""
    known = channels[:1] if np.isfinite(channels[0]).all() else channels[1:3]
    window, values = state.window, state.values
    look = lw.figures(values, window.closed, prepared.negligible)
    ends = window.spacing * (np.array([look.first, look.last]) - window.size // 2)
    low, high = ends
    for scale, shift, variance, *_ in known:
        ends, width = scale * ends + shift, REACH * np.sqrt(variance)
        low, high = min(low, ends[0] - width), max(high, ends[1] + width)
    if not np.isfinite(high - low):
        return None
    for factor in (FINER, 1.0):
        new = lw.quantized(window, low + window.centre, high + window.centre, factor * window.spacing, most=2 * lw.SIZES[-1])
        if new.spacing * new.size >= high - low and new != window:
            moved = lw.resampled(values, window, new)
            return state._replace(values=moved / np.sum(moved), centre=new.centre, spacing=new.spacing)
    return None


def regridded(prepared: Prepared, state: State) -> State:
    """Return a state on a grid that fits it, with a margin for the next steps."""
    window, values = state.window, state.values
    look = lw.figures(values, window.closed, prepared.negligible)
    new = lw.fitted(look, window, prepared.largest, prepared.generous, MARGIN)
    if new == window:
        return state
    moved = lw.resampled(values, window, new)
    return state._replace(values=moved / np.sum(moved), centre=new.centre, spacing=new.spacing)


def _infos(prepared: Prepared, window: lw.Window, out: np.ndarray) -> Infos:
    column = {name: out[:, i] for name, i in _AT.items()}
    mean = window.origin + (window.centre + window.spacing * column["mean"])
    variance = window.spacing**2 * column["variance"]
    health = {name: column[source] for name, source in HEALTH.items()}
    health["tolerance_ratio"] = column["made"] / prepared.promised
    health["tail_depth"] = column["depth"] / prepared.deepest
    health["std_in_spacings"] = np.sqrt(column["variance"])
    return Infos(column["gained"], mean[:, None], variance[:, None, None], health)


def one_of(infos: Infos, k: int) -> Info:
    """Return the report of one step."""
    health: dict[str, Any] = {name: float(values[k]) for name, values in infos.health.items()}
    return Info(infos.log_likelihood_increment[k], infos.mean[k], infos.cov[k], health)
