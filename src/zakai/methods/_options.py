"""Checks of the values of options."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from zakai.errors import InputError


def one_of(option: str, value: Any, words: Iterable[str]) -> str:
    """Return the value of an option that is a word.

    Raises:
        InputError: it is none of the words.
    """
    words = list(words)
    if value not in words:
        which = f'neither "{words[0]}" nor "{words[1]}"' if len(words) == 2 else f"none of {', '.join(words)}"
        raise InputError(f'option {option}: "{value}" is {which}')
    return str(value)


def whole_number(option: str, value: Any, least: int, most: int = 10**9) -> int:
    """Return the value of an option that counts something.

    Raises:
        InputError: it is not a whole number from `least` to `most`.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not least <= value <= most:
        raise InputError(f"option {option}: {value!r} is not a whole number from {least} to {most}")
    return int(value)


def real_number(option: str, value: Any, what: str, fits: Callable[[Any], Any]) -> float:
    """Return the value of an option that measures something.

    Raises:
        InputError: it is not a number, or does not satisfy `fits`, which `what` describes.
    """
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not fits(value):
        raise InputError(f"option {option}: {value!r} is not {what}")
    return float(value)


def tolerance_of(value: Any, default: float) -> float:
    """Return the option `tolerance`, checked; None stands for the default.

    Raises:
        InputError: it is not a number from 1e-12 to 0.1.
    """
    if value is None:
        return default
    return real_number("tolerance", value, "a number from 1e-12 to 0.1", lambda tolerance: 1e-12 <= tolerance <= 0.1)
