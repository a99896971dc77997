"""Run zakai study and zakai reproduce."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from zakai.cli._progress import progress
from zakai.cli.filtering import options_of
from zakai.errors import InputError


def reproduce(name: str, folder: Path | None, settings: list[str]) -> None:
    """Run a published experiment."""
    from zakai import studies

    known = studies.names()
    if not name:
        print("\n".join(known))
        return
    if name not in known:
        raise InputError(f'there is no study "{name}"; there is: {", ".join(known)}')
    options = options_of(settings)
    for key in {"name", "folder"} & set(options):
        raise InputError(f"--option {key}: is not an option of a study")
    with progress(name) as advance:
        studies.reproduce(name, folder, advance, **options)


def study(file: Path, folder: Path, scheduler: str | None, processes: int | None, inputs: Path | None = None) -> None:
    """Run a study, or continue it, and print its table."""
    from zakai.studies.study import run_study
    from zakai.studies.study_files import read_study

    read = read_study(file, inputs)
    with progress(read.name) as advance:
        outcome = run_study(read, folder, scheduler, processes, advance)
    for point, seconds in zip(outcome.summary["points"], outcome.timing["points"], strict=True):
        _print_table(outcome.summary, point, seconds["methods"])
    names = ["study.nc", "summary.json", "timing.json", *_pictures(outcome)]
    print(f"written to {folder}: {', '.join(names)}")


def _pictures(outcome: Any) -> list[str]:
    """Write the pictures and the page if the libraries that draw them are installed; return their names."""
    from zakai.report.study_page import write_study

    try:
        return [path.name for path in write_study(outcome)]
    except InputError as error:
        print(f"note: no pictures: {error}", file=sys.stderr)
        return []


def _print_table(summary: dict[str, Any], point: dict[str, Any], costs: dict[str, Any]) -> None:
    """The figures of a point, a line a method."""
    from rich.console import Console
    from rich.table import Table

    console = Console(width=None if sys.stdout.isatty() else 132, highlight=False)
    title = f"{point['point']}: {summary['runs']:,} runs of {point['observations']:,} observations"
    table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False)
    figures = ("squared error", "median", "worst", "failures", "warned", "distance", "NEES/n", "in 95%", "per observation")
    for name in ("method", *figures):
        table.add_column(name, justify="left" if name == "method" else "right", overflow="fold")
    for label, own in point["methods"].items():
        error, nees = own.get("squared_error", {}), own.get("nees", {})
        spread = error.get("standard_error")
        table.add_row(
            label,
            _number(error.get("mean")) + (f" ±{spread:.1g}" if spread else ""),
            _number(error.get("median")),
            _number(error.get("worst")),
            str(own["failures"]),
            str(own["warned"]),
            _number(own.get("distance", {}).get("mean")),
            _number(nees.get("mean"), 3),
            "-" if nees.get("within") is None else f"{nees['within']:.0%}",
            _time(costs[label]["seconds_per_observation"]),
        )
    console.print(table)
    for label, own in point["methods"].items():
        if own["said"]:
            console.print(f"{label}: {own['said']}", markup=False, soft_wrap=True)


def _number(value: float | None, digits: int = 4) -> str:
    return "-" if value is None else f"{value:.{digits}g}"


def _time(seconds: float | None) -> str:
    if seconds is None:
        return "-"
    return f"{1e6 * seconds:.3g} us" if seconds < 1e-3 else f"{1e3 * seconds:.3g} ms"
