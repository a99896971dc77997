"""Matplotlib, when it is needed and without pyplot's global state."""

from __future__ import annotations

from typing import Any

from zakai.errors import InputError

INK, OURS, TRUTH, OTHER, PALE = "#1d2430", "#2f75ad", "#d55e00", "#009e73", "#cfe0f0"
SERIES = (OURS, TRUTH, OTHER, "#cc79a7", INK, "#e69f00", "#6b7480")


def new_figure(width: float, height: float) -> Any:
    """An empty figure in inches; InputError where matplotlib is not installed."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InputError('matplotlib is not installed; pictures need it: pip install "zakai[plots]"') from error
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def plain(panel: Any) -> Any:
    """A panel without a frame above and to the right, and with a faint grid below everything."""
    panel.spines[["top", "right"]].set_visible(False)
    panel.grid(color="#e4e7eb", linewidth=0.6)
    panel.set_axisbelow(True)
    return panel
