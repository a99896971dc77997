"""Observations a second through `zakai stream`, from a file of JSON lines to a pipe: without a checkpoint and with one every 100.

    python benchmarks/stream.py [--observations 50000] [--model gallery:kalman-bucy-1d]

The time from the first to the last estimate is counted: what the command needs to start is printed beside, as `first_s`, from the
start of the process to the first estimate (run twice for a warm cache of what is compiled), and as `first_cpu_s` the time of a
processor in it, whatever else the machine does.  Expected: at least 5,000 and 2,000 a second, 3 seconds at most.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import zakai

COMMAND = [sys.executable, "-c", "import sys; from zakai.cli import main; sys.exit(main())", "stream"]


def processor_time(process: int) -> float:
    """Seconds that a process has computed."""
    with open(f"/proc/{process}/stat", encoding="ascii") as file:
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(model: str, path: Path, more: list[str]) -> dict[str, float]:
    begin = time.perf_counter()
    with open(path, "rb") as given:
        process = subprocess.Popen([*COMMAND, model, *more], stdin=given, stdout=subprocess.PIPE)
        process.stdout.readline()
        first, used = time.perf_counter(), processor_time(process.pid)
        count = sum(1 for _ in process.stdout)
        end = time.perf_counter()
        if process.wait():
            raise SystemExit(process.returncode)
    return {"first_s": round(first - begin, 2), "first_cpu_s": round(used, 2), "per_second": round(count / (end - first))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--observations", type=int, default=50_000)
    parser.add_argument("--model", default="gallery:kalman-bucy-1d")
    arguments = parser.parse_args()
    chance, m = random.Random(0), zakai.load_model(arguments.model).m
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "lines"
        with path.open("w") as file:
            for k in range(1, arguments.observations + 1):
                file.write(json.dumps({"time": k / 100, "y": [chance.gauss(0, 0.1) for _ in range(m)]}) + "\n")
        saved = ["--checkpoint", str(Path(folder) / "state"), "--checkpoint-every", "100"]
        found = {"plain": measure(arguments.model, path, []), "checkpoint every 100": measure(arguments.model, path, saved)}
    print(json.dumps({"model": arguments.model, **found}, indent=2))


if __name__ == "__main__":
    main()
