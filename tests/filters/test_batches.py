"""Records side by side: what one of them needs is not what all of them get."""

import numpy as np
import pytest

import zakai
from zakai.filters import batches
from zakai.filters._run import Run


@pytest.mark.slow
def test_a_record_that_asks_for_a_larger_lattice_goes_on_by_itself(monkeypatch):
    model = zakai.Model(
        state=["x"], drift=["0"], observation=["x*cos(x)"], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0.5], "cov": [0.5]},
    )  # fmt: skip
    times = 0.005 * np.arange(1, 601)
    records = [zakai.simulate(model, times, seed=seed)[1] for seed in range(8)]
    values = records[3].values.copy()
    values[300:] = 9.0  # a long way off, where the density has several peaks
    records[3] = zakai.Record(times, values, "samples")
    alone = [zakai.filter(model, record, keep="moments") for record in records]
    left, everything = [], Run.all

    def spied(run, progress, until):
        left.append((run.record, run.done))
        return everything(run, progress, until)

    monkeypatch.setattr(Run, "all", spied)
    told = []
    together = zakai.filter(model, records, keep="moments", progress=lambda done, total: told.append(done))
    assert [record for record, _ in left] == [records[3]] and left[0][1] % 256 == 0
    assert told[-1] == 8 * len(times) and told == sorted(told)
    for one, other in zip(alone, together, strict=True):
        assert np.allclose(one.mean, other.mean, rtol=0, atol=1e-8)
        assert np.allclose(one.log_likelihood_increments, other.log_likelihood_increments, rtol=0, atol=1e-8)
        assert one.warnings == other.warnings


@pytest.mark.slow
def test_records_whose_steps_have_tables_are_filtered_by_themselves():
    model = zakai.Model(
        state=["x"], drift=["cos(x)"], observation=["x**3"], prior={"kind": "gaussian", "mean": [0.0], "cov": [0.2]}
    )
    times = 0.005 * np.arange(1, 101)
    records = [zakai.simulate(model, times, seed=seed)[1] for seed in range(3)]
    for record, result in zip(records, zakai.filter(model, records, "yau-yau"), strict=True):
        alone = zakai.filter(model, record, "yau-yau")
        assert np.array_equal(result.mean, alone.mean)
        assert result.log_likelihood == alone.log_likelihood
        assert np.array_equal(result.density(70).log_values, alone.density(70).log_values)


def test_records_that_come_to_tables_on_the_way_share_them():
    model = zakai.Model(
        state=["x"], drift=["cos(x)"], observation=["x**3"], prior={"kind": "gaussian", "mean": [0.0], "cov": [0.2]}
    )
    times = np.cumsum([0.004] * 10 + [0.005] * 60)
    records = [zakai.simulate(model, times, seed=seed)[1] for seed in range(3)]
    for record, result in zip(records, zakai.filter(model, records, "yau-yau", keep="moments"), strict=True):
        alone = zakai.filter(model, record, "yau-yau", keep="moments")
        assert np.abs(result.mean - alone.mean).max() < 2e-5
        assert abs(result.log_likelihood - alone.log_likelihood) < 2e-5


def test_many_records_are_grouped_anew_by_where_their_densities_are(monkeypatch):
    model = zakai.Model(
        state=["x"], drift=["cos(x) + 1e-30*t"], observation=["x**3"], prior={"kind": "gaussian", "mean": [0.0], "cov": [0.2]}
    )
    times = 0.005 * np.arange(1, 101)
    records = [zakai.simulate(model, times, seed=seed)[1] for seed in range(8)]
    alone = [zakai.filter(model, record, "yau-yau", keep="moments") for record in records]
    for name, value in {"ROUND": 40, "MANY": 4, "LANES": 4}.items():
        monkeypatch.setattr(batches, name, value)
    groups, plain = [], batches._together

    def spied(runs, lanes, count, until):
        groups.append((until, [float(run.infos[-1].mean[-1, 0]) if run.infos else 0.0 for run in runs]))
        return plain(runs, lanes, count, until)

    monkeypatch.setattr(batches, "_together", spied)
    told = []
    together = zakai.filter(model, records, "yau-yau", keep="moments", progress=lambda done, total: told.append(done))
    assert sorted({until for until, _ in groups}) == [40, 80, 100]
    assert all(means == sorted(means) for _, means in groups)
    assert told[-1] == 8 * len(times) and told == sorted(told)
    for one, other in zip(alone, together, strict=True):
        assert np.abs((one.mean - other.mean) / np.sqrt(one.variance)).max() < 1e-4
        assert abs(one.log_likelihood - other.log_likelihood) < 1e-4 and not other.warnings
