"""A first interval a thousand times as long as the others is a start that was forgotten."""

import logging

import numpy as np
import pytest

import zakai
from zakai.engine import batch

UNIX = 1_634_800_000.0


def model_of(**keys):
    keys = {"parameters": {"q": 1.0}, "process_noise": [["q"]], **keys}
    return zakai.Model(
        state=["x"],
        drift=["-x"],
        observation=["x"],
        observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
        **keys,
    )


def record_of(first, step=1.0, count=20):
    values = np.random.default_rng(0).normal(size=(count, 1))
    return zakai.Record(first + step * np.arange(count), values, "samples")


def said(warnings):
    return [one for one in warnings if "start" in one]


def test_seconds_since_1970_with_a_start_of_zero_are_warned_of_once():
    (warning,) = said(zakai.filter(model_of(), record_of(UNIX)).warnings)
    assert "from the model's start 0 to the first time 1634800000, is 1.6e+09 times as long as the longest other" in warning
    assert "give a start next to the first time, as start = 1634799999" in warning
    assert not said(zakai.filter(model_of(start=UNIX - 1), record_of(UNIX)).warnings)


def test_a_fit_and_a_smoother_say_it_too():
    assert len(said(zakai.fit(model_of(), record_of(UNIX), ["q"], method="kalman-bucy").warnings)) == 1
    assert len(said(zakai.smooth(model_of(), record_of(UNIX), method="kalman-bucy").warnings)) == 1


def test_independent_blocks_say_it_once():
    model = zakai.Model(
        state=["x", "y"],
        drift=["-x", "-y**3"],
        observation=["x", "y"],
        observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0.0, 0.0], "cov": [1.0, 1.0]},
    )
    record = zakai.Record(5000.0 + np.arange(3.0), np.zeros((3, 2)), "samples")
    assert len(said(zakai.filter(model, record).warnings)) == 1


@pytest.mark.parametrize("record", [record_of(500.0), record_of(0.0), record_of(2e6, count=1), record_of(1.0, step=1e-2)])
def test_a_late_first_observation_is_no_forgotten_start(record):
    assert not said(zakai.filter(model_of(), record).warnings)


def test_messages_print_times_so_that_they_differ():
    model = model_of(start=UNIX, inputs=["u"])
    record = zakai.Record([UNIX + 0.5], [[0.0]], "samples", zakai.Inputs([UNIX + 0.75], [[1.0]]))
    with pytest.raises(zakai.InputError, match=r"the first time 1634800000.75 is after the first observation at 1634800000.5"):
        zakai.filter(model, record)
    result = zakai.filter(model_of(start=UNIX), record_of(UNIX + 1))
    with pytest.raises(zakai.InputError, match=r"the time 1634800019.5 is not after the end of the record, 1634800020;"):
        result.forecast([UNIX + 19.5])


def test_a_forecast_far_ahead_has_no_start():
    result = zakai.filter(model_of(), record_of(1.0))
    assert not said(result.forecast([5000.0, 5001.0]).warnings)


def test_a_long_run_whose_start_was_forgotten_says_so_while_it_runs(monkeypatch, caplog):
    for name, value in (("FIRST", 0.0), ("EARLY", 0.0), ("LONG", 0.0), ("SURE", 0.0)):
        monkeypatch.setattr(batch, name, value)
    with caplog.at_level(logging.WARNING, "zakai"):
        zakai.filter(model_of(), record_of(UNIX, count=200))
    assert any("give a start next to the first time" in one.getMessage() for one in caplog.records)
