"""A long run: dx = (x - x^3) dt + 0.7 dv, a double well whose state switches, dy = x dt + dw, read every 0.01.

    python benchmarks/double_well.py [--observations 1000000] [--pieces 20] [--seed 0]

Printed for each piece of the record are the time of an observation and the memory of the process; then the worst health figures
of the whole run, and how far its last means are from those of a filter that began 5,000 observations before the end, by when
the beginning is forgotten: what a run loses or gathers would stand between the two.
"""

from __future__ import annotations

import argparse
import json
import time

import numpy as np

import zakai

STEP, LATE = 0.01, 5_000
KEYS = dict(
    state=["x"],
    drift=["x - x**3"],
    diffusion=[["0.7"]],
    observation=["x"],
    prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
)


def resident() -> float:
    """The memory of the process in MiB."""
    with open("/proc/self/statm") as pages:
        return int(pages.read().split()[1]) * 4096 / 2**20


class Watch:
    """The time and the memory at the end of every piece."""

    def __init__(self, pieces: int):
        self.pieces, self.last, self.marks = pieces, (0, time.perf_counter()), []

    def __call__(self, done: int, count: int) -> None:
        since, begin = self.last
        if done - since < count / self.pieces and done < count:
            return
        now = time.perf_counter()
        self.marks.append((1e6 * (now - begin) / max(1, done - since), resident()))
        self.last = done, now
        print(f"{done:>9}  {self.marks[-1][0]:6.2f} us an observation  {self.marks[-1][1]:7.1f} MiB", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--observations", type=int, default=1_000_000)
    parser.add_argument("--pieces", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    own = parser.parse_args()
    model = zakai.Model(**KEYS)
    truth, record = zakai.simulate(model, STEP * np.arange(1, own.observations + 1), seed=own.seed)
    x = np.asarray(truth.values)[-own.observations :, 0]
    watch = Watch(own.pieces)
    result = zakai.filter(model, record, "yau-yau", keep="moments", progress=watch)
    start = own.observations - LATE
    late = zakai.Model(**KEYS, start=float(record.times[start - 1]))
    later = zakai.filter(late, zakai.Record(record.times[start:], record.values[start:], record.kind), "yau-yau", keep="moments")
    apart = (later.mean[-100:, 0] - result.mean[-100:, 0]) / np.sqrt(result.variance[-100:, 0])
    error = result.mean[1:, 0] - x
    switches = np.count_nonzero(np.diff(np.sign(x[np.abs(x) > 0.7])))
    figures = {
        "switches": int(switches),
        "rms_error": round(float(np.sqrt(np.mean(error**2))), 4),
        "normalised_squared_error": round(float(np.mean(error**2 / result.variance[1:, 0])), 4),
        "worst_health": {name: float(f"{np.nanmax(values):.2g}") for name, values in result.health.items()},
        "largest_distance_from_a_late_start": float(f"{np.abs(apart).max():.2g}"),
        "warnings": result.warnings,
    }
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
