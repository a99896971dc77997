"""Measure the tables of docs/reference/figures.md: the time of an observation for the gallery and fifteen ordinary systems.

    python benchmarks/figures.py [--only WORD ...] [--repeats 3] [--write]

Each system filters a record with the default settings, which compiles; then other records are measured, with other times where
they are irregular (processor time, the smallest of `--repeats`, of one where it takes ten seconds). The bootstrap particle filter
of `first_answer.py` (10,000 particles, plain NumPy) filters the first record once. `distance` is the largest distance of the last
means of the two filters in posterior standard deviations; the error of the particle filter alone is some hundredths. `error` is
the largest `error_estimate` of the first result. The second table has other calls, and variants of some of the systems. With
`--write` the tables replace those of the page.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parent))

import numpy as np  # noqa: E402
from first_answer import distance, particle_filter, processor, write_table  # noqa: E402
from first_answer_systems import SYSTEMS, System  # noqa: E402

import zakai  # noqa: E402

LONG = 10.0  # seconds of all calls after which none is repeated
TITLES = ("system", "method", "states", "observations", "zakai, µs an observation", "particles, µs", "distance", "error")
OTHER_TITLES = ("what", "system", "method", "zakai, µs an observation", "error")


Call = Callable[..., zakai.FilterResult]
TIDE, SATURATING = "tide: linear, with coefficients in time", "saturating sensor"
WELL = "double well, irregular samples with gaps"
MOTION = {"drift": ["1 + 0.5*sin(x)"], "diffusion": [["0.03"]]}
# What is measured, of which system, the call, and the keys of the model that differ.
VARIANTS: tuple[tuple[str, str, Call, dict[str, Any]], ...] = (
    ("smoothing", TIDE, zakai.smooth, {}),
    ("smoothing", WELL, zakai.smooth, {}),
    ("smoothing", SATURATING, zakai.smooth, {}),
    ("increments", TIDE, zakai.filter, {"observation_kind": "increments"}),
    ("increments", WELL, zakai.filter, {"observation_kind": "increments"}),
    ("increments", SATURATING, zakai.filter, {"observation_kind": "increments"}),
    ("a kink in h, abs(x)", WELL, zakai.filter, {"observation": ["abs(x)"]}),
    ("a kink in f, 2*x - 2*x*abs(x)", WELL, zakai.filter, {"drift": ["2*x - 2*x*abs(x)"]}),
    ("motion with little noise, 1 + sin(x)/2", WELL, zakai.filter, MOTION),
    ("the same, smoothing", WELL, zakai.smooth, MOTION),
)


def measured(model: zakai.Model, system: System, call: Call, repeats: int) -> tuple[zakai.FilterResult, zakai.Record, float, str]:
    """Return the first result, its record, the microseconds an observation of later calls, and the error in words."""
    record = system.record(model, system.times(1), 2)
    result, seconds = call(model, record), []
    while not seconds or (len(seconds) < repeats and sum(seconds) < LONG):
        number = 1 + len(seconds)
        other = system.record(model, system.times(1 + number), 2 + number)
        begin = time.process_time()
        call(model, other)
        seconds.append(time.process_time() - begin)
    errors = result.health.get("error_estimate")
    return result, record, 1e6 / len(record) * min(seconds), "exact" if errors is None else f"{np.nanmax(errors):.0e}"


def row_of(name: str, system: System, repeats: int) -> tuple[str, ...]:
    """Return the row of a system."""
    model = system.loaded()
    result, record, ours, error = measured(model, system, zakai.filter, repeats)
    begin = time.process_time()
    mean = particle_filter(system, record.times, record.values, record.kind)
    theirs = 1e6 / len(record) * (time.process_time() - begin)
    last = {"mean": result.mean[-1], "std": np.sqrt(result.variance[-1]), "particles_mean": mean}
    what = f"{name} (gallery)" if isinstance(system.model, str) else name
    apart = f"{distance(system, last):.3f}"
    return what, result.method, str(model.n), str(len(record)), f"{ours:,.0f}", f"{theirs:,.0f}", apart, error


def heading(titles: tuple[str, ...], words: int) -> Iterator[str]:
    """Yield the first lines of a table, of which the first columns are words."""
    yield "| " + " | ".join(titles) + " |"
    yield "|" + "---|" * words + "---:|" * (len(titles) - words)


def tables(only: list[str], repeats: int) -> Iterator[str]:
    """Yield the lines of the page, each when it is measured."""
    yield from heading(TITLES, 2)
    for name, system in SYSTEMS.items():
        if not only or any(word in name for word in only):
            yield "| " + " | ".join(row_of(name, system, repeats)) + " |"
    yield ""
    yield from heading(OTHER_TITLES, 3)
    for what, name, call, changed in VARIANTS:
        if not only or any(word in f"{what} {name}" for word in only):
            model = zakai.Model(**{**SYSTEMS[name].model, **changed})
            result, _, ours, error = measured(model, SYSTEMS[name], call, repeats)
            yield f"| {what} | {name} | {result.method} | {ours:,.0f} | {error} |"
    versions = f"Python {platform.python_version()}, NumPy {np.__version__}"
    yield f"\nzakai {zakai.__version__}, one core of {processor()}, {versions}."


def main() -> None:
    """Print the tables, and write them into the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=[], help="systems whose name contains one of these words")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--write", action="store_true", help="write the tables into the page")
    given = parser.parse_args()
    lines = []
    for line in tables(given.only, given.repeats):
        print(line, flush=True)
        lines.append(line)
    if given.write:
        write_table(lines, "measured table")


if __name__ == "__main__":
    main()
