"""Peak memory of filtering a long record of the spiral sensor with only moments kept.

    python benchmarks/memory.py [--observations 1000000]

Prints the peak resident memory after a tenth of the record and after all of it.  Expected: flat, and below 1 GiB.
"""

from __future__ import annotations

import argparse
import json
import resource
import time

import numpy as np

import zakai


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--observations", type=int, default=1_000_000)
    count = parser.parse_args().observations
    # The sensor without its drift, which would carry the state beyond all numbers within 10,000 units of time.
    keys = zakai.load_model("gallery:spiral-sensor")
    model = zakai.Model(
        state=["x"],
        drift=["-x/4"],
        observation=[str(h) for h in keys.observation],
        prior={"kind": "gaussian", "mean": [0.1], "cov": [[3.0]]},
    )
    rng = np.random.default_rng(0)
    x, step = 0.1, 0.01
    values = np.sqrt(step) * rng.standard_normal((count, 2))
    for k, shock in enumerate(np.sqrt(step) * rng.standard_normal(count)):
        values[k] += step * x * np.array([np.sin(x), np.cos(x)])
        x += -0.25 * x * step + shock
    record = zakai.Record(step * np.arange(1, count + 1), values, "increments")
    marks: dict[int, float] = {}

    def progress(done: int, total: int) -> None:
        tenth = 10 * done // total
        marks.setdefault(tenth, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)

    begin = time.perf_counter()
    result = zakai.filter(model, record, keep="moments", progress=progress)
    print(
        json.dumps(
            {
                "observations": count,
                "peak_mib_after_a_tenth": round(marks[1]),
                "peak_mib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
                "us_per_observation": round(1e6 * (time.perf_counter() - begin) / count, 1),
                "warnings": result.warnings,
            },
            indent=1,
        )
    )


if __name__ == "__main__":
    main()
