"""The tables of a model file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zakai.errors import InputError
from zakai.models._entries import array, items, kind_of, known_keys
from zakai.models._errors import did_you_mean, echo, listing, named
from zakai.models._text import read_text
from zakai.models.table import KINDS, Table

MOST_NUMBERS = 40_000  # of all tables of a model together, which keeps a model file with them below 1 MiB
LARGEST = 1e150
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)


def read_tables(keys: Any, folder: Path | None) -> dict[str, Table]:
    """Return the tables of the table `[tables]`.

    Args:
        keys: by name a table of keys, a Table, or arrays (x, values) or (x, y, values).
        folder: where files are looked for; None where there is none, so that none is read.

    Raises:
        InputError: a table that cannot be used, by its name, and in a file by its row.
    """
    if not isinstance(keys, Mapping):
        raise InputError(f"expected a table of tables, got {kind_of(keys)}")
    tables: dict[str, Table] = {}
    for name, given in keys.items():
        with named(str(name)):
            tables[str(name)] = _read_table(str(name), given, folder)
        if sum(table.values.size + sum(map(len, table.axes)) for table in tables.values()) > MOST_NUMBERS:
            raise InputError(f"{name}: the tables hold more than {MOST_NUMBERS:,} numbers together; give coarser tables")
    return tables


def _read_table(name: str, given: Any, folder: Path | None) -> Table:
    if isinstance(given, Table):
        given = given.keys()
    if isinstance(given, tuple | list) and len(given) in (2, 3):
        given = dict(zip(("x", "values") if len(given) == 2 else ("x", "y", "values"), given))
    if not isinstance(given, Mapping):
        raise InputError(f'expected {{ file = "NAME.csv", kind = "linear" }} or a pair of arrays, got {kind_of(given)}')
    known_keys(given, ("file", "kind", "periodic", "x", "y", "values"))
    kind = given.get("kind", "linear")
    if not isinstance(kind, str) or kind not in KINDS:
        hint = did_you_mean(kind, KINDS) if isinstance(kind, str) else ""
        raise InputError(f"kind: expected one of {listing(KINDS)}, got {kind_of(kind)}{hint}")
    periodic = given.get("periodic", False)
    if not isinstance(periodic, bool):
        raise InputError(f"periodic: expected true or false, got {kind_of(periodic)}")
    if "file" in given:
        if len(given.keys() & {"x", "y", "values"}):
            raise InputError("file: give a file, or x and values, and not both")
        axes, values = _from_file(given["file"], folder)
    else:
        axes, values = _from_arrays(given)
    for argument, axis in zip(("x", "y"), axes):
        if len(axis) < KINDS[kind] + 1:
            raise InputError(f"{argument}: a {kind} table needs at least {KINDS[kind] + 1} values of it, got {len(axis)}")
        if not (np.diff(axis) > 0).all():
            raise InputError(f"{argument}: its values must increase strictly")
    if max(np.abs(part).max() for part in (*axes, values)) > LARGEST:
        raise InputError(f"its numbers must be at most {LARGEST:g} in size")
    if periodic and (len(axes) > 1 or values[0] != values[-1]):
        raise InputError("periodic: a periodic table has one argument, and its last value is equal to its first")
    return Table(name, axes, values, kind, periodic)


def _from_arrays(given: Mapping[str, Any]) -> tuple[tuple[NDArray[Any], ...], NDArray[Any]]:
    axes = []
    for argument in ("x", "y") if "y" in given else ("x",):
        with named(argument):
            entries = items(given.get(argument), None, "a list of increasing numbers")
            if not 2 <= len(entries) <= MOST_NUMBERS:
                raise InputError(f"expected 2 to {MOST_NUMBERS:,} numbers, got {len(entries)}")
            axes.append(array(entries, (len(entries),), "a list of increasing numbers"))
    shape = tuple(map(len, axes))
    if np.prod(shape) > MOST_NUMBERS:
        raise InputError(f"values: {' x '.join(map(str, shape))} numbers; at most {MOST_NUMBERS:,} are read")
    with named("values"):
        words = f"a list of {shape[0]} numbers" if len(shape) == 1 else f"{shape[0]} rows of {shape[1]} numbers"
        return tuple(axes), array(given.get("values"), shape, words)


def _from_file(file: Any, folder: Path | None) -> tuple[tuple[NDArray[Any], ...], NDArray[Any]]:
    """Return the axes and values of a CSV file with two columns, or three on a full rectangular grid."""
    if not isinstance(file, str) or not file:
        raise InputError(f"file: expected the name of a CSV file, got {kind_of(file)}")
    if folder is None:
        raise InputError("file: a table in a file is read only with a model file; give x and values here")
    shown = file if file.isprintable() else ascii(file)
    rows = _rows(read_text(folder / file, shown, "table"), shown)
    if rows.shape[1] == 2:
        order = np.argsort(rows[:, 0], kind="stable")
        axis, values = rows[order].T
        repeated = np.flatnonzero(np.diff(axis) == 0)
        if len(repeated):
            raise InputError(f"{shown}: {axis[repeated[0]]:g} is given twice; give each argument one value")
        return (axis,), values
    (x, i), (y, j) = (np.unique(column, return_inverse=True) for column in rows.T[:2])
    if len(x) * len(y) != len(rows) or len(np.unique(i * len(y) + j)) != len(rows):
        raise InputError(f"{shown}: {len(rows)} rows are no full grid of {len(x)} x {len(y)} arguments; give each pair once")
    values = np.empty((len(x), len(y)))
    values[i, j] = rows[:, 2]
    return (x, y), values


def _rows(text: str, shown: str) -> NDArray[Any]:
    """Return the numbers of a CSV file, (rows, 2 or 3); the first line may be a header."""
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        cells = [cell.strip() for cell in line.split(",")]
        if cells == [""]:
            continue
        wrong = next((cell for cell in cells if not _NUMBER.fullmatch(cell)), None)
        if wrong is not None and not rows and number == 1:
            continue
        if wrong is not None:
            raise InputError(f"{shown}, row {number}: {echo(wrong)} is not a number; give numbers separated by commas")
        if len(cells) not in (2, 3) or (rows and len(cells) != len(rows[0])):
            expected = len(rows[0]) if rows else "2 or 3"
            raise InputError(f"{shown}, row {number}: {len(cells)} columns; a table has {expected}: its arguments and its value")
        if len(rows) >= MOST_NUMBERS:
            raise InputError(f"{shown}: more than {MOST_NUMBERS:,} rows; give a coarser table")
        rows.append([float(cell) for cell in cells])
    if len(rows) < 2:
        raise InputError(f"{shown}: {len(rows)} rows of numbers; a table needs at least 2")
    return np.array(rows)
