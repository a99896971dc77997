"""The pictures of a study, static for papers: error over time, NEES with its bounds, cost against accuracy."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.report import _style as style
from zakai.report.axes import plain
from zakai.report.comparisons import LEVEL, MOST, Curve, error_curves, log_range, nees_curves, spans_decades, works
from zakai.report.pictures import _figure

# Okabe and Ito's colours in the order of their lightness; dashes and markers tell them apart in grey.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#1d2430")
DASHES: tuple[Any, ...] = ("solid", (0, (5, 2)), (0, (1.2, 1.2)), (0, (6, 1.5, 1.2, 1.5)), (0, (9, 2)))
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
FEW = 4  # methods, beyond which thin lines beside the medians only confuse


def error_figure(outcome: Any, point: int = 0) -> Any:
    """Draw the error |x - m| of every method over time: the median over the runs, and thin what nine in ten stay below.

    Arguments: `outcome`, of `run_study`; `point`, the number of a model with its parameters. Returns a matplotlib figure.
    """
    curves = error_curves(outcome.points[point])
    figure, axes = _axes()
    _lines(axes, curves)
    _logarithmic(axes, curves)
    axes.set_ylabel("error |x − m| (unit of the state)")
    said = "median over runs" + (f"; thin: {MOST:.0%} of the runs are below" if len(curves) <= FEW else "")
    return _finished(figure, axes, said)


def nees_figure(outcome: Any, point: int = 0) -> Any:
    """Draw NEES/n averaged over the runs of every method over time, with its 95% chi-square bounds; 1 is right."""
    curves, (low, high) = nees_curves(outcome.points[point])
    figure, axes = _axes()
    axes.axhspan(low, high, color=style.RULE, linewidth=0)
    axes.axhline(1.0, color=style.FAINT, linewidth=0.8)
    _lines(axes, curves)
    _logarithmic(axes, curves)
    axes.set_ylabel("NEES / n (no unit)")
    return _finished(figure, axes, f"mean over runs; grey: {LEVEL:.0%} bounds of a right filter")


def work_figure(outcome: Any, point: int = 0) -> Any:
    """Draw the cost of every method, seconds for an observation, against its error and its distance from the reference."""
    found = works(outcome.summary["points"][point], outcome.timing["points"][point])
    reference = outcome.summary["reference"]
    both = any(np.isfinite(one.distance) for one in found)
    figure = _figure(8.0, 3.6)
    panels = figure.subplots(1, 2 if both else 1, squeeze=False)[0]
    for number, one in enumerate(found):
        look = {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)], "markersize": 7}
        label = plain(one.label) + (" (reference)" if one.label == reference else "")
        panels[0].errorbar(1e6 * one.seconds, one.error, one.spread, linestyle="none", capsize=3, label=label, **look)
        if both and np.isfinite(one.distance):
            panels[1].plot(1e6 * one.seconds, one.distance, linestyle="none", **look)
        elif both:
            panels[1].axvline(1e6 * one.seconds, color=look["color"], linewidth=1.0, linestyle=":")
    panels[0].set_ylabel("root mean squared error\n(unit of the state)")
    if both:
        panels[1].set_ylabel("distance from the reference\n(unit of the state)")
    for axes in panels:
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("time per observation (µs)")
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_xlim(log_range([1e6 * one.seconds for one in found]))
    panels[0].set_ylim(log_range([one.error for one in found]))
    if both:
        panels[1].set_ylim(log_range([one.distance for one in found]))
    for axes in panels:
        _few_ticks(axes)
    figure.legend(loc="outside upper left", ncols=4, frameon=False, fontsize=9, handlelength=1.2)
    return figure


def _few_ticks(axes: Any) -> None:
    """Numbers, not powers of ten, where an axis spans less than two decades."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        if high > 100 * low:
            continue
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high > 4 * low else (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def _axes() -> tuple[Any, Any]:
    figure = _figure(8.0, 3.6)
    return figure, figure.add_subplot()


def _lines(axes: Any, curves: list[Curve]) -> None:
    for number, curve in enumerate(curves):
        colour = COLOURS[number % len(COLOURS)]
        look = {"color": colour, "linestyle": DASHES[number % len(DASHES)]}
        if curve.high is not None and len(curves) <= FEW:
            axes.plot(curve.times, curve.high, linewidth=0.6, **look)
        axes.plot(curve.times, curve.middle, linewidth=1.6, label=plain(curve.label), **look)


def _logarithmic(axes: Any, curves: list[Curve]) -> None:
    """A logarithmic scale where the curves lie decades apart."""
    if spans_decades(curves):
        axes.set_yscale("log")
        _few_ticks(axes)
    else:
        axes.set_ylim(bottom=0.0)


def _finished(figure: Any, axes: Any, said: str) -> Any:
    axes.set_xlabel("time (unit of the model)")
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0)
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside upper left", ncols=4, frameon=False, fontsize=9, handlelength=3.2)
    axes.set_title(said, loc="right", fontsize=8, color=style.FAINT)
    return figure
