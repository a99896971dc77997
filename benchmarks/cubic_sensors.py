"""Independent cubic sensors, dx_i = cos x_i dt + dv_i, dy_i = x_i^3 dt + dw_i, read every 5 ms: each is a block of its own.

    python benchmarks/cubic_sensors.py [sensors] [observations]

1,000 and 4,000 by default.  Printed are the seconds of the first call, with all compilation, the root mean square
error and the normalised squared error (1 where the variances are right), and how far three of them are from the same sensors
filtered alone.
"""

from __future__ import annotations

import sys
import time

import numpy as np

import zakai


def system(n: int) -> zakai.Model:
    names = [f"x{k}" for k in range(n)]
    prior = {"kind": "gaussian", "mean": [0.0] * n, "cov": (0.05 * np.eye(n)).tolist()}
    drift, observation = [f"cos({name})" for name in names], [f"{name}**3" for name in names]
    return zakai.Model(state=names, drift=drift, observation=observation, observation_kind="increments", prior=prior)


def main(n: int = 1000, count: int = 4000) -> None:
    model = system(n)
    truth, record = zakai.simulate(model, 0.005 * np.arange(1, count + 1), seed=0)
    begin = time.perf_counter()
    result = zakai.filter(model, record)
    print(f"{n} sensors, {count} observations: {time.perf_counter() - begin:.1f} s, {len(result.warnings)} warnings")
    error = np.asarray(truth.values)[-count:] - result.mean[1:]
    print(f"error {np.sqrt(np.mean(error**2)):.4f}, normalised squared error {np.mean(error**2 / result.variance[1:]):.4f}")
    for k in (0, n // 2, n - 1):
        own = zakai.Record(record.times, np.asarray(record.values)[:, [k]], record.kind)
        alone = zakai.filter(system(1), own, keep="moments")
        apart = np.abs(alone.mean[:, 0] - result.mean[:, k]) / np.sqrt(alone.variance[:, 0])
        print(f"sensor {k} alone: means within {apart.max():.1g} deviations")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
