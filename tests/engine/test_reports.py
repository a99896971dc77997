"""What a result and a run report beside the posterior."""

import logging
import re
from itertools import chain, repeat
from threading import get_ident
from time import sleep

import numpy as np
import pytest

import zakai
from zakai import _progress
from zakai.engine import batch
from zakai.numerics import compiled

PRIOR = {"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]}


@pytest.mark.parametrize(("noise", "reported"), [("1 + 9/10*sin(50*t)", True), ("1 + t/100", False), ("2", False)])
def test_noise_that_varies_within_an_interval_is_reported_with_its_first_time(noise, reported):
    kind = "increments"
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=["x"], observation_kind=kind, observation_noise=[[noise]], prior=PRIOR
    )
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
    assert "kalman-bucy: 927 more observations take about" in caplog.text and "to shorten it," in caplog.text
    assert len(caplog.records) == 1


# Seconds at the end of the first interval, of 8 more and of 64 more: slow work, and a kernel that is compiled late.
@pytest.mark.parametrize(
    ("seconds", "announced"), [((100, 102, 118), "927 more observations take about 232 s"), ((100, 130, 130.5), "")]
)
def test_intervals_that_may_compile_do_not_count(monkeypatch, caplog, seconds, announced):
    model = zakai.Model(state=["x"], drift=["-x"], observation=["x"], prior=PRIOR)
    record = zakai.Record(0.01 * np.arange(1, 1001), np.zeros(1000), "increments")
    clock, own = chain(seconds, repeat(seconds[-1] + 0.5)), get_ident()
    monkeypatch.setattr(batch, "working_time", lambda: next(clock) if get_ident() == own else 0.0)
    with caplog.at_level(logging.WARNING, "zakai"):
        zakai.filter(model, record)
    assert (announced in caplog.text) if announced else caplog.text == ""


def test_results_of_earlier_versions_are_read_with_their_old_names(tmp_path):
    model = zakai.Model(state=["x"], drift=["-x"], observation=["x"], prior=PRIOR)
    result = zakai.filter(model, zakai.Record([0.1, 0.2], [0.1, 0.3], "increments"))
    result.health = {"missed": np.array([np.nan, 1.0, 2.0]), "surprise": np.array([np.nan, 0.0, 0.5])}
    result.bounds = {}
    result.save(tmp_path / "old.nc")
    assert set(zakai.load_result(tmp_path / "old.nc").health) == {"tolerance_ratio", "tail_depth"}


def test_a_first_observation_that_takes_long_is_announced(monkeypatch, caplog):
    monkeypatch.setattr(batch, "FIRST", 0.0)
    model = zakai.load_model("gallery:pendulum")
    with caplog.at_level(logging.WARNING, "zakai"):
        zakai.filter(model, zakai.simulate(model, [0.5], seed=0)[1])
    assert "the first of 1 observations takes more than 0 s; to shorten it" in caplog.text


def test_slow_steps_are_announced_within_a_segment_and_on_the_way_back(monkeypatch, caplog):
    for name, value in (("LONG", 0.0), ("EARLY", 0.0), ("FEW", 2), ("WATCHED", 1e6), ("OFF", 1e6)):
        monkeypatch.setattr(batch, name, value)
    model = zakai.load_model("gallery:pendulum")
    _, record = zakai.simulate(model, 0.5 * np.arange(1, 41), seed=0)
    with caplog.at_level(logging.WARNING, "zakai"):
        zakai.smooth(model, record)
    words = [one.getMessage() for one in caplog.records if "more observations take" in one.getMessage()]
    assert len(words) == 2 and all("to shorten it, raise the option tolerance" in line for line in words)


def test_what_takes_longer_than_was_announced_is_announced_again(monkeypatch, caplog):
    model = zakai.Model(state=["x"], drift=["-x"], observation=["x"], prior=PRIOR)
    record = zakai.Record(0.01 * np.arange(1, 1001), np.zeros(1000), "increments")
    # 64 observations take 16 s, so that 927 take 232 s; the next 128 take 1000 s, and so do those after them.
    clock, own = chain((100, 102, 118, 1118, 2118, 3118), repeat(3119)), get_ident()
    monkeypatch.setattr(batch, "working_time", lambda: next(clock) if get_ident() == own else 0.0)
    with caplog.at_level(logging.WARNING, "zakai"):
        zakai.filter(model, record)
    words = [one.getMessage() for one in caplog.records]
    assert len(words) == 2 and "927 more observations take about 232 s" in words[0]
    assert "543 more observations take about 4242 s" in words[1]


def test_a_slow_observation_within_a_segment_is_announced_with_a_method_that_is_expected_to_be_faster(monkeypatch, caplog):
    from zakai.algebra import expected_work
    from zakai.methods.space import filter as space_filter

    own, calls = space_filter.step, []

    def step(*arguments):
        calls.append(1)
        sleep(0.4 if len(calls) == 9 else 0.0)
        return own(*arguments)

    monkeypatch.setattr(space_filter, "step", step)
    monkeypatch.setattr(expected_work, "PARTICLE", 1e-9)
    for name, value in (("FIRST", 0.0), ("EARLY", 1e9), ("LONG", 0.15), ("WATCHED", 0.02), ("MINUTE", 0.1)):
        monkeypatch.setattr(batch, name, value)
    model = zakai.load_model("gallery:pendulum")
    _, record = zakai.simulate(model, 0.1 * np.arange(1, 11), seed=0)
    with caplog.at_level(logging.WARNING, "zakai"):
        zakai.filter(model, record, "yau-yau", keep="moments")
    said = "2 more observations take, if each is as long as the present one,"
    words = [one.getMessage() for one in caplog.records if said in one.getMessage()]
    assert len(words) == 1 and "or take guided-particles, which holds too" in words[0]


def test_a_decision_that_takes_long_is_announced(monkeypatch, caplog):
    from zakai.engine import driver

    monkeypatch.setattr(_progress, "FIRST", 0.01)
    own = driver.plan_of
    monkeypatch.setattr(driver, "plan_of", lambda *arguments: (sleep(0.2), own(*arguments))[1])
    model = zakai.Model(state=["x"], drift=["-x"], observation=["x"], prior=PRIOR)
    with caplog.at_level(logging.WARNING, "zakai"):
        zakai.filter(model, zakai.Record([0.1], [0.0], "increments"))
    assert "deciding which method holds takes more than" in caplog.text


@pytest.mark.parametrize("what", ["residuals", "predict_observations"])
def test_laws_of_observations_that_take_long_are_announced(monkeypatch, caplog, what):
    monkeypatch.setattr(_progress, "FIRST", 0.1)
    model = zakai.Model(state=["x"], drift=["-x"], observation=["x"], prior=PRIOR)
    result = zakai.filter(model, zakai.Record(0.1 * np.arange(1, 21), np.zeros(20), "increments"))
    with caplog.at_level(logging.WARNING, "zakai"):
        getattr(result, what)(progress=lambda *_: sleep(0.02))
    assert re.search(r"(computing residuals|predicting observations) takes about \d+ s more", caplog.text)


def test_compilation_is_not_announced_as_work(monkeypatch, caplog):
    monkeypatch.setattr(_progress, "FIRST", 0.2)
    with caplog.at_level(logging.WARNING, "zakai"), _progress.announced("work"), compiled._compilation:
        sleep(0.5)
    assert caplog.text == ""
    with caplog.at_level(logging.WARNING, "zakai"), _progress.announced("work"):
        sleep(0.5)
    assert "work takes more than" in caplog.text
