"""How long the estimation algebra takes: whole analyses from formulas, in a new process and again in the same one.

    python benchmarks/estimation_algebra.py [--repeats 5]

`cold` is a new process: Python, the imports, the analysis with its page.  `warm` is the analysis of the same formulas as a new
model in a process that has done one before.  Printed as JSON, in seconds of the processor, with the expected upper limits beside.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import statistics
import subprocess
import sys

import zakai

LIMITS = {
    "dong-chen-yau-3-6, k = 6": {"cold": 2.0, "warm": 0.2},
    "linear, n = 8": {"algebra": 1.0},
    "linear, n = 16": {"algebra": 5.0},
}


def dong_chen_yau_3_6(k: int) -> dict:
    """Example 3.6 of Dong, Chen and Yau (2021)."""
    drift = [
        "x1 + x2 + x3 + x4",
        f"x1 - x2 - x3**{k} + x4**{k} + x2**{k + 1}*x3**{k + 3}",
        f"x1 - x3 - x2**{k + 2} - x4**{k} + x3**{k + 5}*x4**{k} - x2**{k + 1}*x3**{k + 3}",
        f"x1 - x4 + x2**{k + 2} + x3**{k} - x3**{k + 5}*x4**{k}",
    ]
    return {"state": ["x1", "x2", "x3", "x4"], "drift": drift, "observation": ["x1"]}


def linear(n: int) -> dict:
    """A dense linear system, one state observed."""
    rng = random.Random(1)
    drift = [" + ".join(f"({rng.randint(-9, 9)})*x{j + 1}" for j in range(n)) for _ in range(n)]
    return {"state": [f"x{j + 1}" for j in range(n)], "drift": drift, "observation": ["x1"]}


def seconds(work, repeats: int) -> float:
    """The median processor time, of this process and of those that it waited for; on an idle machine, the time."""
    times = []
    for _ in range(repeats):
        begin = os.times()
        work()
        times.append(sum(os.times()[:4]) - sum(begin[:4]))
    return statistics.median(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats
    example = dong_chen_yau_3_6(6)
    code = f"import zakai; print(zakai.analyze(zakai.Model(**{example!r})))"
    cold = seconds(lambda: subprocess.run([sys.executable, "-c", code], check=True, capture_output=True), repeats)
    figures: dict = {"dong-chen-yau-3-6, k = 6": {"cold": cold}}
    # Nothing is remembered of a new model.
    str(zakai.analyze(zakai.Model(**example)))
    figures["dong-chen-yau-3-6, k = 6"]["warm"] = seconds(lambda: str(zakai.analyze(zakai.Model(**example))), repeats)
    figures["dong-chen-yau-3-6, k = 6"]["algebra"] = seconds(lambda: zakai.analyze(zakai.Model(**example)).algebra, repeats)
    for n in (8, 16):
        work = lambda n=n: algebra_of(linear(n))  # noqa: E731
        figures[f"linear, n = {n}"] = {"algebra": seconds(work, repeats)}
    print(json.dumps({"seconds": figures, "limits": LIMITS}, indent=1))


def algebra_of(keys: dict) -> None:
    """The estimation algebra alone, of a new model."""
    from zakai.algebra.estimation_algebra import estimation_algebra

    assert estimation_algebra(zakai.Model(**keys)).verdict == "finite"


if __name__ == "__main__":
    main()
