"""What the page draws, as arrays: only what can be seen of a result, at the resolution at which it is seen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from zakai.densities import GridDensity
from zakai.densities._density import wrap
from zakai.report.axes import joint_map
from zakai.report.heatmap import BAND, Profile, direct_observations, is_periodic, profile, true_states

MOST_COLUMNS, MOST_ROWS = 800, 320
MOST_POINTS = 4_000  # observations that are drawn in one picture
FINER = 4  # points of a density that is drawn for each of its grid
Arrays = dict[str, np.ndarray]


class View(NamedTuple):
    """The part of the plane that is seen: times, values of the state (None: those that hold the density), and its cells."""

    first: float = -np.inf
    last: float = np.inf
    low: float | None = None
    high: float | None = None
    columns: int = 400
    rows: int = 240

    @classmethod
    def of(cls, request: Mapping[str, Any]) -> View:
        """Return the view that a request names; what it leaves out is everything."""
        given = {key: float(request[key]) for key in ("first", "last", "low", "high") if request.get(key) is not None}
        columns = int(np.clip(int(request.get("columns") or 400), 2, MOST_COLUMNS))
        rows = int(np.clip(int(request.get("rows") or 240), 2, MOST_ROWS))
        return cls(**given, columns=columns, rows=rows)


def density_picture(result: Any, state: int, truth: Any, view: View) -> tuple[dict[str, Any], Arrays]:
    """Return the density of one state over the times of a view, divided by its highest value at each time, in 0 to 255.

    The density of a cell is its average over the cell, so that one that is narrower than a cell keeps its mass.
    """
    times = np.asarray(result.times, float)
    index = _seen(times, view)
    mean, deviation = result.mean[index, state], np.sqrt(np.maximum(result.variance[index, state], 0.0))
    periodic = is_periodic(result, state)
    profiles = [_profile(result, int(k), state) for k in index] if result.has_densities else _gaussians(mean, deviation)
    tail = 0.5 * (1.0 - BAND)
    cumulatives = [one.cumulative for one in profiles]
    low, high = (
        np.array([one.centre + np.interp(q, upto, one.deviation) for one, upto in zip(profiles, cumulatives)])
        for q in (tail, 1.0 - tail)
    )
    known = None if truth is None else true_states(truth, result)
    path = None if known is None else known[index, state]
    bottom, top = (-np.pi, np.pi) if periodic else _range(mean, low, high, path, index, view)
    edges = np.linspace(bottom, top, view.rows + 1)
    cells = np.stack([_binned(one, upto, edges, periodic) for one, upto in zip(profiles, cumulatives)], axis=1)
    peak = np.max(cells, axis=0, initial=0.0)
    image = np.rint(255.0 * np.nan_to_num(cells / np.where(peak > 0, peak, 1.0))).astype(np.uint8)
    if periodic:
        low, high = wrap(low), wrap(high)
    arrays: Arrays = {"times": times[index], "density": image}
    arrays |= {"mean": mean.astype(np.float32), "lower": low.astype(np.float32), "upper": high.astype(np.float32)}
    arrays["index"] = index.astype(np.int32)
    if path is not None:
        arrays["truth"] = path.astype(np.float32)
    seen = direct_observations(result, state, times[index[0]], times[index[-1]])
    if seen is not None:
        few = np.unique(np.linspace(0, len(seen[0]) - 1, min(MOST_POINTS, len(seen[0]))).astype(int))
        arrays |= {"seen_times": seen[0][few], "seen": seen[1][few].astype(np.float32)}
    header = {
        "low": bottom,
        "high": top,
        "periodic": periodic,
        "kept": result.has_densities,
        "start": float(times[0]),
        "end": float(times[-1]),
        "state": state,
    }
    return header, arrays


def joint_picture(result: Any, pair: tuple[int, int], k: int) -> tuple[dict[str, Any], Arrays]:
    """Return the density of two states at time number k, with the levels that bound the regions that hold 95% and 50%."""
    density = result.density(k).marginal(pair)
    x, y, values, levels = joint_map(density)
    top = float(values.max()) or 1.0
    image = np.rint(255.0 * values / top).astype(np.uint8)
    cov = density.cov()
    scale = float(np.sqrt(max(cov[0, 0] * cov[1, 1], np.finfo(float).tiny)))
    header = {"time": float(result.times[k]), "levels": (levels / top).tolist(), "correlation": float(cov[0, 1]) / scale}
    return header, {"x": x, "y": y, "density": image}


def _seen(times: np.ndarray, view: View) -> np.ndarray:
    """Return the numbers of at most `view.columns` times of a view, evenly spaced, and one on either side."""
    begin, end = np.searchsorted(times, [view.first, view.last])
    begin, end = max(0, int(begin) - 1), min(len(times), int(end) + 1)
    begin = min(begin, len(times) - 1)
    count = max(1, end - begin)
    return begin + np.unique(np.linspace(0, count - 1, min(view.columns, count)).round().astype(int))


def _profile(result: Any, k: int, state: int) -> Profile:
    """Return the marginal density of one state at time k: of a grid on its own points, made finer, else as the report does."""
    density = result.density(k)
    marginal = density if len(result.state) == 1 else density.marginal(state)
    if not isinstance(marginal, GridDensity) or any(marginal.periodic) or len(marginal.log_values) < 8:
        return profile(result, k, state)
    logs = marginal.log_values
    size, finer = len(logs), FINER * len(logs)
    values = np.exp(logs - logs.max())
    spectrum = np.fft.rfft(values, 2 * size)  # as far again of zeros: what wraps around stays outside
    fine = np.fft.irfft(spectrum, 2 * finer)[: finer - FINER + 1] * FINER
    step = float(marginal.basis[0, 0])
    deviation = (np.arange(len(fine)) / FINER - size // 2) * step
    mass = float(fine.sum()) * step / FINER
    return Profile(float(marginal.centre[0]), deviation, np.maximum(fine, 0.0) / mass)


def _gaussians(mean: np.ndarray, deviation: np.ndarray) -> list[Profile]:
    """Return Gaussians of these moments, where no densities were kept."""
    units = np.linspace(-5.5, 5.5, 111)
    shape = np.exp(-0.5 * units**2)
    widths = np.maximum(deviation, 1e-9 * np.maximum(1.0, np.abs(mean)))
    return [Profile(float(m), units * d, shape / (d * shape.sum() * (units[1] - units[0]))) for m, d in zip(mean, widths)]


def _binned(one: Profile, cumulative: np.ndarray, edges: np.ndarray, periodic: bool) -> np.ndarray:
    """Return the average density over each cell."""
    total = np.zeros(len(edges) - 1)
    for turn in (-2.0 * np.pi, 0.0, 2.0 * np.pi) if periodic else (0.0,):
        offset = (wrap(np.array(one.centre)) if periodic else one.centre) + turn
        at = edges - offset
        inside = (at > one.deviation[0]) & (at < one.deviation[-1])
        upto = np.where(at <= one.deviation[0], 0.0, 1.0)
        upto[inside] = _smooth(one, cumulative, at[inside])
        total += np.diff(upto)
    return np.maximum(total, 0.0) / np.diff(edges)


def _smooth(one: Profile, cumulative: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the distribution function at some deviations: cubic between points, with the density as its slope."""
    step = one.deviation[1] - one.deviation[0]
    place = np.clip((at - one.deviation[0]) / step, 0.0, len(cumulative) - 1.000001)
    i = place.astype(int)
    s = place - i
    left, right = cumulative[i], cumulative[i + 1]
    slope, slope_right = step * one.density[i], step * one.density[i + 1]
    found = left + s * (slope + s * (3 * (right - left) - 2 * slope - slope_right + s * (slope + slope_right - 2 * (right - left))))
    return np.asarray(found)


def _range(
    mean: np.ndarray, low: np.ndarray, high: np.ndarray, path: np.ndarray | None, index: np.ndarray, view: View
) -> tuple[float, float]:
    """Return the range of the state: that of the view, else what holds mean, path and most of the band."""
    if view.low is not None and view.high is not None and view.high > view.low:
        return view.low, view.high
    later = index > 0 if (index > 0).sum() > 1 else np.ones(len(index), bool)
    parts = [mean[later], *([] if path is None else [path])]
    band = np.concatenate([low[later], high[later]])
    band = band[np.isfinite(band)]
    if band.size:
        parts.append(np.percentile(band, [0.5, 99.5] if band.size > 100 else [0, 100]))
    values = np.concatenate([part[np.isfinite(part)] for part in parts])
    bottom, top = (float(values.min()), float(values.max())) if values.size else (-1.0, 1.0)
    margin = 0.08 * (top - bottom) or max(1e-6, 1e-3 * abs(bottom))
    return bottom - margin, top + margin
