"""The interactive pictures of the HTML report, drawn with plotly."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np

from zakai.report import _style as style
from zakai.report import words
from zakai.report._extra import plotting
from zakai.report.heatmap import DensityOverTime, Profile, circle_line

MOST_POINTS = 4000
_CONFIG = {
    "displaylogo": False,
    "responsive": True,
    "plotlyServerURL": "",
    "showSendToCloud": False,
    "modeBarButtonsToRemove": ["select2d", "lasso2d", "autoScale2d"],
}


def library() -> str:
    """The text of plotly.js, to be put into a page once."""
    return str(plotting("plotly.offline").get_plotlyjs())


def html(figure: Any, identifier: str) -> str:
    """The figure as a fragment of a page that already holds the library."""
    return str(
        plotting("plotly.io").to_html(
            figure,
            include_plotlyjs=False,
            full_html=False,
            div_id=identifier,
            config=_CONFIG,
            default_height="100%",
        )
    )


def framed(figure: Any, identifier: str, note: str) -> str:
    """The figure with its caption."""
    caption = f"<figcaption>{escape(note)}</figcaption>" if note else ""
    return f"<figure>{html(figure, identifier)}{caption}</figure>"


def posterior(
    picture: DensityOverTime,
    height: int = 430,
    label: str | None = None,
    observed: tuple[np.ndarray, np.ndarray] | None = None,
    clock: Any = None,
) -> Any:
    """Heat map of the marginal density with mean, 95% band and, where it is known, the truth."""
    go = plotting("plotly.graph_objects")
    figure = go.Figure()
    levels = style.DENSITY_COLOURS
    scale = [[i / (len(levels) - 1), colour] for i, colour in enumerate(levels)]
    percent = np.round(100 * picture.relative).astype(np.uint8)
    figure.add_trace(
        go.Heatmap(
            x=moments(picture.times, clock), y=picture.grid.astype(np.float32), z=percent, zmin=0, zmax=100, colorscale=scale,
            hovertemplate="%{z}% of the peak density at %{y:.4g}<extra></extra>" if picture.kept else None,
            hoverinfo=None if picture.kept else "skip", showscale=False, name="density",
        )
    )  # fmt: skip
    if picture.joined:
        band = {"color": style.BAND_COLOUR, "width": 0.8}
        _line(figure, picture, picture.lower, "95% lower", band, clock)
        _line(figure, picture, picture.upper, "95% upper", band, clock, legend=False)
    _line(figure, picture, picture.mean, "mean", {"color": style.INK, "width": 1.5}, clock)
    if observed is not None:
        dots(figure, moments(observed[0], clock), observed[1])
    if picture.truth is not None:
        _line(
            figure,
            picture,
            picture.truth,
            "truth",
            {"color": style.TRUTH_COLOUR, "width": 1.4, "dash": "4px,2px"},
            clock,
        )
    layout(figure, height)
    figure.update_layout(hovermode="x unified")
    time_axis(figure, clock)
    if not picture.joined or observed is not None:  # plotly leaves a margin around dots
        figure.update_xaxes(range=list(moments(picture.times[[0, -1]], clock)))
    figure.update_yaxes(title_text=escape(label or picture.name), range=[picture.edges[0], picture.edges[-1]])
    if picture.periodic:
        angle = [-np.pi, -np.pi / 2, 0.0, np.pi / 2, np.pi]
        figure.update_yaxes(tickvals=angle, ticktext=["−π", "−π/2", "0", "π/2", "π"])
    return figure


def moments(times: np.ndarray, clock: Any) -> np.ndarray:
    """Return the dates of times, or the times where there are no dates."""
    return times if clock is None else clock.dates(times)


def time_axis(figure: Any, clock: Any, **where: int) -> None:
    """Name the time axis; numbers have six digits."""
    figure.update_xaxes(title_text="time" if clock is None else "date", **where)
    if clock is None:
        figure.update_xaxes(hoverformat=".6g", **where)


def dots(figure: Any, times: np.ndarray, values: np.ndarray, **where: Any) -> None:
    """Draw observations as dots."""
    go = plotting("plotly.graph_objects")
    legend = where.pop("showlegend", True)
    figure.add_trace(
        go.Scatter(
            x=times, y=values, mode="markers", marker={"color": style.FAINT, "size": 4}, name="observations",
            legendgroup="observations", showlegend=legend,
        ), **where,
    )  # fmt: skip


def snapshots(shots: list[tuple[str, str, Profile, float | None]], name: str, periodic: bool) -> Any:
    """The density itself at a few times: panels of (title, time, profile, truth)."""
    go, make_subplots = plotting("plotly.graph_objects"), plotting("plotly.subplots").make_subplots
    columns = min(3, len(shots))
    rows = -(-len(shots) // columns)
    # A panel is about thirty letters wide.
    titles = [f"{title},{'<br>' if len(title) + len(time) > 28 else ' '}{time}" for title, time, _, _ in shots]
    figure = make_subplots(rows=rows, cols=columns, subplot_titles=titles, vertical_spacing=0.3 / rows, horizontal_spacing=0.07)
    for position, (_, _, shot, truth) in enumerate(shots):
        row, column = divmod(position, columns)
        where = {"row": row + 1, "col": column + 1}
        keep = shot.density > 2e-4 * shot.density.max()
        keep = slice(max(int(np.argmax(keep)) - 1, 0), len(keep) - int(np.argmax(keep[::-1])) + 1)
        figure.add_trace(
            go.Scatter(
                x=(shot.centre + shot.deviation[keep]).astype(np.float32),
                y=shot.density[keep].astype(np.float32),
                mode="lines", fill="tozeroy", fillcolor="rgba(47,117,173,0.22)", showlegend=False,
                line={"color": style.SERIES_COLOUR, "width": 1.6, "simplify": False},
                hovertemplate=f"{escape(name)} = %{{x:.5g}}<br>density %{{y:.4g}}<extra></extra>",
            ), **where,
        )  # fmt: skip
        figure.add_vline(x=shot.centre, line={"color": style.INK, "width": 1.2}, **where)
        if truth is not None and np.isfinite(truth):
            if periodic:
                truth = shot.centre + float(np.angle(np.exp(1j * (truth - shot.centre))))
            figure.add_vline(x=truth, line={"color": style.TRUTH_COLOUR, "width": 1.6, "dash": "4px,2px"}, **where)
    layout(figure, 235 * rows + 50)
    figure.update_annotations(font={"size": 13, "color": style.INK})
    figure.update_yaxes(rangemode="tozero", nticks=4)
    figure.update_xaxes(nticks=5)
    for column in range(columns):
        figure.update_xaxes(title_text=escape(name), row=rows, col=column + 1)
    figure.update_yaxes(title_text="density", col=1)
    figure.update_layout(margin={"t": 62})
    return figure


def log_likelihood(times: np.ndarray, increments: np.ndarray, surprise: int | None, clock: Any = None) -> Any:
    """The log-likelihood of each observation above its cumulative sum."""
    go, make_subplots = plotting("plotly.graph_objects"), plotting("plotly.subplots").make_subplots
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.07)
    keep, times = thinned(increments), moments(times, clock)
    dots = {
        "color": style.SERIES_COLOUR,
        "size": 4 if len(keep) < 500 else 3,
        "opacity": 0.75 if len(keep) < 500 else 0.5,
    }
    figure.add_trace(
        go.Scatter(x=times[keep], y=increments[keep], mode="markers", marker=dots, name="per observation"),
        row=1, col=1,
    )  # fmt: skip
    if surprise is not None:
        ring = {"symbol": "circle-open", "size": 12, "color": style.TRUTH_COLOUR, "line": {"width": 2}}
        figure.add_trace(
            go.Scatter(
                x=times[[surprise]], y=increments[[surprise]], mode="markers", marker=ring,
                name="largest surprise",
            ),
            row=1, col=1,
        )  # fmt: skip
    total = np.nancumsum(increments)
    few = np.unique(np.round(np.linspace(0, len(times) - 1, min(len(times), 1500))).astype(int))
    line = {"color": style.INK, "width": 1.6}
    figure.add_trace(
        go.Scatter(x=times[few], y=total[few], mode="lines", line=line, name="cumulative", showlegend=False),
        row=2,
        col=1,
    )
    layout(figure, 480)
    figure.update_yaxes(title_text="per observation", row=1, col=1)
    figure.update_yaxes(title_text="cumulative", row=2, col=1)
    time_axis(figure, clock, row=2, col=1)
    return figure


def health(times: np.ndarray, series: dict[str, np.ndarray], bounds: dict[str, float | None], clock: Any = None) -> Any:
    """One panel for each figure of health; a logarithmic scale where no value is negative."""
    go, make_subplots = plotting("plotly.graph_objects"), plotting("plotly.subplots").make_subplots
    rows, times = len(series), moments(times, clock)
    titles = [escape(words.spoken(name)) for name in series]
    figure = make_subplots(rows=rows, cols=1, shared_xaxes=True, vertical_spacing=0.22 / rows, subplot_titles=titles)
    for row, (name, values) in enumerate(series.items(), start=1):
        drawn, logarithmic = on_log_scale(values)
        keep = thinned(drawn, 1600)
        figure.add_trace(
            go.Scatter(
                x=times[keep], y=drawn[keep], mode="lines", line={"color": style.SERIES_COLOUR, "width": 0.9},
                name=titles[row - 1], showlegend=False,
                hovertemplate="%{x}<br>%{y:.3g}<extra></extra>",
            ), row=row, col=1,
        )  # fmt: skip
        if logarithmic:
            few = np.nanmax(drawn) < 100 * np.nanmin(drawn)  # decades: then the ticks are 1, 2, 5
            ticks = {"dtick": "D2"} if few else {"nticks": 5}
            figure.update_yaxes(type="log", exponentformat="power", row=row, col=1, **ticks)
        bound = bounds.get(name)
        if bound is not None and np.nanmax(drawn) > 1e-3 * bound:
            line = {"color": style.TRUTH_COLOUR, "width": 1.2, "dash": "dot"}
            figure.add_hline(y=bound, line=line, row=row, col=1)
    layout(figure, 150 * rows + 70)
    figure.update_annotations(font={"size": 13, "color": style.INK}, x=0, xanchor="left")
    figure.update_layout(margin={"t": 62})
    time_axis(figure, clock, row=rows, col=1)
    return figure


def on_log_scale(values: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the values to draw, and whether the scale is logarithmic; zeros are then a decade below the rest."""
    finite = values[np.isfinite(values)]
    if not finite.size or finite.min() < 0 or finite.max() == 0:
        return values, False
    floor = max(finite[finite > 0].min() / 10, 1e-300)
    return np.where(values == 0, floor, values), True


def thinned(values: np.ndarray, most: int = MOST_POINTS) -> np.ndarray:
    """Return the positions of at most `most` values: the smallest and the largest of every part, so that no extreme is lost."""
    count = len(values)
    if count <= most:
        return np.arange(count)
    bounds = np.linspace(0, count, most // 2 + 1).astype(int)
    low = np.where(np.isfinite(values), values, np.inf)
    high = np.where(np.isfinite(values), values, -np.inf)
    kept = [(a + int(np.argmin(low[a:b])), a + int(np.argmax(high[a:b]))) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
    return np.unique(np.array(kept))


def _line(
    figure: Any, picture: DensityOverTime, values: np.ndarray, name: str, line: dict, clock: Any, legend: bool = True
) -> None:
    go = plotting("plotly.graph_objects")
    times = picture.times
    if picture.periodic and picture.joined:
        times, values = circle_line(times, values)
    shown = "95% band" if name.startswith("95%") else name
    figure.add_trace(
        go.Scatter(
            x=moments(times, clock), y=values.astype(np.float32), mode="lines" if picture.joined else "markers", line=line,
            marker={"color": line["color"], "size": 3.5}, name=shown, showlegend=legend, legendgroup=shown,
            hovertemplate=f"{name} %{{y:.5g}}<extra></extra>", connectgaps=False,
        )
    )  # fmt: skip


def layout(figure: Any, height: int) -> None:
    """Apply the common style to a plotly figure, in place."""
    axis = {
        "showline": True, "linecolor": style.RULE, "ticks": "outside", "tickcolor": style.RULE, "ticklen": 4,
        "zeroline": False, "showgrid": False, "automargin": True, "title_font": {"size": 13},
        "tickfont": {"size": 12},
    }  # fmt: skip
    legend = {
        "orientation": "h",
        "x": 0,
        "xanchor": "left",
        "y": 1,
        "yanchor": "bottom",
        "font": {"size": 12},
    }
    figure.update_layout(
        template="none",
        height=height,
        margin={"l": 64, "r": 12, "t": 28, "b": 48},
        font={"family": style.SANS, "size": 13, "color": style.INK},
        legend=legend,
        hoverlabel={"font": {"size": 12}, "bgcolor": "#fff"},
    )
    figure.update_xaxes(**axis)
    figure.update_yaxes(**axis)
