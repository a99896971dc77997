"""Regular times of observation."""

from __future__ import annotations

from decimal import Decimal
from math import isfinite

import numpy as np

from zakai.errors import InputError

MOST_OBSERVATIONS = 10_000_000


def clock(start: float, until: float, step: float, keys: tuple[str, str] = ("--until", "--step")) -> np.ndarray:
    """start + step, start + 2 step, ... up to `until`, as decimals rather than as sums of rounded numbers.

    `keys` are what errors call `until` and `step`.  Raises InputError where there is no such time, or too many.
    """
    end, each = keys
    if not (isfinite(step) and step > 0):
        raise InputError(f"{each} {step:g}: must be a positive number")
    if not (isfinite(until) and until > start):
        raise InputError(f"{end} {until:g}: must be after the model's start, {start:g}")
    count = (until - start) / step * (1 + 1e-12)
    if count < 1:
        raise InputError(f"{each} {step:g}: leaves no observation between the start {start:g} and {end} {until:g}")
    if count > MOST_OBSERVATIONS:
        raise InputError(f"{each} {step:g}: gives {count:.3g} observations; at most {MOST_OBSERVATIONS:,} are simulated at once")
    digits = max(-int(Decimal(repr(number)).as_tuple().exponent) for number in (start, step))
    times = start + step * np.arange(1, int(count) + 1)
    return np.round(times, digits) if 0 < digits < 12 else times
