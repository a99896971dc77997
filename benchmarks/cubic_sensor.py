"""`yau-yau` on the cubic sensor: dx = cos x dt + dv, dy = x^3 dt + dw, x(0) = 0, prior proportional to exp(-10 x^2), T = 20.

    python benchmarks/cubic_sensor.py [--paths 100] [--references 3] [--seed 0]

The public Yau-Yau codes take this system as their default.  Printed are, over all paths, the root mean square error of the mean
over time, the normalised squared error (1 where the variance is right) and the time of an observation when everything is
compiled.  The first `references` paths are filtered once more by a plain Crank-Nicolson solution on a fixed fine grid that is
wide enough for every path; it shares nothing with zakai but the record.
"""

from __future__ import annotations

import argparse
import json
import time

import numpy as np
from scipy.linalg import solve_banded

import zakai

STEP, COUNT = 0.001, 20_000
MODEL = zakai.Model(
    state=["x"],
    drift=["cos(x)"],
    observation=["x**3"],
    observation_kind="increments",
    prior={"kind": "density", "log_density": "-10*x**2"},
)


def reference_mean(increments: np.ndarray) -> np.ndarray:
    """The means (K,), by half of the likelihood, Crank-Nicolson for the Kolmogorov equation, the other half."""
    x = np.arange(-12.0, 16.0, 0.01)
    cell = x[1] - x[0]
    middle = np.cos(0.5 * (x[1:] + x[:-1])) / 2
    rate = 0.5 / cell**2
    # Fluxes of a finite volume scheme: what leaves a cell enters the next.
    down, up = rate + middle / cell, rate - middle / cell
    lower, upper = np.append(down, 0.0), np.append(0.0, up)
    diagonal = -(np.append(down, 0.0) + np.append(0.0, up))
    left = np.zeros((3, len(x)))
    left[0, 1:], left[1], left[2, :-1] = -0.5 * STEP * up, 1 - 0.5 * STEP * diagonal, -0.5 * STEP * down
    u = np.exp(-10 * x**2)
    cubes, squares = x**3, x**6
    means = np.empty(len(increments))
    for k, increment in enumerate(increments):
        logs = 0.5 * (cubes * increment - 0.5 * squares * STEP)
        # The tails' factors overflow where nothing of the density is.
        top = logs[u > 1e-13 * u.max()].max()
        factor = np.exp(np.minimum(logs - top, 40.0))
        u = u * factor
        right = u + 0.5 * STEP * (diagonal * u + np.append(0.0, lower[:-1] * u[:-1]) + np.append(upper[1:] * u[1:], 0.0))
        u = np.maximum(solve_banded((1, 1), left, right), 0.0) * factor
        u /= u.sum()
        means[k] = x @ u
    return means


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--paths", type=int, default=100)
    parser.add_argument("--references", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    times = STEP * np.arange(1, COUNT + 1)
    errors, normalised, taken, warned, apart, ratios = [], [], [], 0, [], []
    for path in range(arguments.paths):
        truth, record = zakai.simulate(MODEL, times, seed=arguments.seed + path, initial=[0.0])
        x = np.asarray(truth.values)[-COUNT:, 0]
        begin = time.perf_counter()
        result = zakai.filter(MODEL, record, keep="moments")
        taken.append(1e6 * (time.perf_counter() - begin) / COUNT)
        error = result.mean[1:, 0] - x
        errors.append(np.sqrt(np.mean(error**2)))
        normalised.append(np.mean(error**2 / result.variance[1:, 0]))
        warned += bool(result.warnings)
        if path < arguments.references:
            mean = reference_mean(np.asarray(record.values)[:, 0])
            apart.append(np.sqrt(np.mean((mean - result.mean[1:, 0]) ** 2)))
            ratios.append(errors[-1] / np.sqrt(np.mean((mean - x) ** 2)))
    figures = {
        "paths": arguments.paths,
        "rms_error": round(float(np.mean(errors)), 5),
        "worst_path": round(float(np.max(errors)), 5),
        "normalised_squared_error": round(float(np.mean(normalised)), 4),
        "paths_with_warnings": warned,
        "rms_distance_from_reference": [float(f"{value:.2g}") for value in apart],
        "rms_error_over_that_of_reference": [round(float(value), 6) for value in ratios],
        "us_per_observation": round(float(np.median(taken)), 2),
    }
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
