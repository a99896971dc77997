"""Observations line by line, as they come: JSON lines, or CSV where the first line is a header of it."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, BinaryIO, NamedTuple

from zakai.errors import InputError
from zakai.models._errors import named
from zakai.records.columns import observed_columns
from zakai.records.dates import Clock, date_of
from zakai.records.dialect import Dialect, dialect_of
from zakai.records.header import header_names, quoted
from zakai.records.numbers import NUMBER
from zakai.records.writing import default_names

LONGEST = 2**20  # bytes of a line
MOST_DIGITS = 640  # of an integer: what Python always reads, however it is set
_WORD = re.compile(r"[^\W\d][\w.-]*")
_SEPARATOR = re.compile(r"[,;\t]")


class Line(NamedTuple):
    """One line: its number, from 1, its time and its values, None where nothing was observed; or what is wrong with it.

    `inputs` are the values of known inputs by their names, None where the line gives none.
    """

    number: int
    time: Any
    values: list[Any]
    inputs: dict[str, Any] | None = None
    fault: str | None = None


def lines_of(
    file: BinaryIO, m: int, inputs: Sequence[str] = (), clock: Clock | None = None, names: Sequence[str] = ()
) -> Iterator[Line]:
    r"""Yield the lines of a stream of observations, each as soon as it is there.

    JSON lines are {"time": 0.1, "y": [0.5, null], "inputs": {"u": 1.0}}; other keys are ignored, and no key may stand twice. A
    stream whose first line begins with `time` is CSV in the dialects that `read_record` reads, with m columns after that and, in
    any place, one for each input. Empty lines are skipped. No line is held in memory beyond a mebibyte.

    Args:
        file: bytes, as `sys.stdin.buffer`.
        m: how many values an observation has.
        inputs: the names of the known inputs.
        clock: the times are ISO dates, which become times of this clock.
        names: the names of the observations, by which the columns of a CSV are matched.

    Raises:
        InputError: the header of a CSV does not fit, or what looks like CSV has none.

    Example:
        >>> import io
        >>> from zakai.records.stream import lines_of
        >>> [line.values for line in lines_of(io.BytesIO(b'{"time": 1, "y": [0.5]}\n{"time": 2, "y": [null]}\n'), 1)]
        [[0.5], [None]]
    """
    parse: Callable[[str], tuple[Any, list[Any], dict[str, Any] | None]] | None = None
    dialect: Dialect | None = None
    comment: list[str] = []  # the last one before the header
    number = 0
    while content := file.readline(LONGEST + 1):
        number += 1
        if len(content) > LONGEST:
            _skip_rest(file, content)
            yield Line(number, None, [], fault=f"is longer than {LONGEST} bytes")
            continue
        try:
            text = content.decode("utf-8-sig" if number == 1 else "utf-8").rstrip("\r\n")
        except UnicodeDecodeError:
            yield Line(number, None, [], fault="holds bytes that are not UTF-8 text")
            continue
        if parse is None:
            if text.lstrip().startswith("#"):
                comment = [text]
            if not text.strip() or text.lstrip().startswith("#"):
                continue
            found = dialect_of([*comment, text])
            columns = None if found is None else _columns(text, found, number, names or default_names(m), inputs)
            parse = partial(_json, clock) if columns is None else partial(_csv, clock, inputs, columns)
            dialect = None if columns is None else found
            if dialect is not None and dialect.line > len(comment):
                continue
        if dialect is not None:
            text = dialect.translated([text])[0]
        if not text.strip():
            continue
        try:
            yield Line(number, *parse(text))
        except ValueError as error:
            yield Line(number, None, [], fault=str(error))


def _skip_rest(file: BinaryIO, content: bytes) -> None:
    while content and not content.endswith(b"\n"):
        content = file.readline(LONGEST)


def _date(text: Any, clock: Clock) -> float:
    """Return the time of an ISO date."""
    date = date_of(text) if isinstance(text, str) else None
    if date is None:
        raise ValueError(f"the time is {_said(text)}; write dates as 2024-01-31T12:30")
    return clock.time(date)


def _json(clock: Clock | None, text: str) -> tuple[Any, list[Any], dict[str, Any] | None]:
    try:
        found = _DECODER.decode(text)
    except json.JSONDecodeError:
        raise ValueError(f'{quoted(text.strip())} is not JSON; expected {{"time": ..., "y": [...]}}') from None
    except RecursionError:
        raise ValueError(f"{quoted(text.strip())} is nested too deep to be read as JSON") from None
    if not isinstance(found, dict) or "time" not in found or "y" not in found:
        raise ValueError(f'{quoted(text.strip())} is not an object with "time" and "y"')
    time, values, inputs = found["time"], found["y"] if isinstance(found["y"], list) else [found["y"]], found.get("inputs")
    if clock is not None:
        time = _date(time, clock)
    if not _is_number(time):
        hint = " (for dates: --unit and --origin)" if isinstance(time, str) and date_of(time) is not None else ""
        raise ValueError(f"the time is {_said(time)}; give a number{hint}")
    for index, value in enumerate(values):
        if value is not None and not _is_number(value):
            raise ValueError(f"observation {index + 1} is {_said(value)}; give a number, or null where there is none")
    if inputs is not None and not isinstance(inputs, dict):
        raise ValueError(f'"inputs" is {_said(inputs)}; give an object, as {{"u": 1.0}}')
    for name, value in (inputs or {}).items():
        if not _is_number(value):
            raise ValueError(f"the input {_said(name)} is {_said(value)}; give a number")
    return time, values, inputs


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and value not in (math.inf, -math.inf)


def _said(value: Any) -> str:
    """A value that is none we use, in the words of JSON."""
    if isinstance(value, list | dict):
        return "a list" if isinstance(value, list) else "an object"
    if isinstance(value, float):
        return "beyond the range of numbers"
    text = json.dumps(value).replace("\x7f", "\\u007f")
    return text if len(text) <= 40 else text[:37] + "..."


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        ((twice, _),) = Counter(name for name, _ in pairs).most_common(1)
        raise ValueError(f"the key {_said(twice)} stands twice; which of the two is meant is not known")
    return found


def _integer(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"an integer of {len(digits)} characters is too long; the longest that is read has {MOST_DIGITS}")
    return int(digits)


def _no_number(name: str) -> None:
    raise ValueError(f"{name} is not a JSON number; null says that nothing was observed")


_DECODER = json.JSONDecoder(object_pairs_hook=_object, parse_int=_integer, parse_constant=_no_number)


def _csv(
    clock: Clock | None, inputs: Sequence[str], columns: tuple[list[int], list[int]], text: str
) -> tuple[Any, list[Any], dict[str, Any] | None]:
    """Return the time, the observations and the inputs of a row; `columns` are the places of both, see `_columns`."""
    cells = [cell.strip() for cell in text.split(",")]
    if clock is not None and cells[0]:
        cells[0] = repr(_date(cells[0].strip('"'), clock))
    for cell in cells:
        if cell and not NUMBER.fullmatch(cell):
            raise ValueError(f"{quoted(cell)} is not a number; leave the cell empty if nothing was observed")
    if not cells[0]:
        raise ValueError("the time is missing")
    numbers = [float(cell) if cell else None for cell in cells]
    observed, placed = columns
    if not placed and observed == list(range(1, 1 + len(observed))):
        return numbers[0], numbers[1:], None
    if len(cells) != 1 + len(observed) + len(placed):
        raise ValueError(f"{len(cells)} columns; the header has {1 + len(observed) + len(placed)}")
    given = {name: numbers[place] for name, place in zip(inputs, placed, strict=True) if cells[place]}
    return numbers[0], [numbers[place] for place in observed], given or None


def _columns(
    text: str, dialect: Dialect, number: int, observed: Sequence[str], inputs: Sequence[str]
) -> tuple[list[int], list[int]] | None:
    """Return the places of the observations and of the inputs if the first line is the header of a CSV, None if it is JSON.

    Raises:
        InputError: a header that does not fit, or a line that looks like CSV and is no header.
    """
    names = header_names(dialect.header)
    with named(f"standard input: line {number}"):
        if names[0] == "time":
            given = inputs if set(inputs) & set(names[1:]) else ()
            missing = [name for name in given if names.count(name) != 1]
            if missing:
                raise InputError(f"no column, or two, for the input {', '.join(missing)}; give a column for each input")
            places = observed_columns(names[1:], observed, inputs).places
            return [place + 1 for place in places], [names.index(name) for name in given]
        if _looks_like_csv(text):
            header = (
                f"whose first line must be a header: first the column time, then {len(observed)} for the observations, with "
                "commas, semicolons or tabs between"
            )
            raise InputError(f"{quoted(text.strip())} looks like CSV, {header}")
    return None


def _looks_like_csv(text: str) -> bool:
    """Whether a line is several words or numbers with separators between: no part of a line of JSON ends so, nor does prose."""
    cells = [cell.strip().strip('"') for cell in _SEPARATOR.split(text.strip())]
    return len(cells) > 1 and all(_WORD.fullmatch(cell) or NUMBER.fullmatch(cell) for cell in cells)
