"""Frames of panels with lines, dots, bars and bands, which `static/chart.js` draws."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.records.dates import Clock
from zakai.report.frames import pack


def clock_header(clock: Clock | None) -> dict[str, float] | None:
    """Return the date of t = 0 in milliseconds since 1970 and the unit of t in milliseconds."""
    if clock is None:
        return None
    origin, unit = float(clock.days(0.0)), float(clock.days(1.0) - clock.days(0.0))
    return {"origin": origin * 86400e3, "unit": unit * 86400e3}


def axis(title: str = "", low: float | None = None, high: float | None = None, **more: Any) -> dict[str, Any]:
    """Return an axis: its title, its range if it is not that of the series, and `log`, `zero` or `angle`."""
    return {"title": title, "range": None if low is None or high is None else [float(low), float(high)], **more}


def time_axis(clock: Clock | None, title: str = "time") -> dict[str, Any]:
    """Return the axis of times: of dates where there is a clock."""
    return axis(title, clock=clock_header(clock))


class Panel:
    """One panel of a chart."""

    def __init__(self, chart: Chart, header: dict[str, Any]):
        self._chart, self._header = chart, header

    def add(self, kind: str, x: Any = None, y: Any = None, **more: Any) -> Panel:
        """Add a series: its kind, its arrays, and its style as `static/chart.js` describes them."""
        one: dict[str, Any] = {"kind": kind}
        arrays = {"x": x, "y": y, **{key: more.pop(key) for key in ("spread", "low", "high") if np.ndim(more.get(key, 0.0)) == 1}}
        for key, values in arrays.items():
            if values is not None:
                name = f"a{len(self._chart._arrays)}"
                self._chart._arrays[name] = np.asarray(values, dtype=float)
                one[key] = name
        self._header["series"].append(one | {key: float(v) if isinstance(v, np.floating) else v for key, v in more.items()})
        return self


class Chart:
    """Panels, `across` of them in a row on a wide page.

    Example:
        chart = Chart()
        panel = chart.panel("residuals", axis("probability", 0, 1), axis("density"))
        panel.add("bars", [0.25, 0.75], [0.9, 1.1], width=0.5)
        chart.frame()
    """

    def __init__(self, across: int = 1):
        self._across = across
        self._arrays: dict[str, np.ndarray] = {}
        self._panels: list[dict[str, Any]] = []

    def panel(self, title: str, x: dict[str, Any], y: dict[str, Any], **more: Any) -> Panel:
        """Add a panel; `more` are `height`, `wide` and `link`."""
        self._panels.append({"title": title, "x": x, "y": y, "series": [], **more})
        return Panel(self, self._panels[-1])

    def frame(self) -> bytes:
        """Return the frame."""
        return pack({"kind": "chart", "across": self._across, "panels": self._panels}, self._arrays)
