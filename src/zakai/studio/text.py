"""The text of a model file: where a key stands in it, where an error lies, and the text with another value of a key."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from decimal import Decimal
from typing import Any, NamedTuple

from zakai.errors import InputError
from zakai.models.files import read_keys

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
TABLES = ("parameters", "prior", "domain", "tables")
_STEP = re.compile(r"'?([A-Za-z_]\w*)'?((?:\[\d+\])*)(?:: |$)")
_TOKEN = re.compile(r'"""(?:.|\n)*?"""|\'\'\'(?:.|\n)*?\'\'\'|"(?:\\.|[^"\\\n])*"|\'[^\'\n]*\'|\#[^\n]*|[][{},]|[^][{},"\'#\s]+')


class Place(NamedTuple):
    """A part of a text: its first character and the one after its last, line and column (from 1), and its key and indices."""

    start: int
    stop: int
    line: int
    column: int
    key: tuple[str, ...] = ()
    entry: tuple[int, ...] = ()


def place_of_error(text: str, message: str) -> Place | None:
    """Return where in a model's text an error is that its reader has reported; None for an error of the whole."""
    found = re.search(r"\(at line (\d+), column (\d+)\)", message)
    if found:
        line, column = int(found[1]), int(found[2])
        start = _offset(text, line, column)
        if text[start : start + 1] in ("", "\n"):  # something is missing at the end of the line
            start = text.rfind("\n", 0, start) + 1
        return Place(start, max(start + 1, _end_of_line(text, start)), line, column)
    if "(at end of document)" in message:
        return _place(text, max(0, len(text.rstrip()) - 1), len(text.rstrip()))
    found = re.match(r"unknown key '([^']*)'", message)
    if found:
        return place_of(text, (found[1],), (), name=True)
    key: tuple[str, ...] = ()
    index: tuple[int, ...] = ()
    rest = message
    while len(key) < 2 and (step := _STEP.match(rest)):
        if key and key[0] not in TABLES:
            break
        key = (*key, step[1])
        index = tuple(int(number) for number in re.findall(r"\d+", step[2]))
        rest = rest[step.end() :]
    for length in range(len(key), 0, -1):
        found_place = place_of(text, key[:length], index if length == len(key) else ())
        if found_place is not None:
            return _column_within(text, found_place, rest)
    return None


def _column_within(text: str, place: Place, rest: str) -> Place:
    """Return the place from the column of a formula on that the rest of a message names."""
    found = re.match(r"column (\d+)", rest)
    if found is None or text[place.start : place.start + 1] not in ('"', "'"):
        return place
    start = min(place.start + int(found[1]), place.stop - 1)
    return _place(text, start, max(start + 1, place.stop - 1))._replace(key=place.key, entry=place.entry)


def place_of(text: str, key: tuple[str, ...], index: tuple[int, ...] = (), name: bool = False) -> Place | None:
    """Return where the value of a key is, an entry of its list with an index, or with `name` the key itself; None if nowhere."""
    span = _table(text, key[0]) if len(key) == 2 else (0, _first_table(text))
    if span is None:
        return None
    found = re.compile(rf"^[ \t]*([\"']?){re.escape(key[-1])}\1[ \t]*=[ \t]*", re.MULTILINE).search(text, span[0], span[1])
    if found is None:
        head = re.compile(rf"^[ \t]*\[[ \t]*{re.escape(key[0])}[ \t]*\]", re.MULTILINE).search(text) if len(key) == 1 else None
        return None if head is None else _place(text, head.start(), head.end())._replace(key=key)
    if name:
        return _place(text, found.start() + len(found[0]) - len(found[0].lstrip()), found.end())._replace(key=key)
    entries = list(_entries(text, found.end()))
    for entry, start, stop in entries:
        if index and entry == index:
            return _place(text, start, stop)._replace(key=key, entry=index)
    stop = entries[-1][2] if entries else _end_of_line(text, found.end())
    return _place(text, found.end(), max(stop, found.end() + 1))._replace(key=key, entry=index)


def with_values(text: str, changes: Mapping[str, Any]) -> str:
    """Return a model's text with other values of keys, its comments and its order kept.

    Args:
        text: TOML.
        changes: by key a text, a list (of lists) of texts, a table of texts, or None to remove the key. Texts that are numbers
            become numbers in tables and in `start`.

    Raises:
        InputError: the text is not TOML.
    """
    wanted = dict(read_keys(text))
    for key, value in changes.items():
        if value is None:
            wanted.pop(key, None)
        else:
            wanted[key] = _typed(value, key in TABLES or key == "start")
    for key in changes:
        text = _table_written(text, key, wanted.get(key)) if key in TABLES else _written(text, (key,), wanted.get(key))
    try:
        kept = read_keys(text) == wanted
    except InputError:
        kept = False
    return text if kept else _whole(wanted)


def _table_written(text: str, table: str, values: Any) -> str:
    span = _table(text, table)
    if not values:
        return text if span is None else text[: text.rindex("[", 0, span[0])] + text[span[1] :]
    if span is None:
        lines = "".join(f"{name} = {_toml(value)}\n" for name, value in values.items())
        return f"{text.rstrip()}\n\n[{table}]\n{lines}"
    for name in re.findall(r"^[ \t]*(\w+)[ \t]*=", text[span[0] : span[1]], re.MULTILINE):
        if name not in values:
            text = _written(text, (table, name), None)
    for name, value in values.items():
        text = _written(text, (table, name), value)
    return text


def _written(text: str, key: tuple[str, ...], value: Any) -> str:
    """Return the text with one value replaced, removed, or added at the end of its table."""
    place = place_of(text, key)
    if place is not None and place.key and text[place.start : place.stop].startswith("[") and "=" not in _line(text, place.start):
        place = None
    if place is None:
        if value is None:
            return text
        span = _table(text, key[0]) if len(key) == 2 else (0, _first_table(text))
        end = len(text) if span is None else len(text[: span[1]].rstrip())
        return f"{text[:end]}\n{key[-1]} = {_toml(value)}\n{text[end:].removeprefix(chr(10))}"
    if value is None:
        begin = text.rfind("\n", 0, place.start) + 1
        return text[:begin] + text[_end_of_line(text, place.stop) + 1 :]
    return text[: place.start] + _toml(value) + text[place.stop :]


def _typed(value: Any, numbers: bool) -> Any:
    if isinstance(value, list):
        return [_typed(part, numbers) for part in value]
    if isinstance(value, Mapping):
        return {str(name): _typed(part, numbers) for name, part in value.items()}
    text = str(value)
    if numbers and NUMBER.fullmatch(text):
        return int(text) if re.fullmatch(r"[+-]?\d{1,18}", text) else Decimal(text)
    return text


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | Decimal | float):
        return _digits(value)
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_name(key)} = {_toml(part)}" for key, part in value.items()) + " }"
    return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")


def _name(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key)


def _whole(keys: Mapping[str, Any]) -> str:
    lines = [f"{_name(key)} = {_toml(value)}" for key, value in keys.items() if not isinstance(value, Mapping)]
    for key, value in keys.items():
        if isinstance(value, Mapping):
            lines += ["", f"[{_name(key)}]", *(f"{_name(name)} = {_toml(part)}" for name, part in value.items())]
    return "\n".join(lines) + "\n"


def shown(value: Any) -> Any:
    """Return the keys of TOML with every number as its text, for a form."""
    if isinstance(value, Mapping):
        return {str(key): shown(part) for key, part in value.items()}
    if isinstance(value, list):
        return [shown(part) for part in value]
    return value if isinstance(value, bool) else _digits(value)


def _digits(value: Any) -> str:
    """Return a number as TOML has it; an integer of thousands of digits as a hexadecimal one, which takes less time."""
    try:
        return str(value)
    except ValueError:
        return hex(value)


def _entries(text: str, start: int) -> Iterator[tuple[tuple[int, ...], int, int]]:
    """Yield the entries of a value, each with its indices; last the whole value, with none."""
    counts: list[int] = []
    for token in _TOKEN.finditer(text, start):
        mark = token[0]
        if mark.startswith("#"):
            continue
        if mark in "[{":
            counts.append(0)
        elif mark in "]}":
            counts = counts[:-1]
            if not counts:
                yield (), start, token.end()
                return
        elif mark == ",":
            if not counts:
                return
            counts[-1] += 1
        else:
            yield tuple(counts), token.start(), token.end()
            if not counts:
                return


def _first_table(text: str) -> int:
    found = re.search(r"^[ \t]*\[[ \t]*[A-Za-z_][\w.]*[ \t]*\][ \t]*(#.*)?$", text, re.MULTILINE)
    return len(text) if found is None else found.start()


def _table(text: str, name: str) -> tuple[int, int] | None:
    """Return where the lines of a table begin and end."""
    head = re.compile(rf"^[ \t]*\[[ \t]*{re.escape(name)}[ \t]*\][^\n]*\n?", re.MULTILINE).search(text)
    if head is None:
        return None
    rest = text[head.end() :]
    return head.end(), head.end() + _first_table(rest)


def _place(text: str, start: int, stop: int) -> Place:
    line = text.count("\n", 0, start) + 1
    return Place(start, stop, line, start - (text.rfind("\n", 0, start) + 1) + 1)


def _offset(text: str, line: int, column: int) -> int:
    start = 0
    for _ in range(line - 1):
        start = text.find("\n", start) + 1
    return min(start + column - 1, max(0, len(text) - 1))


def _end_of_line(text: str, start: int) -> int:
    end = text.find("\n", start)
    return len(text) if end < 0 else end


def _line(text: str, start: int) -> str:
    return text[text.rfind("\n", 0, start) + 1 : _end_of_line(text, start)]
