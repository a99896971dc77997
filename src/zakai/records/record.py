"""What was observed, when, and in which of the four readings."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from zakai.errors import InputError

if TYPE_CHECKING:
    from zakai.records.inputs import Inputs

KINDS = ("increments", "path", "rates", "samples")

# A filter squares what it reads and sums the squares; beyond this their sum is no longer a float64.
LARGEST = 1e150


@dataclass(frozen=True, eq=False)
class Record:
    """Observations at strictly increasing times, the second of the two things that a filter takes.

    What row k holds depends on `kind`: the increment y(t_k) - y(t_{k-1}) of dy = h dt + dw (`increments`),
    y(t_k) itself (`path`), the increment over the length of its interval (`rates`), or a sample
    z_k = h(x(t_k), t_k) + r_k (`samples`).

    Arguments:
        times: (K,), in the model's unit of time, strictly increasing, at least one.
        values: (K, m), in the model's units; nan, or a masked cell, is "this coordinate was not observed here". (K,) is taken
            as (K, 1).
        kind: "increments" (the default), "path", "rates" or "samples".
        inputs: a `zakai.Inputs` for a model with known inputs.

    Both arrays are copied to float64 and cannot be written to.

    Raises:
        InputError: a wrong shape or kind, times that do not increase, or a number that is infinite or beyond
            1e150 in size.

    Example:
        >>> import numpy as np
        >>> from zakai.records import Record
        >>> Record([0.1, 0.2, 0.5], [[1.0], [np.nan], [0.7]], "samples").values.shape
        (3, 1)
    """

    times: np.ndarray
    values: np.ndarray
    kind: str = "increments"
    inputs: Inputs | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"record: kind is {self.kind!r}; it must be one of {', '.join(KINDS)}")
        times, values = _numbers(self.times, "times"), _numbers(self.values, "values")
        if values.ndim == 1:
            values = values[:, np.newaxis]
        if times.ndim != 1 or times.size == 0:
            raise InputError(f"record: times has shape {times.shape}; expected (K,) with at least one time")
        if values.ndim != 2 or len(values) != len(times) or values.shape[1] == 0:
            raise InputError(f"record: values has shape {values.shape}; expected ({len(times)}, m)")
        fault = first_fault(times, values)
        if fault is not None:
            raise InputError(f"record: row {fault[0]}, counted from 0: {fault[1]}")
        times.flags.writeable = values.flags.writeable = False
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "values", values)

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        span = f"{float(self.times[0])!r} to {float(self.times[-1])!r}"
        return f"Record({len(self)} rows x {self.values.shape[1]} {self.kind}, times {span})"

    def check(self, model: Any) -> None:
        """Refuse a record that `model` cannot have made: another kind or m, or too early times."""
        if self.kind != model.observation_kind:
            raise InputError(f"record: holds {self.kind}; the model observes {model.observation_kind}")
        if self.values.shape[1] != model.m:
            expected = f"expected ({len(self)}, {model.m})"
            raise InputError(f"record: values has shape {self.values.shape}; {expected}")
        fault = early(self.times[0], self.kind, model.start)
        if fault is not None:
            raise InputError(f"record: row 0: {fault}")
        self.check_law(model)

    def check_law(self, model: Any) -> None:
        """Refuse a record without the model's inputs, or with values that its observation family cannot have."""
        if self.inputs is not None or model.inputs:
            from zakai.records.inputs import check_inputs

            check_inputs(model, self.inputs, float(self.times[-1]))
        if self.kind == "samples" and not model.observation_law.is_gaussian:
            model.observation_law.check(self.values)

    @classmethod
    def from_pandas(cls, frame: Any, kind: str) -> Record:
        """A record from a DataFrame: its column `time` or else its index, and the other columns as values.

        Arguments:
            frame: a pandas DataFrame of K rows; missing values are not-observed.
            kind: as for `Record`.

        Raises:
            InputError: as `Record` does; or times that are dates (give numbers), or a missing pandas.

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
        times = frame["time"] if "time" in frame.columns else frame.index.to_series()
        rest = frame.drop(columns="time", errors="ignore")
        columns = [_column(rest.iloc[:, i], f"column {rest.columns[i]!r}") for i in range(rest.shape[1])]
        values = np.column_stack(columns) if columns else np.empty((len(frame), 0))
        return cls(_column(times, "time"), values, kind)

    @classmethod
    def from_xarray(cls, data: Any, kind: str) -> Record:
        """A record from a DataArray over (time,) or (time, channel), or a Dataset of variables over `time`.

        Arguments:
            data: an xarray DataArray or Dataset with a numeric coordinate `time` (K,); nan is not-observed.
            kind: as for `Record`.

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
        columns = []
        for part in parts:
            if "time" not in part.dims or part.ndim > 2:
                what = f"{part.name} has dimensions {part.dims}; expected (time,) or (time, channel)"
                raise InputError(f"Record.from_xarray: {what}")
            values = _numbers(part.transpose("time", ...).values, str(part.name))
            columns.append(values.reshape(data.sizes["time"], -1))
        values = np.concatenate(columns, axis=1) if columns else np.empty((data.sizes["time"], 0))
        return cls(_numbers(data["time"].values, "time"), values, kind)

    def to_csv(self, path: str | os.PathLike[str], names: list[str] | None = None) -> None:
        """Write the record as the CSV that `read_record` reads back bit for bit; see `write_record`."""
        from zakai.records.writing import write_record

        write_record(path, self, names)


def first_fault(times: np.ndarray, values: np.ndarray) -> tuple[int, str] | None:
    """The first row (from 0) that no record may hold, and what is wrong with it; None if all are good."""
    rising = np.ones(len(times), dtype=bool)
    rising[1:] = times[1:] > times[:-1]
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
            return row, f"the time {time!r} repeats the time before it; times must be strictly increasing: leave one row out"
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


def _numbers(array: Any, name: str, what: str = "record") -> np.ndarray:
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


def _column(series: Any, name: str) -> np.ndarray:
    """A pandas column as float64, its missing values (None and NA included) as nan."""
    plain = isinstance(series.dtype, np.dtype) and series.dtype.kind != "O"
    return _numbers(series.to_numpy() if plain else series.to_numpy(dtype=object, na_value=np.nan), name)
