"""CSV to times and values: strictly increasing, finite or missing, and read alike whatever part of the file is held at once."""

import io

import numpy as np

from fuzz.oracle import value_or_one_line
from zakai.errors import InputError
from zakai.records import csv
from zakai.records.numbers import LARGEST


def one_input(data: bytes) -> None:
    found = value_or_one_line(lambda: _read(data))
    usual, csv._AT_ONCE = csv._AT_ONCE, 7
    try:
        again = value_or_one_line(lambda: _read(data))
    finally:
        csv._AT_ONCE = usual
    if isinstance(found, InputError):
        assert str(found).startswith("r.csv: ") and str(again) == str(found)
        return
    table, row = found
    assert table.ndim == 2 and table.shape[1] == 3 and len(table) and row >= 2
    assert again[1] == row and again[0].tobytes() == table.tobytes()
    assert (np.diff(table[:, 0]) > 0).all() and np.isfinite(table[:, 0]).all()
    assert not (np.abs(table) > LARGEST).any()


def _read(data: bytes):
    file = io.TextIOWrapper(io.BytesIO(data), encoding="utf-8-sig", errors="surrogateescape", newline=None)
    return csv.table_of(file, "r.csv", 2, "observations")
