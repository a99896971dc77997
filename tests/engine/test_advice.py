"""Warnings say in one sentence what is wrong, when, how much, and what to change; "auto" keeps the prior."""

from __future__ import annotations

import re

import numpy as np
import pytest

import zakai
from zakai._registry import METHODS, load
from zakai.notes.health import warnings_of_run, warnings_of_step


@pytest.mark.parametrize("name", METHODS)
def test_every_warning_is_one_sentence_with_what_to_change(name):
    bounds = load(name).bounds
    said = warnings_of_step({figure: 2 * bound + 1 for figure, (bound, _) in bounds.items()}, bounds, {})
    assert len(said) == len(bounds)
    for sentence in said:
        assert not re.search(r"[.!] [A-Z]", sentence) and sentence.isprintable()
        wrong, _, change = sentence.partition(": ")[2].rpartition("; ")
        assert wrong and change, sentence


def test_a_warning_has_the_time_the_size_and_the_count():
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=["x"], observation_kind="samples", observation_noise=[[0.01]],
        prior={"kind": "gaussian", "mean": [0], "cov": [[1]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([0.5, 1.0, 1.5], [0.2, 0.3, 0.1], "samples"), "yau-yau")
    result.bounds = {"tail_depth": (0.5, "depth in the tails")}
    result.health["tail_depth"] = np.array([np.nan, 0.1, 0.7, 0.9])
    (said,) = warnings_of_run(result)
    assert said.startswith("tail_depth exceeds 0.5 at 2 of 3 times, most at t = 1.5 (0.9): ")
    assert said.endswith("; check that observation and its noise")


@pytest.mark.parametrize(
    ("observation", "kind", "states", "method"),
    [
        ("abs(x)", "increments", 2, "yau-yau"),
        ("abs(x)", "samples", 2, "yau-yau"),
        ("abs(x)", "increments", 1, "limited-direct"),
        ("sqrt(1 + x**2)", "increments", 2, "limited-direct"),
    ],
)
def test_auto_leaves_the_direct_method_where_h_needs_many_substeps_or_points(observation, kind, states, method):
    keys = {"state": ["x", "y"][:states], "drift": ["-x + y/2", "-y"] if states == 2 else ["-x"]}
    prior = {"kind": "gaussian", "mean": [0.5] * states, "cov": [0.5] * states}
    model = zakai.Model(**keys, observation=[observation], observation_kind=kind, observation_noise=[["0.1"]], prior=prior)
    assert zakai.online(model).method == method


def test_auto_goes_on_where_a_method_loses_the_prior():
    certain = zakai.load_model("gallery:spiral-sensor").with_prior({"kind": "gaussian", "mean": [0.3], "cov": [[0]]})
    record = zakai.Record([0.01, 0.02], [[0.001, 0.002], [0.0, 0.1]])
    with pytest.raises(zakai.InputError, match="a variance is zero"):
        zakai.filter(certain, record, "limited-direct")
    result = zakai.filter(certain, record)
    assert result.method == "general-direct" and "limited-direct holds too, but loses the density at the prior" in result.why
    near = certain.with_prior({"kind": "gaussian", "mean": [0.3], "cov": [[1e-8]]})
    other = zakai.filter(near, record, "limited-direct")
    np.testing.assert_allclose(result.mean, other.mean, atol=1e-3 * np.sqrt(other.variance[-1, 0]))


def test_auto_leaves_a_method_that_loses_a_formula_s_density():
    model = zakai.Model(
        state=["x", "y"], drift=["y - x", "-y"], observation=["x"], observation_kind="increments",
        prior={"kind": "density", "log_density": "-x**2/2 - y**2/2 + log(heaviside(x))"},
    )  # fmt: skip
    start = zakai.online(model)
    assert start.last.mean[0] == pytest.approx(np.sqrt(2 / np.pi), abs=0.02)
    assert start.last.cov[0, 0] == pytest.approx(1 - 2 / np.pi, abs=0.02)


@pytest.mark.parametrize("variance", [0.3, 30.0])
def test_auto_keeps_the_first_method_for_an_angle_of_any_width(variance):
    model = zakai.Model(
        state=["x"], drift=["1"], observation=["sin(x)", "cos(x)"], observation_kind="increments", periodic=["x"],
        prior={"kind": "gaussian", "mean": [3], "cov": [[variance]]},
    )  # fmt: skip
    assert zakai.online(model).method == "limited-direct"
