"""Frames of the picture of a density over time, which `static/density.js` draws.

A frame holds only what can be seen: at most `columns` densities of a window of times, and the extremes of everything else.
"""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np

from zakai.densities._values import wrap
from zakai.errors import InputError
from zakai.report import words
from zakai.report.charts import clock_header
from zakai.report.columns import ROWS, columns_at
from zakai.report.frames import pack
from zakai.report.heatmap import circle_line, direct_observations, is_periodic, state_names, true_states
from zakai.report.series import thinned

LEVELS = (0.025, 0.975)
_NORMAL_QUANTILE = 1.959963984540054
COLUMNS = 1000
_SCALE = 65535  # the largest cell of a column
_TEXTS = {"mean": "mean", "band": "95% band", "truth": "truth", "observations": "observations", "filtered": "filtered mean"}


def picture_bytes(
    result: Any,
    coordinate: int | str = 0,
    window: tuple[float, float] | None = None,
    columns: int = COLUMNS,
    rows: int = ROWS,
    truth: Any = None,
    *,
    alone: bool = False,
) -> bytes:
    """Return the frame of one state over a window of times.

    Args:
        result: a `FilterResult`, `SmoothingResult` or forecast.
        coordinate: a state, by name or number.
        window: first and last time; all times by default.  The next time on either side belongs to the frame.
        columns: the number of densities at most; of more times, as many are taken evenly.
        rows: the number of cells of a density.
        truth: the true states where they are known, as for `FilterResult.plot`.
        alone: whether the window is all that a reader can see.

    Raises:
        InputError: an unknown state, a window without times, or a truth of the wrong shape.
    """
    number = number_of(result, coordinate)
    times = np.asarray(result.times, dtype=float)
    inside, index = chosen(times, window, columns)
    periodic, kept = is_periodic(result, number), bool(result.has_densities)
    means = np.asarray(result.mean, dtype=float)[:, number]
    variances = np.asarray(result.variance, dtype=float)[:, number]
    arrays: dict[str, np.ndarray] = {"times": times[index], "mean": means[index]}
    if kept:
        drawn = columns_at(result, index, number, rows)
        peaks = drawn.density.max(axis=1)
        finite = np.isfinite(peaks)
        peaks = np.where(finite, peaks, 0.0)
        arrays["low"], arrays["high"] = (np.where(finite, ends, means[index]) for ends in (drawn.low, drawn.high))
        arrays["peak"] = peaks
        shapes = drawn.density * (_SCALE / np.where(finite, peaks, 1.0))[:, None]
        arrays["cells"] = np.rint(np.nan_to_num(shapes, copy=False)).astype(np.uint16)
        quantiles = drawn.quantile(LEVELS)
    else:
        half = _NORMAL_QUANTILE * np.sqrt(np.maximum(variances[index], 0.0))
        half = np.minimum(half, np.pi) if periodic else half
        quantiles = means[index] + np.array([-1.0, 1.0])[:, None] * half
    arrays["quantiles"] = wrap(quantiles) if periodic else quantiles
    states = true_states(truth, result)
    known = None if states is None else wrap(states[:, number]) if periodic else states[:, number]
    if known is not None:
        arrays["truth"] = known[index]
    lines = _Lines(arrays, 2 * columns, periodic)
    joined = not periodic or len(index) == len(inside)
    if joined:
        for values in arrays["quantiles"]:
            lines.add("band", times[index], values)
    filtered = getattr(result, "filtered", None)
    if filtered is not None:
        lines.add("filtered", times[inside], np.asarray(filtered.mean, dtype=float)[inside, number])
    lines.add("mean", times[inside], means[inside])
    observed = direct_observations(result, number, float(times[inside[0]]), float(times[inside[-1]]))
    if observed is not None:
        lines.add("observations", *observed, dots=True)
    if known is not None:
        lines.add("truth", times[inside], known[inside])
    names, ranged = state_names(result), inside if alone else slice(None)
    header = {
        "kind": "density",
        "key": f"{names[number]}-{zlib.crc32(means.tobytes() + variances.tobytes()):08x}",
        "name": names[number],
        "clock": clock_header(getattr(result, "clock", None)),
        "periodic": periodic,
        "given": words.given(result),
        "levels": list(LEVELS),
        "window": [float(times[inside[0]]), float(times[inside[-1]])],
        "extent": [float(times[k]) for k in ((inside[0], inside[-1]) if alone else (0, -1))],
        "range": value_range(means[ranged], variances[ranged], None if known is None else known[ranged], periodic),
        "complete": len(index) == len(inside),
        "coverage": None if known is None else coverage(arrays["quantiles"], arrays["truth"], periodic),
        "lines": lines.described,
    }
    return pack(header, {name: np.ascontiguousarray(array) for name, array in arrays.items()})


class _Lines:
    """The lines of a frame: each is thinned to its extremes, and of an angle cut where it passes pi."""

    def __init__(self, arrays: dict[str, np.ndarray], most: int, periodic: bool):
        self.arrays, self.most, self.periodic = arrays, most, periodic
        self.described: list[dict[str, Any]] = []

    def add(self, role: str, times: np.ndarray, values: np.ndarray, dots: bool = False) -> None:
        few = thinned(values, self.most)
        # Between points that are left out an angle may have gone either way round.
        dots = dots or (self.periodic and len(few) < len(values))
        times, values = times[few], values[few]
        if self.periodic and not dots:
            times, values = circle_line(times, values)
        names = [f"line{len(self.described)}.{part}" for part in ("times", "values")]
        self.arrays.update(zip(names, (times, values), strict=True))
        self.described.append({"role": role, "text": _TEXTS[role], "times": names[0], "values": names[1], "dots": dots})


def coverage(quantiles: np.ndarray, truth: np.ndarray, periodic: bool) -> float | None:
    """Return the share of the times with a known truth (C,) at which it is between two quantiles (2, C); None without any."""
    known = np.isfinite(truth)
    if not known.any():
        return None
    offset, width = truth - quantiles[0], quantiles[1] - quantiles[0]
    if periodic:
        offset, width = np.mod(offset, 2 * np.pi), 2 * np.pi - np.mod(-width, 2 * np.pi)
    return float(np.mean((0 <= offset[known]) & (offset[known] <= width[known])))


def chosen(times: np.ndarray, window: tuple[float, float] | None, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions of the times in a window, with a neighbour on either side, and at most `columns` of them, evenly."""
    if columns < 2:
        raise InputError(f"picture: columns is {columns}; at least 2 densities are drawn")
    first, stop = 0, len(times)
    if window is not None:
        low, high = (float(end) for end in window)
        if not low <= high:
            raise InputError(f"picture: the window {window!r} does not rise; give its first and its last time")
        first = max(0, int(np.searchsorted(times, low, "left")) - 1)
        stop = min(len(times), int(np.searchsorted(times, high, "right")) + 1)
    if stop <= first:
        raise InputError(f"picture: no time of the result is in the window {window!r}")
    inside = np.arange(first, stop)
    if len(inside) <= columns:
        return inside, inside
    return inside, inside[np.unique(np.round(np.linspace(0, len(inside) - 1, columns)).astype(int))]


def number_of(result: Any, coordinate: int | str) -> int:
    """Return the number of a state that is given by name or number."""
    names = state_names(result)
    if isinstance(coordinate, str) and coordinate in names:
        return names.index(coordinate)
    if isinstance(coordinate, int | np.integer) and 0 <= coordinate < len(names):
        return int(coordinate)
    raise InputError(f"picture: there is no state {coordinate!r}; the states are {', '.join(names)}")


def value_range(means: np.ndarray, variances: np.ndarray, truth: np.ndarray | None, periodic: bool) -> list[float]:
    """Return the range of values to show: it follows mean, band and truth, but not a wide prior or a few wide moments."""
    if periodic:
        return [-np.pi, np.pi]
    data = np.arange(len(means)) > 0 if len(means) > 2 else np.ones(len(means), dtype=bool)
    half = _NORMAL_QUANTILE * np.sqrt(np.maximum(variances[data], 0.0))
    band = np.concatenate([means[data] - half, means[data] + half])
    band = band[np.isfinite(band)]
    ends = np.percentile(band, [0.5, 99.5] if band.size > 100 else [0, 100]) if band.size else np.zeros(0)
    values = np.concatenate([means[data], np.zeros(0) if truth is None else truth, ends])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if values.size else (-1.0, 1.0)
    margin = 0.06 * (high - low) or max(1e-6, 1e-3 * abs(low))
    return [low - margin, high + margin]
