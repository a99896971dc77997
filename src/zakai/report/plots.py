"""The pictures of the HTML report that are panels of lines, dots and bars, as frames."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.report import words
from zakai.report.charts import Chart, axis, time_axis
from zakai.report.columns import columns_at
from zakai.report.series import on_log_scale, thinned

_SHOWN = 2e-4  # of its peak: below, the density of a moment is not drawn
_FEW = 1600  # points of a line


def snapshots(
    result: Any, shots: list[tuple[int, str]], state: int, truth: np.ndarray | None, name: str, periodic: bool
) -> bytes:
    """Return the densities of one state at a few times: panels of (position, title)."""
    drawn = columns_at(result, [k for k, _ in shots], state)
    chart = Chart(across=min(3, len(shots)))
    for (k, title), x, density in zip(shots, drawn.middles, drawn.density, strict=True):
        panel = chart.panel(title, axis(name), axis("density", zero=True), height=210, label=f"Density of {name}: {title}")
        keep = np.flatnonzero(density > _SHOWN * np.max(density, initial=0.0))
        own = slice(max(int(keep[0]) - 1, 0), int(keep[-1]) + 2) if len(keep) else slice(0)
        mean = float(np.asarray(result.mean)[k, state])
        panel.add("area", x[own], density[own], width=1.6)
        panel.add("mark", at=mean, colour="ink", text="mean")
        if truth is not None and np.isfinite(truth[k]):
            at = mean + float(np.angle(np.exp(1j * (truth[k] - mean)))) if periodic else float(truth[k])
            panel.add("mark", at=at, colour="truth", width=1.6, dash=[5, 3], text="truth")
    return chart.frame()


def log_likelihood(times: np.ndarray, increments: np.ndarray, surprise: int | None, clock: Any = None) -> bytes:
    """Return the log-likelihood of each observation above its cumulative sum."""
    chart, keep = Chart(), thinned(increments)
    above = chart.panel(
        "", time_axis(clock), axis("per observation"), height=230, link="time", label="Log-likelihood per observation"
    )
    above.add("dots", times[keep], increments[keep], text="per observation")
    if surprise is not None:
        above.add("rings", times[[surprise]], increments[[surprise]], colour="truth", text="largest surprise")
    total = np.nancumsum(increments)
    few = thinned(total, _FEW)
    below = chart.panel("", time_axis(clock), axis("cumulative"), height=210, link="time", label="Cumulative log-likelihood")
    below.add("line", times[few], total[few], colour="ink", width=1.6, text="cumulative")
    return chart.frame()


def health(times: np.ndarray, series: dict[str, np.ndarray], bounds: dict[str, float | None], clock: Any = None) -> bytes:
    """Return one panel for each figure of health; a logarithmic scale where no value is negative."""
    chart = Chart()
    for name, values in series.items():
        drawn, logarithmic = on_log_scale(values)
        keep = thinned(drawn, _FEW)
        said = words.spoken(name)
        panel = chart.panel(said, time_axis(clock), axis("", log=logarithmic), height=150, link="time", label=said)
        panel.add("line", times[keep], drawn[keep], width=1.0)
        bound = bounds.get(name)
        if bound is not None and np.nanmax(drawn) > 1e-3 * bound:
            panel.add("row", at=float(bound), colour="truth", dash=[2, 3], text="bound")
    return chart.frame()
