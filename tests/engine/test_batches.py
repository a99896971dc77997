"""Many records give what each gives alone, to the bit."""

import numpy as np
import pytest

import zakai

GAUSSIAN = {"kind": "gaussian", "mean": [0.3], "cov": [[0.5]]}
SYSTEMS = {
    "kalman-bucy": dict(drift=["cos(t) - x/2"], observation=["2*x"]),
    "limited-direct": dict(drift=["t*x/40"], observation=["x*sin(x)", "x*cos(x)"]),
    "yau-yau": dict(drift=["x - x**3"], observation=["x**3"]),
}


@pytest.mark.parametrize("method", SYSTEMS)
def test_many_records_give_what_each_gives_alone_to_the_bit(method):
    model = zakai.Model(state=["x"], prior=GAUSSIAN, **SYSTEMS[method])
    times = np.cumsum(np.tile([0.01, 0.03, 0.01, 0.2], 10))
    records = [zakai.simulate(model, times, seed=seed)[1] for seed in range(6)]
    values = records[3].values.copy()
    values[5] = np.nan
    records[3] = zakai.Record(times[:30], values[:30], "increments")
    done = []
    together = zakai.filter(model, records, method, progress=lambda now, total: done.append((now, total)))
    assert done[-1] == (230, 230) and done == sorted(done)
    for record, one in zip(records, together, strict=True):
        alone = zakai.filter(model, record, method)
        assert np.array_equal(one.mean, alone.mean) and np.array_equal(one.cov, alone.cov)
        assert np.array_equal(one.log_likelihood_increments, alone.log_likelihood_increments)
        assert one.warnings == alone.warnings and one.record is record
        x = alone.mean[7] + np.linspace(-1, 1, 5)[:, None]
        assert np.array_equal(one.density(7).log_density(x), alone.density(7).log_density(x))


def test_the_length_of_a_chunk_changes_no_bit():
    model = zakai.Model(state=["x"], prior=GAUSSIAN, observation_kind="increments", **SYSTEMS["kalman-bucy"])
    times = np.cumsum(np.random.default_rng(0).uniform(0.001, 0.1, 2500))
    record = zakai.simulate(model, times, seed=1, substeps=1)[1]
    whole = zakai.filter(model, record, keep="moments")
    rest = zakai.filter(model, zakai.Record(times[:700], record.values[:700], "increments"), keep="moments")
    assert np.array_equal(whole.mean[:701], rest.mean)
    online = zakai.online(model)
    for time, value in zip(times[:1100], record.values[:1100], strict=True):
        estimate = online.update(time, value)
    assert np.array_equal(estimate.mean, whole.mean[1100]) and np.array_equal(estimate.cov, whole.cov[1100])
