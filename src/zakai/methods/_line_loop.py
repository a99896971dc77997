"""Many steps in one compiled loop (`numerics/line_loop.py`), for `_line`.

A step that the loop does not take (an error above the tolerance, a gap in a path) is taken by `_line.step`, which asks this loop
for its one interval first: whether steps are taken one by one or together makes no difference.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from zakai.methods._line_figures import edge_of_moments, figures, outside_tables, resampled, state_moments
from zakai.methods._line_grids import grid_of, known
from zakai.methods._line_system import FINEST, Prepared, State
from zakai.methods._line_tables import tables
from zakai.methods._protocol import Info, Infos
from zakai.methods._states import Joined, StackedStates
from zakai.numerics import line_window as lw
from zakai.numerics.line_density import support
from zakai.numerics.line_filters import BAND
from zakai.numerics.line_loop import advance
from zakai.numerics.line_modes import narrow
from zakai.numerics.line_segment import AFTER, COLUMNS, FACTOR, FAILED, RANGE, Segment

LARGER = 0.2  # margin of a new grid, relative to the range of the density
TOGETHER = 32  # intervals whose tables of coefficients in time are computed together
ATTEMPTS = 8  # grids on which a step is tried
HEALTH = {
    "edge_mass": "edge",
    "negative_mass": "negative",
    "aliasing": "aliasing",
    "time_error": "time",
    "tail_depth": "depth",
    "error_estimate": "error",
}


class Piece(NamedTuple):
    """Steps on one grid that begin with interval `first`; `last` is the state after them, on the grid of the next step."""

    first: int
    before: State
    grid_start: int
    segment: Segment
    last: State

    def centre(self, start: Any) -> Any:
        """Return the centres of grids that begin at points of the table: multiples of the spacing, however they came there."""
        return self.before.spacing * (round(self.before.centre / self.before.spacing) + (start - self.grid_start))

    @property
    def states(self) -> Sequence[State]:
        """The states after the steps."""
        reports = self.segment.reports
        centres = self.centre(reports[:, START])
        fields = {"values": self.segment.densities, "centre": centres, "error": reports[:, ERROR], "log_floor": reports[:, FLOOR]}
        return Joined([StackedStates[State](self.before, fields)[:-1], [self.last]])


START, ERROR, FLOOR = (COLUMNS.index(name) for name in ("start", "error", "log_floor"))


def run(prepared: Prepared, rows: slice, state: State, observed: np.ndarray) -> tuple[Sequence[State], Infos] | None:
    """Return the states after the first intervals of `rows`, as many as the loop takes, and their reports; None for none."""
    pieces = taken(prepared, rows, state, observed)
    if not pieces:
        return None
    return Joined([piece.states for piece in pieces]), joined([_infos(prepared, piece) for piece in pieces])


def one(prepared: Prepared, k: int, state: State, observed: np.ndarray) -> tuple[State, Info] | None:
    """Return the state after interval k, and its report; None where the loop does not take it."""
    pieces = taken(prepared, slice(k, k + 1), state, observed[None])
    return (pieces[0].last, _info(prepared, pieces[0])) if pieces else None


def taken(prepared: Prepared, rows: slice, state: State, observed: np.ndarray) -> list[Piece]:
    """Return the first steps of `rows`, as many as the loop takes."""
    pieces: list[Piece] = []
    attempts, first, observed = 0, rows.start, np.ascontiguousarray(observed, float)
    while first < rows.stop and attempts < ATTEMPTS:
        window = state.window
        if not prepared.gaussian and not known(prepared, window) and _narrow(prepared, first, state):
            break
        here = slice(first, min(rows.stop, first + TOGETHER) if prepared.mixed else rows.stop)
        grid = grid_of(prepared, window, here)
        if grid is None:
            break
        found = advance(
            prepared.mechanisms, np.ascontiguousarray(state.values), grid, prepared.steps, first,
            observed[first - rows.start : here.stop - rows.start], float(state.error), float(state.log_floor), prepared.limits,
        )  # fmt: skip
        attempts += 1
        if len(found.reports):
            attempts, piece = 1, Piece(first, state, grid.start, found, state)
            *_, error, log_floor, start = found.reports[-1].tolist()
            state = state._replace(values=found.densities[-1], centre=piece.centre(start), error=error, log_floor=log_floor)
            state = regridded(prepared, state) if found.why == AFTER else state
            pieces.append(piece._replace(last=state))
            first += len(found.reports)
        if found.why == RANGE:
            larger = _covering(prepared, state, *found.answer.tolist())
            if larger is None:
                break
            state = larger
        elif found.why == FAILED:
            break
    return pieces


def _narrow(prepared: Prepared, k: int, state: State) -> bool:
    """Return whether the loop leaves interval k to another grid, before the present one is decomposed."""
    if prepared.kinds[k] != FACTOR or state.closed:
        return False
    covariance = float(np.max(tables(prepared, state.window).covariance))
    cut = max(prepared.cut, min(30.0 * np.exp(state.log_floor), lw.CUT))
    low, high = support(np.ascontiguousarray(state.values), cut)
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


def _infos(prepared: Prepared, piece: Piece) -> Infos:
    """Return the reports of some steps."""
    states, stops = piece.states, prepared.schedule.stops[piece.first :].tolist()

    def each(function: Callable[[State, float], Any]) -> np.ndarray:
        return np.array([function(*pair) for pair in zip(states, stops)])

    columns = dict(zip(COLUMNS, piece.segment.reports.T))
    mean, variance, health = _report(prepared, piece, columns, each)
    return Infos(columns["gained"], mean[:, None], variance[:, None, None], health)


def _info(prepared: Prepared, piece: Piece) -> Info:
    """Return the report of a single step."""

    def each(function: Callable[[State, float], Any]) -> np.ndarray:
        return np.asarray(function(piece.states[0], float(prepared.schedule.stops[piece.first])))

    columns = dict(zip(COLUMNS, piece.segment.reports[0].tolist()))
    mean, variance, health = _report(prepared, piece, columns, each)
    return Info(columns["gained"], np.array([mean]), np.array([[variance]]), health)


def _report(
    prepared: Prepared, piece: Piece, columns: Mapping[str, Any], each: Callable[[Callable[[State, float], Any]], np.ndarray]
) -> tuple[Any, Any, dict[str, Any]]:
    """Return the mean, the variance and the health figures of steps, as arrays (K,), or as the numbers of a single one.

    `each` applies a function to the state after every step and the time.
    """
    origin, spacing = piece.before.origin, piece.before.spacing
    mean = origin + (piece.centre(columns["start"]) + spacing * columns["mean"])
    variance = spacing**2 * columns["variance"]
    health = {name: columns[source] for name, source in HEALTH.items()}
    health["tolerance_ratio"] = columns["made"] / prepared.promised
    health["std_in_spacings"] = np.sqrt(columns["variance"])
    if prepared.model.domain:
        mean, variance = each(lambda one, t: state_moments(prepared, one.values, one.window, 0.0, 0.0)).T
        edges = each(lambda one, t: edge_of_moments(prepared, one.values, one.window))
        for name, edge in (
            ("edge_mass", edges), ("tolerance_ratio", 10.0 * edges / prepared.promised), ("error_estimate", 10.0 * edges)
        ):  # fmt: skip
            health[name] = np.maximum(health[name], edge)
    if prepared.system.general:
        health["without_law"] = 0.0 * columns["made"]
    if prepared.system.tabulated:
        health["outside_tables"] = each(lambda one, t: outside_tables(prepared, one.values, one.window, t))
    return mean, variance, health
