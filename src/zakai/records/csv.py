"""Records from CSV files: a fast road for good files, and a careful one that names the first bad row."""

from __future__ import annotations

import csv
import os
import re
from array import array
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NoReturn, TextIO

import numpy as np

from zakai.errors import InputError
from zakai.records.record import Record, early, first_fault
from zakai.records.writing import shown

_NUMBER = re.compile(r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf|infinity)", re.ASCII | re.IGNORECASE)


def read_record(path: str | os.PathLike[str], model: Any) -> Record:
    """Read the observations of `model` from a CSV file.

    The first line is a header: `time`, then one column for each of the model's m observations, of any names.
    Every other line is one time and its m readings, in what the model's `observation_kind` says. Times
    increase strictly, need not be regular, and begin after the model's `start` (samples: at or after). An
    empty cell or `nan` is "not observed". The text is UTF-8; a byte-order mark, Windows line ends and blank
    lines are accepted.

    Arguments:
        path: the file.
        model: a `zakai.Model`; its `m`, `start` and `observation_kind` say what the file must hold.

    Raises:
        InputError: the file, or its first bad row by its line number (the header is line 1), cannot be used.

    Example:
        >>> import zakai, tempfile, pathlib
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "record.csv"
        >>> _ = path.write_text("time,y\\n0.1,0.5\\n0.2,\\n0.4,-0.1\\n")
        >>> zakai.read_record(path, zakai.load_model("gallery:cubic-sensor"))
        Record(3 rows x 1 increments, times 0.1 to 0.4)
    """
    path = Path(path)
    table = read_table(path, model.m, "observations")
    record = Record(table[:, 0], table[:, 1:], model.observation_kind)
    fault = early(record.times[0], record.kind, model.start)
    if fault is not None:
        raise InputError(f"{shown(path)}: row {_first_row(path)}: {fault}")
    return record


def read_table(path: Path, columns: int, what: str, names: Sequence[str] | None = None) -> np.ndarray:
    """The times and the `columns` numbers of every row of a CSV file, (K, 1 + columns).

    `what` is what a column holds, in the plural; with `names` the columns must have just these. Raises
    InputError as `read_record` does.
    """
    try:
        # A pipe or a device could be endless, and cannot be read a second time to find the row that is wrong.
        if path.exists() and not path.is_file():
            kind = "a folder" if path.is_dir() else "not a regular file"
            raise InputError(f"{shown(path)}: is {kind}; give a CSV file")
        # Bytes that are not UTF-8 become lone surrogates, which no number has; so their row is found.
        with path.open(encoding="utf-8-sig", errors="surrogateescape", newline=None) as file:
            header = _header(path, file, columns, what, names)
            table = _fast(file, len(header))
        if table is None or first_fault(table[:, 0], table[:, 1:]) is not None:
            with path.open(encoding="utf-8-sig", errors="surrogateescape", newline=None) as file:
                table = _careful(path, file, header)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{shown(path)}: cannot be read: {reason}; give a CSV file") from None
    return table


def _header(path: Path, file: TextIO, m: int, what: str, expected: Sequence[str] | None) -> list[str]:
    line = file.readline()
    if not line:
        raise InputError(f"{shown(path)}: is empty; expected a header of time and {m} names, then rows")
    if (fault := _not_text(line)) is not None:
        raise InputError(f"{shown(path)}: row 1: {fault}")
    names = [name.strip() for name in _cells(line)]
    if names[0] != "time":
        hint = " (is the header missing?)" if _NUMBER.fullmatch(names[0]) else ""
        fault = f"the first column is {_quoted(names[0])}; the header must begin with time{hint}"
        raise InputError(f"{shown(path)}: row 1: {fault}")
    if len(names) != m + 1:
        fault = f"{len(names)} columns; the model needs time and {m} {what}, {m + 1} columns in all"
        raise InputError(f"{shown(path)}: row 1: {fault}")
    for name, wanted in zip(names[1:], expected or names[1:]):
        if name != wanted:
            raise InputError(f"{shown(path)}: row 1: a column is {_quoted(name)}; expected time, {', '.join(expected or ())}")
    return names


def _fast(file: TextIO, columns: int) -> np.ndarray | None:
    """The rows after the header as a table (K, columns); None if they are not all plain numbers and gaps."""

    def filled() -> Iterator[str]:
        for line in file:
            if "\0" in line:
                raise ValueError("NUL")
            line = line.rstrip("\n")
            while ",," in line:
                line = line.replace(",,", ",nan,")
            yield line + "nan" if line.endswith(",") else line

    lines = filled()
    try:
        first = next(lines)
        while not first.strip():
            first = next(lines)
        table = np.loadtxt(chain([first], lines), delimiter=",", comments=None, ndmin=2)
    except (StopIteration, ValueError):
        return None
    return table if table.shape[1] == columns else None


def _careful(path: Path, file: TextIO, names: list[str]) -> np.ndarray:
    """The same table, cell by cell; raises for the first row that is wrong."""
    table, lines = array("d"), array("q")

    def so_far() -> np.ndarray:
        rows = np.array(table, dtype=np.float64).reshape(len(lines), len(names))
        fault = first_fault(rows[:, 0], rows[:, 1:]) if len(rows) else None
        if fault is not None:
            raise InputError(f"{shown(path)}: row {lines[fault[0]]}: {fault[1]}")
        return rows

    def refuse(number: int, what: str) -> NoReturn:
        so_far()  # an earlier row may break a rule about its numbers; the first bad row is the one to name
        raise InputError(f"{shown(path)}: row {number}: {what}")

    for number, line in enumerate(file, start=1):
        if number == 1 or not line.strip():
            continue
        if (fault := _not_text(line)) is not None:
            refuse(number, fault)
        cells = [cell.strip() for cell in _cells(line)]
        if len(cells) != len(names):
            cut = "" if line.endswith("\n") else " (the file ends in this row; was it cut off?)"
            refuse(number, f"{len(cells)} columns; expected {len(names)}: {_quoted(','.join(names))}{cut}")
        for name, cell in zip(names, cells):
            if cell and not _NUMBER.fullmatch(cell):
                what = f"{_quoted(cell)} in column {_quoted(name)} is not a number"
                refuse(number, f"{what}; leave the cell empty if nothing was observed")
        table.extend(float(cell) if cell else np.nan for cell in cells)
        lines.append(number)
    if not lines:
        raise InputError(f"{shown(path)}: has a header but no row; a record needs at least one observation")
    return so_far()


def _first_row(path: Path) -> int:
    """The line number of the first row after the header."""
    with path.open(encoding="utf-8-sig", errors="surrogateescape", newline=None) as file:
        return next(number for number, line in enumerate(file, start=1) if number > 1 and line.strip())


def _cells(line: str) -> list[str]:
    """The cells of one line; one that `csv` refuses is split at its commas."""
    try:
        return next(csv.reader([line.rstrip("\n")]), [""]) or [""]
    except csv.Error:
        return line.rstrip("\n").split(",")


def _not_text(line: str) -> str | None:
    if any("\ud800" <= character <= "\udfff" for character in line):
        return "bytes that are not UTF-8 text; save the file as UTF-8"
    if "\0" in line:
        return "a NUL byte; is this a CSV file?"
    return None


def _quoted(text: str) -> str:
    """Text from the file as it may appear in an error: one short line of printable characters."""
    return ascii(text if len(text) <= 40 else text[:37] + "...")
