"""zakai filter"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from zakai.cli._files import check_outputs
from zakai.cli._progress import progress
from zakai.errors import InputError
from zakai.models.files import load_model
from zakai.models.simulate import Truth
from zakai.records import Record, read_record, read_truth

_SHOWN = 20  # states whose last estimates are printed


def filter(
    source: str,
    record_path: Path,
    output: Path,
    method: str,
    settings: list[str],
    truth_path: Path | None,
    report: Path | None,
) -> None:
    """Filter a record, and write the result and the report; wrong input is refused before the work begins."""
    check_outputs([output, report], [source, record_path, truth_path])
    options = options_of(settings)
    if report is not None:
        from zakai.report import write_report
        from zakai.report._extra import plotting

        plotting("plotly")
    model = load_model(source)
    record = read_record(record_path, model)
    truth = None if truth_path is None else _truth(truth_path, model, record)

    from zakai.engine.driver import filter as run

    with progress("filtering") as advance:
        # Only the report uses the densities.
        result = run(model, record, method, keep=None if report else "moments", progress=advance, **options)
    for warning in result.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    result.save(output)
    if report is not None:
        write_report(result, report, truth=truth)
    lines = [
        ("method", f"{result.method}: {result.why}"),
        ("observations", f"{len(record):,}, times {record.times[0]:g} to {record.times[-1]:g}"),
        ("log-likelihood", f"{result.log_likelihood:.6f}"),
    ]
    last = list(zip(result.state, result.mean[-1], np.sqrt(result.variance[-1]), strict=True))
    lines += [(f"{name} at the end", f"{mean:.6g} +- {deviation:.3g}") for name, mean, deviation in last[:_SHOWN]]
    if len(last) > _SHOWN:
        lines.append(("and", f"{len(last) - _SHOWN} more states, in the result"))
    lines += [("written", str(path)) for path in (output, report) if path is not None]
    width = max(len(what) for what, _ in lines)
    for what, said in lines:
        print(f"{what:<{width}}  {said}")


def _truth(path: Path, model: Any, record: Record) -> Truth:
    truth = read_truth(path, model)
    times = np.concatenate([[model.start], record.times])
    nearest = truth.times[np.clip(np.searchsorted(truth.times, times - 1e-9 * np.abs(times)), 0, len(truth.times) - 1)]
    if not np.isclose(nearest, times, rtol=1e-9, atol=1e-12).any():
        raise InputError(f"{path}: none of its times is one of the record; give the states at the times of the record")
    return truth


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
