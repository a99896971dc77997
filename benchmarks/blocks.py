"""What it costs to filter many independent blocks: n linear sensors, K observations; and a few of them as one system.

python benchmarks/blocks.py [n] [K]
"""

from __future__ import annotations

import sys
import time

import numpy as np

import zakai
from zakai.algebra.independent import independent_blocks


def system(n: int) -> zakai.Model:
    names = [f"x{i}" for i in range(n)]
    prior = {"kind": "gaussian", "mean": [0.5] * n, "cov": [0.5] * n}
    return zakai.Model(state=names, drift=[f"-{name}" for name in names], observation=names, prior=prior)


def record(n: int, count: int) -> zakai.Record:
    increments = np.random.default_rng(0).normal(size=(count, n)) * np.sqrt(0.005)
    return zakai.Record(np.arange(1, count + 1) * 0.005, increments, "increments")


def timed(what: str, function):
    began = time.perf_counter()
    value = function()
    print(f"{what:<44}{time.perf_counter() - began:8.2f} s")
    return value


def main(n: int = 1000, count: int = 4000) -> None:
    print(f"{n} independent linear sensors, {count} observations")
    model = timed("reading the model", lambda: system(n))
    timed("finding the blocks", lambda: independent_blocks(model, model.prior))
    given = record(n, count)
    timed("filtering, with compilation", lambda: zakai.filter(model, given, keep="moments"))
    result = timed("filtering again", lambda: zakai.filter(model, given, keep="moments"))
    few = system(10)
    blocks = zakai.filter(few, record(10, count), keep="moments")
    whole = zakai.filter(few, record(10, count), "kalman-bucy", keep="moments")
    print(f"{result.method}; 10 of them against the whole: means differ by {np.abs(blocks.mean - whole.mean).max():.1g}, "
          f"log-likelihoods by {abs(blocks.log_likelihood - whole.log_likelihood):.1g}")  # fmt: skip


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
