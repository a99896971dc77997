"""Options that several methods share."""

from __future__ import annotations

from typing import Any

from zakai.errors import InputError


def tolerance_of(value: Any, default: float) -> float:
    """Return the option `tolerance`, checked; None stands for the default.

    Raises:
        InputError: it is not a number from 1e-12 to 0.1.
    """
    if value is None:
        return default
    if isinstance(value, bool) or not isinstance(value, int | float) or not 1e-12 <= value <= 0.1:
        raise InputError(f"option tolerance: {value!r} must be a number from 1e-12 to 0.1")
    return float(value)
