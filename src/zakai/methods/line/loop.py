"""Many steps of one-state filters in one compiled loop (`numerics/line/loop.py`, `numerics/line/modes_loop.py`).

An interval that the loop refuses (an error above the tolerance, a gap in a path) is filtered by `single` of `line/filter.py`.
`step` of that file asks this loop for its one interval first: whether steps are taken one by one or together makes no difference.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from zakai.methods._protocol import Info, Infos, joined
from zakai.methods._states import Joined, StackedStates
from zakai.methods.line import modal
from zakai.methods.line.cache import Derived
from zakai.methods.line.coefficients import misses_drift, on_grid_for_drift, sensor_at_nodes
from zakai.methods.line.prepared import INTERVALS_TOGETHER as INTERVALS_TOGETHER
from zakai.methods.line.prepared import Prepared, State
from zakai.methods.line.update import edge_of_moments, grid_check, on_fitting_grid, outside_tables, resampled, state_moments
from zakai.numerics.arrays import Array
from zakai.numerics.line import steps as ls
from zakai.numerics.line import window as lw
from zakai.numerics.line.averages import GAUSS_NODES, parts_needed, probed
from zakai.numerics.line.gaussian_kernels import BAND
from zakai.numerics.line.loop import advance
from zakai.numerics.line.modes_loop import OWN, PLACE, STAY
from zakai.numerics.line.resolution import TRIALS

BLOCK = 2048  # points by which the tables of a spacing are apart; a table has twice as many
LOBATTO = np.array([0.0, 0.5 - 0.5 / np.sqrt(5.0), 0.5 + 0.5 / np.sqrt(5.0)])  # nodes within a spacing
_NONE = np.zeros(0)


def grid_of(prepared: Prepared, window: lw.Window, rows: slice) -> ls.Grid | None:
    """Return what the loop knows of a grid, None where a formula has no value."""
    index, size = round(window.centre / window.spacing), window.size
    if window.closed:
        begin, length = 0, size
    elif prepared.mixed:
        begin, length = index - size // 2 - ls.TABLE_MARGIN, size + 2 * ls.TABLE_MARGIN
    else:
        begin, length = BLOCK * round(index / BLOCK) - BLOCK, 2 * BLOCK
    start = 0 if window.closed else index - size // 2 - begin

    def make() -> tuple[ls.Grid, np.ndarray]:
        offsets = window.offsets if window.closed else window.spacing * (begin + np.arange(float(length)))
        x = window.origin + offsets
        table = _mixed(prepared, window, x, rows) if prepared.mixed else _separated(prepared, window, x)
        offset, fine = window.origin - prepared.origin + float(offsets[0]), _fine(prepared, window, x)
        missing = ~np.isfinite(table[:, :, ls.OBSERVED:]).all(axis=(0, 1, 2))
        grid = ls.Grid(table, 0, offset, window.spacing, fine)
        return grid, np.append(0, np.cumsum(missing))

    key = window.origin, window.spacing, begin, length
    grid, missing = make() if prepared.mixed else prepared.once(Derived.TERMS, key, make)
    return None if missing[start + size] > missing[start] else ls.Grid(grid.table, start, *grid[2:])


def _separated(prepared: Prepared, window: lw.Window, x: np.ndarray) -> np.ndarray:
    """Return the terms (1, R, 4 + m, T) of f and h at points (T,)."""
    system, start, theta = prepared.system, prepared.model.start, prepared.theta
    assert system.separated is not None
    parts = np.moveaxis(system.separated[1](_nodes(window, x), start, theta), 0, -1)
    table = np.zeros((1, len(parts), ls.OBSERVED + system.m, len(x)), theta.dtype)
    table[0, :, ls.CELL] = _cells(window, parts[:, 0])
    table[0, :, ls.DRIFT:] = parts[..., :-1:3]
    if prepared.yau is not None:
        table[0, 0, ls.PHI] = prepared.yau.potential(x, start, theta)
    return table


def _fine(prepared: Prepared, window: lw.Window, x: np.ndarray) -> np.ndarray:
    """Return an h with kinks or jumps, of samples, at the nodes of points (m, F, P), else nothing."""
    if not prepared.weak:
        return _NONE[None, None]
    key = window.origin, window.spacing, float(x[0]), len(x)
    return prepared.once(Derived.FINE, key, lambda: sensor_at_nodes(prepared, x, window.spacing))


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
    starts, stops = prepared.schedule.starts[rows, None], prepared.schedule.stops[rows, None]
    inner = np.clip(starts + prepared.lengths[rows, None] * GAUSS_NODES, starts, np.nextafter(stops, starts))
    times = np.concatenate([inner, stops], axis=1)
    table = np.zeros((*times.shape, ls.OBSERVED + system.m, len(x)), theta.dtype)
    f = system.drift(_nodes(window, x), times[..., None], theta)[..., 0]
    table[..., ls.CELL, :], table[..., ls.DRIFT, :] = _cells(window, f), f[..., :-1:3]
    assert system.slope is not None
    table[..., ls.SLOPE, :] = system.slope(x[:, None], times[..., None], theta)[..., 0]
    table[..., ls.OBSERVED:, :] = np.moveaxis(system.observation(x[:, None], times[..., None], theta), -1, 2)
    at = window.points[:: max(1, window.size // 8), None]

    def coefficients(t: np.ndarray) -> np.ndarray:
        f: np.ndarray = system.drift(at, t[..., None], theta)[..., 0]
        if system.samples:
            return f
        return np.concatenate([f, system.observation(at, t[..., None], theta).reshape(*t.shape, -1)], axis=-1)

    known = coefficients(times[:, :count])
    table[parts_needed(coefficients(probed(starts, stops)), known) != 1, :, :ls.OBSERVED] = np.nan
    return table


HEALTH = {
    "edge_mass": ls.EDGE, "negative_mass": ls.NEGATIVE, "aliasing": ls.ALIASING, "time_error": ls.TIME, "tail_depth": ls.DEPTH,
    "error_estimate": ls.ERROR,
}  # fmt: skip


class Piece(NamedTuple):
    """Steps that begin with interval `first`, from the state `before` on.

    The densities (K, N) have grids with these centres and spacings (K,); `last` is the state after them, on the grid of the next
    step.  Where every step has placed a grid of its own, `coarse` are the grids of the transitions (`line/modal.py`).
    """

    first: int
    before: State
    densities: Array
    centres: Array
    spacings: Array
    reports: Array
    last: State
    coarse: Array | None = None

    @property
    def number(self) -> int:
        """The number of steps."""
        return len(self.reports)

    @property
    def states(self) -> Sequence[State]:
        """The states after the steps."""
        errors, floors = self.reports[:, ls.ERROR], self.reports[:, ls.LOG_FLOOR]
        fields = {
            "values": self.densities, "centre": self.centres, "spacing": self.spacings, "error": errors, "log_floor": floors
        }  # fmt: skip
        return Joined([StackedStates[State](self.before, fields)[:-1], [self.last]])

    @classmethod
    def of(cls, first: int, before: State, densities: Array, centres: Array, spacings: Array, reports: Array) -> Piece:
        """Return steps after which the grid stays."""
        error, log_floor = float(reports[-1, ls.ERROR]), float(reports[-1, ls.LOG_FLOOR])
        centre, spacing = float(centres[-1]), float(spacings[-1])
        last = before._replace(values=densities[-1], centre=centre, spacing=spacing, error=error, log_floor=log_floor)
        return cls(first, before, densities, centres, spacings, reports, last)


def infos_of(prepared: Prepared, pieces: Sequence[Piece]) -> Infos:
    """Return the reports of the steps of pieces."""
    return joined([_infos(prepared, piece) for piece in pieces])


def one(prepared: Prepared, k: int, state: State, observed: np.ndarray) -> tuple[State, Info] | None:
    """Return the state after interval k, and its report; None where the loop does not take it."""
    if prepared.gaussian and not prepared.cut_up:
        segment = _single(prepared, k, state, observed)
        if segment is not None:
            return segment
    pieces = compiled_steps(prepared, slice(k, k + 1), state, observed[None])
    if not pieces:
        return None
    first = pieces[0]
    place = first.before.origin, float(first.centres[0]), float(first.spacings[0])
    return first.last, _info(prepared, k, first.last, place, first.reports[0].tolist())


def _single(prepared: Prepared, k: int, state: State, observed: np.ndarray) -> tuple[State, Info] | None:
    """Return the state after interval k, and its report, where the grid of the state serves; None where another is needed."""
    window, size = state.window, len(state.values)
    if size > prepared.largest or misses_drift(prepared, window):
        return None
    grid = grid_of(prepared, window, slice(k, k + 1))
    if grid is None:
        return None
    start = ls.Start(np.ascontiguousarray(state.values), float(state.error), float(state.log_floor))
    observed = np.ascontiguousarray(observed[None], float)
    segment = advance(prepared.mechanisms, start, grid, prepared.steps, k, observed, prepared.limits)
    if not len(segment.reports):
        return None
    figures, origin, spacing = segment.reports[0].tolist(), state.origin, float(state.spacing)
    centre = spacing * (round(state.centre / spacing) + (figures[ls.START] - grid.start))
    error, log_floor = figures[ls.ERROR], figures[ls.LOG_FLOOR]
    state = State(segment.densities[0], origin, centre, spacing, state.unit, state.closed, error, log_floor)
    if segment.status == ls.Status.AFTER:
        state = regridded(prepared, state)
    return state, _info(prepared, k, state, (origin, centre, spacing), figures)


def compiled_steps(prepared: Prepared, rows: slice, state: State, observed: np.ndarray) -> list[Piece]:
    """Return the first steps of `rows`, as many as the loop takes."""
    pieces: list[Piece] = []
    trials, first, placement, observed = 0, rows.start, STAY, np.ascontiguousarray(observed, float)
    most = prepared.largest
    while first < rows.stop and trials < TRIALS and len(state.values) <= most:
        trials += 1
        stop, window = rows.stop, state.window
        if misses_drift(prepared, window):
            interval = float(prepared.schedule.starts[first]), float(prepared.lengths[first])
            values, window = on_grid_for_drift(prepared, np.asarray(state.values), window, *interval)
            state, stop = state._replace(values=values, centre=window.centre, spacing=window.spacing), first + 1
            if window.size > most:
                break
        now = observed[first - rows.start : stop - rows.start]
        if prepared.gaussian:
            piece, status, answer = _on_one_table(prepared, slice(first, stop), state, window, now)
        else:
            result = modal.advanced(prepared, first, stop, state, now, placement)
            status, answer = result.status, result.answer
            piece = Piece.of(first, state, *result[:4])._replace(coarse=result.coarse) if len(result.reports) else None
        if piece is not None:
            if status == ls.Status.AFTER or prepared.cut_up:
                piece = piece._replace(last=regridded(prepared, piece.last))
            pieces.append(piece)
            trials, state, first = 1, piece.last, first + len(piece.reports)
        if status == ls.Status.FAILED or (status == ls.Status.OK and piece is None):
            break
        if status == ls.Status.RANGE:
            larger = _covering(prepared, state, *answer.tolist())
            if larger is None:
                break
            state = larger
        if placement == STAY and status in (ls.Status.NARROW, ls.Status.UNRESOLVED):
            if prepared.kinked:
                break
            placement = PLACE if status == ls.Status.NARROW else OWN
        elif status == ls.Status.BROAD or placement == OWN:
            placement = STAY
    return pieces


def _on_one_table(
    prepared: Prepared, rows: slice, state: State, window: lw.Window, observed: np.ndarray
) -> tuple[Piece | None, ls.Status, Array]:
    """Return the first steps of `rows` by kernels or splitting, why they end, and the grid that is needed."""
    together = 1 if prepared.cut_up else INTERVALS_TOGETHER if prepared.mixed else len(observed)
    here = slice(rows.start, min(rows.stop, rows.start + together))
    grid = grid_of(prepared, window, here)
    if grid is None:
        return None, ls.Status.FAILED, np.zeros(3)
    start = ls.Start(np.ascontiguousarray(state.values), float(state.error), float(state.log_floor))
    segment = advance(prepared.mechanisms, start, grid, prepared.steps, rows.start, observed[:together], prepared.limits)
    return (_piece(rows.start, state, grid.start, segment) if len(segment.reports) else None), segment.status, segment.answer


def _piece(first: int, before: State, start: int, segment: ls.Segment) -> Piece:
    """Return the steps of a grid that begins at a point of its table: centres are multiples of the spacing."""
    spacing = before.spacing
    centres = spacing * (round(before.centre / spacing) + (segment.reports[:, ls.START] - start))
    return Piece.of(first, before, segment.densities, centres, np.full(len(centres), spacing), segment.reports)


def _covering(prepared: Prepared, state: State, low: float, high: float, spacing: float) -> State | None:
    """Return a state on a grid for a range relative to the centre of its grid, None if that needs too many points."""
    window = state.window
    if window.closed:
        size = lw.size_for(2 * np.pi / spacing)
        new = window._replace(size=size, spacing=2 * np.pi / size)
    else:
        new = lw.quantized(window, low + window.centre, high + window.centre, spacing, most=prepared.largest_for())
        if new.spacing * new.size < high - low:
            return None
    if new == window:
        return None
    new_values = resampled(prepared, np.asarray(state.values), window, new)
    return state._replace(values=new_values / np.sum(new_values), centre=new.centre, spacing=new.spacing)


def regridded(prepared: Prepared, state: State) -> State:
    """Return a state on a grid that fits it, with a margin for the next steps."""
    window, values = state.window, state.values
    check = grid_check(prepared, values, window)
    if prepared.gaussian:
        check = check._replace(resolving=check.resolving * BAND / 0.92)
    new_values, new, _ = on_fitting_grid(prepared, np.asarray(values), window, check, prepared.generous)
    return state if new == window else state._replace(values=new_values, centre=new.centre, spacing=new.spacing)


def _infos(prepared: Prepared, piece: Piece) -> Infos:
    """Return the reports of some steps."""
    states, stops = piece.states, prepared.schedule.stops[piece.first :].tolist()

    def each(function: Callable[[State, float], Any]) -> np.ndarray:
        return np.array([function(*pair) for pair in zip(states, stops)])

    place = piece.before.origin, piece.centres, piece.spacings
    mean, variance, health = _report(prepared, place, list(piece.reports.T), each)
    return Infos(piece.reports[:, ls.GAINED], mean[:, None], variance[:, None, None], health)


def _info(prepared: Prepared, k: int, state: State, place: Place, figures: list[float]) -> Info:
    """Return the report of interval k, after which the state is this one."""

    def each(function: Callable[[State, float], Any]) -> np.ndarray:
        return np.asarray(function(state, float(prepared.schedule.stops[k])))

    mean, variance, health = _report(prepared, place, figures, each)
    return Info(figures[ls.GAINED], np.array([mean]), np.array([[variance]]), health)


Place = tuple[Any, Any, Any]  # the origin, the centres and the spacings of the grids of steps


def _report(
    prepared: Prepared, place: Place, figures: Sequence[Any], each: Callable[[Callable[[State, float], Any]], np.ndarray]
) -> tuple[Any, Any, dict[str, Any]]:
    """Return the mean, the variance and the health figures of steps, as arrays (K,), or as the numbers of a single one.

    `figures` are those of their reports, and `each` applies a function to the state after every step and the time.
    """
    origin, centre, spacing = place
    mean = origin + (centre + spacing * figures[ls.MEAN])
    variance = spacing**2 * figures[ls.VARIANCE]
    health = {name: figures[i] for name, i in HEALTH.items()}
    health["tolerance_ratio"] = figures[ls.MADE] / prepared.promised
    health["std_in_spacings"] = np.sqrt(figures[ls.VARIANCE])
    if prepared.model.domain:
        mean, variance = each(lambda one, t: state_moments(prepared, one.values, one.window, 0.0, 0.0)).T
        edges = each(lambda one, t: edge_of_moments(prepared, one.values, one.window))
        for name, edge in (
            ("edge_mass", edges), ("tolerance_ratio", 10.0 * edges / prepared.promised), ("error_estimate", 10.0 * edges)
        ):  # fmt: skip
            health[name] = np.maximum(health[name], edge)
    if prepared.system.general:
        health["without_law"] = 0.0 * figures[ls.MADE]
    if prepared.system.tabulated:
        health["outside_tables"] = each(lambda one, t: outside_tables(prepared, one.values, one.window, t))
    return mean, variance, health
