"""Time of `zakai.filter` on the spiral sensor: the first call, and calls on other records of the same length.

    python benchmarks/spiral_sensor.py [--observations 1000] [--repeats 15]

Everything in a call is counted.  The median of the repeats is printed, and as JSON what was measured.  Pin the process to one
core (`taskset -c 0`) for the time on one core.  Expected on one core of a quiet machine: at most 30 microseconds an observation.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time

import numpy as np

import zakai


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--observations", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=15)
    arguments = parser.parse_args()
    count = arguments.observations
    model = zakai.load_model("gallery:spiral-sensor")
    times = 0.01 * np.arange(1, count + 1)
    records = [zakai.simulate(model, times, seed=seed)[1] for seed in range(arguments.repeats + 1)]

    def timed(record: zakai.Record) -> float:
        begin = time.perf_counter()
        zakai.filter(model, record)
        return time.perf_counter() - begin

    first = timed(records[0])
    same = [timed(records[0]) for _ in range(arguments.repeats)]
    for record in records[1:]:
        timed(record)
    other = [timed(record) for record in records[1:]]
    figures = {
        "observations": count,
        "first_call_s": round(first, 3),
        "same_record_us_per_observation": round(1e6 * statistics.median(same) / count, 2),
        "other_records_us_per_observation": round(1e6 * statistics.median(other) / count, 2),
        "fastest_us_per_observation": round(1e6 * min(same + other) / count, 2),
    }
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
