"""Time of `zakai.filter` on many records of the spiral sensor at once, and on the same records one by one.

    python benchmarks/batch.py [--records 1000] [--observations 1000] [--method auto]

Both are measured in one process after a first call, everything in the calls counted; the results must be
the same.  Expected with two cores: at most half of the time.
"""

from __future__ import annotations

import argparse
import json
import os
import time

import numpy as np

import zakai

EXPECTED_RATIO = 2.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=1000)
    parser.add_argument("--observations", type=int, default=1000)
    parser.add_argument("--method", default="auto")
    arguments = parser.parse_args()
    model = zakai.load_model("gallery:spiral-sensor")
    times = 0.01 * np.arange(1, arguments.observations + 1)
    records = [zakai.simulate(model, times, seed=seed)[1] for seed in range(arguments.records)]

    def together() -> list[zakai.FilterResult]:
        return zakai.filter(model, records, arguments.method, keep="moments")

    def one_by_one() -> list[zakai.FilterResult]:
        return [zakai.filter(model, record, arguments.method, keep="moments") for record in records]

    seconds, results = {}, {}
    for name, run in (("together", together), ("one_by_one", one_by_one)):
        begin = time.perf_counter()
        run()
        seconds[f"{name}_first_s"] = round(time.perf_counter() - begin, 3)
        begin = time.perf_counter()
        results[name] = run()
        seconds[f"{name}_s"] = round(time.perf_counter() - begin, 3)
    pairs = list(zip(results["together"], results["one_by_one"], strict=True))
    figures = {
        "settings": {**vars(arguments), "cores": os.cpu_count(), "expected_ratio": EXPECTED_RATIO},
        "method": results["together"][0].method,
        **seconds,
        "ratio": round(seconds["one_by_one_s"] / seconds["together_s"], 2),
        "largest_difference_of_means": max(float(np.abs(a.mean - b.mean).max()) for a, b in pairs),
        "largest_difference_of_log_likelihoods": max(abs(a.log_likelihood - b.log_likelihood) for a, b in pairs),
    }
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
