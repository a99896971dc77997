"""How the time of an observation grows with the number of states, by method.

    python benchmarks/scaling.py [--observations 300] [--repeats 5] [--most 16] [--json FILE] [--picture FILE.png]

A chain whose states are all coupled, so that it does not fall into blocks, each seen through a sine, read every 0.05:

    dx_i = (-x_i/2 + (x_{i-1} + x_{i+1} - 2 x_i)/5) dt + dv_i,        dy_i = sin(x_i) dt + dw_i

The exact methods see the states themselves, dy_i = x_i dt + dw_i.  A method is left out for more states than it takes, or than
take more than `--patience` seconds.  What is compiled is so before a clock starts; figures are medians over the repeats, which
all contestants take in turn.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from typing import Any

import numpy as np

import zakai

EXACT = "kalman-bucy", "general-direct", "limited-direct"
STATES = (1, 2, 3, 4, 6, 8, 12, 16)
METHODS: dict[str, tuple[str, int, dict[str, Any]]] = {
    "kalman-bucy": ("kalman-bucy", 99, {}),
    "extended-kalman-bucy": ("extended-kalman-bucy", 99, {}),
    "general-direct": ("general-direct", 6, {}),
    "limited-direct": ("limited-direct", 2, {}),
    "yau-yau": ("yau-yau", 2, {}),
    "yau-yau, tolerance 0.01": ("yau-yau", 3, {"tolerance": 0.01}),
    "ekf (dynamax)": ("ekf", 99, {}),
    "enkf, 100 members (cuthbert)": ("enkf", 99, {}),
    "particle, 1,000 (cuthbert)": ("particle", 99, {}),
}


def chain(n: int, linear: bool) -> zakai.Model:
    names = [f"x{i}" for i in range(n)]
    drift = []
    for i, name in enumerate(names):
        near = [names[j] for j in (i - 1, i + 1) if 0 <= j < n]
        drift.append(f"-{name}/2" + (f" + ({' + '.join(near)} - {len(near)}*{name})/5" if near else ""))
    observation = names if linear else [f"sin({name})" for name in names]
    prior = {"kind": "gaussian", "mean": [0.0] * n, "cov": [0.5] * n}
    return zakai.Model(state=names, drift=drift, observation=observation, prior=prior)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--observations", type=int, default=300)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--most", type=int, default=16, help="states")
    parser.add_argument("--patience", type=float, default=100.0, help="seconds of a first call")
    parser.add_argument("--json")
    parser.add_argument("--picture")
    own = parser.parse_args()
    times = 0.05 * np.arange(1, own.observations + 1)
    rows: list[dict[str, Any]] = []
    tired: set[str] = set()
    for n in (n for n in STATES if n <= own.most):
        runs = []
        for label, (method, most, options) in METHODS.items():
            if n > most or label in tired:
                continue
            model = chain(n, method in EXACT)
            record = zakai.simulate(model, times, seed=n)[1]
            begin = time.perf_counter()
            result = zakai.filter(model, record, method, keep="moments", **options)
            first = time.perf_counter() - begin
            if first > own.patience:
                tired.add(label)
            runs.append((label, model, record, method, options, []))
            rows.append({"method": label, "states": n, "first_call_s": round(first, 2), "warnings": len(result.warnings)})
        for _ in range(own.repeats):
            for _, model, record, method, options, taken in runs:
                begin = time.perf_counter()
                zakai.filter(model, record, method, keep="moments", **options)
                taken.append(1e6 * (time.perf_counter() - begin) / own.observations)
        for row, run in zip(rows[-len(runs) :], runs, strict=True):
            row["us_per_observation"] = round(statistics.median(run[-1]), 1)
            print(json.dumps(row), flush=True)
    if own.json:
        with open(own.json, "w") as file:
            json.dump(rows, file, indent=1)
    if own.picture:
        draw(own.picture, rows)


def draw(path: str, rows: list[dict[str, Any]]) -> None:
    """Time against states, both logarithmic; each line has a marker and its name at its end."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.add_subplot()
    colours = {"zakai": "#1d2430", "dynamax": "#d55e00", "cuthbert": "#2f75ad"}
    for marker, label in zip("os^vD<>Px", METHODS, strict=True):
        mine = [row for row in rows if row["method"] == label]
        if not mine:
            continue
        library = next((name for name in colours if name in label), "zakai")
        xs, ys = [row["states"] for row in mine], [row["us_per_observation"] for row in mine]
        axes.plot(xs, ys, marker=marker, color=colours[library], linewidth=1, markersize=5, label=label)
        axes.annotate(label, (xs[-1], ys[-1]), xytext=(6, -2), textcoords="offset points", fontsize=7, color=colours[library])
    axes.set(xscale="log", yscale="log", xlabel="states", ylabel="time per observation (microseconds)")
    axes.set(xticks=STATES, xticklabels=STATES, xlim=(0.9, 40), title="how cost grows with the number of states")
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main()
