"""How a Gaussian sum is kept small, and what that costs: the spiral sensor of Chen, Luo and Yau (2017).

On the same Euler paths every reduction of `general-direct` and the exact `limited-direct`: mean squared errors, and a picture of
the density where Algorithm 1 has lost a mode.

    python benchmarks/reductions.py [--paths 6] [--steps 500] [--picture docs/images/algorithm-1.png]
"""

from __future__ import annotations

import argparse
import json

import numpy as np

import zakai
from zakai.studies.chen_luo_yau_2017 import STEP, euler_paths

WAYS = {
    "split-merge": {},
    "algorithm-1, alpha = 0.1": {"reduction": "algorithm-1", "alpha": 0.1},
    "algorithm-1, alpha = 0.01": {"reduction": "algorithm-1", "alpha": 0.01},
    "algorithm-1, alpha = 0.001": {"reduction": "algorithm-1", "alpha": 0.001},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--paths", type=int, default=6)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--picture")
    given = parser.parse_args()
    states, increments = euler_paths(np.random.default_rng(20170111), given.paths, given.steps)
    model = zakai.load_model("gallery:spiral-sensor")
    times = STEP * np.arange(1, given.steps + 1)
    records = [zakai.Record(times, observed, "increments") for observed in increments]
    exact = [zakai.filter(model, record, "limited-direct") for record in records]
    figures = {"exact": squared_error(exact, states)}
    results = {}
    for name, options in WAYS.items():
        results[name] = [zakai.filter(model, record, "general-direct", **options) for record in records]
        figures[name] = squared_error(results[name], states)
        away = np.sqrt(squared_error(results[name], np.stack([result.mean[:, 0] for result in exact])))
        percent = 100 * (figures[name] / figures["exact"] - 1)
        print(f"{name:28s} {figures[name]:.4f}  ({percent:+.2f} %), {away:.3f} from the exact mean (rms)", flush=True)
    print(json.dumps(figures))
    if given.picture:
        draw(given.picture, exact, results["algorithm-1, alpha = 0.1"], states)


def squared_error(results, states) -> float:
    """The mean over paths and times of (x - xhat)^2."""
    return float(np.mean([(result.mean[:, 0] - state) ** 2 for result, state in zip(results, states)]))


def draw(path: str, exact, lossy, states) -> None:
    """The exact density and Algorithm 1's at the time at which their means are furthest apart."""
    from matplotlib.figure import Figure

    apart = [np.abs(a.mean[:, 0] - b.mean[:, 0]) for a, b in zip(exact, lossy)]
    which = int(np.argmax([a.max() for a in apart]))
    first = int(np.argmax(apart[which] > 0.3 * apart[which].max()))
    a, b, state = exact[which], lossy[which], states[which]
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    x = np.linspace(min(a.mean.min(), state.min()) - 5, max(a.mean.max(), state.max()) + 5, 1500)
    for density, label, style in ((a.density(first), "exact", "-"), (b.density(first), "Algorithm 1, α = 0.1", "--")):
        left.plot(x, np.exp(density.log_density(x[:, None])), style, label=label, linewidth=1.2)
    left.axvline(state[first], color="0.5", linewidth=0.8, label="truth")
    left.set(xlabel="x", ylabel="density", title=f"t = {a.times[first]:.2f}")
    left.legend(frameon=False, fontsize=8)
    lines = ((state, "truth", "0.5"), (a.mean[:, 0], "exact mean", "C0"), (b.mean[:, 0], "Algorithm 1", "C1"))
    for values, label, style in lines:
        right.plot(a.times, values, color=style, label=label, linewidth=1.0)
    right.set(xlabel="t", ylabel="x", title="the means after it")
    right.legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    main()
