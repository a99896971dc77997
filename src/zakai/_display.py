"""What objects show of themselves: names in short, numbers in few digits, tables in a notebook."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

MOST_NAMES = 6
MOST_ROWS = 12


def short_names(names: Sequence[str]) -> str:
    """Return names in a list, of many the first and the last."""
    listed = list(names)
    if len(listed) > MOST_NAMES:
        listed = [*listed[: MOST_NAMES - 2], "...", listed[-1]]
    return ", ".join(listed)


def number(value: float) -> str:
    """Return a number in six digits."""
    return f"{float(value):.6g}"


def rough(value: float) -> str:
    """Return a number in one or two digits, as in 0.03, 5,600 or 3e+06."""
    if not 0.0 < abs(value) < 1e5:
        return f"{value:.0e}"
    return f"{float(f'{value:.2g}'):,.12g}"


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, in the plural where needed."""
    return f"{count:,} {noun}" + ("" if count == 1 else "s")


def html_table(
    title: str, header: Sequence[str], rows: Iterable[Sequence[object]], notes: Sequence[str] = (), total: int = 0
) -> str:
    """Return a table for a notebook: a title, columns, rows (of `total` or of many the first ones), and notes below."""
    listed = list(rows)
    left = max(len(listed), total) - min(len(listed), MOST_ROWS)
    omitted = [f"... {left:,} more"] if left else []
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    body = "".join("<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>" for row in listed[:MOST_ROWS])
    below = "".join(f"<div>{escape(note)}</div>" for note in [*omitted, *notes])
    top = f"<thead><tr>{head}</tr></thead>" if any(header) else ""
    return f"<div><b>{escape(title)}</b><table>{top}<tbody>{body}</tbody></table>{below}</div>"
