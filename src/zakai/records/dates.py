"""Dates as times of a model: t = (date - origin) / unit."""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from zakai.errors import InputError
from zakai.models._errors import did_you_mean, echo, listing

_SECOND = 10**9
_NANOSECONDS = {
    "ns": 1,
    "us": 10**3,
    "ms": 10**6,
    "s": _SECOND,
    "min": 60 * _SECOND,
    "h": 3600 * _SECOND,
    "d": 86400 * _SECOND,
    "week": 7 * 86400 * _SECOND,
    "year": 31557600 * _SECOND,  # 365.25 days
}
_OTHER_NAMES = {
    "D": "d", "H": "h", "W": "week", "Y": "year", "day": "d", "hour": "h", "minute": "min", "second": "s", "sec": "s",
    "years": "year", "weeks": "week", "days": "d", "hours": "h", "hr": "h", "minutes": "min", "seconds": "s",
}  # fmt: skip


_TIME = re.compile(r"\bt = ([-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?)(?![\d*/])")


class Clock(NamedTuple):
    """The date `origin` at which t = 0, in UTC where dates have a time zone, and the `unit` of t."""

    origin: np.datetime64
    unit: str

    @classmethod
    def of(cls, origin: Any, unit: Any, what: str = "record") -> Clock:
        """Return the clock of a date and the name of a unit; InputError where they are none."""
        found = as_dates(origin)
        if found is None or found.ndim or np.isnat(found):
            raise InputError(f"{what}: origin is {echo(origin, 40)}; give the date at which t = 0, as in '2024-01-31T12:00'")
        return cls(np.datetime64(found.item(), "ns"), unit_name(unit, what))

    def time(self, date: np.datetime64) -> float:
        """Return the time of one date."""
        return float(self.times(np.array([date]))[0])

    def times(self, dates: np.ndarray) -> np.ndarray:
        """Return the times (...) of dates (...)."""
        missing = np.isnat(dates)
        apart = (dates - self.origin).astype(np.int64)
        size = _NANOSECONDS[self.unit]
        # Whole units are exact; a float64 holds 100 days in nanoseconds.
        whole, rest = np.divmod(apart, size)
        return np.where(missing, np.nan, whole + rest / size)

    def dates(self, times: np.ndarray) -> np.ndarray:
        """Return the dates (...) of times (...), to the microsecond; to the nanosecond where the unit is less than a second."""
        size = _NANOSECONDS[self.unit]
        step = 1000 if size >= _SECOND else 1
        whole = np.floor(times)
        apart = whole.astype(np.int64) * size + np.round((times - whole) * (size / step)).astype(np.int64) * step
        return np.asarray(self.origin + apart.astype("timedelta64[ns]"))

    def text(self, time: float) -> str:
        """Return the date of one time as text, to the second or, where it is not whole, to the digits that it needs."""
        step = "ms" if _NANOSECONDS[self.unit] >= _SECOND else "ns"
        half = np.timedelta64(_NANOSECONDS[step] // 2, "ns")  # so that it is rounded
        date = (self.dates(np.array([time], float))[0] + half).astype(f"datetime64[{step}]")
        seconds, _, fraction = str(date).replace("T", " ").partition(".")
        return f"{seconds}.{fraction.rstrip('0')}".rstrip(".")

    def days(self, times: Any) -> Any:
        """Return the times as numbers of days since 1970, which Matplotlib draws as dates."""
        start = self.origin.astype("datetime64[ns]").astype(np.int64) / _NANOSECONDS["d"]
        return start + np.asarray(times, float) * (_NANOSECONDS[self.unit] / _NANOSECONDS["d"])


def dated(sentences: Iterable[str], clock: Clock | None) -> list[str]:
    """Return sentences with dates in place of times, where there is a clock: `t = 1.5` becomes `2024-03-31 12:00:00`."""
    if clock is None:
        return list(sentences)
    return [_TIME.sub(lambda found: clock.text(float(found[1])), one) for one in sentences]


def unit_name(unit: Any, what: str = "record") -> str:
    """Return the name of a unit of time; InputError, which begins with `what`, for an unknown one."""
    name = _OTHER_NAMES.get(unit, unit) if isinstance(unit, str) else unit
    if not isinstance(name, str) or name not in _NANOSECONDS:
        hint = did_you_mean(name, _NANOSECONDS) if isinstance(name, str) else ""
        raise InputError(f"{what}: unit is {echo(unit)}; it must be one of {listing(_NANOSECONDS)}{hint}")
    return name


def usual_unit(dates: np.ndarray) -> str:
    """Return a unit in which dates (K,) may be counted, up to days: the largest that is at most ten of their median distances."""
    apart = np.diff(np.sort(dates[~np.isnat(dates)])).astype(np.int64)
    median = float(np.median(apart[apart > 0])) if (apart > 0).any() else float(_NANOSECONDS["h"])
    return max((name for name in _NANOSECONDS if _NANOSECONDS[name] <= min(max(10.0 * median, 1.0), _NANOSECONDS["d"])),
               key=lambda name: _NANOSECONDS[name])  # fmt: skip


def as_dates(values: Any) -> np.ndarray | None:
    """Return dates as datetime64[ns], in UTC where they have a time zone; None where these are no dates.

    Args:
        values: datetime64, `datetime` objects, ISO texts, or a pandas index or column of dates.
    """
    if hasattr(values, "to_numpy"):
        values = values.to_numpy()
    array = np.asarray(values)
    if array.dtype.kind == "M":
        return array.astype("datetime64[ns]")
    if array.dtype.kind not in "OU" or array.size == 0:
        return None
    found = [date_of(one) for one in array.ravel().tolist()]
    if any(one is None for one in found):
        return None
    return np.array(found, "datetime64[ns]").reshape(array.shape)


def date_of(value: Any) -> np.datetime64 | None:
    """Return one date, None where it is none."""
    if isinstance(value, str):
        try:
            value = datetime.datetime.fromisoformat(value.strip())
        except ValueError:
            return None
    if isinstance(value, np.datetime64):
        return value.astype("datetime64[ns]")
    if isinstance(value, datetime.datetime):
        if value != value:  # NaT of pandas
            return np.datetime64("NaT", "ns")
        if value.tzinfo is not None:
            value = value.astimezone(datetime.UTC).replace(tzinfo=None)
        return np.datetime64(value, "ns")  # of a pandas Timestamp to the microsecond
    return np.datetime64(value, "ns") if isinstance(value, datetime.date) else None


def read_times(values: Any, unit: Any, origin: Any, what: str = "record") -> tuple[Any, Clock | None, np.ndarray | None]:
    """Return times as numbers, their clock, and the dates; numbers without a unit stay as they are, without a clock.

    Raises:
        InputError: dates without a unit, a unit without dates and without an origin, or a wrong unit or origin.
    """
    if hasattr(values, "dtype") and getattr(values.dtype, "kind", "") == "m":
        if unit is None:
            raise InputError(f"{what}: times are durations; give the unit of the model's time, as in unit='h'")
        return np.asarray(values).astype("timedelta64[ns]").astype(np.int64) / _NANOSECONDS[unit_name(unit, what)], None, None
    dates = as_dates(values) if unit is not None or _are_dates(values) else None
    if dates is None:
        if unit is None and origin is None:
            return values, None, None
        if unit is None or origin is None:
            raise InputError(f"{what}: times are numbers; give dates, or both unit and origin, the date at which t = 0")
        return values, Clock.of(origin, unit, what), None
    if unit is None:
        raise InputError(f"{what}: times are dates; give the unit of the model's time, as in unit='h'")
    if dates.ndim != 1 or not dates.size:
        return np.zeros(dates.shape), None, None
    if origin is None and np.isnat(dates[0]):
        raise InputError(f"{what}: the first row has no time; drop it, or give the date at which t = 0 as origin")
    clock = Clock.of(dates[0] if origin is None else origin, unit, what)
    return clock.times(dates), clock, dates


def _are_dates(values: Any) -> bool:
    """Return whether values are dates, and not texts."""
    if isinstance(values, list | tuple):
        return len(values) > 0 and isinstance(values[0], datetime.date | np.datetime64)
    if getattr(getattr(values, "dtype", None), "kind", "") == "O":
        return np.size(values) > 0 and isinstance(np.asarray(values).flat[0], datetime.date)
    return bool(getattr(getattr(values, "dtype", None), "kind", "") == "M")
