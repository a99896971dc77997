"""The true path of the state as CSV, where it is known: `time`, then one column a state, of its name."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from zakai.models.simulate import Truth
from zakai.records.csv import read_table
from zakai.records.writing import write_table


def read_truth(path: str | os.PathLike[str], model: Any) -> Truth:
    """Read the true states of `model` from a CSV file.

    The header is `time` and the names of the states in their order; the rules are those of `read_record`: an
    empty cell or `nan` is "not known", and times need not be those of the record.

    Raises InputError: the file, or its first bad row by its line number, cannot be used.

        >>> import zakai, tempfile, pathlib
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "truth.csv"
        >>> _ = path.write_text("time,x\\n0,0.1\\n0.1,0.2\\n")
        >>> read_truth(path, zakai.load_model("gallery:benes")).values.shape
        (2, 1)
    """
    table, _ = read_table(Path(path), model.n, "states", model.state)
    return Truth(table[:, 0], table[:, 1:])


def write_truth(path: str | os.PathLike[str], truth: Truth, names: Sequence[str]) -> None:
    """Write the true states, atomically, so that `read_truth` gives them back bit for bit.

    `names` are those of the states. Raises InputError if the file cannot be written.
    """
    write_table(path, truth.times, truth.values, names)
