"""The header of a CSV file: the names of its columns, and what is wrong with them."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

from zakai.records.dialect import dialect_of

LONGEST_LINE = 1 << 20  # characters: a thousand numbers with a thousand blanks each


def header_of(path: Path) -> list[str]:
    """The names of the columns of a CSV file, or nothing where it cannot be read, which `read_table` reports."""
    try:
        with path.open(encoding="utf-8-sig", errors="surrogateescape") if path.is_file() else nullcontext() as file:
            lines = [] if file is None else file.read(LONGEST_LINE).split("\n")
        dialect = dialect_of(lines)
        return [] if dialect is None else header_names(dialect.header)
    except (OSError, ValueError):
        return []


def header_names(line: str) -> list[str]:
    """The names of the columns that a header gives."""
    return [name.strip() for name in cells_of(line)]


def columns_fault(names: Sequence[str], m: int, what: str, expected: Sequence[str] | None = None) -> str | None:
    """What is wrong with the columns of a header, of which the first is the time, or None."""
    if len(names) != m + 1:
        return f"{len(names)} columns; the model needs {m + 1}: time, and one for each of its {what}"
    if expected is not None:
        wrong = next((name for name, wanted in zip(names[1:], expected) if name != wanted), None)
        return None if wrong is None else f"a column is {quoted(wrong)}; expected time, {', '.join(expected)}"
    return None


def cells_of(line: str) -> list[str]:
    """Return the cells of one line; one that `csv` refuses is split at its commas."""
    try:
        return next(csv.reader([line]), [""]) or [""]
    except csv.Error:
        return line.split(",")


def quoted(text: str) -> str:
    """Text from the file as it may appear in an error: one short line of printable characters."""
    return ascii(text if len(text) <= 40 else text[:37] + "...")
