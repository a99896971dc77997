"""Show that the sunspots' filter is right, and what it is good for: `python examples/sunspots/compare.py`, less than a minute.

Writes results.json beside this file.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import reference
from scipy.optimize import minimize

import zakai

HERE = Path(__file__).parent
NAMES = ("omega", "eps", "A", "sigma", "r")
START = {"omega": 0.3, "eps": 0.3, "A": 10.0, "sigma": 0.15, "r": 1.2}


def most_likely(score: Callable[[dict], float]) -> dict[str, float]:
    """The parameters with the largest log-likelihood that a search from START finds."""

    def negative(logs: np.ndarray) -> float:
        return -score(dict(zip(NAMES, map(float, np.exp(logs)), strict=True)))

    corner = np.log(list(START.values()))
    simplex = np.vstack([corner, corner + np.diag([0.03, 0.3, 0.05, 0.2, 0.1])])
    options = {"xatol": 1e-3, "fatol": 1e-3, "maxfev": 500, "initial_simplex": simplex}
    found = minimize(negative, corner, method="Nelder-Mead", options=options)
    return dict(zip(NAMES, map(float, np.exp(found.x)), strict=True)) | {"log_likelihood": -float(found.fun)}


def main() -> None:
    model = zakai.load_model(HERE / "sunspots.toml")
    record = zakai.read_record(HERE / "observations.csv", model)
    observations = record.values[:, 0]

    def extended_kalman(values: dict) -> float:
        return zakai.filter(model.with_parameters(**values), record, "extended-kalman-bucy", keep="moments").log_likelihood

    # The plain filter on the circle is smooth in the parameters and takes a tenth of a second.
    found = {
        "fit": most_likely(lambda values: reference.grid_filter(record.times, observations, values, 256, 16)[1].sum()),
        "fit_extended_kalman": most_likely(extended_kalman),
    }
    result = zakai.filter(model, record, "yau-yau")
    extended = zakai.filter(model, record, "extended-kalman-bucy")
    values = {name: float(value) for name, value in model.parameters.items()}
    field, increments, below = reference.grid_filter(record.times, observations, values)
    densities = [result.density(k) for k in range(1, len(field) + 1)]
    ours = np.array([density.weights.ravel() @ np.sin(density.points.ravel()) for density in densities])
    found["yau_yau"] = {
        "log_likelihood": result.log_likelihood,
        "extended_kalman_log_likelihood": extended.log_likelihood,
        "warnings": len(result.warnings),
        "largest_health": float(np.nanmax(result.health["missed"])),
        "log_likelihood_difference": abs(result.log_likelihood - increments.sum()),
        "increment_difference": float(np.max(abs(result.log_likelihood_increments[1:] - increments))),
        "field_difference": float(np.max(abs(values["A"] * ours - field))),
        "within_90_percent": float(np.mean((below > 0.05) & (below < 0.95))),
        "within_50_percent": float(np.mean((below > 0.25) & (below < 0.75))),
    }
    rounded = json.loads(json.dumps(found, default=float), parse_float=lambda text: float(f"{float(text):.6g}"))
    (HERE / "results.json").write_text(json.dumps(rounded, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(rounded, indent=2))


if __name__ == "__main__":
    main()
