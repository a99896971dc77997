"""Known inputs from CSV files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from zakai.errors import InputError
from zakai.records.csv import Dates, read_table
from zakai.records.dates import Clock
from zakai.records.header import header_of
from zakai.records.inputs import Inputs
from zakai.records.writing import shown

if TYPE_CHECKING:
    from zakai.models.model import Model


def read_inputs(path: str | os.PathLike[str], model: Model, clock: Clock | None = None) -> Inputs:
    """Read the inputs of a model from a CSV file: `time`, then one column for each input, in any order.

    Args:
        path: the file.
        model: says the names of the inputs.
        clock: of a record with dates, for ISO dates in the column `time`.

    Raises:
        InputError: the file, or its first bad row by its line number, cannot be used, or an input is missing.
    """
    path = Path(path)
    if not model.inputs:
        raise InputError(f"{shown(path)}: {model.source} has no inputs; leave --inputs out, or name them in the model")
    names = header_of(path)
    missing = [name for name in model.inputs if name not in names[1:]]
    if missing:
        raise InputError(
            f"{shown(path)}: row 1: no column for the input {', '.join(missing)}; give time, {', '.join(model.inputs)}"
        )
    wanted = names[1:] if sorted(names[1:]) == sorted(model.inputs) else model.inputs
    dates = None if clock is None else Dates(clock.unit, clock.origin)
    table, row = read_table(path, len(model.inputs), "inputs", wanted, dates)
    values = table[:, 1:][:, [wanted.index(name) for name in model.inputs]]
    gaps = np.isnan(values).any(axis=1)
    if gaps.any():
        raise InputError(f"{shown(path)}: row {row + int(np.argmax(gaps))}: an input is missing; fill it or leave the row out")
    return Inputs(table[:, 0], values)
