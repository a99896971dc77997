"""Run zakai filter, smooth, forecast and fit."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from zakai.cli._files import check_outputs
from zakai.cli._progress import progress
from zakai.errors import InputError
from zakai.models.files import load_model
from zakai.records import Record, read_inputs, read_record, read_truth
from zakai.records.dates import Clock, date_of
from zakai.records.writing import shown

if TYPE_CHECKING:
    from zakai.engine.results import FilterResult
    from zakai.models.model import Model

_WIDTH = 110  # columns of a terminal
_SHOWN = 20  # states whose last estimates are printed


def filter(
    source: str,
    record_path: Path,
    output: Path,
    method: str,
    settings: list[str],
    truth_path: Path | None,
    report: Path | None,
    inputs_path: Path | None = None,
    smoothed: bool = False,
    unit: str | None = None,
    origin: str | None = None,
    columns: str = "",
) -> None:
    """Filter or smooth a record, print a summary, and write the result and the report.

    Wrong input is refused before the work begins.
    """
    check_outputs([output, report], [source, record_path, truth_path, inputs_path])
    if report is not None:
        from zakai.report import write_report
    from zakai.engine.kept_record import MOST_QUANTILES

    model, record, options = _given(source, record_path, settings, inputs_path, unit, origin, columns)
    truth = None if truth_path is None else read_truth(truth_path, model, record)

    if smoothed:
        from zakai.engine.smoother import smooth

        with progress("smoothing") as advance:
            result: FilterResult = smooth(model, record, method, progress=advance, **options)
    else:
        from zakai.engine.driver import filter as run

        with progress("filtering") as advance:
            # Only the report and quantiles use the densities.
            kept = report is not None or (len(record) + 1) * model.n <= MOST_QUANTILES
            result = run(model, record, method, keep=None if kept else "moments", progress=advance, **options)
    _warn(_but_note(result.warnings, record))
    result.save(output)
    if report is not None:
        write_report(result, report, truth=truth)
    first, last = (_moment(record.times[k], record.clock) for k in (0, -1))
    lines = [
        ("observations", f"{len(record):,}, times {first} to {last}"),
        ("log-likelihood", f"{result.log_likelihood:.6f}"),
    ]
    _summarise(result, lines, (0, "start") if smoothed else (-1, "end"), [output, report])


def forecast(
    source: str,
    record_path: Path,
    until: str,
    step: float,
    output: Path,
    method: str,
    settings: list[str],
    inputs_path: Path | None = None,
    unit: str | None = None,
    origin: str | None = None,
    columns: str = "",
) -> None:
    """Filter a record, and write the density of the state at times after it."""
    from zakai.engine.driver import filter as run
    from zakai.models.clock import clock

    check_outputs([output], [source, record_path, inputs_path])
    model, record, options = _given(source, record_path, settings, inputs_path, unit, origin, columns)
    last, end = float(record.times[-1]), _end(until, record)
    if not end > last:
        raise InputError(f"--until {until}: must be after the end of the record, {_moment(last, record.clock)}")
    times = clock(last, end, step)
    with progress("filtering") as advance:
        result = run(model, record, method, keep="moments", progress=advance, **options)
    found = result.forecast(times)
    _warn(_but_note(dict.fromkeys([*result.warnings, *found.warnings]), record))
    found.save(output)
    _summarise(found, [("forecast", _span(times, record.clock))], (-1, "end"), [output])


def _end(until: str, record: Record) -> float:
    """Return the time of `--until`: a number, or a date where the record has dates."""
    try:
        return float(until)
    except ValueError:
        pass
    date = date_of(until)
    if date is None:
        raise InputError(f"--until {until}: is neither a number nor a date, as in 2024-01-31T12:00")
    if record.clock is None:
        raise InputError(f"--until {until}: is a date, and the times of the record are numbers; give a number")
    return record.clock.time(date)


def _moment(time: float, clock: Clock | None) -> str:
    """Return a time as text: its number, with its date where the record has dates."""
    return f"{time:.12g}" if clock is None else f"{clock.text(time)} (t = {time:.12g})"


def _span(times: Any, clock: Clock | None) -> str:
    """Return the number of times, the first and the last."""
    if len(times) == 1:
        return f"1 time, {_moment(times[0], clock)}"
    return f"{len(times):,} times, {_moment(times[0], clock)} to {_moment(times[-1], clock)}"


def fit(
    source: str,
    record_path: Path,
    parameters: str,
    output: Path | None,
    method: str,
    settings: list[str],
    inputs_path: Path | None = None,
    unit: str | None = None,
    origin: str | None = None,
    columns: str = "",
) -> None:
    """Print the parameters of largest likelihood, and write the model with them."""
    from zakai.inference.fit import fit as run
    from zakai.records.writing import atomic_write

    check_outputs([output], [source, record_path, inputs_path])
    model, record, options = _given(source, record_path, settings, inputs_path, unit, origin, columns)
    names = [name.strip() for name in parameters.split(",") if name.strip()] or None
    found = run(model, record, names, method, **options)
    _warn(_but_note(found.warnings, record))
    if output is not None:
        with atomic_write(output) as temporary:
            temporary.write_text(found.model.text, encoding="utf-8")
    print("\n".join(line for line in str(found).splitlines() if not line.startswith("  warning: ")))
    if output is not None:
        print(f"written  {output}")


def _given(
    source: str,
    path: Path,
    settings: list[str],
    inputs_path: Path | None,
    unit: str | None,
    origin: str | None,
    columns: str,
) -> tuple[Model, Record, dict[str, Any]]:
    """Read the model, the record with its inputs, and the options."""
    options = options_of(settings)
    model = load_model(source)
    record = record_with_inputs(path, model, inputs_path, unit, origin, columns)
    _warn([record._note] if record._note else [])  # before a long run
    return model, record, options


def record_with_inputs(
    path: Path, model: Any, inputs_path: Path | None, unit: str | None = None, origin: str | None = None, columns: str = ""
) -> Record:
    """Read a record, and its inputs from a file of their own where there is one."""
    if origin is not None and unit is None:
        raise InputError("--origin: is the date at which t = 0, and needs --unit, the unit of the model's time, as in --unit h")
    wanted = [name.strip() for name in columns.split(",")] if columns else None
    record = read_record(path, model, unit, origin, columns=wanted)
    if inputs_path is None:
        return record
    if record.inputs is not None:
        raise InputError(f"--inputs {inputs_path}: {path} has columns for the inputs too; give them once")
    inputs = read_inputs(inputs_path, model, record.clock)
    inputs.check(model, float(record.times[0]), float(record.times[-1]), name=shown(inputs_path))
    return record.with_inputs(inputs)


def _but_note(warnings: Iterable[str], record: Record) -> list[str]:
    """Return the warnings without that about the columns of the record, which has been printed."""
    return [warning for warning in warnings if warning != record._note]


def _warn(warnings: Iterable[str]) -> None:
    for warning in warnings:
        print(f"warning: {warning}", file=sys.stderr)


def _summarise(
    result: FilterResult, lines: Sequence[tuple[str, str]], row: tuple[int, str], written: Sequence[Path | None]
) -> None:
    """Print the method, the lines, the estimate of one row and the files that were written, in two columns."""
    index, when = row
    estimates = list(zip(result.state, result.mean[index], np.sqrt(result.variance[index]), strict=True))
    table = [("method", f"{result.method}: {result.why}"), *lines]
    table += [(f"{name} at the {when}", f"{mean:.6g} +- {deviation:.3g}") for name, mean, deviation in estimates[:_SHOWN]]
    if len(estimates) > _SHOWN:
        table.append(("and", f"{len(estimates) - _SHOWN} more states, in the result"))
    table += [("written", str(path)) for path in written if path is not None]
    width = max(len(name) for name, _ in table)
    for name, text in table:
        indent = " " * (width + 2)
        wrapped = textwrap.fill(text, _WIDTH, subsequent_indent=indent, break_on_hyphens=False) if name == "method" else text
        print(f"{name:<{width}}  {wrapped}")


def options_of(settings: list[str]) -> dict[str, Any]:
    """Return KEY=VALUE as keywords: numbers, true, false and none by their meaning, anything else as text."""
    options: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not (equals and key.isidentifier()):
            raise InputError(f'--option "{setting}": expected KEY=VALUE')
        if key in options:
            raise InputError(f"--option {key}: is given twice")
        if key in ("model", "record", "method", "keep", "progress"):
            raise InputError(f"--option {key}: is not an option of a method; zakai filter --help lists what else there is")
        options[key] = _value(text.strip())
    return options


def _value(text: str) -> Any:
    words = {"true": True, "false": False, "none": None}
    if text.lower() in words:
        return words[text.lower()]
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
