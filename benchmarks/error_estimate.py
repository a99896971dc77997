"""Is `error_estimate` honest? The error of `yau-yau` beside its own estimate, on problems with a known or a converged answer.

    python benchmarks/error_estimate.py [--tolerance 1e-4 1e-2] [--seeds 3]

The error is the largest over a record of |mean - true mean| in deviations and |variance / true variance - 1|; the estimate is
the largest of the same record. True is what an exact filter gives, where there is one, or else `yau-yau` at a tolerance of 1e-8.
"""

from __future__ import annotations

import argparse
from typing import Any, NamedTuple

import numpy as np

import zakai


class Problem(NamedTuple):
    """A model, the step and the number of its observations, and the method of the reference."""

    keys: dict[str, Any]
    step: float
    count: int
    exact: str | None = None


def linear(n: int, **more: Any) -> dict[str, Any]:
    drift = [" + ".join(f"{-0.5 if i == j else 0.3 * (-1) ** i / (1 + abs(i - j))}*x{j}" for j in range(n)) for i in range(n)]
    prior = {"kind": "gaussian", "mean": [0.5] * n, "cov": np.eye(n).tolist()}
    return dict(state=[f"x{i}" for i in range(n)], drift=drift, observation=["x0"], prior=prior, **more)


def one(drift: str, *observation: str, mean: float = 0.0, variance: float = 1.0, **more: Any) -> dict[str, Any]:
    prior = {"kind": "gaussian", "mean": [mean], "cov": [[variance]]}
    return dict(state=["x"], drift=[drift], observation=list(observation), prior=prior, **more)


SAMPLES = dict(observation_kind="samples")
VAN_DER_POL = dict(
    state=["x", "v"], drift=["v", "0.3*(1 - x**2)*v - x"], diffusion=[["0"], ["1"]], process_noise=[["1"]], observation=["x"],
    prior={"kind": "gaussian", "mean": [0.5, 0.0], "cov": [[0.5, 0.0], [0.0, 0.5]]},
)  # fmt: skip
PROBLEMS = {
    "linear, n = 1, every 0.1": Problem(linear(1), 0.1, 100, "kalman-bucy"),
    "linear, n = 2, every 0.05": Problem(linear(2), 0.05, 100, "kalman-bucy"),
    "linear, n = 3, every 0.05": Problem(linear(3), 0.05, 30, "kalman-bucy"),
    "linear, n = 2, samples every 0.5": Problem(linear(2, **SAMPLES), 0.5, 40, "kalman-bucy"),
    "Benes, every 0.01": Problem(one("tanh(x)", "x"), 0.01, 400, "benes"),
    "Benes, every 0.1": Problem(one("tanh(x)", "x"), 0.1, 100, "benes"),
    "cubic sensor, every 0.001": Problem(one("cos(x)", "x**3", variance=0.05), 0.001, 1000),
    "cubic sensor, every 0.005": Problem(one("cos(x)", "x**3", variance=0.05), 0.005, 400),
    "spiral sensor, every 0.01": Problem(one("t/40*x", "x*sin(x)", "x*cos(x)", mean=0.1, variance=3.0), 0.01, 400),
    "spiral sensor, every 0.04": Problem(one("t/40*x", "x*sin(x)", "x*cos(x)", mean=0.1, variance=3.0), 0.04, 200),
    "three wells, every 0.02": Problem(one("3*sin(2*x)/2", "x**2"), 0.02, 300),
    "double well, samples every 0.5": Problem(one("x - x**3", "x", **SAMPLES), 0.5, 60),
    "Van der Pol, every 0.02": Problem(VAN_DER_POL, 0.02, 150),
    "Van der Pol, samples every 0.5": Problem({**VAN_DER_POL, **SAMPLES}, 0.5, 30),
}


def error(result: zakai.FilterResult, true: zakai.FilterResult) -> float:
    means = np.abs(result.mean - true.mean) / np.sqrt(true.variance)
    return float(max(means[1:].max(), np.abs(result.variance / true.variance - 1)[1:].max()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tolerance", type=float, nargs="*", default=[1e-4, 1e-2])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--only", default="", help="problems whose name holds this")
    own = parser.parse_args()
    print(f"{'':34}{'tolerance':>10}{'error':>10}{'estimate':>10}{'ratio':>8}  warnings")
    for name, problem in PROBLEMS.items():
        if own.only not in name:
            continue
        model = zakai.Model(**problem.keys)
        times = problem.step * np.arange(1, problem.count + 1)
        for seed in range(own.seeds):
            record = zakai.simulate(model, times, seed=seed)[1]
            if problem.exact:
                true = zakai.filter(model, record, problem.exact, keep="moments")
            else:
                true = zakai.filter(model, record, "yau-yau", keep="moments", tolerance=1e-8)
            for tolerance in own.tolerance:
                result = zakai.filter(model, record, "yau-yau", keep="moments", tolerance=tolerance)
                off, estimate = error(result, true), float(np.nanmax(result.health["error_estimate"]))
                print(f"{name:34}{tolerance:10.0e}{off:10.1e}{estimate:10.1e}{off / estimate:8.2f}  "
                      f"{len(result.warnings)}", flush=True)


if __name__ == "__main__":
    main()
