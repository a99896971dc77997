"""A result as a table: a row for each time, moments and quantiles in columns."""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from zakai.records.writing import atomic_write

if TYPE_CHECKING:
    from zakai.engine.results import FilterResult


def columns_of(result: FilterResult, quantiles: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the columns: the mean, the deviation and the quantiles of each state, then the increments of the log-likelihood.

    `quantiles` are `level` and `quantile` as variables of a file, or nothing.
    """
    found = {}
    for i, name in enumerate(result.state):
        found[name] = result.mean[:, i]
        found[f"{name}_deviation"] = np.sqrt(np.maximum(result.variance[:, i], 0.0))
        if quantiles:
            levels, values = quantiles["level"][1], quantiles["quantile"][1]
            found |= {f"{name}_q{level:g}": one[:, i] for level, one in zip(levels, values, strict=True)}
    found["log_likelihood_increment"] = result.log_likelihood_increments
    return found


def save_table(result: FilterResult, path: str | os.PathLike[str], quantiles: Mapping[str, Any]) -> None:
    """Write a result as CSV, atomically; times are ISO dates where the record has dates."""
    columns = columns_of(result, quantiles)
    times = result.times.tolist() if result.dates is None else [str(date) for date in result.dates]
    rows = np.column_stack(list(columns.values())).tolist()
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["time", *columns])
        for time, row in zip(times, rows, strict=True):
            table.writerow([time, *("" if value != value else value for value in row)])
