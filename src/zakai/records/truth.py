"""The true path of the state as CSV, where it is known: `time`, then one column a state, of its name."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zakai import _display
from zakai.errors import InputError
from zakai.records.csv import Dates, read_table
from zakai.records.record import Record
from zakai.records.writing import shown, write_table


@dataclass(frozen=True, eq=False, repr=False)
class Truth:
    """A path of the state: `times` (K+1,), the start first, `values` (K+1, n), the names of the states; angles in (-pi, pi]."""

    times: np.ndarray
    values: np.ndarray
    names: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        first, last = (_display.number(self.times[k]) for k in (0, -1))
        what = _display.short_names(self.names) or _display.counted(self.values.shape[1], "state")
        return f"Truth({what} at {_display.counted(len(self), 'time')}, {first} to {last})"

    def _repr_html_(self) -> str:
        names = self.names or tuple(f"x{i + 1}" for i in range(self.values.shape[1]))
        few = slice(_display.MOST_ROWS)
        rows = [tuple(map(_display.number, (time, *row))) for time, row in zip(self.times[few], self.values[few], strict=True)]
        return _display.html_table(repr(self), ("time", *names), rows, total=len(self))


def read_truth(path: str | os.PathLike[str], model: Any, record: Record | None = None) -> Truth:
    r"""Read the true states of `model` from a CSV file.

    The header is `time` and the names of the states in their order; the rules are those of `read_record`: an
    empty cell or `nan` is "not known", and times need not be those of the record.

    Args:
        path: the CSV file.
        model: the system.
        record: the record of these states; one of its times at least is among theirs, and if its times are dates, so are theirs.

    Raises:
        InputError: the file, or its first bad row by its line number, cannot be used.

    Example:
        >>> import zakai, tempfile, pathlib
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "truth.csv"
        >>> _ = path.write_text("time,x\n0,0.1\n0.1,0.2\n")
        >>> read_truth(path, zakai.load_model("gallery:benes")).values.shape
        (2, 1)
    """
    dates = None if record is None or record.clock is None else Dates(record.clock.unit, record.clock.origin)
    table, _ = read_table(Path(path), model.n, "states", model.state, dates=dates)
    truth = Truth(table[:, 0], table[:, 1:], model.state)
    if record is not None:
        times = np.concatenate([[model.start], record.times])
        nearest = truth.times[np.clip(np.searchsorted(truth.times, times - 1e-9 * np.abs(times)), 0, len(truth) - 1)]
        if not np.isclose(nearest, times, rtol=1e-9, atol=1e-12).any():
            raise InputError(f"{shown(path)}: none of its times is one of the record; give the states at the times of the record")
    return truth


def write_truth(path: str | os.PathLike[str], truth: Truth, names: Sequence[str]) -> None:
    """Write the true states, atomically, so that `read_truth` gives them back bit for bit.

    `names` are those of the states. Raises InputError if the file cannot be written.
    """
    write_table(path, truth.times, truth.values, names)
