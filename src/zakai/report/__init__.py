"""Pictures and the HTML report of a result; matplotlib is imported when it is used."""

from __future__ import annotations

from typing import Any

__all__ = ["diagnostics_figure", "notebook_picture", "posterior_figure", "save_figure", "write_report"]


def __getattr__(name: str) -> Any:
    if name == "write_report":
        from zakai.report.html import write_report

        return write_report
    if name == "notebook_picture":
        from zakai.report.scripts import notebook_picture

        return notebook_picture
    if name in __all__:
        from zakai.report import pictures

        return getattr(pictures, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
