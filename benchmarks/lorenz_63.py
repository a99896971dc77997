"""Lorenz' system of 1963, sampled as by Sakov, Oliver and Bertino (2012): all three coordinates every .25, noise of variance 2.

    python benchmarks/lorenz_63.py [--observations 1000] [--noise 0.01] [--tolerance 0.1] [--seed 1]

The truth is without process noise, by Runge and Kutta's formula with steps of .01; the model of the filter has the noise that
its operator needs, `--noise` times the identity a unit of time.  Printed are the root mean square error over the three
coordinates, its mean in time after 100 observations (a quarter of a short record), the seconds of the call with all compilation,
the health and the warnings.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

import zakai

EVERY, VARIANCE, STEP = 0.25, 2.0, 0.01


def drift(x: np.ndarray) -> np.ndarray:
    return np.array([10 * (x[1] - x[0]), 28 * x[0] - x[1] - x[0] * x[2], x[0] * x[1] - 8 / 3 * x[2]])


def moved(x: np.ndarray, count: int) -> np.ndarray:
    for _ in range(count):
        k1 = drift(x)
        k2 = drift(x + STEP / 2 * k1)
        k3 = drift(x + STEP / 2 * k2)
        k4 = drift(x + STEP * k3)
        x = x + STEP / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


def simulated(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The state at the start, a point of the attractor; the states (count, 3) and their observations."""
    rng = np.random.default_rng(seed)
    start = x = moved(np.array([1.509, -1.531, 25.46]) + rng.normal(size=3), 2000)
    states = []
    for _ in range(count):
        x = moved(x, round(EVERY / STEP))
        states.append(x)
    return start, np.array(states), np.array(states) + np.sqrt(VARIANCE) * rng.normal(size=(count, 3))


def system(mean: np.ndarray, noise: float) -> zakai.Model:
    return zakai.Model(
        name="Lorenz 1963",
        state=["x", "y", "z"],
        drift=["10*(y - x)", "28*x - y - x*z", "x*y - 8*z/3"],
        observation=["x", "y", "z"],
        observation_kind="samples",
        process_noise=np.diag([noise] * 3).tolist(),
        observation_noise=np.diag([VARIANCE] * 3).tolist(),
        prior={"kind": "gaussian", "mean": mean.tolist(), "cov": np.eye(3).tolist()},
    )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--observations", type=int, default=1000)
    parser.add_argument("--noise", type=float, default=0.01)
    parser.add_argument("--tolerance", type=float, default=0.1)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    start, states, values = simulated(given.observations, given.seed)
    first = start + np.random.default_rng([given.seed, 1]).normal(size=3)
    record = zakai.Record(EVERY * np.arange(1, given.observations + 1), values, "samples")
    begin, cpu = time.perf_counter(), time.process_time()
    result = zakai.filter(
        system(first, given.noise), record, "yau-yau", tolerance=given.tolerance, keep="moments"
    )
    seconds, cpu = time.perf_counter() - begin, time.process_time() - cpu
    errors = np.sqrt(np.mean((result.mean[1:] - states) ** 2, axis=1))
    later = slice(min(100, given.observations // 4), None)
    print(f"{given.observations} observations, noise {given.noise:g}, tolerance {given.tolerance:g}, seed {given.seed}")
    print(f"RMSE {errors[later].mean():.3f}, median {np.median(errors[later]):.3f}, largest {errors[later].max():.2f}")
    print(f"deviation as the filter has it {np.sqrt(result.variance[1:].mean(axis=1))[later].mean():.3f}")
    print(f"{seconds:.1f} s, {cpu:.1f} s of the processor, compilation included")
    for name, figures in result.health.items():
        figures = figures[1:]
        print(f"{name}: median {np.median(figures):.2g}, 95% {np.quantile(figures, 0.95):.2g}, largest {figures.max():.2g}")
    for warning in result.warnings:
        print(f"warning: {warning}")


if __name__ == "__main__":
    main()
