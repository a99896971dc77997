"""Colours and type of the page and of the static pictures: dark on light, readable in grey."""

from __future__ import annotations

from importlib.resources import files

# Lightness falls evenly: the order survives colour blindness and a grey printer, and never hides the lines.
DENSITY_COLOURS = ("#ffffff", "#eaf1f8", "#cfe0f0", "#a9cae4", "#7aaed4", "#4b8fc2", "#2f75ad")
INK = "#1d2430"
FAINT = "#6b7480"
RULE = "#d9dde2"
BAND_COLOUR = "#3b5f86"
TRUTH_COLOUR = "#d55e00"
SERIES_COLOUR = "#2f75ad"


def css() -> str:
    """The style sheet of the page."""
    return files("zakai.report").joinpath("page.css").read_text(encoding="utf-8")
