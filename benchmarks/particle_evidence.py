"""Errors that `guided-particles` reports with few particles, against the spread over seeds, on systems that shaped no rule.

    python benchmarks/particle_evidence.py [SYSTEM ...] [--seeds 64] [--particles 500]

For each system, in this order: the error of the log-likelihood (rms over seeds, about the logarithm of the mean likelihood of all
seeds), the reported error over it, and the share of seeds within 1.96 reported errors; for the means the reported error over the
true one (rms over times and states, about the mean of all seeds) and the share within 1.96 reported errors; the share of seeds
whose report calls itself a lower bound at some time, and that of seeds with a warning.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import several_states
from several_states import system, times

import zakai


def oscillators():
    """Two coupled oscillators of van der Pol, seen by the sum of their places."""
    return system(
        ["x", "v", "y", "w"], ["v", "1.2*(1 - x**2)*v - x + 0.5*(y - x)", "w", "0.8*(1 - y**2)*w - y + 0.5*(x - y)"],
        {1: 0.4, 3: 0.4}, ["x + y"], [0.05], [1.0, 0.0, -0.5, 0.0], [0.5] * 4,
    ), times(30, 0.1, 0.4)  # fmt: skip


def reactions():
    """A chain of three reactions, of which the last substance and a product are seen."""
    return system(
        ["a", "b", "c"], ["1 - a - 0.5*a*b", "a - 0.8*b - 0.3*b*c", "b - 0.6*c"], {0: 0.1, 1: 0.1, 2: 0.1}, ["c", "a*b"],
        [0.01, 0.02], [0.7, 0.6, 0.7], [0.05] * 3,
    ), times(30, 0.2, 0.8)  # fmt: skip


def lorenz():
    """Lorenz' system of 1963, seen by its first coordinate."""
    return system(
        ["x", "y", "z"], ["10*(y - x)", "x*(28 - z) - y", "x*y - 8/3*z"], {0: 1.0, 1: 1.0, 2: 1.0}, ["x"], [1.0],
        [1.0, 1.0, 20.0], [4.0, 4.0, 9.0],
    ), times(30, 0.05, 0.12)  # fmt: skip


def unicycle():
    """A robot with a heading and a speed; range and bearing of a beacon."""
    return system(
        ["px", "py", "a", "s"], ["s*cos(a)", "s*sin(a)", "0.2", "-0.3*(s - 1)"], {2: 0.3, 3: 0.2},
        ["sqrt(px**2 + py**2)", "atan2(py, px)"], [0.02, 0.005], [2.0, 1.0, 0.5, 1.0], [0.5, 0.5, 0.6, 0.1], periodic=["a"],
    ), times(30, 0.15, 0.5)  # fmt: skip


def drag():
    """A body that falls, with a drag of which the rate varies; the range from a mast."""
    return system(
        ["h", "v", "b", "q"], ["-v", "0.1 - exp(b - h)*v**2", "-0.1*q", "-0.5*q"], {1: 0.02, 3: 0.1}, ["sqrt(9 + h**2)"],
        [1e-3], [4.2, 1.1, 0.1, 0.0], [0.03, 0.02, 0.15, 0.02],
    ), times(30, 0.1, 0.3)  # fmt: skip


def pendulums():
    """Two pendulums joined by a spring."""
    return system(
        ["a", "p", "b", "q"], ["p", "-sin(a) - 0.2*p + 0.4*(b - a)", "q", "-sin(b) - 0.2*q + 0.4*(a - b)"], {1: 0.4, 3: 0.4},
        ["sin(a)", "cos(b)"], [0.02, 0.02], [0.5, 0.0, -0.5, 0.0], [0.3] * 4,
    ), times(30, 0.2, 0.5)  # fmt: skip


OWN = {f.__name__: f for f in (oscillators, reactions, lorenz, unicycle, drag, pendulums)}
SYSTEMS = {**several_states.SYSTEMS, **OWN}
FIGURES = ("states", "error", "ratio", "covered", "of means", "covered ", "marked", "warned")


def rms(values: np.ndarray) -> float:
    """Return the root of the mean of squares."""
    return float(np.sqrt(np.mean(np.square(values))))


def measure(name: str, seeds: int, particles: int) -> list[float]:
    """Return the figures of one system."""
    model, when = SYSTEMS[name]()
    when = when.copy()
    when[10:] += 4.0 * np.median(np.diff(when))  # two gaps
    when[20:] += 4.0 * np.median(np.diff(when))
    _, record = zakai.simulate(model, when, seed=5)
    options = {"particles": particles, "keep": "moments"}
    runs = [zakai.filter(model, record, "guided-particles", seed=seed, **options) for seed in range(seeds)]
    logs = np.array([run.log_likelihood for run in runs])
    errors = logs - (logs.max() + np.log(np.mean(np.exp(logs - logs.max()))))
    reported = np.array([run.log_likelihood_standard_error for run in runs])
    means = np.array([run.mean[1:] for run in runs])
    apart = means - means[0]
    angles = [state in model.periodic for state in model.state]
    apart[..., angles] -= 2 * np.pi * np.round(apart[..., angles] / (2 * np.pi))
    apart = (apart - apart.mean(axis=0)) * np.sqrt(seeds / (seeds - 1))
    own = np.array([run.mean_standard_error[1:] for run in runs])
    deviations = np.sqrt(np.mean([run.variance[1:] for run in runs], axis=0))
    marked = float(np.mean([np.nanmax(run.health["lower_bound"]) > 0 for run in runs]))
    return [
        model.n, rms(errors), rms(reported) / rms(errors), float(np.mean(np.abs(errors) < 1.96 * reported)),
        rms(own / deviations) / rms(apart / deviations), float(np.mean(np.abs(apart) < 1.96 * own)), marked,
        float(np.mean([bool(run.warnings) for run in runs])),
    ]  # fmt: skip


def main() -> None:
    """Print a line for each system."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("systems", nargs="*", default=list(SYSTEMS))
    parser.add_argument("--seeds", type=int, default=64)
    parser.add_argument("--particles", type=int, default=500)
    given = parser.parse_args()
    print(f"{'':12}", *(f"{key:>9}" for key in FIGURES))
    for name in given.systems or SYSTEMS:
        print(f"{name:12}", *(f"{value:9.3g}" for value in measure(name, given.seeds, given.particles)), flush=True)


if __name__ == "__main__":
    main()
