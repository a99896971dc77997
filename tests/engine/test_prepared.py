"""Prepared work that is saved and loaded equals what is prepared again, to the bit, and is not computed twice."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest

import zakai
from zakai.records.checkpoint import read_checkpoint, write_checkpoint

TIMES = np.concatenate([np.arange(1, 9) / 20, [0.5, 0.53, 0.6]])
GAUSSIAN = {"kind": "gaussian", "mean": [0.3], "cov": [[2.0]]}
LINEAR = dict(
    state=["x"],
    drift=["-a*x + sin(t)"],
    observation=["2*x"],
    observation_kind="increments",
    parameters={"a": 0.5},
    prior=GAUSSIAN,
)
SPIRAL = dict(state=["x"], drift=["t*x/3"], observation=["x*sin(x)", "x*cos(x)"], prior=GAUSSIAN)
CUBIC = dict(state=["x"], drift=["cos(x)"], observation=["x**3"], prior=GAUSSIAN)
BENES = dict(state=["x"], drift=["tanh(x)"], observation=["x"], prior=GAUSSIAN)
PAIR = dict(
    state=["x", "y"],
    drift=["-x + sin(t)", "cos(y)"],
    observation=["x", "y**3"],
    prior={"kind": "gaussian", "mean": [0.3, 0.0], "cov": [[2.0, 0], [0, 1]]},
)


def record_of(model):
    record = zakai.simulate(model, TIMES, seed=1)[1]
    values = record.values.copy()
    values[3, 0] = np.nan
    return zakai.Record(TIMES, values, model.observation_kind)


def same(a, b):
    for name in ("mean", "variance", "log_likelihood_increments"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes()
    assert (a.method, a.why, a.warnings) == (b.method, b.why, b.warnings)


@pytest.mark.parametrize(
    ("keys", "method"),
    [
        (LINEAR, "kalman-bucy"),
        (LINEAR, "extended-kalman-bucy"),
        (BENES, "benes"),
        (BENES, "hu-yau"),
        (SPIRAL, "limited-direct"),
        (BENES, "wei-norman"),
        (LINEAR, "ekf"),
        (PAIR, "auto"),
    ],
)
def test_saved_work_equals_what_is_prepared_again(tmp_path, keys, method):
    model = zakai.Model(**keys)
    record = record_of(model)
    zakai.prepare(model, record, method).save(tmp_path / "offline")
    expected = zakai.filter(model, record, method)
    loaded = zakai.Prepared.load(tmp_path / "offline")
    same(loaded.filter(record), expected)


def test_other_times_are_prepared_again():
    model = zakai.Model(**LINEAR)
    prepared = zakai.prepare(model, TIMES[:5])
    record = record_of(model)
    same(prepared.filter(record), zakai.filter(model, record))


def test_a_file_of_another_model_or_that_is_none_is_refused(tmp_path):
    model, path = zakai.Model(**LINEAR), tmp_path / "offline"
    zakai.prepare(model, TIMES, "kalman-bucy").save(path)
    with pytest.raises(zakai.InputError, match="another model"):
        zakai.Prepared.load(path, zakai.Model(**{**LINEAR, "drift": ["-x"]}))
    assert zakai.Prepared.load(path, model).filter(record_of(model)).method == "kalman-bucy"
    about, arrays = read_checkpoint(path, "prepared")
    for changed in ({}, {"times": arrays["times"]}, {**arrays, "seen": arrays["times"]}, {**arrays, "times": arrays["seen"]}):
        write_checkpoint(path, about, changed, "prepared")
        with pytest.raises(zakai.InputError):
            zakai.Prepared.load(path)
    write_checkpoint(path, {**about, "versions": {}}, arrays, "prepared")
    with pytest.raises(zakai.InputError, match="another version of"):
        zakai.Prepared.load(path)
    write_checkpoint(path, about, arrays)
    with pytest.raises(zakai.InputError, match="not a prepared file"):
        zakai.Prepared.load(path)


def test_times_that_are_none_are_refused():
    model = zakai.Model(**LINEAR)
    wrong = {"a vector": [3.0, []], "of numbers": ["x"], "after the model.s start": [[0.0, 1.0]], "increas": [[2.0, 1.0]]}
    for times, words in [(times, words) for words, every in wrong.items() for times in every]:
        with pytest.raises(zakai.InputError, match=words):
            zakai.prepare(model, times)


def test_what_is_kept_of_a_model_ends_with_it():
    alive = []
    for i in range(1, 91):
        model = zakai.Model(
            state=["x"],
            drift=[f"-{i}*x"],
            observation=["x"],
            prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
        )
        zakai.filter(model, zakai.Record([0.1], [[0.0]], "increments"), "kalman-bucy")
        alive.append(weakref.ref(model))
    gc.collect()
    assert sum(one() is not None for one in alive) <= 70  # what is known of the formulas of the last 64
