"""Observations line by line, as they come: JSON lines, or CSV where the first line is a header of it."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO, NamedTuple

from zakai.errors import InputError
from zakai.records.csv import columns_fault, header_names

LONGEST = 2**20  # bytes of a line
MOST_DIGITS = 640  # of an integer: what Python always reads, however it is set
_WORD = re.compile(r"[^\W\d][\w.-]*")
_SEPARATOR = re.compile(r"[,;\t]")
_NUMBER = re.compile(r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf|infinity)", re.ASCII | re.IGNORECASE)


class Line(NamedTuple):
    """One line: its number, from 1, its time and its values, None where nothing was observed; or what is wrong with it."""

    number: int
    time: Any
    values: list[Any]
    fault: str | None = None


def lines_of(file: BinaryIO, m: int) -> Iterator[Line]:
    """The lines of a stream of observations, each as soon as it is there.

    JSON lines are {"time": 0.1, "y": [0.5, null]}, of which other keys are left alone, but none may stand twice; a stream
    whose first line begins with `time` is CSV, with m columns after that. Empty lines are passed over. No line is held in
    memory beyond a mebibyte.

    Arguments:
        file: bytes, as `sys.stdin.buffer`.
        m: how many values an observation has.

    Raises:
        InputError: the header of a CSV does not fit, or what looks like CSV has none.

    Example:
        >>> import io
        >>> from zakai.records.stream import lines_of
        >>> [line.values for line in lines_of(io.BytesIO(b'{"time": 1, "y": [0.5]}\\n{"time": 2, "y": [null]}\\n'), 1)]
        [[0.5], [None]]
    """
    parse: Callable[[str], tuple[Any, list[Any]]] | None = None
    number = 0
    while content := file.readline(LONGEST + 1):
        number += 1
        if len(content) > LONGEST:
            _skip_rest(file, content)
            yield Line(number, None, [], f"is longer than {LONGEST} bytes")
            continue
        try:
            text = content.decode("utf-8-sig" if number == 1 else "utf-8")
        except UnicodeDecodeError:
            yield Line(number, None, [], "holds bytes that are not UTF-8 text")
            continue
        if not text.strip():
            continue
        if parse is None:
            parse = _csv if _is_header(text, number, m) else _json
            if parse is _csv:
                continue
        try:
            yield Line(number, *parse(text))
        except ValueError as error:
            yield Line(number, None, [], str(error))


def _skip_rest(file: BinaryIO, content: bytes) -> None:
    while content and not content.endswith(b"\n"):
        content = file.readline(LONGEST)


def _json(text: str) -> tuple[Any, list[Any]]:
    try:
        told = _DECODER.decode(text)
    except json.JSONDecodeError:
        raise ValueError(f'{_quoted(text.strip())} is not JSON; expected {{"time": ..., "y": [...]}}') from None
    except RecursionError:
        raise ValueError(f"{_quoted(text.strip())} is nested too deep to be read as JSON") from None
    if not isinstance(told, dict) or "time" not in told or "y" not in told:
        raise ValueError(f'{_quoted(text.strip())} is not an object with "time" and "y"')
    time, values = told["time"], told["y"] if isinstance(told["y"], list) else [told["y"]]
    if not _is_number(time):
        raise ValueError(f"the time is {_said(time)}; give a number")
    for index, value in enumerate(values):
        if value is not None and not _is_number(value):
            raise ValueError(f"observation {index + 1} is {_said(value)}; give a number, or null where there is none")
    return time, values


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
    told = dict(pairs)
    if len(told) < len(pairs):
        ((twice, _),) = Counter(name for name, _ in pairs).most_common(1)
        raise ValueError(f"the key {_said(twice)} stands twice; which of the two is meant is not known")
    return told


def _integer(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"an integer of {len(digits)} characters is too long; the longest that is read has {MOST_DIGITS}")
    return int(digits)


def _no_number(name: str) -> None:
    raise ValueError(f"{name} is no number of JSON; null says that nothing was observed")


_DECODER = json.JSONDecoder(object_pairs_hook=_object, parse_int=_integer, parse_constant=_no_number)


def _csv(text: str) -> tuple[Any, list[Any]]:
    cells = [cell.strip() for cell in text.split(",")]
    for cell in cells:
        if cell and not _NUMBER.fullmatch(cell):
            raise ValueError(f"{_quoted(cell)} is not a number; leave the cell empty if nothing was observed")
    if not cells[0]:
        raise ValueError("the time is missing")
    return float(cells[0]), [float(cell) if cell else None for cell in cells[1:]]


def _is_header(text: str, number: int, m: int) -> bool:
    """Whether the first line of a stream is the header of a CSV, else it is JSON; InputError where the header is wrong."""
    names = header_names(text.strip())
    fault = None
    if names[0] == "time":
        fault = columns_fault(names, m, "observations")
    elif _looks_like_csv(text):
        header = f"whose first line must be a header: first the column time, then {m} for the observations, with commas between"
        fault = f"{_quoted(text.strip())} looks like CSV, {header}"
    if fault is not None:
        raise InputError(f"standard input: line {number}: {fault}")
    return names[0] == "time"


def _looks_like_csv(text: str) -> bool:
    """Whether a line is several words or numbers with separators between: no part of a line of JSON ends so, nor does prose."""
    cells = [cell.strip().strip('"') for cell in _SEPARATOR.split(text.strip())]
    return len(cells) > 1 and all(_WORD.fullmatch(cell) or _NUMBER.fullmatch(cell) for cell in cells)


def _quoted(text: str) -> str:
    return ascii(text if len(text) <= 40 else text[:37] + "...")
