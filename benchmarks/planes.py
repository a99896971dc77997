"""`yau-yau` in the plane: two cubic sensors filtered as one system, and Van der Pol's oscillator with noise on its velocity
alone.

    python benchmarks/planes.py [--observations 2000] [--repeats 5] [--seed 0]

Printed for each are the grid, the median time of an observation after a first call, and the differences of the means from those
at a tolerance of 1e-7, in deviations: root mean square and largest.
"""

from __future__ import annotations

import argparse
import json
import time

import numpy as np

import zakai

CUBIC = zakai.Model(
    state=["x", "y"],
    drift=["cos(x)", "cos(y)"],
    observation=["x**3", "y**3"],
    prior={"kind": "gaussian", "mean": [0.0, 0.0], "cov": [[0.05, 0.0], [0.0, 0.05]]},
)
VAN_DER_POL = zakai.Model(
    state=["x", "v"],
    drift=["v", "0.3*(1 - x**2)*v - x"],
    diffusion=[["0"], ["1"]],
    process_noise=[["1"]],
    observation=["x"],
    prior={"kind": "gaussian", "mean": [0.5, 0.0], "cov": [[0.5, 0.0], [0.0, 0.5]]},
)
PROBLEMS = {"two cubic sensors, every 0.005": (CUBIC, 0.005), "Van der Pol, every 0.01": (VAN_DER_POL, 0.01)}


def figures(model: zakai.Model, step: float, count: int, repeats: int, seed: int) -> dict[str, object]:
    _, record = zakai.simulate(model, step * np.arange(1, count + 1), seed=seed)
    result = zakai.filter(model, record, "yau-yau", keep="moments")
    taken = []
    for _ in range(repeats):
        begin = time.perf_counter()
        zakai.filter(model, record, "yau-yau", keep="moments")
        taken.append(1e3 * (time.perf_counter() - begin) / count)
    near = zakai.filter(model, record, "yau-yau", keep="moments", tolerance=1e-7)
    apart = (result.mean - near.mean) / np.sqrt(near.variance)
    begun = zakai.Record(record.times[:50], record.values[:50], record.kind)
    density = zakai.filter(model, begun, "yau-yau").density(-1)
    return {
        "grid after 50 observations": list(np.shape(density.log_values)),
        "ms_per_observation": round(float(np.median(taken)), 4),
        "rms_distance": float(f"{np.sqrt(np.mean(apart**2)):.2g}"),
        "largest_distance": float(f"{np.abs(apart).max():.2g}"),
        "largest_error_estimate": float(f"{np.nanmax(result.health['error_estimate']):.2g}"),
        "warnings": result.warnings,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--observations", type=int, default=2000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    own = parser.parse_args()
    for name, (model, step) in PROBLEMS.items():
        print(json.dumps({name: figures(model, step, own.observations, own.repeats, own.seed)}, indent=1), flush=True)


if __name__ == "__main__":
    main()
