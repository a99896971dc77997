"""Check the filter of the volatility: `python examples/stock-volatility/compare.py`, less than a minute.

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


def most_likely(returns: np.ndarray) -> dict[str, float]:
    """Return the parameters with the largest log-likelihood."""

    def values(q: np.ndarray) -> dict[str, float]:
        return {"k": float(np.exp(q[0])), "s": float(np.exp(q[1])), "mu": float(q[2]), "m": float(q[3])}

    found = minimize(
        lambda q: -float(reference.grid_filter(returns, values(q), 201)[1].sum()),
        [-3.5, -1.4, 0.3, 0.05],
        method="Nelder-Mead",
        options={"xatol": 2e-3, "fatol": 1e-3},
    )
    return values(found.x) | {"log_likelihood": -float(found.fun)}


def main() -> None:
    model = zakai.load_model(HERE / "stock-volatility.toml")
    record = zakai.read_record(HERE / "observations.csv", model)
    returns, values = record.values[:, 0], {name: float(value) for name, value in model.parameters.items()}
    result = zakai.filter(model, record)
    mean, increments, below = reference.grid_filter(returns, values)
    constant = -0.5 * (np.log(2 * np.pi * returns.var()) + 1) * len(returns)
    found = {
        "fit": most_likely(returns),
        "filter": {
            "method": result.method,
            "log_likelihood": result.log_likelihood,
            "constant_volatility_log_likelihood": float(constant),
            "warnings": len(result.warnings),
            "increment_difference": float(np.max(np.abs(result.log_likelihood_increments[1:] - increments))),
            "mean_difference": float(np.max(np.abs(result.mean[1:, 0] - mean) / np.sqrt(result.variance[1:, 0]))),
        },
        "calibration": {
            "in_50_percent": float(np.mean(np.abs(below - 0.5) < 0.25)),
            "in_90_percent": float(np.mean(np.abs(below - 0.5) < 0.45)),
            "in_99_percent": float(np.mean(np.abs(below - 0.5) < 0.495)),
        },
    }
    rounded = json.loads(json.dumps(found), parse_float=lambda text: float(f"{float(text):.5g}"))
    (HERE / "results.json").write_text(json.dumps(rounded, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(rounded, indent=2))


if __name__ == "__main__":
    main()
