"""Lines of a stream, JSON or CSV: each is an observation or one short reason; an online filter takes or refuses what they say."""

import io
from types import SimpleNamespace

from fuzz.oracle import value_or_one_line
from zakai.engine.online import Online, _number
from zakai.errors import InputError
from zakai.records.stream import Line, lines_of

_ONLINE = Online.__new__(Online)
vars(_ONLINE).update(model=SimpleNamespace(m=2, source="m.toml"))


def one_input(data: bytes) -> None:
    lines = value_or_one_line(lambda: list(lines_of(io.BytesIO(data), 2)))
    if isinstance(lines, InputError):
        assert str(lines).startswith("standard input: ")
        return
    assert [line.number for line in lines] == sorted({line.number for line in lines})
    for line in lines:
        assert isinstance(line, Line)
        if line.fault is not None:
            assert line.fault.isprintable() and len(line.fault) < 300
            continue
        time = value_or_one_line(lambda line=line: _number(line.time))
        assert isinstance(time, InputError | float)
        values = value_or_one_line(lambda line=line: _ONLINE._values(line.values))
        assert isinstance(values, InputError) or all(isinstance(value, float) for value in values)
