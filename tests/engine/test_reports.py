"""What a result and a run report beside the posterior."""

import logging
from types import SimpleNamespace

import numpy as np
import pytest

import zakai
from zakai.engine import batch

PRIOR = {"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]}


@pytest.mark.parametrize(("noise", "reported"), [("1 + 9/10*sin(50*t)", True), ("1 + t/100", False), ("2", False)])
def test_noise_that_varies_within_an_interval_is_reported_with_its_first_time(noise, reported):
    model = zakai.Model(state=["x"], drift=["-x"], observation=["x"], observation_noise=[[noise]], prior=PRIOR)
    record = zakai.Record([0.1, 0.4, 0.9], [np.nan, 0.2, 0.1], "increments")
    warnings = [line for line in zakai.filter(model, record).warnings if "observation_noise varies" in line]
    assert len(warnings) == reported
    if reported:
        assert "within 2 of 3 intervals (first at t = 0.4)" in warnings[0]
        online = zakai.online(model)
        online.update(0.1, None)
        assert any("observation_noise varies" in line for line in online.update(0.4, 0.2).warnings)


def test_long_work_is_announced_with_what_would_shorten_it(monkeypatch, caplog):
    model = zakai.Model(state=["x"], drift=["-x"], observation=["x"], prior=PRIOR)
    record = zakai.Record(0.01 * np.arange(1, 1001), np.zeros(1000), "increments")
    monkeypatch.setattr(batch, "SURE", 0.0)
    with caplog.at_level(logging.WARNING, "zakai"):
        zakai.filter(model, record)
        assert caplog.text == ""
        monkeypatch.setattr(batch, "LONG", 0.0)
        zakai.filter(model, record)
    assert "kalman-bucy: 991 more observations take about" in caplog.text and "to shorten it," in caplog.text
    assert len(caplog.records) == 1


def test_the_first_interval_which_may_compile_does_not_count(monkeypatch, caplog):
    model = zakai.Model(state=["x"], drift=["-x"], observation=["x"], prior=PRIOR)
    record = zakai.Record(0.01 * np.arange(1, 1001), np.zeros(1000), "increments")
    clock = iter([100.0, 102.0] + [103.0] * 100)  # after the first interval, and after eight more
    monkeypatch.setattr(batch, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    with caplog.at_level(logging.WARNING, "zakai"):
        zakai.filter(model, record)
    assert "991 more observations take about 248 s" in caplog.text


def test_results_of_earlier_versions_are_read_with_their_old_names(tmp_path):
    model = zakai.Model(state=["x"], drift=["-x"], observation=["x"], prior=PRIOR)
    result = zakai.filter(model, zakai.Record([0.1, 0.2], [0.1, 0.3], "increments"))
    result.health = {"missed": np.array([np.nan, 1.0, 2.0]), "surprise": np.array([np.nan, 0.0, 0.5])}
    result.bounds = {}
    result.save(tmp_path / "old.nc")
    assert set(zakai.load_result(tmp_path / "old.nc").health) == {"tolerance_ratio", "tail_depth"}
