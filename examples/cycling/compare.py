"""Check the cyclist's filter, and measure how good it is: `python examples/cycling/compare.py`, less than a minute.

Writes results.json beside this file.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import reference
from scipy.optimize import minimize

import zakai

HERE = Path(__file__).parent
LAP = 20_231.0  # metres
NAMES = "v0", "relax", "spread"


def read(name: str) -> np.ndarray:
    return np.loadtxt(HERE / name, delimiter=",", skiprows=1)


def most_likely(record: zakai.Record, table: np.ndarray, r: float) -> dict[str, float]:
    """Return the most likely law of the speed for the altitudes of the record, which holds no positions."""

    def negative(logs: np.ndarray) -> float:
        values = dict(zip(NAMES, np.exp(logs), strict=True)) | {"r": r}
        return -float(reference.histogram_filter(record.times, record.values[:, 0], table, values, 512, 32)[3].sum())

    corner = np.log([2.5e-3, 100.0, 8e-4])
    simplex = np.vstack([corner, corner + np.diag([0.1, 0.5, 0.2])])
    found = minimize(negative, corner, method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": 2e-3, "fatol": 1e-4})
    return dict(zip(NAMES, map(float, np.exp(found.x)), strict=True)) | {"log_likelihood": -float(found.fun)}


def calibration(record: zakai.Record, table: np.ndarray, values: dict, truth: np.ndarray) -> dict[str, float]:
    """Return how often the regions with 50 and 90 % of the mass hold the true position, and observations their intervals."""
    phi, posterior, _, _, below = reference.histogram_filter(record.times, record.values[:, 0], table, values)
    level = reference.level_of_truth(phi, posterior, truth)
    apart = np.abs(np.angle(np.exp(1j * (phi - truth[:, None])))) * LAP / (2 * np.pi)
    error = (posterior * apart).sum(axis=1)
    return {
        "truth_in_50_percent": float(np.mean(level < 0.5)),
        "truth_in_90_percent": float(np.mean(level < 0.9)),
        "observation_in_50_percent": float(np.mean(np.abs(below - 0.5) < 0.25)),
        "observation_in_90_percent": float(np.mean(np.abs(below - 0.5) < 0.45)),
        "expected_distance_first_ten": float(error[:10].mean()),
        "expected_distance_last_twenty": float(error[-20:].mean()),
    }


def main() -> None:
    model = zakai.load_model(HERE / "cycling.toml")
    record = zakai.read_record(HERE / "observations.csv", model)
    table, truth = read("map.csv"), read("truth.csv")[:, 1]
    values = {name: float(value) for name, value in model.parameters.items()}
    result = zakai.filter(model, record)
    phi, posterior, speed, increments, _ = reference.histogram_filter(record.times, record.values[:, 0], table, values)
    direction = posterior @ np.exp(1j * phi)
    deviation = np.sqrt(result.variance[1:])
    apart = np.angle(direction * np.exp(-1j * result.mean[1:, 0]))
    found = {
        "fit": most_likely(record, table, values["r"]),
        "filter": {
            "method": result.method,
            "log_likelihood": result.log_likelihood,
            "warnings": len(result.warnings),
            "largest_tolerance_ratio": float(np.nanmax(result.health["tolerance_ratio"])),
            "increment_difference": float(np.max(np.abs(result.log_likelihood_increments[1:] - increments))),
            "position_difference": float(np.max(np.abs(apart) / deviation[:, 0])),
            "speed_difference": float(np.max(np.abs(result.mean[1:, 1] - speed) / deviation[:, 1])),
        },
        "calibration": calibration(record, table, values, truth),
    }
    rounded = json.loads(json.dumps(found), parse_float=lambda text: float(f"{float(text):.5g}"))
    (HERE / "results.json").write_text(json.dumps(rounded, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(rounded, indent=2))


if __name__ == "__main__":
    main()
