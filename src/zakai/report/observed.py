"""The sections on the joint density of two states, and on the observations."""

from __future__ import annotations

import itertools
from html import escape
from typing import Any

import numpy as np

from zakai.densities._values import wrap
from zakai.errors import InputError
from zakai.models.numeric import numpy_function
from zakai.records.schedule import schedule_of
from zakai.report import words
from zakai.report.charts import Chart, axis, time_axis
from zakai.report.heatmap import circle_line, state_names
from zakai.report.plane import plane_bytes
from zakai.report.scripts import framed
from zakai.report.sections import special_moments
from zakai.report.series import thinned

_MOST_PAIRS = 3
_MOST_COORDINATES = 4


def joint(result: Any, truth: np.ndarray | None) -> str:
    """The joint density of two states at the moments of note, for the first pairs."""
    names, moments = state_names(result), special_moments(result)
    if len(names) < 2:
        return "<p>There is one state.</p>"
    if not result.has_densities:
        return '<p>The densities of this run were not kept. Filter again with <code>keep="densities"</code> to see them.</p>'
    pairs = list(itertools.combinations(range(len(names)), 2))
    parts = [
        "<p>The density of two states at the moments of the next section; the slider chooses one of them. The lines bound the "
        "smallest regions that hold 95% and 50%.</p>"
    ]
    if len(pairs) > _MOST_PAIRS:
        parts.append(f"<p>The first {_MOST_PAIRS} of {len(pairs)} pairs are drawn.</p>")
    for pair in pairs[:_MOST_PAIRS]:
        last = len(result.times) - 1
        try:
            frame = plane_bytes(result, pair, [k for k, _ in moments], truth=truth)
        except (InputError, np.linalg.LinAlgError):
            parts.append(f"<p>{escape(names[pair[0]])} and {escape(names[pair[1]])} have no joint density.</p>")
            continue
        note = f"At the end, {words.moment(result, last)}, the correlation is {_correlation(result, pair):.3f}."
        parts.append(framed("plane", frame, f"joint-{pair[0]}-{pair[1]}", note, 420))
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
    return text + "</p>" + framed("chart", figure, "observations-figure") + known_inputs(result)


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
    return "<h3>Known inputs</h3>" + framed("chart", figure, "inputs")


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
) -> bytes:
    """Return one panel for each observed coordinate: (title, times, values, times and values of a line, or None)."""
    chart = Chart()
    for title, times, values, line in series:
        panel = chart.panel(title, time_axis(clock), axis(""), height=190, link="time")
        keep = thinned(values)
        if len(values):
            panel.add("dots", times[keep], values[keep], colour="faint", text="observations")
        if line is not None:
            few = thinned(line[1])
            panel.add("line", line[0][few], line[1][few], colour="ink", width=1.4, text=said)
    return chart.frame()
