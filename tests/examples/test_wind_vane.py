"""The wind vane of `examples/wind-vane`: a real record on the circle, against plain NumPy filters that use nothing of zakai."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import zakai

FOLDER = Path(__file__).parents[2] / "examples" / "wind-vane"


def script(name: str) -> ModuleType:
    """A script of the example, which is no package."""
    found = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = sys.modules[name] = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


reference = script("reference")
RESULTS = json.loads((FOLDER / "results.json").read_text(encoding="utf-8"))


def first_hours(model: zakai.Model, count: int) -> zakai.Record:
    record = zakai.read_record(FOLDER / "observations.csv", model)
    return zakai.Record(record.times[:count], record.values[:count], record.kind)


def angle_between(direction: np.ndarray, mean: np.ndarray) -> np.ndarray:
    return np.abs(np.angle(direction * np.exp(-1j * mean)))


def test_a_hundred_days_of_wind_agree_with_bayes_rule_on_the_circle():
    model = zakai.load_model(FOLDER / "wind-vane.toml")
    record = first_hours(model, 2420)  # the wind turns round several times in the last days
    assert 5 < np.isnan(record.values[:, 0]).sum() < 1000, "there are gaps to predict through"
    sigma, r = (float(model.parameters[name]) for name in ("sigma", "r"))
    direction, increments = reference.grid_filter(record.times, record.values, sigma, r, bins=360)
    result = zakai.filter(model, record)
    assert result.method == "limited-direct" and result.warnings == []
    np.testing.assert_allclose(result.log_likelihood_increments[1:], increments, atol=1e-10)
    assert result.log_likelihood == pytest.approx(increments.sum(), abs=1e-8)
    # Hour 0 has no direction, and a uniform angle no mean.
    assert angle_between(direction, result.mean[1:, 0])[1:].max() < 1e-8


def test_an_angle_and_a_rate_agree_with_bayes_rule_on_a_grid_of_both():
    model = zakai.load_model("gallery:wind-vane-rate")
    record = first_hours(model, 30)
    numbers = {name: float(value) for name, value in model.parameters.items()}
    numbers |= {"angle_variance": model.prior.cov[0, 0], "rate_variance": model.prior.cov[1, 1]}
    direction, rate, increments = reference.grid_filter_with_rate(record.times, record.values, numbers)
    result = zakai.filter(model, record, "limited-direct", keep="moments")
    assert result.warnings == []
    # An angle in two states is filtered to the tolerance 1e-5.
    np.testing.assert_allclose(result.log_likelihood_increments[1:], increments, atol=2e-5)
    np.testing.assert_allclose(result.mean[1:, 1], rate, atol=1e-6)
    assert angle_between(direction, result.mean[1:, 0]).max() < 1e-5


def test_the_model_files_hold_the_most_likely_parameters_that_the_comparison_found():
    for source in (FOLDER / "wind-vane.toml", "gallery:wind-vane"):
        parameters = zakai.load_model(source).parameters
        for name in ("sigma", "r"):
            assert float(parameters[name]) == pytest.approx(RESULTS["direct"][name], abs=0.002)


def test_over_the_year_the_direct_method_forecasts_better_than_the_extended_kalman_filter():
    compare = script("compare")
    year, first = compare.Year(), compare.Year(hours=1000)
    # The direct method's likelihood is smooth: at its maximum a step to any side loses. The extended Kalman filter's is rough and
    # its maximum the best that a search found (compare.most_likely): no step may gain what would matter beside 2700 nats.
    steps = np.array([[1, 0.9, 1.1, 1, 1], [1, 1, 1, 0.9, 1.1]])
    scores = {}
    for name, many, gain in (
        ("direct", compare.one_by_one(year.direct), 0.0), ("extended_kalman", year.extended_kalman_scores, 30.0)
    ):  # fmt: skip
        best = np.array([RESULTS[name]["sigma"], RESULTS[name]["r"]])
        scores[name], *around = many(*(best[:, None] * steps))
        assert scores[name] == pytest.approx(RESULTS[name]["log_score"], abs=0.1)
        assert max(around) < scores[name] + gain
    # The plain filter of the search is zakai's.
    assert first.extended_kalman(*best)[1].sum() == pytest.approx(first.extended_kalman_scores(*best[:, None])[0], abs=1e-5)
    assert scores["direct"] > scores["extended_kalman"] + 2000


def test_particles_agree_within_their_own_scatter(monkeypatch):
    compare = script("compare")
    monkeypatch.setattr(compare, "PARTICLES", 5_000)
    best = RESULTS["extended_kalman"]["sigma"], RESULTS["extended_kalman"]["r"]
    found = compare.against_particles(compare.Year(hours=2000), *best)
    # In hours in which most runs find no particle near the reading, all of them are too low, and their scatter does not tell.
    assert abs(found["probable"]["evidence_difference"]) < 4 * found["probable"]["evidence_error"]
    assert 0.8 < found["probable"]["mean_difference"] / found["probable"]["mean_error"] < 1.25
