"""The pictures of a study, interactive: the same as the static ones, with hovering."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.report.charts import Chart, axis
from zakai.report.comparisons import MOST, Curve, error_curves, log_range, nees_curves, spans_decades, works
from zakai.report.study_pictures import FEW

DASHES: tuple[list[int], ...] = ([], [7, 3], [2, 2], [8, 2, 2, 2], [12, 3])


def error(outcome: Any, point: int) -> bytes:
    """Return the error of every method over time: the median over the runs, and thin what most stay below."""
    return _curves(error_curves(outcome.points[point]), "error |x − m| (unit of the state)").frame()


def nees(outcome: Any, point: int) -> bytes:
    """Return NEES/n of every method over time, with the bounds of a right filter."""
    curves, (low, high) = nees_curves(outcome.points[point])
    return _curves(curves, "NEES / n (no unit)", (low, high)).frame()


def work(outcome: Any, point: int) -> bytes:
    """Return cost against accuracy."""
    found = works(outcome.summary["points"][point], outcome.timing["points"][point])
    both = any(np.isfinite(one.distance) for one in found)
    chart = Chart(across=2 if both else 1)
    across = axis("time per observation (µs)", *log_range([1e6 * one.seconds for one in found]), log=True)
    panels = [("root mean squared error", [one.error for one in found])]
    if both:
        panels.append(("distance from the reference", [one.distance for one in found]))
    for number, (what, values) in enumerate(panels):
        panel = chart.panel("", across, axis(f"{what} (unit of the state)", *log_range(values), log=True), height=340, label=what)
        for place, (one, value) in enumerate(zip(found, values, strict=True)):
            label = one.label + (" (reference)" if one.label == outcome.summary["reference"] else "")
            if np.isfinite(value):
                more = {"spread": np.array([one.spread])} if number == 0 else {}
                point_at = (np.array([1e6 * one.seconds]), np.array([value]))
                panel.add("dots", *point_at, colour=place, shape=place % 7, size=5.5, text=label, **more)
            elif number:
                panel.add("mark", at=1e6 * one.seconds, colour="faint", dash=[2, 3])
    return chart.frame()


def _curves(curves: list[Curve], what: str, bounds: tuple[float, float] | None = None) -> Chart:
    chart = Chart()
    vertical = axis(what, zero=True)
    if spans_decades(curves):
        vertical = axis(what, *log_range(np.concatenate([curve.middle for curve in curves]).tolist(), 1.2), log=True)
    panel = chart.panel("", axis("time (unit of the model)"), vertical, height=330, label=what)
    if bounds is not None:
        panel.add("rows", low=float(bounds[0]), high=float(bounds[1]), colour="faint").add("row", at=1.0, colour="faint")
    for number, curve in enumerate(curves):
        look = {"colour": number, "dash": DASHES[number % len(DASHES)]}
        panel.add("line", curve.times, curve.middle, width=1.8, text=curve.label, **look)
        if curve.high is not None and len(curves) <= FEW:
            panel.add("line", curve.times, curve.high, width=0.8, text=f"{curve.label}: {MOST:.0%} below", **look)
    return chart
