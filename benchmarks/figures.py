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
from first_answer import distance, particle_filter  # noqa: E402
from first_answer_systems import SYSTEMS, System  # noqa: E402

import zakai  # noqa: E402

PAGE = Path(__file__).parents[1] / "docs/reference/figures.md"
BEGIN, END = "% begin of the measured table", "% end of the measured table"
LONG = 10.0  # seconds of all calls after which none is repeated
TITLES = ("system", "method", "states", "observations", "zakai, µs an observation", "particles, µs", "distance", "error")
OTHER_TITLES = ("what", "system", "method", "zakai, µs an observation", "error")


def processor() -> str:
    """Return the name of the processor, or what Python knows of it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


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


def record_of(model: zakai.Model, system: System, number: int) -> zakai.Record:
    """Return a simulated record of a system, with missing values; each number has its own."""
    _, record = zakai.simulate(model, system.times(1 + number), seed=2 + number)
    missing = np.random.default_rng(2 + number).random(record.values.shape) < system.missing
    return zakai.Record(record.times, np.where(missing, np.nan, record.values), record.kind)


def measured(model: zakai.Model, system: System, call: Call, repeats: int) -> tuple[zakai.FilterResult, zakai.Record, float, str]:
    """Return the first result, its record, the microseconds an observation of later calls, and the error in words."""
    record = record_of(model, system, 0)
    result, seconds = call(model, record), []
    while not seconds or (len(seconds) < repeats and sum(seconds) < LONG):
        other = record_of(model, system, 1 + len(seconds))
        begin = time.process_time()
        call(model, other)
        seconds.append(time.process_time() - begin)
    errors = result.health.get("error_estimate")
    return result, record, 1e6 / len(record) * min(seconds), "exact" if errors is None else f"{np.nanmax(errors):.0e}"


def row_of(name: str, system: System, repeats: int) -> tuple[str, ...]:
    """Return the row of a system."""
    model = zakai.load_model(f"gallery:{system.model}") if isinstance(system.model, str) else zakai.Model(**system.model)
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
        before, _, rest = PAGE.read_text(encoding="utf-8").partition(f"{BEGIN}\n")
        PAGE.write_text(f"{before}{BEGIN}\n\n" + "\n".join(lines) + f"\n\n{END}{rest.partition(END)[2]}", encoding="utf-8")


if __name__ == "__main__":
    main()
