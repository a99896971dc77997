"""Static pictures of a result for papers and slides, drawn with matplotlib without the global state of pyplot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from zakai.errors import InputError
from zakai.report import _style as style
from zakai.report import words
from zakai.report._extra import plotting
from zakai.report.axes import plain, plot_result
from zakai.report.series import on_log_scale, thinned

_FORMATS = ("png", "pdf", "svg")


def posterior_figure(
    result: Any, state: int | str = 0, truth: Any = None, start: int | None = None, stop: int | None = None
) -> Any:
    """Draw the marginal posterior of one state over time: heat map, mean, 95 % credible band and, if given, the truth.

    Arguments: `result`, a `FilterResult`; `state`, a number or a name; `truth`, (K+1, n) or an object with
    `times` and `values`; `start`, `stop`: positions in `result.times`, as in a slice. Returns a
    `matplotlib.figure.Figure`. Raises `InputError` for an unknown state, an empty range, a truth of the wrong
    shape, or when matplotlib is not installed.

    Example: `save_figure(posterior_figure(result, "theta"), "theta.png")`.
    """
    figure = _figure(8.0, 3.6)
    plot_result(result, state, truth, start, stop, figure.add_subplot())
    return figure


def diagnostics_figure(result: Any) -> Any:
    """Draw the log-likelihood per observation, its cumulative sum and every figure of health over time.

    Returns a `matplotlib.figure.Figure`. Raises `InputError` when matplotlib is not installed.

    Example: `save_figure(diagnostics_figure(result), "health.pdf")`.
    """
    times = np.asarray(result.times, dtype=float)
    increments = np.asarray(result.log_likelihood_increments, dtype=float)[1:]
    series = {name: np.asarray(values, dtype=float) for name, values in result.health.items()}
    figure = _figure(8.0, 1.55 * (2 + len(series)) + 0.4)
    panels = figure.subplots(2 + len(series), 1, sharex=True)
    few = thinned(increments)
    panels[0].plot(times[1:][few], increments[few], ".", color=style.SERIES_COLOUR, markersize=2.5, rasterized=True)
    panels[0].set_title("log-likelihood per observation", loc="left", fontsize=9)
    panels[1].plot(times, np.concatenate([[0.0], np.nancumsum(increments)]), color=style.INK, linewidth=1.1)
    panels[1].set_title("cumulative log-likelihood", loc="left", fontsize=9)
    for axes, (name, values) in zip(panels[2:], series.items(), strict=True):
        drawn, logarithmic = on_log_scale(values)
        few = thinned(drawn, 1600)
        axes.plot(times[few], drawn[few], color=style.SERIES_COLOUR, linewidth=0.7)
        axes.set_yscale("log" if logarithmic else "linear")
        axes.set_title(plain(words.spoken(name)), loc="left", fontsize=9)
        bound = words.health_bound(result, name)
        if bound is not None and np.nanmax(drawn, initial=0.0) > 1e-3 * bound:
            axes.axhline(bound, color=style.TRUTH_COLOUR, linewidth=0.9, linestyle=":")
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
    panels[-1].set_xlabel("time")
    return figure


def save_figure(figure: Any, path: str | Path, dpi: int = 160) -> None:
    """Write a figure as PNG, PDF or SVG, by the ending of `path`; the file appears only when it is complete.

    Raises `InputError` for another ending.
    """
    from zakai.records.writing import atomic_write

    ending = Path(path).suffix.lstrip(".").lower()
    if ending not in _FORMATS:
        raise InputError(f"{path}: pictures are written as {', '.join(_FORMATS)}; the file's name must end in one of them")
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format=ending, dpi=dpi)


def _figure(width: float, height: float) -> Any:
    figure = plotting("matplotlib.figure").Figure(figsize=(width, height), layout="constrained")
    plotting("matplotlib.backends.backend_agg").FigureCanvasAgg(figure)
    return figure
