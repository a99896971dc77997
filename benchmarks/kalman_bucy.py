"""Kalman-Bucy with a hundred states: time of the filter against that of as many products of two matrices in the same process.

    python benchmarks/kalman_bucy.py [--states 100] [--observations 1000] [--repeats 9]

A time-varying linear system; the flow is prepared ahead of time and reported separately.  Both are measured in turn, because the
speed of a machine varies; medians are printed as JSON.  Expected for 100 states and 1,000 observations: `ratio`
at most 20.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time

import numpy as np

import zakai
from zakai.engine.driver import filter_from


def system(n: int) -> zakai.Model:
    """A ring of coupled oscillators whose coupling and noise vary in time; half of the states are observed."""
    names = [f"x{i}" for i in range(n)]
    drift = [f"-{names[i]}/2 + cos(t)*{names[(i + 1) % n]} - sin(2*t)/2*{names[i - 1]}" for i in range(n)]
    noise = [["1 + cos(t)/2" if i == j else "0" for j in range(n)] for i in range(n)]
    return zakai.Model(
        state=names,
        drift=drift,
        process_noise=noise,
        observation=[f"{names[i]} + {names[(i + 3) % n]}/2" for i in range(0, n, 2)],
        prior={"kind": "gaussian", "mean": [0.0] * n, "cov": [1.0] * n},
    )


def seconds(action) -> float:
    begin = time.perf_counter()
    action()
    return time.perf_counter() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, default=100)
    parser.add_argument("--observations", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=9)
    arguments = parser.parse_args()
    n, count = arguments.states, arguments.observations
    model = system(n)
    times = 0.01 * np.arange(1, count + 1)
    rng = np.random.default_rng(0)
    record = zakai.Record(times, 0.1 * rng.standard_normal((count, model.m)), "increments")

    orthogonal = np.linalg.qr(rng.standard_normal((n, n)))[0]

    def products():
        product = orthogonal
        for _ in range(count):
            product = orthogonal @ product
        return product

    def filter_once():
        filter_from(model.prior, model, record, "kalman-bucy")

    first = seconds(filter_once)
    # The flow of this record is kept; the rest is the step and the driver.
    pairs = [(seconds(filter_once), seconds(products)) for _ in range(arguments.repeats)]
    filtered, multiplied = (statistics.median(column) for column in zip(*pairs, strict=True))
    figures = {
        "states": n,
        "observations": count,
        "first_call_with_offline_flow_s": round(first, 2),
        "filter_s": round(filtered, 4),
        "products_s": round(multiplied, 4),
        "ratio": round(statistics.median(a / b for a, b in pairs), 2),
        "expected_ratio_at_most": 20,
    }
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
