"""Standard errors that `guided-particles` reports, against the spread over seeds, and error and time against a bootstrap filter.

    python benchmarks/particle_errors.py [SYSTEM ...] [--seeds N]

The reference of each system is the mean of two runs of `guided-particles` with 40,000 particles and other seeds.  `apart` is its
distance from the mean of two plain bootstrap filters in NumPy with 100,000 particles each, in standard deviations.  The error of
these is taken from their distance, as that of the reference is as large.  Times are those of the processor in milliseconds an
observation; `gain` is error^2 x time of a bootstrap filter over ours.
"""

from __future__ import annotations

import argparse
import os
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from particle_systems import SYSTEMS, bootstrap, problem

import zakai

REFERENCE, PEER = 40_000, 100_000


def apart(model: zakai.Model, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return differences, those of angles wrapped."""
    d = a - b
    angles = [name in model.periodic for name in model.state]
    d[..., angles] -= 2 * np.pi * np.round(d[..., angles] / (2 * np.pi))
    return d


def rms(values: np.ndarray) -> float:
    """Return the root of the mean of squares."""
    return float(np.sqrt(np.mean(np.square(values))))


def measure(name: str, seeds: int) -> dict[str, float]:
    """Return the figures of one system."""
    model, record = problem(name)
    steps = SYSTEMS[name][2]
    big = [zakai.filter(model, record, "guided-particles", particles=REFERENCE, seed=1000 + i, keep="moments") for i in range(2)]
    clock = time.process_time()
    filters = [bootstrap(model, record, PEER, i, steps) for i in range(2)]
    other_time = (time.process_time() - clock) / len(filters)
    sd = np.sqrt(np.mean([one.variance[1:] for one in big], axis=0))
    angles = apart(model, big[1].mean[1:], big[0].mean[1:])
    reference = big[0].mean[1:] + 0.5 * angles
    theirs = filters[0][0] + 0.5 * apart(model, filters[1][0], filters[0][0])
    likelihood = float(np.mean([one.log_likelihood for one in big]))
    runs, spent = [], []
    for seed in range(seeds):
        clock = time.process_time()
        runs.append(zakai.filter(model, record, "guided-particles", seed=seed, keep="moments"))
        spent.append(time.process_time() - clock)
    errors = np.array([apart(model, run.mean[1:], reference) / sd for run in runs])
    reported = np.array([run.mean_standard_error[1:] / sd for run in runs])
    log_errors = np.array([run.log_likelihood - likelihood for run in runs])
    log_reported = np.array([run.log_likelihood_standard_error for run in runs])
    # The random error from the distance of two, and the bias of its Euler steps from what the distance of their mean from the
    # reference leaves beside the random errors of both.
    random_error = rms(apart(model, filters[1][0], filters[0][0]) / sd) / np.sqrt(2)
    distance = rms(apart(model, reference, theirs) / sd)
    peer_error = np.sqrt(random_error**2 + max(distance**2 - random_error**2 / 2 - (rms(angles / sd) / 2) ** 2, 0.0))
    ours_time = float(np.median(spent))
    return {
        "states": model.n,
        "particles": float(np.mean([np.nanmean(run.health["particles"]) for run in runs])),
        "error": rms(errors),
        "reported": rms(reported),
        "coverage": float(np.mean(np.abs(errors) < 1.96 * reported)),
        "marked": float(np.mean([np.nanmean(run.health["lower_bound"]) for run in runs])),
        "log error": rms(log_errors),
        "reported ": rms(log_reported),
        "largest z": float(np.abs(log_errors / log_reported).max()),
        "ms": ours_time / len(record) * 1e3,
        "moves": float(np.mean([np.nansum(run.health["moved"]) for run in runs])),
        "peer error": peer_error,
        "peer ms": other_time / len(record) * 1e3,
        "apart": distance,
        "gain": (peer_error / rms(errors)) ** 2 * other_time / ours_time,
    }


def main() -> None:
    """Print a line for each system."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("systems", nargs="*", default=list(SYSTEMS))
    parser.add_argument("--seeds", type=int, default=8)
    given = parser.parse_args()
    first = True
    for name in given.systems or SYSTEMS:
        found = measure(name, given.seeds)
        if first:
            print(f"{'':10}", *(f"{key:>10}" for key in found))
            first = False
        print(f"{name:10}", *(f"{value:10.3g}" for value in found.values()), flush=True)


if __name__ == "__main__":
    main()
