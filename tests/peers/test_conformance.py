"""What every method promises, for the filters of other libraries."""

from __future__ import annotations

import numpy as np
import pytest

import zakai
from peers.systems import FEW, SPIRAL, linear, record_of, spiral
from zakai import _registry

TIMES = np.cumsum([0.1, 0.05, 0.2, 0.1, 0.1, 0.15, 0.05, 0.1, 0.3, 0.1])


@pytest.mark.parametrize("name", _registry.PEERS)
def test_record_batch_and_online_agree_to_the_last_bit(name, tmp_path):
    model, options = spiral("path"), FEW.get(name, {})
    records = [record_of(model, TIMES, seed=seed, gaps=True) for seed in range(2)]
    whole = zakai.filter(model, records[0], name, **options)
    many = zakai.filter(model, records, name, **options)
    assert np.array_equal(many[0].mean, whole.mean) and np.array_equal(many[0].cov, whole.cov)
    online = zakai.online(model, method=name, **options)
    for k, (time, value) in enumerate(zip(records[0].times, records[0].values, strict=True)):
        estimate = online.update(time, value)
        assert np.array_equal(estimate.mean, whole.mean[k + 1])
        if k == 4:
            online.save(tmp_path / "filter.checkpoint")
            online = zakai.online(model, method=name, **options)
            online.restore(tmp_path / "filter.checkpoint")


@pytest.mark.parametrize("name", _registry.PEERS)
def test_the_density_has_the_reported_moments(name):
    model = linear("samples")
    result = zakai.filter(model, record_of(model, TIMES, gaps=True), name, substeps=4, **FEW.get(name, {}))
    for k in (0, 5, -1):
        assert result.density(k).mean() == pytest.approx(result.mean[k], abs=1e-9)
        assert result.density(k).cov() == pytest.approx(result.cov[k], abs=1e-9)


@pytest.mark.parametrize("name", ["ekf", "particle"])
def test_a_filter_without_gradient_is_refused_by_fit(name):
    model = zakai.Model(
        state=["x"], drift=["a*x"], observation=["x"], observation_kind="samples", parameters={"a": -1.0},
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
    )  # fmt: skip
    with pytest.raises(zakai.ConditionError, match=f"{name} has no gradient"):
        zakai.fit(model, zakai.Record([1.0], [[0.2]], "samples"), ["a"], method=name)


@pytest.mark.parametrize("name", _registry.PEERS)
def test_a_prior_given_by_its_density_is_used(name):
    parts = SPIRAL | {"observation_kind": "samples"}
    record = zakai.Record([0.1, 0.2], [[0.1, 0.5], [0.2, 0.6]], "samples")
    options = {"particle": {"particles": 4000}, "enkf": {"members": 4000}}.get(name, {})
    gaussian = {"kind": "gaussian", "mean": [0.5], "cov": [[0.3]]}
    density = {"kind": "density", "log_density": "-(x - 1/2)**2/(2*3/10)"}
    one, other = (zakai.filter(zakai.Model(**parts | {"prior": prior}), record, name, **options) for prior in (gaussian, density))
    tolerance = 0.05 if options else 1e-8
    assert one.mean == pytest.approx(other.mean, abs=tolerance) and one.cov == pytest.approx(other.cov, abs=tolerance)


def test_an_interval_is_the_same_whatever_else_is_in_the_schedule():
    from zakai.records.schedule import schedule_of

    model = linear("increments")
    schedule, _ = schedule_of(model, record_of(model, TIMES, gaps=True))
    for name in _registry.PEERS:
        method = _registry.load(name)
        whole = method.prepare(model, schedule, model.theta())
        for k in range(len(schedule)):
            own = method.prepare(model, schedule.part(slice(k, k + 1)), model.theta())
            assert np.array_equal(own.whiten[0], whole.whiten[k])
            if whole.roots is not None:
                assert np.array_equal(own.roots[0], whole.roots[k])


@pytest.mark.parametrize("name", ["ekf", "particle"])
def test_nothing_is_compiled_for_another_record_or_another_noise_or_other_parameters(name, monkeypatch):
    from zakai.peers._translation import System

    traced = []
    before_noise = System.before_noise
    monkeypatch.setattr(System, "before_noise", lambda *given: traced.append(1) or before_noise(*given))

    def model(a, kind="samples", noise="1"):
        return zakai.Model(
            state=["x"], drift=["-a*sin(3*x)"], observation=["x"], observation_kind=kind, observation_noise=[[noise]],
            parameters={"a": a}, prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
        )  # fmt: skip

    options = FEW.get(name, {})
    zakai.filter(model(1.0), zakai.Record([0.1, 0.2], [[0.1], [0.3]], "samples"), name, **options)
    count = len(traced)
    assert count > 0
    times = np.arange(1, 151) / 20
    zakai.filter(model(2.0), zakai.Record(times, np.sin(times)[:, None], "samples"), name, **options)
    zakai.online(model(0.5), method=name, **options).update(0.3, [0.1])
    zakai.online(model(0.5, "increments", "a/4"), method=name, **options).update(0.3, [0.1])
    assert len(traced) == count
