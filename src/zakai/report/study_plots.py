"""The pictures of a study, interactive: the same as the static ones, with hovering."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np

from zakai.report import _style as style
from zakai.report._extra import plotting
from zakai.report.comparisons import MOST, Curve, error_curves, log_range, nees_curves, spans_decades, works
from zakai.report.plots import layout
from zakai.report.study_pictures import COLOURS, FEW

DASHES = ("solid", "7px,3px", "2px,2px", "8px,2px,2px,2px", "12px,3px")
MARKERS = ("circle", "square", "triangle-up", "diamond", "triangle-down", "cross", "x")


def error(outcome: Any, point: int) -> Any:
    """The error of every method over time: the median over the runs, and thin what most stay below."""
    curves = error_curves(outcome.points[point])
    figure = plotting("plotly.graph_objects").Figure()
    _lines(figure, curves)
    return _finished(figure, curves, "error |x − m| (unit of the state)")


def nees(outcome: Any, point: int) -> Any:
    """NEES/n of every method over time, with the bounds of a right filter."""
    curves, (low, high) = nees_curves(outcome.points[point])
    figure = plotting("plotly.graph_objects").Figure()
    figure.add_hrect(y0=low, y1=high, fillcolor=style.RULE, line_width=0, layer="below")
    figure.add_hline(y=1.0, line={"color": style.FAINT, "width": 0.8})
    _lines(figure, curves)
    return _finished(figure, curves, "NEES / n (no unit)")


def work(outcome: Any, point: int) -> Any:
    """Cost against accuracy."""
    go, make_subplots = plotting("plotly.graph_objects"), plotting("plotly.subplots").make_subplots
    found = works(outcome.summary["points"][point], outcome.timing["points"][point])
    both = any(np.isfinite(one.distance) for one in found)
    figure = make_subplots(rows=1, cols=2 if both else 1, horizontal_spacing=0.13)
    for number, one in enumerate(found):
        look = {"color": COLOURS[number % len(COLOURS)], "symbol": MARKERS[number % len(MARKERS)], "size": 11}
        label = escape(one.label) + (" (reference)" if one.label == outcome.summary["reference"] else "")
        shown = f"{label}<br>%{{x:.4g}} µs<br>%{{y:.4g}}<extra></extra>"
        figure.add_trace(
            go.Scatter(
                x=[1e6 * one.seconds], y=[one.error], mode="markers", marker=look, name=label, legendgroup=label,
                error_y={"type": "data", "array": [one.spread], "thickness": 1.2, "width": 4}, hovertemplate=shown,
            ), row=1, col=1,
        )  # fmt: skip
        if both and np.isfinite(one.distance):
            figure.add_trace(
                go.Scatter(
                    x=[1e6 * one.seconds], y=[one.distance], mode="markers", marker=look, name=label, legendgroup=label,
                    showlegend=False, hovertemplate=shown,
                ), row=1, col=2,
            )  # fmt: skip
    for one in found if both else ():
        if not np.isfinite(one.distance):  # a line in an empty panel would not be drawn, so it comes last
            figure.add_vline(x=1e6 * one.seconds, line={"color": style.FAINT, "width": 1.2, "dash": "dot"}, row=1, col=2)
    layout(figure, 400)
    figure.update_xaxes(title_text="time per observation (µs)", **_log(*log_range([1e6 * one.seconds for one in found])))
    panels = [("root mean squared error", [one.error for one in found])]
    if both:
        panels.append(("distance from the reference", [one.distance for one in found]))
    for column, (what, values) in enumerate(panels, 1):
        figure.update_yaxes(title_text=f"{what} (unit of the state)", **_log(*log_range(values)), row=1, col=column)
    return figure


def _log(low: float, high: float) -> dict[str, Any]:
    """A logarithmic axis with numbers at 1, 2 and 5, or at powers of ten where it is long."""
    steps = (1, 2, 5) if high < 1000 * low else (1,)
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    values = [step * 10.0**power for power in powers for step in steps]
    return {"type": "log", "range": np.log10([low, high]), "tickvals": values, "ticktext": [f"{value:g}" for value in values]}


def _lines(figure: Any, curves: list[Curve]) -> None:
    go = plotting("plotly.graph_objects")
    for number, curve in enumerate(curves):
        line = {"color": COLOURS[number % len(COLOURS)], "width": 1.8, "dash": DASHES[number % len(DASHES)]}
        label = escape(curve.label)
        figure.add_trace(
            go.Scatter(
                x=curve.times, y=curve.middle, mode="lines", line=line, name=label, legendgroup=label,
                hovertemplate=f"{label} %{{y:.4g}}<extra></extra>",
            )
        )  # fmt: skip
        if curve.high is not None and len(curves) <= FEW:
            figure.add_trace(
                go.Scatter(
                    x=curve.times, y=curve.high, mode="lines", line={**line, "width": 0.8}, showlegend=False, legendgroup=label,
                    hovertemplate=f"{label}, {MOST:.0%} below %{{y:.4g}}<extra></extra>",
                )
            )  # fmt: skip


def _finished(figure: Any, curves: list[Curve], what: str) -> Any:
    layout(figure, 380)
    figure.update_layout(hovermode="x unified")
    figure.update_xaxes(title_text="time (unit of the model)", hoverformat=".6g")
    figure.update_yaxes(title_text=what, rangemode="tozero")
    if spans_decades(curves):
        figure.update_yaxes(**_log(*log_range(np.concatenate([curve.middle for curve in curves]).tolist(), 1.2)))
    return figure
