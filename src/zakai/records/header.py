"""The header of a CSV file: the names of its columns, and what is wrong with them."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

from zakai.errors import InputError
from zakai.records.writing import default_names

LONGEST_LINE = 1 << 20  # characters: a thousand numbers with a thousand blanks each


def header_of(path: Path) -> list[str]:
    """The names of the columns of a CSV file, or nothing where it cannot be read, which `read_table` reports."""
    try:
        with path.open(encoding="utf-8-sig", errors="surrogateescape") if path.is_file() else nullcontext() as file:
            return [] if file is None else header_names(file.readline(LONGEST_LINE).rstrip("\r\n"))
    except (OSError, ValueError):
        return []


def header_names(line: str) -> list[str]:
    """The names of the columns that a header gives."""
    return [name.strip() for name in cells_of(line)]


def columns_with_inputs(names: Sequence[str], m: int, inputs: Sequence[str]) -> tuple[list[int], list[int]]:
    """Return the places of the m observations and of the inputs in a header, the first column of which is the time.

    Raises:
        InputError: an input has no column or two, or the other columns are not the observations.
    """
    missing = [name for name in inputs if name not in names[1:]]
    if missing:
        raise InputError(f"no column for the input {', '.join(missing)}; give a column for each input")
    observed = [i for i, name in enumerate(names) if i > 0 and name not in inputs]
    fault = columns_fault([names[0], *(names[i] for i in observed)], m, "observations")
    if fault is None and len(names) != 1 + m + len(inputs):
        fault = "an input has two columns; give one for each"
    if fault is not None:
        raise InputError(fault)
    return observed, [names.index(name) for name in inputs]


def columns_fault(names: Sequence[str], m: int, what: str, expected: Sequence[str] | None = None) -> str | None:
    """What is wrong with the columns of a header, of which the first is the time, or None."""
    if len(names) != m + 1:
        return f"{len(names)} columns; the model needs {m + 1}: time, and one for each of its {what}"
    if expected is not None:
        wrong = next((name for name, wanted in zip(names[1:], expected) if name != wanted), None)
        return None if wrong is None else f"a column is {quoted(wrong)}; expected time, {', '.join(expected)}"
    # Columns are taken by their position; names that are all our own say which position was meant.
    ours = default_names(m)
    if sorted(names[1:]) != sorted(ours):
        return None
    for place, (name, wanted) in enumerate(zip(names[1:], ours), start=2):
        if name != wanted:
            return (
                f"column {place} is {name}, where {wanted} is read: columns are taken by their position; put them in the order "
                f"time, {', '.join(ours) if m <= 4 else f'{ours[0]} to {ours[-1]}'}, or give them other names"
            )
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
