"""Arrays of real numbers that a filter can use."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from zakai.errors import InputError

# A filter squares what it reads and sums the squares; beyond this their sum is no longer a float64.
LARGEST = 1e150
NUMBER = re.compile(r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf|infinity)", re.ASCII | re.IGNORECASE)  # in a file of text


def real_numbers(array: Any, name: str, what: str = "record") -> np.ndarray:
    """A fresh float64 copy, nan where it is masked; text, dates, durations and complex numbers are refused."""
    try:
        if isinstance(array, np.ma.MaskedArray) and array.dtype.kind in "biuf":
            array = np.ma.filled(array.astype(np.float64), np.nan)
        array = np.asarray(array)
        texts = array.dtype.kind == "O" and any(isinstance(item, str | bytes) for item in array.flat)
        if texts or array.dtype.kind not in "biufO":
            raise TypeError
        return np.array(array, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        kind = f" of {array.dtype}" if isinstance(array, np.ndarray) else ""
        raise InputError(f"{what}: {name} must be real numbers, not an array{kind}") from None


def numbers_in_time(times: Any, values: Any, what: str, rows: str, columns: str) -> tuple[np.ndarray, np.ndarray]:
    """Return fresh float64 copies of times (k,) and of values (k, m), neither of them empty; values (k,) become (k, 1)."""
    times, values = real_numbers(times, "times", what), real_numbers(values, "values", what)
    if values.ndim == 1:
        values = values[:, np.newaxis]
    if times.ndim != 1 or times.size == 0:
        raise InputError(f"{what}: times has shape {times.shape}; expected {rows} with at least one time")
    if values.ndim != 2 or len(values) != len(times) or values.shape[1] == 0:
        raise InputError(f"{what}: values has shape {values.shape}; expected ({len(times)}, {columns})")
    return times, values
