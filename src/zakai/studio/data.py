"""The record that a request names: simulated, or columns of a file that was given to the studio."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from zakai.errors import InputError
from zakai.models._errors import listing
from zakai.models.clock import clock
from zakai.models.model import Model
from zakai.records import Inputs, Record, Truth, read_truth
from zakai.records.csv import Dates, clock_of, read_table
from zakai.records.dates import date_of, usual_unit
from zakai.records.dialect import dialect_of
from zakai.records.header import cells_of, header_of
from zakai.records.numbers import NUMBER
from zakai.report.charts import clock_header
from zakai.simulation.simulate import simulate
from zakai.studio.time_column import with_time

MOST_ROWS, MOST_COLUMNS = 1_000_000, 200
MOST_SIMULATED = 200_000  # observations that are drawn on demand
# Rows of a file that are shown, those of which the dates say the unit of time, and points of a column that are drawn.
PREVIEWED, JUDGED, MOST_DRAWN = 6, 200, 2_000
_IDENTIFIER = re.compile(r"[0-9a-f]{32}")


class Given(NamedTuple):
    """A record, the true states where they are known, and what it is called."""

    record: Record
    truth: Truth | None
    name: str


def given(model: Model, request: Mapping[str, Any], folder: Path) -> Given:
    """Return the record that `request` describes for a model.

    Args:
        model: the system.
        request: `{"kind": "simulate", "until", "step", "seed", "inputs", "from"}`, the last the text of another model that
            simulates the record, or
            `{"kind": "file", "file", "columns", "inputs", "unit", "origin", "time", "truth": {"file", "name"}}`.
        folder: where the files are that were given to the studio.

    Raises:
        InputError: the record cannot be used, with its row.
    """
    if request.get("kind") == "file":
        return _of_file(model, request, folder)
    until, step = (_number(request.get(key), key) for key in ("until", "step"))
    times = clock(model.start, until, step, ("simulate: until", "simulate: step"))
    if len(times) > MOST_SIMULATED:
        raise InputError(f"simulate: {len(times):,} observations; at most {MOST_SIMULATED:,} are drawn here: take a longer step")
    seed = request.get("seed", 0)
    if not isinstance(seed, int) or isinstance(seed, bool) or seed < 0:
        raise InputError("simulate: seed: expected a whole number of at least 0")
    inputs = None
    if model.inputs:
        values = request.get("inputs") or {}
        row = [_number(values.get(name, 0), f"input {name}") for name in model.inputs]
        inputs = Inputs(np.array([model.start]), np.array([row]))
    truth, record = simulate(model, times, seed, inputs=inputs)
    return Given(record, truth, "simulated")


def simulated_by(source: Model, found: Given, model: Model) -> Given:
    """Return the record that `source` has simulated for another model.

    Raises:
        InputError: the models have other observations or inputs.
    """
    for what, own, other in (
        ("observation_kind", source.observation_kind, model.observation_kind),
        ("the number of observations", source.m, model.m),
        ("inputs", source.inputs, model.inputs),
    ):
        if own != other:
            raise InputError(f"the record that is kept was simulated by a model with other {what}; press Simulate again")
    found.record.check(model)
    return found if source.state == model.state else found._replace(truth=None)


def _of_file(model: Model, request: Mapping[str, Any], folder: Path) -> Given:
    path = file_of(request, folder)
    names = header_of(path)
    name = str(request.get("name") or "the record")[:80]
    wanted = request.get("columns") or _matched(model, names)
    columns = [_column(names, column, name) for column in wanted]
    if len(columns) != model.m:
        raise InputError(f"{name}: {len(columns)} columns are chosen; the model has {model.m} observations: choose one for each")
    known = [_column(names, column, name) for column in (request.get("inputs") or model.inputs)]
    unit, origin = (request.get(key) or None for key in ("unit", "origin"))
    dates = None if unit is None else Dates(unit, origin)
    equal = model.observation_kind == "samples"
    try:
        table, _ = read_table(path, len(names) - 1, "observations", dates=dates, used=[0, *columns, *known], equal=equal)
    except InputError as error:  # the file has another name here
        raise InputError(str(error).replace(str(path), name)) from None
    inputs = None
    if model.inputs:
        inputs = Inputs.of_rows(table[:, 0], table[:, 1 + model.m :])
    record = Record(table[:, 0], table[:, 1 : 1 + model.m], model.observation_kind, inputs, **clock_of(dates))
    record.check(model)
    truth = request.get("truth")
    return Given(record, _truth(model, record, truth, folder) if isinstance(truth, Mapping) else None, name)


def _truth(model: Model, record: Record, request: Mapping[str, Any], folder: Path) -> Truth:
    path = file_of(request, folder)
    try:
        return read_truth(path, model, record)
    except InputError as error:
        raise InputError(str(error).replace(str(path), str(request.get("name") or "the true states")[:80])) from None


def file_of(request: Mapping[str, Any], folder: Path) -> Path:
    """Return the path of a file that was given to the studio; a request has nothing but its number."""
    number = request.get("file")
    if not isinstance(number, str) or not _IDENTIFIER.fullmatch(number) or not (folder / f"{number}.csv").is_file():
        raise InputError("the file is no longer here; drop it again")
    path, column = folder / f"{number}.csv", request.get("time")
    return with_time(path, str(column), str(request.get("name") or "the record")[:80]) if column else path


def _matched(model: Model, names: list[str]) -> list[str]:
    """Return the columns of the observations where none was chosen: those of their names, else the first that are no inputs."""
    if set(model.observation_names) <= set(names[1:]):
        return list(model.observation_names)
    return [name for name in names[1:] if name not in model.inputs][: model.m]


def _column(names: list[str], column: Any, name: str) -> int:
    if names[1:].count(column) != 1:
        what = "has no column" if column not in names[1:] else "has several columns"
        raise InputError(f"{name}: {what} {str(column)[:40]!r}; its columns are {listing(names[1:])}")
    return names.index(column)


def columns_of(request: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the names of the columns of a file, its first rows, whether its times are dates, and a unit for them."""
    path = file_of(request, folder)
    name = str(request.get("name") or "the record")[:80]
    names = header_of(path)
    if not names:
        raise InputError(f"{name}: has no header; its first line must be names, the first of them time")
    if len(names) > MOST_COLUMNS:
        raise InputError(f"{name}: {len(names):,} columns; at most {MOST_COLUMNS} are read: keep time and what was observed")
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        lines = file.read(1 << 16).split("\n")
    dialect = dialect_of(lines)
    rows: list[list[str]] = []
    if dialect is not None:
        after = dialect.translated(lines[dialect.line :])
        rows = [[cell.strip() for cell in cells_of(line)] for line in after if line.strip()][:JUDGED]
    if all(NUMBER.fullmatch(one) for one in names):
        raise InputError(f"{name}: has no header; its first line must be names, one of them the time's")
    dated = bool(rows) and date_of(rows[0][0].strip('"')) is not None
    dates = [date for row in rows if (date := date_of(row[0].strip('"'))) is not None]
    unit = usual_unit(np.array(dates, "datetime64[ns]")) if dated else None
    rows = [[cell[:24] for cell in row] for row in rows[:PREVIEWED]]
    every = header_of(file_of({**request, "time": None}, folder))
    return {"columns": names, "every": every, "rows": rows, "dated": dated, "unit": unit, "timed": names[0] == "time"}


def described(model: Model, found: Given) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return what a record holds in figures, and few enough of its points to draw them."""
    record = found.record
    steps = np.diff(record.times)
    median = float(np.median(steps)) if len(steps) else None
    missing = np.isnan(record.values)
    rows = np.unique(np.linspace(0, len(record) - 1, min(MOST_DRAWN, len(record))).astype(int))
    about = {
        "name": found.name,
        "rows": len(record),
        "first": float(record.times[0]),
        "last": float(record.times[-1]),
        "names": list(model.observation_names),
        "kind": record.kind,
        "missing": missing.sum(axis=0).tolist(),
        "unobserved": int(missing.all(axis=1).sum()),
        "step": median,
        "longest": float(steps.max()) if len(steps) else None,
        "longest_from": float(record.times[np.argmax(steps)]) if len(steps) else None,
        "irregular": bool(len(steps) and np.ptp(steps) > 1e-6 * abs(median or 1.0)),
        "unit": record.unit,
        "origin": None if record.clock is None else str(record.clock.origin)[:19],
        "clock": clock_header(record.clock),
        "truth": found.truth is not None,
    }
    return about, {"times": record.times[rows], "values": record.values[rows].astype(np.float32)}


def _number(value: Any, what: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise InputError(f"{what}: expected a number, got {str(value)[:30]!r}") from None
    if not np.isfinite(number):
        raise InputError(f"{what}: expected a finite number")
    return number
