"""Observations, their times, and of which of the four kinds they are."""

from __future__ import annotations

import os
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from zakai import _display
from zakai.errors import InputError
from zakai.models._errors import listing, named
from zakai.records.columns import observed_columns
from zakai.records.dates import Clock, read_times
from zakai.records.dialect import TIMES
from zakai.records.inputs import Inputs, check_inputs, expected_inputs
from zakai.records.numbers import LARGEST, numbers_in_time, real_numbers
from zakai.records.writing import default_names, write_table

KINDS = ("increments", "path", "rates", "samples")


@dataclass(frozen=True, eq=False)
class Record:
    """Observations at increasing times.

    Samples of several sensors at one time may be rows with equal times: each is a factor of its own, in their order.  Of the
    other kinds times increase strictly.

    What row k holds depends on `kind`: the increment y(t_k) - y(t_{k-1}) of dy = h dt + dw (`increments`),
    y(t_k) itself (`path`), the increment over the length of its interval (`rates`), or a sample
    z_k = h(x(t_k), t_k) + r_k (`samples`).

    Args:
        times: (K,), in the model's unit of time, increasing, at least one; or dates (pandas, NumPy, `datetime` or ISO
            texts), with a `unit`.
        values: (K, m), in the model's units; nan, or a masked cell, is "this coordinate was not observed here". (K,) is taken
            as (K, 1).
        kind: "increments", "path", "rates" or "samples"; by default that of the model with which it is used.
        inputs: a `zakai.Inputs` for a model with known inputs.
        unit: the model's unit of time, for dates: "ns", "us", "ms", "s", "min", "h", "d", "week" or "year" (365.25 days).
        origin: the date at which t = 0, by default the first date.  Dates with a time zone are taken in UTC.
        names: the names of the columns of `values`, by which they are matched to the observations of a model; without names they
            are in the order of the observations.

    Both arrays are copied to float64 and cannot be written to.

    Raises:
        InputError: a wrong shape or kind, times that do not increase, a number that is infinite or beyond 1e150 in size, or
            dates without a unit.

    Example:
        >>> import numpy as np
        >>> from zakai.records import Record
        >>> Record([0.1, 0.2, 0.5], [[1.0], [np.nan], [0.7]], "samples").values.shape
        (3, 1)
        >>> Record(np.array(["2024-01-31T00", "2024-01-31T06"], "M8[h]"), [0.5, 0.7], "samples", unit="d").times.tolist()
        [0.0, 0.25]
    """

    times: np.ndarray
    values: np.ndarray
    kind: str | None = None
    inputs: Inputs | None = None
    unit: str | None = None
    origin: Any = None
    names: Sequence[str] | None = None
    _note: str = field(default="", init=False)
    _dates: np.ndarray | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        if self.kind is not None and self.kind not in KINDS:
            raise InputError(f"record: kind is {self.kind!r}; it must be one of {', '.join(KINDS)}")
        given, clock, dates = read_times(self.times, self.unit, self.origin)
        times, values = numbers_in_time(given, self.values, "record", "(K,)", "m")
        fault = first_fault(times, values, self.kind in (None, "samples"))
        if fault is not None:
            raise InputError(f"record: row {fault[0]}, counted from 0: {fault[1]}")
        times.flags.writeable = values.flags.writeable = False
        found: dict[str, Any] = {"times": times, "values": values, "_dates": dates}
        if self.inputs is not None:
            found["inputs"] = expected_inputs(self.inputs, "record: inputs").on(clock)
        if self.names is not None:
            found["names"] = tuple(map(str, self.names))
            if len(found["names"]) != values.shape[1]:
                raise InputError(f"record: {len(found['names'])} names for {values.shape[1]} columns; give one for each")
        found |= {"unit": None, "origin": None} if clock is None else clock._asdict()
        for name, value in found.items():
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        first, last = self._when(0), self._when(-1)
        return f"Record({len(self)} rows x {self.values.shape[1]} {self.kind or 'observations'}, times {first} to {last})"

    def _repr_html_(self) -> str:
        rows = [(self._when(k), *map(_display.number, self.values[k])) for k in range(min(len(self), _display.MOST_ROWS))]
        header = ["time" if self.clock is None else "date", *(self.names or default_names(self.values.shape[1]))]
        return _display.html_table(repr(self), header, rows, total=len(self))

    def _when(self, row: int) -> str:
        return repr(float(self.times[row])) if self.dates is None else _date_text(self.dates[row])

    @property
    def clock(self) -> Clock | None:
        """The unit and the date at which t = 0, of a record with dates."""
        return None if self.unit is None else Clock(self.origin, self.unit)

    @cached_property
    def dates(self) -> np.ndarray | None:
        """The dates (K,) of the observations as datetime64, of a record with dates."""
        if self._dates is not None or self.clock is None:
            return self._dates
        return self.clock.dates(self.times)

    def of(self, model: Any) -> Record:
        """Return the record with the kind of a model and its columns in the order of the model's observations.

        Raises:
            InputError: neither says the kind, they differ, or the columns are not the observations.
        """
        kind = self.kind
        if kind is None:
            check_kind(model)
            kind = model.observation_kind
        elif kind != model.observation_kind and not model.kind_given:
            raise InputError(f'record: holds {kind}, and the model does not say so; give it observation_kind = "{kind}"')
        if self.names is None and kind == self.kind:
            return self
        found = copy(self)
        object.__setattr__(found, "kind", kind)
        if self.names is not None:
            with named("record"):
                places, note = observed_columns(self.names, model.observation_names, model.inputs)
            values = self.values[:, places]
            values.flags.writeable = False
            for name, value in (("values", values), ("names", None), ("_note", note)):
                object.__setattr__(found, name, value)
        return found

    def with_inputs(self, inputs: Inputs | None) -> Record:
        """Return the record with these known inputs in place of its own; itself for None.

        Raises:
            InputError: something else than `zakai.Inputs`, or inputs with dates where the record has none.
        """
        if inputs is None:
            return self
        other = copy(self)
        object.__setattr__(other, "inputs", expected_inputs(inputs).on(self.clock))
        return other

    def check(self, model: Any) -> None:
        """Refuse a record that `model` cannot have made.

        It has another kind or m, too early times, not the model's inputs, or values that the observation family cannot have.
        """
        if self.kind != model.observation_kind:
            wanted = model.observation_kind
            raise InputError(f"record: holds {self.kind}; the model observes {wanted}; give the record kind={wanted!r}")
        if self.values.shape[1] != model.m:
            raise InputError(f"record: values has shape {self.values.shape}; the model needs ({len(self)}, {model.m})")
        too_early = early(self.times[0], model.observation_kind, model.start)
        if too_early is not None:
            hint = "" if self.unit is None else "; give the date at which t = 0 as origin"
            raise InputError(f"record: row 0, counted from 0: {too_early}{hint}")
        if model.observation_kind != "samples" and (np.diff(self.times) == 0).any():
            fault = first_fault(self.times, self.values)
            if fault is not None:
                raise InputError(f"record: row {fault[0]}, counted from 0: {fault[1]}")
        if self.inputs is not None or model.inputs:
            check_inputs(model, self.inputs, float(self.times[0]), float(self.times[-1]))
        fault = self.fault_of_law(model)
        if fault is not None:
            raise InputError(f"record: row {fault[0]}, counted from 0: {fault[1]}")

    def fault_of_law(self, model: Any) -> tuple[int, str] | None:
        """Return the first row with a value that the model's observation family cannot have, and why, or None."""
        lawless = self.kind != "samples" or model.observation_law.is_gaussian
        return None if lawless else model.observation_law.fault(self.values)

    @classmethod
    def from_pandas(
        cls,
        frame: Any,
        kind: str | None = None,
        unit: str | None = None,
        origin: Any = None,
        *,
        columns: Sequence[str] | None = None,
        inputs: Sequence[str] = (),
    ) -> Record:
        """Return a record from a DataFrame: its column `time`, `t` or `date`, else its index, and the other columns as values.

        Args:
            frame: a pandas DataFrame of K rows; missing values are not-observed.
            kind: as for `Record`.
            unit: as for `Record`, for dates.
            origin: as for `Record`, for dates.
            columns: the columns to take, in the order of the observations; without it they are matched by the names of the
                observations, in any order, if these are their names, and else taken by their position.
            inputs: names of the columns that are the model's known inputs, in its order.  The first row holds from the model's
                start, and a row without inputs changes nothing.

        Raises:
            InputError: as `Record` does, or pandas is not installed.

        Example:
            >>> import pandas
            >>> from zakai.records import Record
            >>> Record.from_pandas(pandas.DataFrame({"time": [1.0, 2.0], "y": [0.5, None]}), "samples")
            Record(2 rows x 1 samples, times 1.0 to 2.0)
        """
        try:
            import pandas
        except ImportError:
            raise InputError("Record.from_pandas needs pandas: pip install 'zakai[pandas]'") from None
        if not isinstance(frame, pandas.DataFrame):
            raise InputError(f"Record.from_pandas takes a DataFrame, not {type(frame).__name__}")
        known_times = [name for name in frame.columns if str(name).strip().lower() in TIMES]
        if len(known_times) > 1:
            listed = listing(map(str, known_times))
            raise InputError(f"Record.from_pandas: the columns {listed} may all be the time; drop all but one")
        times = frame[known_times[0]] if known_times else frame.index.to_series()
        rest = frame.drop(columns=known_times)
        inputs = [inputs] if isinstance(inputs, str) else list(inputs)
        for name in inputs:
            if list(rest.columns).count(name) != 1:
                raise InputError(f"Record.from_pandas: inputs: {name!r} is not one of the columns {listing(rest.columns)}")
        known = [_column(rest[name], f"column {name!r}") for name in inputs]
        rest = rest.drop(columns=inputs)
        if columns is not None:
            rest = rest[_known_columns(columns, list(rest.columns))]
        else:
            _check_numbers(rest)
        read = [_column(rest.iloc[:, i], f"column {rest.columns[i]!r}") for i in range(rest.shape[1])]
        values = np.column_stack(read) if read else np.empty((len(frame), 0))
        dated = times.dtype.kind in "mM"
        if dated:
            read_times(times.to_numpy(), unit, origin, "Record.from_pandas")
        when = times if dated else _column(times, "time")
        given = Inputs.of_rows(times.to_numpy() if dated else when, np.column_stack(known), unit, origin) if known else None
        names = None if columns is not None else list(rest.columns)
        return cls(when, values, kind, given, unit, origin, names=names)

    @classmethod
    def from_xarray(cls, data: Any, kind: str | None = None, unit: str | None = None, origin: Any = None) -> Record:
        """Return a record from a DataArray over (time,) or (time, channel), or a Dataset of variables over `time`.

        Args:
            data: an xarray DataArray or Dataset with a coordinate `time` (K,) of numbers or dates; nan is not-observed.
            kind: as for `Record`.
            unit: as for `Record`, for dates.
            origin: as for `Record`, for dates.

        Raises:
            InputError: as `Record` does; or no coordinate `time`, or another dimension too many.

        Example:
            >>> import xarray
            >>> from zakai.records import Record
            >>> Record.from_xarray(xarray.DataArray([0.5, 0.7], coords={"time": [1.0, 2.0]}), "samples")
            Record(2 rows x 1 samples, times 1.0 to 2.0)
        """
        import xarray

        if not isinstance(data, xarray.DataArray | xarray.Dataset):
            raise InputError(f"Record.from_xarray takes a DataArray or a Dataset, not {type(data).__name__}")
        if "time" not in data.coords or "time" not in data.dims:
            raise InputError("Record.from_xarray: there is no dimension time with a coordinate of that name")
        parts = list(data.data_vars.values()) if isinstance(data, xarray.Dataset) else [data]
        columns, names = [], list[str]()
        for part in parts:
            if "time" not in part.dims or part.ndim > 2:
                what = f"{part.name} has dimensions {part.dims}; expected (time,) or (time, channel)"
                raise InputError(f"Record.from_xarray: {what}")
            values = real_numbers(part.transpose("time", ...).values, str(part.name))
            columns.append(values.reshape(data.sizes["time"], -1))
            names += _names_of(part)
        values = np.concatenate(columns, axis=1) if columns else np.empty((data.sizes["time"], 0))
        known = names if len(names) == values.shape[1] else None
        return cls(data["time"].values, values, kind, unit=unit, origin=origin, names=known)

    def to_csv(self, path: str | os.PathLike[str], names: list[str] | None = None) -> None:
        """Write the record as the CSV that `read_record` reads back bit for bit; see `write_record`."""
        own = self.names or default_names(self.values.shape[1])
        write_table(path, self.times, self.values, list(own if names is None else names), self.dates)


def write_record(path: str | os.PathLike[str], record: Record, names: list[str] | None = None) -> None:
    """Write a record as CSV, atomically; `read_record` gives the same float64 numbers back, bit for bit.

    Arguments:
        path: the file to write.
        record: times (K,) and values (K, m); nan becomes an empty cell.
        names: m column names, y1 to ym if not given.

    Raises:
        InputError: the file cannot be written, or there are not m names.

    Example:
        >>> import tempfile, pathlib
        >>> from zakai.records import Record, write_record
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "record.csv"
        >>> write_record(path, Record([0.1, 0.3], [[1.5], [float("nan")]], "samples"), ["range"])
        >>> path.read_text().split()
        ['time,range', '0.1,1.5', '0.3,']
    """
    record.to_csv(path, names)


def _date_text(date: np.datetime64) -> str:
    """Return a date to the second, without the time of day at midnight."""
    return str(date.astype("datetime64[s]")).removesuffix("T00:00:00")


def first_fault(times: np.ndarray, values: np.ndarray, equal: bool = False) -> tuple[int, str] | None:
    """The first row (from 0) that no record may hold, and what is wrong with it; None if all are good.

    Times may be `equal` in records of samples, of which each row is a factor of its own.
    """
    rising = np.ones(len(times), dtype=bool)
    rising[1:] = times[1:] >= times[:-1] if equal else times[1:] > times[:-1]
    good = rising & (np.abs(times) <= LARGEST) & ~(np.abs(values) > LARGEST).any(axis=1)
    if good.all():
        return None
    row = int(np.argmin(good))
    time = float(times[row])
    if np.isnan(time):
        return row, "the time is missing; every row needs one"
    if abs(time) > LARGEST:
        return row, f"the time is {time!r}; times must be finite and at most {LARGEST:g} in size"
    if not rising[row]:
        before = float(times[row - 1])
        if time == before:
            what = f"the time {time!r} repeats the time before it"
            return row, f"{what}; times must be strictly increasing: merge them into one row"
        return row, f"the time {time!r} comes after the time {before!r}; times must be strictly increasing: sort the rows"
    column = int(np.argmax(np.abs(values[row]) > LARGEST))
    return row, (
        f"observation {column + 1} is {float(values[row, column])!r}; values must be finite and at most "
        f"{LARGEST:g} in size, or nan (in a file, an empty cell) where nothing was observed"
    )


def early(first: float, kind: str, start: float) -> str | None:
    """What is wrong with the first time of a record of this kind for a model's `start`, or None."""
    if first > start or (kind == "samples" and first == start):
        return None
    need = "at or after" if kind == "samples" else "after"
    return f"the time {float(first)!r} must be {need} the model's start {float(start)!r}"


def check_kind(model: Any) -> None:
    """Raise InputError where a model does not say of what kind an observation is."""
    if not model.kind_given:
        raise InputError(
            f'{model.source}: observation_kind: missing; give "samples" if an observation is h + noise at its time, and for '
            'dy = h dt + dw "increments" if it is the change of y since the last one, "path" if it is y, "rates" if it is that '
            "change over its time"
        )


def _known_columns(columns: Any, known: list[Any]) -> list[Any]:
    wanted = [columns] if isinstance(columns, str) else list(columns)
    for name in wanted:
        if known.count(name) != 1 or wanted.count(name) != 1:
            what = "is not one of" if name not in known else "is there twice among"
            raise InputError(f"Record.from_pandas: columns: {name!r} {what} the columns {listing(map(str, known))}")
    return wanted


def _check_numbers(frame: Any) -> None:
    """Refuse a frame that has columns of something else than numbers among those that may be observations."""
    numbers = [name for name, kind in frame.dtypes.items() if getattr(kind, "kind", "O") in "biuf"]
    for i, name in enumerate(frame.columns):
        try:
            _column(frame.iloc[:, i], "")
        except InputError:
            if not numbers:  # nothing to choose from
                return
            wanted = ", ".join(map(repr, numbers))
            raise InputError(
                f"Record.from_pandas: column {name!r} holds no numbers; make them by pandas.to_numeric, or name the "
                f"columns of the observations, as in columns=[{wanted}]"
            ) from None


def _names_of(part: Any) -> list[str]:
    """The name of a variable over time, or the labels of its channels where these are texts."""
    if part.ndim == 1:
        return [] if part.name is None else [str(part.name)]
    labels = part.coords.get(next(name for name in part.dims if name != "time"))
    return [] if labels is None or labels.dtype.kind not in "UO" else list(map(str, labels.values))


def _column(series: Any, name: str) -> np.ndarray:
    """A pandas column as float64, its missing values (None and NA included) as nan."""
    plain = isinstance(series.dtype, np.dtype) and series.dtype.kind != "O"
    return real_numbers(series.to_numpy() if plain else series.to_numpy(dtype=object, na_value=np.nan), name)
