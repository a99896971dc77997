"""The sunspots of `examples/sunspots`: a real record without an exact filter, against Bayes' rule in plain NumPy."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

import zakai

FOLDER = Path(__file__).parents[2] / "examples" / "sunspots"
RESULTS = json.loads((FOLDER / "results.json").read_text(encoding="utf-8"))


def plain(record: zakai.Record, values: dict[str, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The example's plain filter, of a script that is in no package."""
    found = importlib.util.spec_from_file_location("sunspots_reference", FOLDER / "reference.py")
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module.grid_filter(record.times, record.values[:, 0], values)


def test_three_centuries_of_sunspots_agree_with_bayes_rule_on_the_circle():
    model = zakai.load_model(FOLDER / "sunspots.toml")
    record = zakai.read_record(FOLDER / "observations.csv", model)
    values = {name: float(value) for name, value in model.parameters.items()}
    field, increments, below = plain(record, values)
    result = zakai.filter(model, record, "yau-yau")
    assert result.warnings == []
    np.testing.assert_allclose(result.log_likelihood_increments[1:], increments, atol=3e-4)
    assert result.log_likelihood == pytest.approx(RESULTS["yau_yau"]["log_likelihood"], abs=1e-3)
    for k in (1, 12, 100, 309):
        density = result.density(k)
        mean = values["A"] * (density.weights.ravel() @ np.sin(density.points.ravel()))
        assert mean == pytest.approx(field[k - 1], abs=1e-3)
    assert 0.87 < np.mean((below > 0.05) & (below < 0.95)) < 0.95
    extended = zakai.filter(model, record, "extended-kalman-bucy", keep="moments")
    assert result.log_likelihood > extended.log_likelihood + 50


def test_the_model_file_holds_the_most_likely_parameters_that_the_comparison_found():
    model = zakai.load_model(FOLDER / "sunspots.toml")
    for name, value in model.parameters.items():
        assert float(value) == pytest.approx(RESULTS["fit"][name], rel=0.005)


def test_the_plain_filter_finds_these_parameters_more_likely_than_others():
    model = zakai.load_model(FOLDER / "sunspots.toml")
    record = zakai.read_record(FOLDER / "observations.csv", model)
    values = {name: float(value) for name, value in model.parameters.items()}
    best = plain(record, values)[1].sum()
    for name in values:
        for factor in (0.9, 1.1):
            assert plain(record, values | {name: values[name] * factor})[1].sum() < best
