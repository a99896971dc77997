"""Error^2 x time of `guided-particles` with and without a Kalman filter in each particle, on systems with linear states.

    python benchmarks/conditionally_linear.py [SYSTEM ...] [--seeds N] [--particles N]

For each system: the states that are linear given the others, the error of the means over seeds in standard deviations of the
state (rms over times, states and seeds), the reported error, the milliseconds of the processor for an observation, and `gain`,
error^2 x time without the Kalman filters over that with them.  `taken` says which of the two `guided-particles` takes; where it
takes draws nothing is measured, as Kalman filters may need very short steps there; `--forced` measures it all the same.
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from collections.abc import Callable
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

import zakai

Problem = tuple[zakai.Model, np.ndarray, zakai.Inputs | None]
GRID = np.arange(0.0, 60.0, 0.5)


def _model(state: str, mean: list[float], cov: list[float], **keys: Any) -> zakai.Model:
    """Return a model with samples and a Gaussian prior of independent states."""
    prior = {"kind": "gaussian", "mean": mean, "cov": cov}
    return zakai.Model(state=state.split(), prior=prior, observation_kind="samples", **keys)


def _irregular(count: int, low: float, high: float) -> np.ndarray:
    return np.cumsum(np.random.default_rng(5).uniform(low, high, count))


def battery() -> Problem:
    """State of charge and the voltages of two RC pairs, seen by the terminal voltage."""
    model = _model(
        "s a b", [0.8, 0, 0], [0.0225, 0.0025, 0.0025], drift=["-I/80", "I/20 - a/2", "I/60 - b/15"], inputs=["I"],
        observation=["3.3 + 0.7*s + tanh(8*s - 1.2)/4 + 0.15*tanh(10*s - 9) + sin(14*s)/20 - a - b"], observation_noise=[[1e-4]],
        diffusion=np.diag([0.004, 0.006, 0.004]), input_hold="linear",
    )  # fmt: skip
    return model, _irregular(40, 0.4, 1.2), zakai.Inputs(GRID, (1 + np.sin(0.3 * GRID))[:, None])


def vehicle(noise: float = 0.02) -> Problem:
    """Position, heading and speed with the biases of a gyroscope and an accelerometer, seen by its position."""
    diffusion = np.zeros((6, 2))
    diffusion[2, 0], diffusion[3, 1] = noise, 0.1
    model = _model(
        "x y h v g a", [0, 0, 0.3, 8, 0, 0], [4, 4, 0.3, 1, 0.0025, 0.04], inputs=["w", "u"], diffusion=diffusion,
        drift=["v*cos(h)", "v*sin(h)", "w - g", "u - a", "0", "0"], observation=["x", "y"], observation_noise=np.eye(2),
    )  # fmt: skip
    rates = np.stack([0.4 * np.sin(0.4 * GRID), 0.5 * np.cos(0.2 * GRID)], axis=1)
    return model, np.arange(1, 41) * 0.5, zakai.Inputs(GRID, rates)


def sinusoid() -> Problem:
    """A sinusoid with unknown amplitudes and a frequency that drifts."""
    model = _model(
        "p w a b", [0, 2, 1, 0], [0.1, 0.04, 1, 1], drift=["w", "0", "0", "0"], observation=["a*cos(p) + b*sin(p)"],
        diffusion=[["0.1", "0"], ["0", "0.05"], ["0", "0"], ["0", "0"]], observation_noise=[[0.09]],
    )  # fmt: skip
    return model, _irregular(40, 0.1, 0.5), None


def price() -> Problem:
    """A logarithm of a price and its variance, with correlated noise (Heston 1993)."""
    model = _model(
        "s V", [0, 0.05], [1e-4, 1e-4], drift=["0.05 - V/2", "0.08 - 2*V"], domain={"V": {"lower": 0.0}}, observation=["s"],
        diffusion=[["0.6*sqrt(V)", "0.8*sqrt(V)"], ["-0.3*sqrt(V)", "0"]], observation_noise=[[1e-5]],
    )  # fmt: skip
    return model, np.arange(1, 41) * 0.02, None


def decay() -> Problem:
    """Two substances in a chain of reactions with an unknown rate."""
    model = _model(
        "A B k", [2, 0, 0.5], [0.04, 0.01, 0.04], drift=["-k*A", "k*A - B", "0"], observation=["B"], observation_noise=[[0.0025]],
        diffusion=[["0.05", "0"], ["0", "0.05"], ["0", "0"]],
    )  # fmt: skip
    return model, np.arange(1, 31) * 0.2, None


def sensors() -> Problem:
    """A pendulum, seen by three sensors with biases."""
    diffusion = np.zeros((5, 2))
    diffusion[1, 0], diffusion[3, 1] = 0.3, 0.1
    model = _model(
        "x v a b c", [0.5, 0, 0, 0, 0], [0.2, 0.2, 0.1, 0.1, 0.1], drift=["v", "-4*sin(x) - v/5", "0", "-b/10", "0"],
        observation=["sin(x) + a", "cos(x) + b", "v + c"], observation_noise=0.01 * np.eye(3), diffusion=diffusion,
    )  # fmt: skip
    return model, np.arange(1, 41) * 0.2, None


def radar(noise: float = 0.5) -> Problem:
    """A target with noise in its position, seen as range and bearing."""
    model = _model(
        "x y u v", [5, 5, -0.3, 0.1], [1, 1, 0.1, 0.1], drift=["u", "v", "0", "0"], diffusion=np.diag([noise, noise, 0.1, 0.1]),
        observation=["sqrt(x**2 + y**2)", "atan2(y, x)"], observation_noise=np.diag([0.01, 1e-4]),
    )  # fmt: skip
    return model, _irregular(40, 0.2, 0.6), None


def lorenz_96() -> Problem:
    """Six variables of Lorenz, four of them seen."""
    names = [f"x{i}" for i in range(6)]
    model = _model(
        " ".join(names), [2, 3, -1, 4, 2, 0], [4.0] * 6, observation=["x0", "x1", "x3", "x4"], observation_noise=0.5 * np.eye(4),
        drift=[f"(x{(i + 1) % 6} - x{(i - 2) % 6})*x{(i - 1) % 6} - x{i} + 8" for i in range(6)], diffusion=np.eye(6),
    )  # fmt: skip
    return model, _irregular(40, 0.05, 0.11), None


SYSTEMS: dict[str, Callable[[], Problem]] = {
    "battery": battery,
    "vehicle": vehicle,
    "vehicle, precise gyroscope": lambda: vehicle(0.005),
    "sinusoid": sinusoid,
    "price": price,
    "decay": decay,
    "sensors": sensors,
    "radar": radar,
    "radar, noise 0.02": lambda: radar(0.02),
    "Lorenz-96": lorenz_96,
}


def measure(name: str, seeds: int, particles: int, forced: bool) -> tuple[str, list[float], str]:
    """Return the linear states, the figures, and which way is taken."""
    model, times, inputs = SYSTEMS[name]()
    _, record = zakai.simulate(model, times, seed=1, inputs=inputs)
    options: dict[str, Any] = {"inputs": inputs, "keep": "moments", "particles": particles}
    linear = ", ".join(zakai.analyze(model).conditionally_linear)
    first = zakai.Record(record.times[:1], record.values[:1], record.kind)
    taken = zakai.filter(model, first, "guided-particles", **{**options, "particles": 200}).health["linear_states"][-1] > 0
    if not taken and not forced:
        return linear, [np.nan] * 7, "draws"
    runs: dict[bool, list[Any]] = {True: [], False: []}
    spent: dict[bool, list[float]] = {True: [], False: []}
    for seed in range(seeds):
        for split in runs:
            clock = time.process_time()
            runs[split].append(zakai.filter(model, record, "guided-particles", split=split, seed=seed, **options))
            spent[split].append((time.process_time() - clock) / len(times) * 1e3)
    variance = np.mean([run.variance[1:] for run in runs[True]], axis=0)
    figures = []
    for split in runs:
        means = np.array([run.mean[1:] for run in runs[split]])
        error = np.sqrt(np.mean(means.var(axis=0, ddof=1) / variance))
        reported = np.sqrt(np.mean([run.mean_standard_error[1:] ** 2 / variance for run in runs[split]]))
        figures += [error, reported, float(np.median(spent[split]))]
    gain = (figures[3] / figures[0]) ** 2 * figures[5] / figures[2]
    return linear, [*figures, gain], "Kalman filters" if taken else "draws"


def main() -> None:
    """Print a line for each system."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("systems", nargs="*", default=list(SYSTEMS))
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--forced", action="store_true")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    heads = ("error", "reported", "ms", "drawn", "reported", "ms", "gain")
    print(f"{'':28}{'linear':16}", *(f"{head:>9}" for head in heads), " taken")
    for name in given.systems or SYSTEMS:
        linear, figures, taken = measure(name, given.seeds, given.particles, given.forced)
        print(f"{name:28}{linear:16}", *(f"{value:9.3g}" for value in figures), f" {taken}", flush=True)


if __name__ == "__main__":
    main()
