"""Many steps in one compiled loop (`numerics/line_loop.py`), for `_line`.

A step that the loop does not take (an error above the tolerance, a gap in a path) is taken by `_line.step`, which asks this loop
for its one interval first: whether steps are taken one by one or together makes no difference.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.methods._line_grids import grid_of
from zakai.methods._line_steps import steps_of
from zakai.methods._line_system import (
    FINEST,
    Prepared,
    State,
    edge_of_moments,
    figures,
    outside_tables,
    resampled,
    state_moments,
    tables,
)
from zakai.methods._protocol import Info, Infos
from zakai.numerics import line_window as lw
from zakai.numerics.line_density import support
from zakai.numerics.line_filters import BAND
from zakai.numerics.line_loop import advance
from zakai.numerics.line_modes import narrow
from zakai.numerics.line_segment import AFTER, COLUMNS, FACTOR, FAILED, RANGE, Limits, Steps

LARGER = 0.2  # margin of a new grid, relative to the range of the density
KERNEL_SHARE = 2e-2  # of the promised error that the splitting of one interval may leave in `limited-direct`
SHARE = 5e-3  # of the tolerance that the splitting of one interval may leave
TOGETHER = 32  # intervals whose tables of coefficients in time are computed together
HEALTH = {
    "edge_mass": "edge",
    "negative_mass": "negative",
    "aliasing": "aliasing",
    "time_error": "time",
    "tail_depth": "depth",
    "error_estimate": "error",
}
_AT = {name: i for i, name in enumerate(COLUMNS)}


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
