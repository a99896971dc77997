"""A table of results for the same record: which model or method predicts it best."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from zakai import _display
from zakai.engine.results import FilterResult
from zakai.errors import InputError
from zakai.models.numeric import numpy_function

if TYPE_CHECKING:
    import pandas

COLUMNS = ("method", "observations", "log-likelihood", "difference", "warnings")


class Row(NamedTuple):
    """One result of a comparison; `difference` is that to the largest log-likelihood, at most zero."""

    name: str
    method: str
    observations: int
    log_likelihood: float
    difference: float
    warnings: int


class Comparison:
    """A table of log-likelihoods; `rows` are in the order that was given."""

    def __init__(self, rows: Sequence[Row]):
        self.rows = tuple(rows)

    def __len__(self) -> int:
        return len(self.rows)

    def _cells(self) -> list[tuple[str, ...]]:
        return [
            (one.name, one.method, str(one.observations), f"{one.log_likelihood:.4f}", f"{difference:.4f}", str(one.warnings))
            for one, difference in ((row, round(row.difference, 4) + 0.0) for row in self.rows)
        ]

    def __repr__(self) -> str:
        table = [("", *COLUMNS), *self._cells()]
        widths = [max(len(line[column]) for line in table) for column in range(len(table[0]))]
        lines = [
            "  ".join(cell.ljust(width) if i < 2 else cell.rjust(width) for i, (cell, width) in enumerate(zip(line, widths)))
            for line in table
        ]
        return "\n".join(line.rstrip() for line in lines)

    def _repr_html_(self) -> str:
        return _display.html_table("Comparison", ("", *COLUMNS), self._cells())

    def to_pandas(self) -> pandas.DataFrame:
        """Return the table as a DataFrame, with the names as its index.

        Raises:
            InputError: pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise InputError("Comparison.to_pandas needs pandas: pip install 'zakai[pandas]'") from None
        return pandas.DataFrame(self.rows).set_index("name")


def compare(results: Sequence[FilterResult] | Mapping[str, FilterResult]) -> Comparison:
    """Return a table of the log-likelihoods of results for one record, and their differences to the largest.

    Args:
        results: at least two results, or a dictionary of them by name.

    Raises:
        InputError: the results are for different records, or for increments with different noises: the log-likelihood of
            increments is relative to their noise.

    Example:
        print(zakai.compare({"linear": zakai.filter(a, record), "cubic": zakai.filter(b, record)}))
    """
    if isinstance(results, FilterResult):
        raise InputError("compare: 1 result; give a list of at least two for the same record")
    named = dict(results) if isinstance(results, Mapping) else None
    listed: list[FilterResult] = list(results if named is None else named.values())  # type: ignore[arg-type]
    for result in listed:
        if not isinstance(result, FilterResult):
            raise InputError(f"compare: expected results of zakai.filter, got a {type(result).__name__}")
    if len(listed) < 2:
        raise InputError(f"compare: {len(listed)} results; give at least two for the same record")
    names = list(named) if named is not None else _names(listed)
    for name, result in zip(names[1:], listed[1:], strict=True):
        _check_same(names[0], listed[0], name, result)
    best = max((result.log_likelihood for result in listed if np.isfinite(result.log_likelihood)), default=np.nan)
    return Comparison(
        [
            Row(name, one.method, len(one.times) - 1, one.log_likelihood, one.log_likelihood - best, len(one.warnings))
            for name, one in zip(names, listed, strict=True)
        ]
    )


def _names(results: Sequence[FilterResult]) -> list[str]:
    """Return the models' names, with numbers where they are not unique."""
    names = [result.model.name if result.model is not None and result.model.name else "result" for result in results]
    return [name if names.count(name) == 1 else f"{name} {names[: i + 1].count(name)}" for i, name in enumerate(names)]


def _check_same(first_name: str, first: FilterResult, name: str, other: FilterResult) -> None:
    """Raise InputError unless two results have one record and one reference of their log-likelihoods."""
    fault = ""
    if len(first.times) != len(other.times) or not np.array_equal(first.times[1:], other.times[1:]):
        fault = "have different times"
    elif first.record is not None and other.record is not None:
        if first.record.kind != other.record.kind:
            fault = f"are for {first.record.kind} and {other.record.kind}"
        elif not np.array_equal(first.record.values, other.record.values, equal_nan=True):
            fault = "have different observations"
    if fault:
        raise InputError(f"compare: {first_name} and {name} {fault}; give results for the same record")
    noises = []
    for result in (first, other):
        model = result.model
        if model is None or model.observation_kind == "samples":
            return
        function = numpy_function(model.observation_noise, model, model.observation_noise.shape)
        points, inputs = np.zeros((len(result.times), model.n)), None
        if model.inputs:
            inputs = np.zeros((len(result.times), len(model.inputs)))
        noises.append(np.real(function(points, result.times, model.theta(), inputs)))
    if not np.allclose(noises[0], noises[1], rtol=1e-9, atol=0.0):
        raise InputError(
            f"compare: {first_name} and {name} have different observation noises; the log-likelihood of increments is relative "
            "to the noise, so that only results with the same noise can be compared"
        )
