"""The cyclist of `examples/cycling`: position and speed from altitudes, against a histogram filter in plain NumPy."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import zakai

FOLDER = Path(__file__).parents[2] / "examples" / "cycling"
RESULTS = json.loads((FOLDER / "results.json").read_text(encoding="utf-8"))


def reference() -> ModuleType:
    """Return the example's plain filter, a script that is in no package."""
    found = importlib.util.spec_from_file_location("cycling_reference", FOLDER / "reference.py")
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


def rows(name: str) -> np.ndarray:
    return np.loadtxt(FOLDER / name, delimiter=",", skiprows=1)


def test_the_second_lap_agrees_with_a_histogram_of_position_and_speed():
    model = zakai.load_model(FOLDER / "cycling.toml")
    record = zakai.read_record(FOLDER / "observations.csv", model)
    values = {name: float(value) for name, value in model.parameters.items()}
    plain, truth = reference(), rows("truth.csv")[:, 1]
    phi, posterior, speed, increments, _ = plain.histogram_filter(record.times, record.values[:, 0], rows("map.csv"), values)
    result = zakai.filter(model, record)
    assert result.method == "yau-yau" and result.warnings == []
    np.testing.assert_allclose(result.log_likelihood_increments[1:], increments, atol=1e-4)
    deviation = np.sqrt(result.variance[1:])
    direction = np.angle(posterior @ np.exp(1j * phi) * np.exp(-1j * result.mean[1:, 0]))
    np.testing.assert_allclose(direction / deviation[:, 0], 0, atol=1e-3)
    np.testing.assert_allclose((result.mean[1:, 1] - speed) / deviation[:, 1], 0, atol=1e-3)
    # Several peaks on the flat half of the loop, then one, near the true position.
    peaks = [np.sum((p > np.roll(p, 1)) & (p > np.roll(p, -1)) & (p > 0.2 * p.max())) for p in posterior]
    assert max(peaks[:30]) >= 3 and max(peaks[-15:]) == 1
    error = np.angle(np.exp(1j * (result.mean[1:, 0] - truth))) * 20_231 / (2 * np.pi)
    assert np.abs(error[40:]).max() < 400
    level = plain.level_of_truth(phi, posterior, truth)
    assert np.mean(level < 0.9) == pytest.approx(RESULTS["calibration"]["truth_in_90_percent"], abs=0.02)
    assert np.mean(level < 0.9) > 0.75 and 0.35 < np.mean(level < 0.5) < 0.65


def test_the_model_file_holds_the_most_likely_parameters_that_the_comparison_found():
    model = zakai.load_model(FOLDER / "cycling.toml")
    for name in ("v0", "relax", "spread"):
        assert float(model.parameters[name]) == pytest.approx(RESULTS["fit"][name], rel=0.01)
