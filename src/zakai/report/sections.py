"""The sections of the HTML report: each takes a result and gives a fragment of the page."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np

from zakai.report import plots, words
from zakai.report.equations import equations
from zakai.report.frames import unpack
from zakai.report.heatmap import is_periodic, state_names
from zakai.report.picture import picture_bytes
from zakai.report.scripts import framed
from zakai.report.series import MOST_POINTS
from zakai.report.words import signed

_COLUMNS = 600
_ROWS = 160  # of the columns of the report: 14 or more for a standard deviation of a Gaussian
_DETAIL = 200
_MOST_STATES = 6


def posterior(result: Any, truth: np.ndarray | None) -> str:
    """The heat maps, one per state, with the end once more where the record is long."""
    total = len(result.times)
    names = state_names(result)
    shown = min(len(names), _MOST_STATES)
    parts = [f"<p>{_how_to_read(result, truth)}</p>"]
    if shown < len(names):
        parts.append(f"<p>The first {shown} of {len(names)} states are drawn.</p>")
    for i in range(shown):
        frame = picture_bytes(result, i, None, _COLUMNS, _ROWS, truth)
        header, arrays = unpack(frame)
        note = "Every time is drawn." if header["complete"] else (
            f"{len(arrays['times']):,} of {total:,} densities are drawn, evenly spaced; of the mean, the extremes."
        )  # fmt: skip
        if any(line["role"] == "mean" and line["dots"] for line in header["lines"]):
            note += " Between them the angle may have gone either way round: the means are dots."
        if header["coverage"] is not None:
            note += f" The band holds the true state at {header['coverage']:.1%} of them."
        title = f"<h3>{escape(names[i])}</h3>" if len(names) > 1 else ""
        parts.append(title + framed("density", frame, f"posterior-{i}", note, 400))
        if total > _COLUMNS:
            times = np.asarray(result.times, dtype=float)
            last = picture_bytes(result, i, (times[-_DETAIL], times[-1]), _DETAIL + 1, _ROWS, truth, alone=True)
            parts.append(framed("density", last, f"detail-{i}", f"The last {_DETAIL} times, every one drawn.", 320))
    return "".join(parts)


def _how_to_read(result: Any, truth: np.ndarray | None) -> str:
    if result.has_densities:
        text = (
            f"Each column of the picture is the conditional density of the state, given {words.given(result)}: the "
            "stronger the blue, the more probable, each column relative to its own peak. The thick line is the mean; between the "
            "thin lines lies the state with probability 95%. Point at a place for its numbers; drag, pinch or use Ctrl and the "
            "wheel to look closer."
        )
    else:
        text = (
            "<strong>The densities of this run were not kept,</strong> only mean and variance: the shaded "
            "band is the 95% band of "
            "a Gaussian with that mean and variance. The true density may have another shape; to see it, "
            "filter again with "
            '<code>keep="densities"</code>. The thick line is the mean.'
        )
    if truth is not None:
        text += " The dashed orange line is the true state."
    if any(is_periodic(result, i) for i in range(len(state_names(result)))):
        text += " An angle is drawn on the circle from −π to π: what leaves at the top comes back at the bottom."
    return text


def special_moments(result: Any) -> list[tuple[int, str]]:
    """At most six times of note, in their order, each with a name."""
    last = len(result.times) - 1
    named: dict[int, str] = {0: words.first_moment(result)}
    if last:
        after = np.arange(1, last + 1)
        with np.errstate(divide="ignore"):
            spread = np.sum(np.log(np.asarray(result.variance, dtype=float)), axis=1)[1:]
        if result.record is not None and len(result.record.values) == last:
            # Only what an observation has left is of note; without one the density just spreads.
            spread = np.where(np.isnan(result.record.values).all(axis=1), np.nan, spread)
        increments = np.asarray(result.log_likelihood_increments, dtype=float)[1:]
        named.setdefault(last, "last")
        for values, name in (
            (increments, "largest surprise"),
            (-spread, "most uncertain"),
            (spread, "most certain"),
        ):
            if np.isfinite(values).any():
                k = int(after[np.nanargmin(values)])
                named[k] = f"{named[k]}, {name}" if k in named else name
        for part in (0.5, 0.25, 0.75):
            if len(named) < 6:
                named.setdefault(round(part * last), "halfway" if part == 0.5 else f"{part:.0%} of the way")
    return sorted(named.items())


def snapshots(result: Any, truth: np.ndarray | None) -> str:
    """The densities themselves at a few moments."""
    if not result.has_densities:
        return '<p>The densities of this run were not kept. Filter again with <code>keep="densities"</code> to see them.</p>'
    parts = [
        "<p>The vertical line is the mean"
        + (", the dashed orange line the true state" if truth is not None else "")
        + ". The largest surprise is the observation with the lowest log-likelihood; the most uncertain "
        "moment the one with the "
        "largest variance after an observation. Every panel has axes of its own.</p>"
    ]
    moments = special_moments(result)
    names = state_names(result)
    shots = [(k, f"{name[0].upper()}{name[1:]}, {words.moment(result, k)}") for k, name in moments]
    for i in range(min(len(names), _MOST_STATES)):
        frame = plots.snapshots(result, shots, i, None if truth is None else truth[:, i], names[i], is_periodic(result, i))
        title = f"<h3>{escape(names[i])}</h3>" if len(names) > 1 else ""
        parts.append(title + framed("chart", frame, f"snapshots-{i}"))
    return "".join(parts)


def likelihood(result: Any) -> str:
    """How well each observation was predicted."""
    increments = np.asarray(result.log_likelihood_increments, dtype=float)
    times = np.asarray(result.times, dtype=float)
    if len(times) < 2:
        return "<p>There was no observation.</p>"
    surprise = int(1 + np.nanargmin(increments[1:])) if np.isfinite(increments[1:]).any() else None
    text = (
        "How well each observation was predicted, given all that came before it: the higher, the better. "
        "A run of low values is "
        "where model and data disagree. "
    )
    kind = result.model.observation_kind if result.model is not None else None
    if kind == "samples":
        text += "It is the logarithm of the probability density of the reading."
    elif kind is not None:
        text += "It is the logarithm of the density ratio against pure observation noise (h = 0): above 0, there is signal."
    note = signed(f"The sum is {result.log_likelihood:,.4f}.")
    if surprise is not None:
        worst = signed(f"{increments[surprise]:.4g}")
        note += f" The largest surprise, {worst}, came at {words.moment(result, surprise)} (circled)."
    if len(times) - 1 > MOST_POINTS:
        note += " The record is long: of every stretch of observations, the best and the worst are drawn."
    drawn = plots.log_likelihood(
        times[1:], increments[1:], None if surprise is None else surprise - 1, getattr(result, "clock", None)
    )
    return f"<p>{text}</p>" + framed("chart", drawn, "log-likelihood-figure", note)


def health(result: Any) -> str:
    """The figures of health, drawn and explained."""
    series = {name: np.asarray(values, dtype=float) for name, values in result.health.items()}
    if not series:
        return "<p>This method reports no figures of health.</p>"
    varying = {name: v for name, v in series.items() if np.isfinite(v).any() and np.nanmax(v) > np.nanmin(v)}
    figure = ""
    if varying:
        bounds = {name: words.health_bound(result, name) for name in varying}
        note = "Dotted line: the bound beyond which to worry. On a logarithmic scale an exact zero lies a decade below the rest."
        drawn = plots.health(np.asarray(result.times, dtype=float), varying, bounds, getattr(result, "clock", None))
        figure = framed("chart", drawn, "health-figures", note)
    meaning = "".join(
        f"<dt>{escape(words.spoken(name))}</dt><dd>{escape(words.health_span(v))} {escape(words.health_words(result, name))}</dd>"
        for name, v in series.items()
    )
    return (
        "<p>A filter can be wrong without noticing; these figures say how far it was from that at each "
        "step.</p>"
        f'{figure}<dl class="words">{meaning}</dl>'
    )


def method(result: Any) -> str:
    """The method, why it was taken, and every condition that was decided."""
    parts = [f"<p><strong>{escape(result.method)}.</strong> {escape(str(result.why))}</p>"]
    conditions = getattr(result, "conditions", None) or {}
    used = [name for name in conditions if name == result.method]
    for name in used:
        parts.append(f"<h3>What {escape(name)} needs, and whether it holds here</h3>" + _conditions(conditions[name]))
    others = [name for name in conditions if name not in used]
    if others:
        parts.append("<h3>The other methods</h3>")
    for name in others:
        held = [c.holds for c in conditions[name]]
        said = "does not hold" if False in held else "undecided" if None in held else "holds"
        mark = {"does not hold": "fails", "undecided": "open", "holds": "holds"}[said]
        parts.append(
            f"<details><summary>{escape(name)}: <span "
            f'class="{mark}">{said}</span></summary>{_conditions(conditions[name])}</details>'
        )
    return "".join(parts)


def _conditions(conditions: Any) -> str:
    marks = {True: ("holds", "✓ holds"), False: ("fails", "✗ fails"), None: ("open", "? undecided")}
    rows = "".join(
        f'<tr><td class="{marks[c.holds][0]}">{marks[c.holds][1]}</td><td>{escape(str(c.statement))}</td>'
        f"<td>{escape(str(c.evidence))}</td><td>{escape(str(c.source))}</td></tr>"
        for c in conditions
    )
    return (
        '<table class="conditions"><colgroup><col class="mark"><col><col><col '
        'class="source"></colgroup><thead><tr><th></th>'
        f"<th>Condition</th><th>What decided it</th><th>Source</th></tr></thead><tbody>{rows}</tbody></table>"
    )


def model(result: Any) -> str:
    """The equations, the parameters and the model file."""
    model = result.model
    if model is None:
        return "<p>The result does not hold the model that it came from.</p>"
    parts = [equations(model)]
    if model.parameters:
        rows = "".join(
            f'<tr><td>{escape(name)}</td><td class="number">{signed(f"{float(value):.10g}")}</td></tr>'
            for name, value in model.parameters.items()
        )
        parts.append(
            f"<h3>Parameters</h3><table "
            f'class="narrow"><thead><tr><th>Name</th><th>Value</th></tr></thead><tbody>{rows}</tbody></table>'
        )
    parts.append(f"<details><summary>The model file</summary><pre>{escape(model.text)}</pre></details>")
    return "".join(parts)
