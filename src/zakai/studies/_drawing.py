"""Matplotlib, when it is needed and without pyplot's global state."""

from __future__ import annotations

from typing import Any

from zakai.errors import InputError


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
