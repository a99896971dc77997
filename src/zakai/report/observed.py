"""The sections on the joint density of two states, and on the observations."""

from __future__ import annotations

import itertools
from html import escape
from typing import Any

import numpy as np

from zakai.densities._values import wrap
from zakai.models.numeric import numpy_function
from zakai.records.schedule import schedule_of
from zakai.report import _style as style
from zakai.report import plots, words
from zakai.report._extra import plotting
from zakai.report.axes import joint_map
from zakai.report.heatmap import circle_line, state_names

_MOST_PAIRS = 3
_MOST_COORDINATES = 4


def joint(result: Any) -> str:
    """The joint density of two states at the end, for the first pairs."""
    names, clock_end = state_names(result), words.moment(result, len(result.times) - 1)
    if len(names) < 2:
        return "<p>There is one state.</p>"
    if not result.has_densities:
        return '<p>The densities of this run were not kept. Filter again with <code>keep="densities"</code> to see them.</p>'
    pairs = list(itertools.combinations(range(len(names)), 2))
    parts = [
        f"<p>The density of two states at {escape(clock_end)}; the lines bound the smallest regions that hold 95% and 50%.</p>"
    ]
    if len(pairs) > _MOST_PAIRS:
        parts.append(f"<p>The first {_MOST_PAIRS} of {len(pairs)} pairs are drawn.</p>")
    for pair in pairs[:_MOST_PAIRS]:
        drawn = joint_map(result.density(len(result.times) - 1).marginal(pair))
        if not (np.isfinite(drawn[2]).all() and drawn[2].max() > 0):
            parts.append(f"<p>{escape(names[pair[0]])} and {escape(names[pair[1]])} have no joint density.</p>")
            continue
        figure = joint_figure(*drawn, (names[pair[0]], names[pair[1]]))
        parts.append(plots.framed(figure, f"joint-{pair[0]}-{pair[1]}", f"Correlation {_correlation(result, pair):.3f}."))
    return "".join(parts)


def _correlation(result: Any, pair: tuple[int, int]) -> float:
    cov = result.density(len(result.times) - 1).marginal(pair).cov()
    return float(cov[0, 1] / np.sqrt(max(cov[0, 0] * cov[1, 1], np.finfo(float).tiny)))


def observations(result: Any) -> str:
    """What was observed, against h at the posterior mean."""
    model, record = result.model, result.record
    if model is None or record is None:
        return "<p>The result does not hold its record.</p>"
    schedule, values = schedule_of(model, record)
    with np.errstate(divide="ignore", invalid="ignore"):
        values = np.where(schedule.seen, values if record.kind == "samples" else values / schedule.elapsed, np.nan)
    expected = _expected(result) if getattr(model, "log_density", None) is None else None
    series = []
    for j in np.flatnonzero(schedule.seen.any(axis=0))[:_MOST_COORDINATES]:
        rows = schedule.seen[:, j]
        title, times, seen, line = f"observation {j + 1}", record.times[rows], values[rows, j], None
        if expected is not None:
            title += f": h = {_short(model.observation[j])}"
            line = times, expected[rows, j]
            if model.observation_family[j] == "von-mises" or model.observation_law.angles[j]:
                seen, line = wrap(seen), circle_line(times, wrap(expected[rows, j]))
        series.append((title, times, seen, line))
    if not series:
        return "<p>Nothing was observed.</p>"
    what = "the observations" if record.kind == "samples" else "the increments of y over their time"
    text = f"<p>The dots are {what}" + ("." if expected is None else "; the line is h at the posterior mean after each of them.")
    if len(series) < record.values.shape[1]:
        text += f" The first {len(series)} of {record.values.shape[1]} coordinates are drawn."
    figure = observations_figure(series, getattr(result, "clock", None))
    return text + "</p>" + plots.framed(figure, "observations-figure", "") + known_inputs(result)


def known_inputs(result: Any) -> str:
    """The known inputs over the times of the record, or nothing where there are none."""
    model, record = result.model, result.record
    if model is None or record is None or record.inputs is None:
        return ""
    times = np.unique(np.concatenate([result.times, record.inputs.times]))
    times = times[(times >= result.times[0]) & (times <= result.times[-1])]
    values = record.inputs.at(times, model.input_hold)
    nothing = np.zeros(0)
    shown = model.inputs[:_MOST_COORDINATES]
    series = [(f"input {name}", nothing, nothing, (times, values[:, j])) for j, name in enumerate(shown)]
    figure = observations_figure(series, getattr(result, "clock", None), "known input")
    return "<h3>Known inputs</h3>" + plots.framed(figure, "inputs", "")


def _expected(result: Any) -> np.ndarray:
    """Return the mean of the observations at the posterior mean of the state (K, m): h, of most families."""
    model, record = result.model, result.record
    inputs = None if record.inputs is None else record.inputs.at(record.times, model.input_hold)
    function = numpy_function(list(model.observation), model)
    if record.kind == "samples" and not model.observation_law.is_gaussian:
        function = model.observation_law.mean
    with np.errstate(all="ignore"):
        return np.asarray(function(np.asarray(result.mean, float)[1:], record.times, model.theta(), inputs))


def _short(formula: Any) -> str:
    text = str(formula)
    return text if len(text) <= 60 else f"{text[:57]}..."


def observations_figure(
    series: list[tuple[str, np.ndarray, np.ndarray, Any]], clock: Any = None, said: str = "h at the posterior mean"
) -> Any:
    """One panel for each observed coordinate: (title, times, values, times and values of a line, or None)."""
    go, make_subplots = plotting("plotly.graph_objects"), plotting("plotly.subplots").make_subplots
    rows = len(series)
    titles = [escape(title) for title, _, _, _ in series]
    figure = make_subplots(rows=rows, cols=1, shared_xaxes=True, vertical_spacing=0.22 / rows, subplot_titles=titles)
    for row, (_, times, values, line) in enumerate(series, start=1):
        keep = plots.thinned(values)
        if len(values):
            plots.dots(figure, plots.moments(times[keep], clock), values[keep], row=row, col=1, showlegend=row == 1)
        if line is not None:
            few = plots.thinned(line[1])
            figure.add_trace(
                go.Scatter(
                    x=plots.moments(line[0][few], clock), y=line[1][few].astype(np.float32), mode="lines",
                    line={"color": style.INK, "width": 1.4}, showlegend=row == 1, legendgroup="expected",
                    name=said,
                ), row=row, col=1,
            )  # fmt: skip
    plots.layout(figure, 190 * rows + 80)
    figure.update_annotations(font={"size": 13, "color": style.INK}, x=0, xanchor="left")
    figure.update_layout(margin={"t": 62}, legend={"x": 1, "xanchor": "right"})
    plots.time_axis(figure, clock, row=rows, col=1)
    return figure


def joint_figure(x: np.ndarray, y: np.ndarray, values: np.ndarray, levels: np.ndarray, names: tuple[str, str]) -> Any:
    """The joint density of two states, with the regions that hold 50% and 95%."""
    go = plotting("plotly.graph_objects")
    figure = go.Figure()
    colours = style.DENSITY_COLOURS
    scale = [[i / (len(colours) - 1), colour] for i, colour in enumerate(colours)]
    grid = {"x": x.astype(np.float32), "y": y.astype(np.float32)}
    percent = np.round(100 * values / max(values.max(), np.finfo(float).tiny)).astype(np.uint8)
    figure.add_trace(
        go.Heatmap(
            **grid, z=percent, colorscale=scale, showscale=False,
            hovertemplate="%{x:.4g}, %{y:.4g}<br>%{z}% of the peak<extra></extra>",
        )
    )  # fmt: skip
    for level, width in zip(levels, (0.9, 1.4), strict=True):
        height = float(100 * level / values.max())
        figure.add_trace(
            go.Contour(
                **grid, z=100 * values / values.max(), showscale=False, hoverinfo="skip",
                contours={"start": height, "end": height, "size": 1, "coloring": "none"},
                line={"color": style.BAND_COLOUR, "width": width},
                showlegend=False,
            )
        )  # fmt: skip
    plots.layout(figure, 430)
    figure.update_layout(width=520)
    figure.update_xaxes(title_text=escape(names[0]))
    figure.update_yaxes(title_text=escape(names[1]))
    return figure
