"""Measure the table of docs/reference/figures.md: the time of an observation for the gallery and fifteen ordinary systems.

    python benchmarks/figures.py [--only WORD ...] [--repeats 3] [--write]

Each system filters a record with the default settings, and the same record again: the first call compiles and prepares, the
later ones are measured (processor time, the smallest of `--repeats`, of one where it takes ten seconds). The bootstrap
particle filter of `first_answer.py` (10,000 particles, plain NumPy) filters the same record once. `distance` is the largest
distance of the last means of the two filters in posterior standard deviations; the error of the particle filter alone is some
hundredths. `error` is the largest `error_estimate` of the result. With `--write` the table replaces that of the page.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import time
from pathlib import Path

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


def processor() -> str:
    """Return the name of the processor, or what Python knows of it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


def row_of(name: str, system: System, repeats: int) -> tuple[str, ...]:
    """Return the row of a system."""
    model = zakai.load_model(f"gallery:{system.model}") if isinstance(system.model, str) else zakai.Model(**system.model)
    times = system.times()
    _, record = zakai.simulate(model, times, seed=2)
    missing = np.random.default_rng(2).random(record.values.shape) < system.missing
    record = zakai.Record(times, np.where(missing, np.nan, record.values), record.kind)
    result, seconds = zakai.filter(model, record), []
    while not seconds or (len(seconds) < repeats and sum(seconds) < LONG):
        begin = time.process_time()
        zakai.filter(model, record)
        seconds.append(time.process_time() - begin)
    begin = time.process_time()
    mean = particle_filter(system, times, record.values, record.kind)
    particles = time.process_time() - begin
    last = {"mean": result.mean[-1], "std": np.sqrt(result.variance[-1]), "particles_mean": mean}
    per = 1e6 / len(record)
    errors = result.health.get("error_estimate")
    error = "exact" if errors is None else f"{np.nanmax(errors):.0e}"
    what = f"{name} (gallery)" if isinstance(system.model, str) else name
    ours, theirs = per * min(seconds), per * particles
    apart = f"{distance(system, last):.3f}"
    return what, result.method, str(model.n), str(len(record)), f"{ours:,.0f}", f"{theirs:,.0f}", apart, error


def main() -> None:
    """Print the table, and write it into the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=[], help="systems whose name contains one of these words")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--write", action="store_true", help="write the table into the page")
    given = parser.parse_args()
    lines = ["| " + " | ".join(TITLES) + " |", "|---|---|" + "---:|" * (len(TITLES) - 2)]
    print("\n".join(lines))
    for name, system in SYSTEMS.items():
        if not given.only or any(word in name for word in given.only):
            lines.append("| " + " | ".join(row_of(name, system, given.repeats)) + " |")
            print(lines[-1], flush=True)
    versions = f"Python {platform.python_version()}, NumPy {np.__version__}"
    lines.append(f"\nzakai {zakai.__version__}, one core of {processor()}, {versions}.")
    print(lines[-1])
    if given.write:
        before, _, rest = PAGE.read_text(encoding="utf-8").partition(f"{BEGIN}\n")
        PAGE.write_text(f"{before}{BEGIN}\n\n" + "\n".join(lines) + f"\n\n{END}{rest.partition(END)[2]}", encoding="utf-8")


if __name__ == "__main__":
    main()
