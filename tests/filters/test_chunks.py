"""A long record is prepared and filtered in pieces, and no estimate depends on how it was cut."""

from __future__ import annotations

import numpy as np
import pytest

import zakai
from zakai.filters import _run

PLANE = dict(
    state=["x", "y"],
    drift=["-x/2 + y/3", "-y"],
    observation=["x", "x + y"],
    prior={"kind": "gaussian", "mean": [0.3, -0.2], "cov": [[1.0, 0.2], [0.2, 0.5]]},
)
LINE = dict(state=["x"], drift=["-x"], observation=["sin(x)"], prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]})


@pytest.mark.parametrize(
    ("keys", "method"), [pytest.param(PLANE, "limited-direct", marks=pytest.mark.slow), (LINE, "extended-kalman-bucy")]
)
def test_the_length_of_a_chunk_changes_no_estimate(keys, method, monkeypatch):
    model = zakai.Model(**keys)
    _, record = zakai.simulate(model, 0.1 * np.arange(1, 31), seed=1)
    whole = zakai.filter(model, record, method)
    monkeypatch.setattr(_run, "CHUNK", 11)
    pieces = zakai.filter(model, record, method)
    assert np.allclose(pieces.mean, whole.mean, rtol=0, atol=1e-10)
    assert np.allclose(pieces.cov, whole.cov, rtol=0, atol=1e-10)
    assert np.isclose(pieces.log_likelihood, whole.log_likelihood, rtol=0, atol=1e-9)


def test_a_chunk_is_as_long_as_the_memory_allows(monkeypatch):
    model = zakai.Model(**LINE)
    _, record = zakai.simulate(model, 0.1 * np.arange(1, 41), seed=1)
    run = _run.Run(_setting(model), record, None)
    assert list(run.setting.chunks(run.data, 0)) == [slice(0, 40)]
    one = _run.size_of(run.setting.prepared(run.data.part(slice(0, 1))).intervals)
    monkeypatch.setattr(_run, "CHUNK_BYTES", 15 * max(one, 64))
    assert [rows.stop for rows in run.setting.chunks(run.data, 0)] == [15, 30, 40]


def _setting(model):
    from zakai import _registry

    method = _registry.load("extended-kalman-bucy")
    return _run.Setting(model, model.prior, method, method.options)
