"""The page and the pictures of a study, in its folder."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

from zakai.records.writing import atomic_write
from zakai.report import _style, study_pictures, study_plots
from zakai.report.pictures import save_figure
from zakai.report.scripts import framed, policy, script

MOST_POINTS = 12  # of a grid of parameters that are drawn
_PICTURES = (
    ("error-over-time", "squared-error", "Error over time", study_pictures.error_figure, study_plots.error,
     "The median over the runs of the error; nine in ten runs are below the thin line. Failed runs are left out."),
    ("nees", "nees", "Is the filter as sure as it may be?", study_pictures.nees_figure, study_plots.nees,
     "The normalised estimation error squared, averaged over the runs. A filter that knows its error is near 1 and, if its "
     "posterior is Gaussian, within the grey bounds at 95% of the times; above, it is too sure of itself; below, not enough."),
    ("work-precision", "squared-error", "Cost against accuracy", study_pictures.work_figure, study_plots.work,
     "Further left is faster, further down is better. The time is that of one observation when a batch of records is filtered "
     "side by side. A dotted line is the time of the reference, whose distance from itself is nothing."),
)  # fmt: skip
_COLUMNS = ("method", "squared error", "median", "worst", "failures", "warned", "distance", "NEES / n", "CRPS", "log score")


def write_study(outcome: Any) -> list[Path]:
    """Write `study.html` and a PNG of every picture into the folder of a study.

    `outcome` is what `run_study` gave. Gives the files. Raises InputError when the extra `plots` is not installed.
    """
    written = []
    shown = range(min(MOST_POINTS, len(outcome.points)))
    for point in shown:
        for name, metric, _, figure, _, _ in _PICTURES:
            if metric in outcome.study.metrics:
                ending = f"-{point}" if len(outcome.points) > 1 else ""
                written.append(outcome.folder / f"{name}{ending}.png")
                save_figure(figure(outcome, point), written[-1])
    written.append(outcome.folder / "study.html")
    text = page(outcome)
    with atomic_write(written[-1]) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return written


def page(outcome: Any) -> str:
    """The text of the page."""
    name = escape(outcome.study.name)
    shown = range(min(MOST_POINTS, len(outcome.points)))
    body = "".join(_section(outcome, point) for point in shown)
    omitted = len(outcome.points) - len(shown)
    if omitted:
        body += f"<p>{omitted} more points are in summary.json and study.nc.</p>"
    reference = outcome.summary["reference"]
    said = f"{outcome.summary['runs']:,} runs of {len(outcome.study.methods)} methods on the same records"
    said += f"; distances are from {escape(reference)}." if reference else "."
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f"{policy()}"
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{name}: study</title><style>{_style.css()}</style></head>\n"
        f'<body><main><header><p class="eyebrow">Study</p><h1>{name}</h1><p class="verdict">{said}</p>'
        "<noscript><p>The pictures on this page need JavaScript; the tables do not.</p></noscript></header>"
        f"{body}</main>{script()}</body></html>\n"
    )


def _section(outcome: Any, point: int) -> str:
    figures = outcome.summary["points"][point]
    title = f"{escape(figures['point'])}: {figures['observations']:,} observations a run"
    parts = [f"<h2>{title}</h2>", _table(figures)]
    for name, metric, heading, _, draw, caption in _PICTURES:
        if metric in outcome.study.metrics:
            parts.append(f"<h3>{heading}</h3>{framed('chart', draw(outcome, point), f'{name}-{point}', caption)}")
    return f"<section>{''.join(parts)}</section>"


def _table(figures: dict[str, Any]) -> str:
    rows = []
    for label, own in figures["methods"].items():
        error = own.get("squared_error", {})
        cells = [error.get("mean"), error.get("median"), error.get("worst"), own["failures"], own["warned"]]
        cells += [own.get(name, {}).get("mean") for name in ("distance", "nees", "crps", "log_score")]
        numbers = "".join(f'<td class="number">{"–" if cell is None else f"{cell:.4g}"}</td>' for cell in cells)
        rows.append(f"<tr><td>{escape(label)}</td>{numbers}</tr>")
        if own["said"]:
            rows.append(f'<tr><td></td><td colspan="{len(_COLUMNS) - 1}">{escape(own["said"])}</td></tr>')
    head = "".join(f"<th>{column}</th>" for column in _COLUMNS)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
