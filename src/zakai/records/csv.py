"""Records from CSV files: a fast road for good lines, and a careful one that names the first bad row."""

from __future__ import annotations

import os
import re
from array import array
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np

from zakai.errors import InputError
from zakai.models._errors import named
from zakai.records.columns import observed_columns
from zakai.records.dates import Clock, date_of, unit_name
from zakai.records.dialect import Dialect, dialect_of, other_separator
from zakai.records.header import LONGEST_LINE, cells_of, columns_fault, header_names, header_of, quoted
from zakai.records.inputs import Inputs
from zakai.records.numbers import NUMBER
from zakai.records.record import Record, early, first_fault
from zakai.records.writing import default_names, shown

_AT_ONCE = 1 << 18  # characters
_NO_TEXT = re.compile("[\ud800-\udfff]")


def read_record(
    path: str | os.PathLike[str],
    model: Any,
    unit: str | None = None,
    origin: Any = None,
    *,
    columns: Sequence[str] | None = None,
) -> Record:
    r"""Read the observations of `model` from a CSV file.

    The first line is a header: `time`, then one column for each of the model's m observations. They are matched by the names of
    the observations, or y1 to ym, in any order, if these are their names, and else taken in their order; with `columns` there may
    be others. Every other line is one time and its m observations, in what the model's `observation_kind` says. Times increase
    strictly, need not be regular, and begin after the model's `start` (samples: at or after). An empty cell or `nan` is "not
    observed". The text is UTF-8; a byte-order mark, Windows line ends and blank lines are accepted.

    Cells may be separated by semicolons or tabs, with decimal commas. Lines that begin with `#` are comments, `NA`, `null` and
    the like are "not observed", `Time`, `t` and `date` are `time`, and a column of row numbers before it is left out.

    Columns with the names of the model's inputs, in addition to the m observations, are the inputs at these times; the first
    row with inputs holds from the model's start, and a row with empty inputs changes nothing.

    Arguments:
        path: the file.
        model: a `zakai.Model`; its `m`, `start`, `observation_kind` and `observation_law` say what the file must hold.
        unit: the model's unit of time, for a file whose first column has ISO dates; see `Record`.
        origin: the date at which t = 0, by default the first date.
        columns: the names of the columns to take, in the order of the observations.

    Raises:
        InputError: the file, or its first bad row by its line number (the header is line 1), cannot be used.

    Example:
        >>> import zakai, tempfile, pathlib
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "record.csv"
        >>> _ = path.write_text("time,y\n0.1,0.5\n0.2,\n0.4,-0.1\n")
        >>> zakai.read_record(path, zakai.load_model("gallery:cubic-sensor"))
        Record(3 rows x 1 increments, times 0.1 to 0.4)
    """
    path = Path(path)
    names = header_of(path)
    dates = None if unit is None else Dates(unit, origin)
    if names[:1] != ["time"]:  # `read_table` says what is wrong
        read_table(path, model.m, "observations", dates=dates)
    observed = getattr(model, "observation_names", default_names(model.m))
    with named(f"{shown(path)}: row 1"):
        try:
            places, note = observed_columns(names[1:], observed, model.inputs, columns)
        except InputError as error:
            missing = [name for name in model.inputs if name not in names]
            error.args = (f"{error}; there is no column for the input {', '.join(missing)}" if missing else str(error),)
            raise
        known = _input_columns(names, model)
    used = [0, *(place + 1 for place in places), *known]
    equal = model.observation_kind == "samples" or not getattr(model, "kind_given", True)
    table, row = read_table(path, len(names) - 1, "observations", dates=dates, used=used, equal=equal)
    values, rest = table[:, 1 : 1 + model.m], table[:, 1 + model.m :]
    inputs = _inputs_of(path, model, row, table[:, 0], rest) if known else None
    kind = model.observation_kind if getattr(model, "kind_given", True) else None
    record = Record(table[:, 0], values, kind, inputs, **clock_of(dates))
    object.__setattr__(record, "_note", note)
    fault = early(record.times[0], kind or "samples", model.start)
    if fault is not None:
        hint = "" if dates is None else "; give the date at which t = 0 as origin"
        raise InputError(f"{shown(path)}: row {row}: {fault}{hint}")
    wrong = record.fault_of_law(model)
    if wrong is not None:
        raise InputError(f"{shown(path)}: row {row + wrong[0]}: {wrong[1]}")
    return record


def _input_columns(names: list[str], model: Any) -> list[int]:
    """Return the places of the model's inputs in a header; none where the file has none of them."""
    if not set(model.inputs) & set(names[1:]):
        return []
    for name in model.inputs:
        if list(names[1:]).count(name) != 1:
            what = "no column for the input" if name not in names else "two columns for the input"
            raise InputError(f"{what} {quoted(name)[1:-1]}; give one for each input")
    return [names.index(name) for name in model.inputs]


def _inputs_of(path: Path, model: Any, row: int, times: np.ndarray, values: np.ndarray) -> Inputs:
    """The inputs in the rows of a record; `row` is the line of the first."""
    given = ~np.isnan(values)
    partial = given.any(axis=1) & ~given.all(axis=1)
    if partial.any():
        raise InputError(f"{shown(path)}: row {row + int(np.argmax(partial))}: only some inputs are given; give all or none")
    rows = given.all(axis=1)
    if not rows.any():
        raise InputError(f"{shown(path)}: no row has the inputs {', '.join(model.inputs)}; fill their columns")
    times, values = times[rows], values[rows]
    if times[0] > model.start:
        times, values = np.concatenate([[model.start], times]), np.concatenate([values[:1], values])
    return Inputs(times, values)


def _advice(cell: str) -> str:
    """Return what to do about a time that is not an ISO date."""
    try:
        float(cell)
    except ValueError:
        return "write it as 2024-01-31 or 2024-01-31T12:30"
    return "write it as 2024-01-31T12:30, or omit the unit"


class Dates:
    """ISO dates of a file as times, in a unit from an origin, which is the first date unless it is given."""

    def __init__(self, unit: str, origin: Any = None):
        self.unit = unit_name(unit)
        self.clock = None if origin is None else Clock.of(origin, unit)

    def numbered(self, part: _Part) -> tuple[_Part, tuple[int, str] | None]:
        """Return the lines with numbers for dates, up to the first without a date, and the row and fault of that one."""
        cells = [line.partition(",") for line in part.lines]
        found: list[Any] = []
        wrong = None
        for number, (cell, _, rest) in enumerate(cells, part.number):
            found.append(date_of(cell.strip().strip('"')) if cell.strip() or rest else np.datetime64("NaT", "ns"))
            if found[-1] is None:
                wrong = number, f"{quoted(cell)} in column 'time' is not a date; {_advice(cell)}"
                found.pop()
                break
        dates = np.array(found, "datetime64[ns]")
        known = dates[~np.isnat(dates)]
        if self.clock is None and len(known):
            self.clock = Clock(known[0], self.unit)
        times = np.zeros(len(dates)) if self.clock is None else self.clock.times(dates)
        lines = [
            line if np.isnan(time) else f"{time!r}{comma}{rest}"
            for line, time, (_, comma, rest) in zip(part.lines[: len(found)], times.tolist(), cells, strict=False)
        ]
        return part._replace(lines=lines), wrong


def clock_of(dates: Dates | None) -> dict[str, Any]:
    """Return the unit and the origin of dates as keywords of a `Record`."""
    return {} if dates is None or dates.clock is None else dates.clock._asdict()


def read_table(
    path: Path,
    columns: int,
    what: str,
    names: Sequence[str] | None = None,
    dates: Dates | None = None,
    used: Sequence[int] | None = None,
    equal: bool = False,
) -> tuple[np.ndarray, int]:
    """The times and the `columns` numbers of every row of a CSV file, (K, 1 + columns), and the line of the first row.

    `what` is what a column holds, in the plural; with `names` the columns must have just these; `used` are the places of the
    columns that are read, the first of which is 0, in the order of the table; times may be `equal`. Raises InputError as
    `read_record` does.
    """
    try:
        # A pipe or a device could be endless.
        if path.exists() and not path.is_file():
            kind = "a folder" if path.is_dir() else "not a regular file"
            raise InputError(f"{shown(path)}: is {kind}; give a CSV file")
        # Bytes that are not UTF-8 become lone surrogates, which no number has; so their row is found.
        with path.open(encoding="utf-8-sig", errors="surrogateescape", newline=None) as file:
            return table_of(file, shown(path), columns, what, names, dates, used, equal)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{shown(path)}: cannot be read: {reason}; give a CSV file") from None


def table_of(
    file: TextIO,
    source: str,
    columns: int,
    what: str,
    names: Sequence[str] | None = None,
    dates: Dates | None = None,
    used: Sequence[int] | None = None,
    equal: bool = False,
) -> tuple[np.ndarray, int]:
    """`read_table` of an open file, which is read once, a part at a time; `source` is what errors call it."""
    parts = _parts(file, source)
    first = next(parts, None)
    if first is None:
        raise InputError(f"{source}: is empty; expected a header of {columns + 1} names, the first of them time, then rows")
    dialect = dialect_of(first.lines)
    if dialect is None:
        raise InputError(f"{source}: has no header; the first line that is no comment must have names, the first of them time")
    header = _header(source, dialect, columns, what, names, used is not None)
    used = range(len(header)) if used is None else used
    numbers, row, before = array("d"), 0, np.empty((0, len(used)))
    for part in chain([first._replace(number=dialect.line + 1, lines=first.lines[dialect.line :])], parts):
        part = part._replace(lines=dialect.translated(part.lines))
        part, wrong = (part, None) if dates is None else dates.numbered(part)
        rows = _fast(part.lines, len(header), used)
        if rows is None:
            rows, other = _careful(part, header, used)
            wrong = other or wrong
        # The first bad row is the one to name: an earlier one may break a rule about its numbers.
        both = np.vstack([before, rows])
        fault = first_fault(both[:, 0], both[:, 1:], equal)
        if fault is not None:
            wrong = _line(part, fault[0] - len(before)), fault[1]
        if wrong is not None:
            raise InputError(f"{source}: row {wrong[0]}: {wrong[1]}")
        if len(rows):
            row = row or _line(part, 0)
            numbers.frombytes(rows.tobytes())
            before = rows[-1:]
    if not numbers:
        raise InputError(f"{source}: has a header but no row; a record needs at least one observation")
    return np.frombuffer(numbers).reshape(-1, len(used)), row


class _Part(NamedTuple):
    """Some lines of a file, the number of the first, and whether the last has an end."""

    number: int
    lines: list[str]
    whole: bool


def _parts(file: TextIO, source: str) -> Iterator[_Part]:
    """The lines of a file, little more than the longest at once."""
    number, rest = 1, ""
    while block := file.read(_AT_ONCE):
        lines = (rest + block).split("\n")
        rest = lines.pop()
        if lines:
            yield _Part(number, lines, True)
        number += len(lines)
        if len(rest) > LONGEST_LINE:
            fault = _not_text(rest) or f"is longer than {LONGEST_LINE:,} characters; is this a CSV file?"
            raise InputError(f"{source}: row {number}: {fault}")
    if rest:
        yield _Part(number, [rest], False)


def _header(
    source: str, dialect: Dialect, m: int, what: str, expected: Sequence[str] | None, known: bool = False
) -> list[str]:
    where = f"{source}: row {dialect.line}"
    if (fault := _not_text(dialect.header)) is not None:
        raise InputError(f"{where}: {fault}")
    names = header_names(dialect.header)
    if names[0] != "time":
        hint = " (is the header missing?)" if NUMBER.fullmatch(names[0]) else other_separator(names[0])
        raise InputError(f"{where}: the first column is {quoted(names[0])}; the header must begin with time{hint}")
    if not known and (fault := columns_fault(names, m, what, expected)) is not None:
        raise InputError(f"{where}: {fault}")
    return names


def _fast(lines: list[str], columns: int, used: Sequence[int]) -> np.ndarray | None:
    """The rows as a table (k, used columns); None if they are not all plain numbers and gaps."""
    text = "\n".join(lines)
    if not text.strip():
        return np.empty((0, len(used)))
    if "\0" in text:
        return None
    text = f"{text}\n".replace(",,", ",nan,").replace(",,", ",nan,").replace(",\n", ",nan\n")
    try:
        table = np.loadtxt(text.split("\n"), delimiter=",", comments=None, ndmin=2)
    except ValueError:
        return None
    return table[:, used] if table.shape[1] == columns else None


def _careful(part: _Part, names: list[str], used: Sequence[int]) -> tuple[np.ndarray, tuple[int, str] | None]:
    """The same table, cell by cell, up to the first row that cannot be read; the line of that one, and why."""
    table, wrong = array("d"), None
    for number, line in enumerate(part.lines, start=part.number):
        if not line.strip():
            continue
        cells = [cell.strip() for cell in cells_of(line)]
        what = _not_text(line) or _not_numbers(cells, names, part.whole, used)
        if what is not None:
            wrong = number, what
            break
        table.extend(float(cells[i]) if cells[i] else np.nan for i in used)
    return np.array(table, dtype=np.float64).reshape(-1, len(used)), wrong


def _not_numbers(cells: list[str], names: list[str], whole: bool, used: Sequence[int]) -> str | None:
    if len(cells) != len(names):
        cut = "" if whole else " (the file ends in this row; was it cut off?)"
        return f"{len(cells)} columns; expected {len(names)}: {quoted(','.join(names))}{cut}"
    for name, cell in ((names[i], cells[i]) for i in used):
        if cell and not NUMBER.fullmatch(cell):
            what = f"{quoted(cell)} in column {quoted(name)} is not a number"
            if name == "time" and date_of(cell) is not None:
                return f"{what}; for dates give the model's unit of time, as in unit='h' (command: --unit h)"
            return f"{what}; leave the cell empty if nothing was observed"
    return None


def _line(part: _Part, row: int) -> int:
    """The number of the line that holds this row of a part, blank lines not counted."""
    filled = (number for number, line in enumerate(part.lines, start=part.number) if line.strip())
    return next(islice(filled, row, None))


def _not_text(line: str) -> str | None:
    if _NO_TEXT.search(line):
        return "bytes that are not UTF-8 text; save the file as UTF-8"
    if "\0" in line:
        return "a NUL byte; is this a CSV file?"
    return None
