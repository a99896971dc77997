"""The dialect of a table of text: its separator, decimal comma, comments, words for missing values, and a column of row numbers.

Lines are translated to the one form that is read: commas between cells, decimal points, and empty cells for missing values.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from typing import NamedTuple

from zakai.records.numbers import NUMBER

SEPARATORS = {",": "a comma", ";": "a semicolon", "\t": "a tab"}
_OTHERS = {"|": "a bar", " ": "a space", ":": "a colon"}
_MISSING = re.compile(r'(^|,)[ \t]*"?(?:NA|N/A|n/a|na|null|NULL|None|<NA>|#N/A)"?[ \t]*(?=,|$)', re.MULTILINE)
_DECIMAL_COMMA = re.compile(r"[+-]?(\d+,\d*|,\d+)(e[+-]?\d+)?", re.IGNORECASE)
TIMES = ("time", "t", "date", "datetime", "timestamp")  # names of the first column: `t` is the time in formulas too
_UNIT = re.compile(r"\s*(\[[^]]*\]|\([^)]*\))\s*$")  # behind a name, as in "Time [s]"
_ROW_NUMBERS = ("", "index", "unnamed: 0")  # names of a column of row numbers before the time


class Dialect(NamedTuple):
    """The separator, whether a column of row numbers comes first, the header as it is read, and its line (from 1)."""

    separator: str
    numbered: bool
    header: str
    line: int

    def translated(self, lines: list[str]) -> list[str]:
        """Return lines of the table in the form that is read; comments become blank lines, so that their number stays."""
        if self.separator == "," and not self.numbered:
            text = "\n".join(lines)
            if "#" not in text and not _MISSING.search(text):
                return lines
        return [self._translated(line) for line in lines]

    def _translated(self, line: str) -> str:
        if line.lstrip().startswith("#"):
            return ""
        if self.separator != ",":
            line = ",".join(_with_point(cell) for cell in _split(line, self.separator)) if line.strip() else ""
        if self.numbered:
            line = line.partition(",")[2]
        for _ in range(2):  # neighbours share their comma
            line = _MISSING.sub(r"\1", line)
        return line


def dialect_of(lines: Sequence[str]) -> Dialect | None:
    """Return the dialect of a table by its first lines, None where they have no header.

    The header is the first line that is no comment and not blank; or the last comment before it, if that begins with `time` and
    the line with a number.
    """
    comment = 0
    for place, line in enumerate(lines):
        if not line.strip():
            continue
        if line.lstrip().startswith("#"):
            comment = place + 1
            continue
        if comment and NUMBER.fullmatch(_split(line, _separator(line))[0].replace(",", ".")):
            header = lines[comment - 1].lstrip().lstrip("#").strip()
            if _is_time(_split(header, _separator(header))[0]):
                return _of_header(header, comment)
        return _of_header(line, place + 1)
    return None


def other_separator(name: str) -> str:
    """Return which separator a header seems to have, whose first name is this; nothing where there is none."""
    for mark, words in _OTHERS.items():
        if mark in name.strip() and name.strip().lower().startswith("time"):
            return f" (its cells seem to be separated by {words}; separate them by {', '.join(SEPARATORS.values())})"
    return ""


def _is_time(cell: str) -> bool:
    """Return whether a cell of a header names the time, with or without a unit."""
    return _UNIT.sub("", cell.strip().strip('"')).lower() in TIMES


def _of_header(header: str, line: int) -> Dialect:
    separator = _separator(header)
    cells = [cell.strip() for cell in _split(header, separator)] if separator != "," else []
    text = ",".join(_quoted(cell) for cell in cells) if cells else header
    first, _, rest = text.partition(",")
    numbered = first.strip().strip('"').lower() in _ROW_NUMBERS and _is_time(rest.partition(",")[0])
    text = rest if numbered else text
    first, comma, rest = text.partition(",")
    text = f"time{comma}{rest}" if _is_time(first) else text
    return Dialect(separator, numbered, text, line)


def _separator(line: str) -> str:
    """Return the separator of a line: a semicolon or a tab where it has some and no comma outside of numbers, else a comma."""
    for mark in ("\t", ";"):
        if mark in line and all(_DECIMAL_COMMA.fullmatch(cell.strip()) for cell in line.split(mark) if "," in cell):
            return mark
    return ","


def _split(line: str, separator: str) -> list[str]:
    if '"' not in line:
        return line.split(separator)
    try:
        return next(csv.reader([line], delimiter=separator), [""]) or [""]
    except csv.Error:
        return line.split(separator)


def _with_point(cell: str) -> str:
    """Return a cell with a decimal point for a decimal comma."""
    cell = cell.strip()
    return cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else _quoted(cell)


def _quoted(cell: str) -> str:
    return '"' + cell.replace('"', '""') + '"' if "," in cell or '"' in cell else cell
