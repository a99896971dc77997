"""The volatility of `examples/stock-volatility`: daily returns, against Bayes' rule on a grid in plain NumPy."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

import zakai

FOLDER = Path(__file__).parents[2] / "examples" / "stock-volatility"
RESULTS = json.loads((FOLDER / "results.json").read_text(encoding="utf-8"))


def test_six_years_of_returns_agree_with_bayes_rule_on_a_grid():
    found = importlib.util.spec_from_file_location("volatility_reference", FOLDER / "reference.py")
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    model = zakai.load_model(FOLDER / "stock-volatility.toml")
    record = zakai.read_record(FOLDER / "observations.csv", model)
    values = {name: float(value) for name, value in model.parameters.items()}
    mean, increments, below = module.grid_filter(record.values[:, 0], values)
    result = zakai.filter(model, record, keep="moments")
    assert result.method == "limited-direct" and result.warnings == []
    # The file rounds the variance of the prior, which the first days remember.
    np.testing.assert_allclose(result.log_likelihood_increments[1:], increments, atol=1e-4)
    np.testing.assert_allclose((result.mean[1:, 0] - mean) / np.sqrt(result.variance[1:, 0]), 0, atol=1e-3)
    assert result.log_likelihood == pytest.approx(RESULTS["filter"]["log_likelihood"], abs=0.1)
    assert result.log_likelihood > RESULTS["filter"]["constant_volatility_log_likelihood"] + 100
    assert np.mean(np.abs(below - 0.5) < 0.45) == pytest.approx(0.9, abs=0.03)
    assert np.mean(np.abs(below - 0.5) < 0.25) == pytest.approx(0.5, abs=0.04)


def test_the_model_file_holds_the_most_likely_parameters_that_the_comparison_found():
    model = zakai.load_model(FOLDER / "stock-volatility.toml")
    for name, value in model.parameters.items():
        assert float(value) == pytest.approx(RESULTS["fit"][name], rel=0.05)
