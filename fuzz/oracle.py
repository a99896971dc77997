"""What every reader promises of any input: a value, or an InputError of one short line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from zakai.errors import InputError

LONGEST = 600  # characters of an error


def value_or_one_line(read: Callable[[], Any]) -> Any:
    """What the reader gives, or the InputError that it raises; anything else goes through and is a finding."""
    try:
        return read()
    except InputError as error:
        text = str(error)
        assert text and text.isprintable() and len(text) <= LONGEST, f"not one short line: {text!r}"
        assert error.exit_code == 2
        return error
