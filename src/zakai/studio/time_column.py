"""A record whose time is not the first column, or has another name: a copy of its file in the form that is read."""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Iterator
from pathlib import Path

from zakai.errors import InputError
from zakai.records.dialect import Dialect, dialect_of
from zakai.records.header import cells_of, header_names


def with_time(path: Path, column: str, name: str) -> Path:
    """Return a copy of a CSV file in which `column` comes first and is named time; its rows keep their numbers.

    Args:
        path: the file; the copy is beside it.
        column: a name in its header.
        name: what errors call the file.

    Raises:
        InputError: the file has no such column.
    """
    found = path.with_name(hashlib.sha256(f"{path.stem} {column}".encode("utf-8", "replace")).hexdigest()[:32] + ".csv")
    if not found.is_file():
        lines = path.read_text(encoding="utf-8-sig", errors="surrogateescape").split("\n")
        dialect = dialect_of(lines)
        names = [] if dialect is None else header_names(dialect.header)
        if dialect is None or names.count(column) != 1:
            raise InputError(f"{name}: has no column {column[:40]!r} for the time; choose another one")
        part = found.with_suffix(".part")
        with part.open("w", encoding="utf-8", errors="surrogateescape", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            file.write("\n" * (dialect.line - 1))
            writer.writerow(["time", *(other for other in names if other != column)])
            writer.writerows(_rows(lines, dialect, names.index(column)))
        part.replace(found)
    return found


def _rows(lines: list[str], dialect: Dialect, place: int) -> Iterator[list[str]]:
    for line in dialect.translated(lines[dialect.line :]):
        cells = cells_of(line) if line.strip() else []
        if len(cells) > place:
            cells.insert(0, cells.pop(place))
        yield cells
