"""The tables of f and h on a grid that the compiled loop of one-state filters reads."""

from __future__ import annotations

import numpy as np

from zakai.methods.line.steps import parts_needed, probed
from zakai.methods.line.system import Prepared
from zakai.numerics.line import window as lw
from zakai.numerics.line.panels import GAUSS_NODES
from zakai.numerics.line.segment import MARGIN, Grid
from zakai.numerics.line.terms import CELL, DRIFT, OBSERVED, PHI, SLOPE
from zakai.numerics.line.weak import at_nodes, nodes

BLOCK = 2048  # points by which the tables of a spacing are apart; a table has twice as many
SHARED = 128  # points of the largest grid on which many steps share a decomposition
LOBATTO = np.array([0.0, 0.5 - 0.5 / np.sqrt(5.0), 0.5 + 0.5 / np.sqrt(5.0)])  # nodes within a spacing
_NONE = np.zeros(0)


def grid_of(prepared: Prepared, window: lw.Window, rows: slice) -> Grid | None:
    """Return what the loop knows of a grid, None where a formula has no value."""
    index, size = round(window.centre / window.spacing), window.size
    if window.closed:
        begin, length = 0, size
    elif prepared.mixed:
        begin, length = index - size // 2 - MARGIN, size + 2 * MARGIN
    else:
        begin, length = BLOCK * round(index / BLOCK) - BLOCK, 2 * BLOCK
    start = 0 if window.closed else index - size // 2 - begin

    def make() -> tuple[Grid, np.ndarray]:
        offsets = window.offsets if window.closed else window.spacing * (begin + np.arange(float(length)))
        x = window.origin + offsets
        table = _mixed(prepared, window, x, rows) if prepared.mixed else _separated(prepared, window, x)
        offset, fine = window.origin - prepared.origin + float(offsets[0]), _fine(prepared, window, x)
        missing = ~np.isfinite(table[:, :, OBSERVED:]).all(axis=(0, 1, 2))
        grid = Grid(table, 0, offset, window.spacing, fine)
        return grid, np.append(0, np.cumsum(missing))

    key = ("table", window.origin, window.spacing, begin, length)
    grid, missing = make() if prepared.mixed else prepared.once(key, make)
    return None if missing[start + size] > missing[start] else grid._replace(start=start)


def _separated(prepared: Prepared, window: lw.Window, x: np.ndarray) -> np.ndarray:
    """Return the terms (1, R, 4 + m, T) of f and h at points (T,)."""
    system, start, theta = prepared.system, prepared.model.start, prepared.theta
    assert system.separated is not None
    parts = np.moveaxis(system.separated[1](_nodes(window, x), start, theta), 0, -1)
    table = np.zeros((1, len(parts), OBSERVED + system.m, len(x)), theta.dtype)
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
    starts, stops = prepared.schedule.starts[rows, None], prepared.schedule.stops[rows, None]
    inner = np.clip(starts + prepared.lengths[rows, None] * GAUSS_NODES, starts, np.nextafter(stops, starts))
    times = np.concatenate([inner, stops], axis=1)
    table = np.zeros((*times.shape, OBSERVED + system.m, len(x)), theta.dtype)
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
    table[parts_needed(coefficients(probed(starts, stops)), known) != 1, :, :OBSERVED] = np.nan
    return table
