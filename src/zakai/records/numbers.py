"""Arrays of real numbers that a filter can use."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.errors import InputError

# A filter squares what it reads and sums the squares; beyond this their sum is no longer a float64.
LARGEST = 1e150


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
