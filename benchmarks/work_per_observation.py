"""Affine h: the work per observation does not grow with time, nor with the past, and at most linearly with the prior.

    python benchmarks/work_per_observation.py [--observations 4096] [--repeats 5]

Benes' filter of one record; the time of its first and of its last quarter, each as a record of its own length, and of priors
with 1, 4 and 16 components.  Printed as JSON.  Expected: `last_over_first` and `long_over_short` about 1, and
`per_component_growth` at most 1.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time

import numpy as np

import zakai
from zakai.engine.driver import filter_from


def model(components: int) -> zakai.Model:
    """Benes' system with a prior of so many components."""
    means = np.linspace(-2, 2, components) if components > 1 else np.zeros(1)
    prior = {
        "kind": "mixture",
        "weights": [1.0] * components,
        "means": means[:, None].tolist(),
        "covs": [[[0.3]]] * components,
    }
    return zakai.Model(state=["x"], drift=["tanh(x)"], observation=["x"], prior=prior)


def per_observation(system: zakai.Model, record: zakai.Record, repeats: int) -> float:
    """Microseconds an observation, the flow being prepared and everything compiled."""
    times = []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        filter_from(system.prior, system, record, "benes")
        times.append(time.perf_counter() - begin)
    return 1e6 * statistics.median(times[1:]) / len(record.times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--observations", type=int, default=4096)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    count, quarter = arguments.observations, arguments.observations // 4
    times = 0.01 * np.arange(1, count + 1)
    single = model(1)
    record = zakai.simulate(single, times, seed=0)[1]

    def part(rows: slice) -> zakai.Record:
        return zakai.Record(record.times[rows] - times[rows.start or 0] + 0.01, record.values[rows], "increments")

    first = per_observation(single, part(slice(0, quarter)), arguments.repeats)
    last = per_observation(single, part(slice(3 * quarter, count)), arguments.repeats)
    whole = per_observation(single, record, arguments.repeats)
    by_components = {k: per_observation(model(k), part(slice(0, quarter)), arguments.repeats) for k in (1, 4, 16)}
    figures = {
        "observations": count,
        "us_per_observation": {"first_quarter": first, "last_quarter": last, "whole_record": whole},
        "last_over_first": last / first,
        "long_over_short": whole / first,
        "us_per_observation_by_components": by_components,
        "per_component_growth": by_components[16] / (16 * by_components[1]),
    }
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
