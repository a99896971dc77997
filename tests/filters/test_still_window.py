"""Whole runs of the limited direct method on a window that stands still: the numbers of its steps, in less time."""

from dataclasses import replace

import numpy as np
import pytest

import zakai
from zakai.filters import _still_window, limited_direct

SPIRAL = zakai.load_model("gallery:spiral-sensor")
STEPWISE = replace(limited_direct.METHOD, at_once=None)


def increments(model, count, seeds=(4,)):
    times = 0.01 * np.arange(1, count + 1)
    return [zakai.simulate(model, times, seed=seed)[1] for seed in seeds]


def same(one, other, close=1e-10):
    assert np.allclose(one.mean, other.mean, rtol=0, atol=close)
    assert np.allclose(one.cov, other.cov, rtol=0, atol=close)
    assert np.allclose(one.log_likelihood_increments, other.log_likelihood_increments, rtol=0, atol=close)


@pytest.fixture
def moved(monkeypatch):
    """How often a run was traced to be taken at once."""
    calls, own = [], _still_window.moved

    def spied(lattice, *rest):
        calls.append(lattice.log_values.shape)
        return own(lattice, *rest)

    monkeypatch.setattr(_still_window, "moved", spied)
    return calls


def test_a_run_at_once_gives_the_numbers_of_its_steps(monkeypatch, moved):
    records = increments(SPIRAL, 300, seeds=(3, 4))
    at_once = [zakai.filter(SPIRAL, record, "limited-direct") for record in records]
    together = zakai.filter(SPIRAL, records, "limited-direct")
    assert moved
    monkeypatch.setattr(limited_direct, "METHOD", STEPWISE)
    for one, other, record in zip(at_once, together, records, strict=True):
        stepwise = zakai.filter(SPIRAL, record, "limited-direct")
        same(one, stepwise)
        same(other, stepwise)
        for k in (1, 150, 300):
            assert np.allclose(one.density(k).mean(), stepwise.density(k).mean(), rtol=0, atol=1e-10)
            assert np.allclose(one.density(k).cov(), stepwise.density(k).cov(), rtol=0, atol=1e-10)
        assert not one.warnings and not other.warnings


@pytest.mark.slow
def test_a_drift_that_is_a_constant_and_noise_that_is_not_one_are_in_the_kernel(monkeypatch, moved):
    model = zakai.Model(
        state=["x"], drift=["cos(t) - (1 + t)*x/2"], observation=["x*sin(x)", "x*cos(x)"], observation_kind="increments",
        process_noise=[["2 + sin(3*t)"]],
        prior={"kind": "mixture", "weights": [0.4, 0.6], "means": [[-1.0], [1.5]], "covs": [[[0.3]], [[0.2]]]},
    )  # fmt: skip
    (record,) = increments(model, 100)
    at_once = zakai.filter(model, record, "limited-direct")
    assert moved
    monkeypatch.setattr(limited_direct, "METHOD", STEPWISE)
    same(at_once, zakai.filter(model, record, "limited-direct"))


@pytest.mark.slow
def test_mass_that_leaves_the_window_is_followed_step_by_step(monkeypatch, moved):
    model = zakai.Model(
        state=["x"], drift=["100"], observation=["x*sin(x)", "x*cos(x)"], observation_kind="increments",
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[0.1]]},
    )  # fmt: skip
    (record,) = increments(model, 64)
    at_once = zakai.filter(model, record, "limited-direct")
    assert moved
    monkeypatch.setattr(limited_direct, "METHOD", STEPWISE)
    stepwise = zakai.filter(model, record, "limited-direct")
    same(at_once, stepwise)
    assert at_once.warnings == stepwise.warnings


def test_where_readings_are_missing_or_h_depends_on_time_steps_are_taken_one_by_one(moved):
    (record,) = increments(SPIRAL, 20)
    values = record.values.copy()
    values[7, 0] = np.nan
    zakai.filter(SPIRAL, zakai.Record(record.times, values, "increments"), "limited-direct")
    assert not moved


@pytest.mark.slow
def test_the_first_error_of_the_splitting_is_undone():
    """Readings of a path that runs linearly between two of them, given at finer and finer times, converge to one density."""
    (record,) = increments(SPIRAL, 64)

    def refined(parts):
        times = np.linspace(0.0, record.times[-1], parts * 64 + 1)[1:]
        fine = zakai.Record(times, np.repeat(record.values, parts, axis=0) / parts, "increments")
        return zakai.filter(SPIRAL, fine, "limited-direct", keep="moments").mean[parts::parts, 0]

    truth = refined(8)
    # Without the correction the distance is 3e-4.
    assert np.sqrt(np.mean((refined(1) - truth) ** 2)) < 5e-5
