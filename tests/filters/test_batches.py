"""Records side by side: what one of them needs is not what all of them get."""

import numpy as np
import pytest

import zakai
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

    def spied(run, progress):
        left.append((run.record, run.done))
        return everything(run, progress)

    monkeypatch.setattr(Run, "all", spied)
    told = []
    together = zakai.filter(model, records, keep="moments", progress=lambda done, total: told.append(done))
    assert [record for record, _ in left] == [records[3]] and left[0][1] % 256 == 0
    assert told[-1] == 8 * len(times) and told == sorted(told)
    for one, other in zip(alone, together, strict=True):
        assert np.allclose(one.mean, other.mean, rtol=0, atol=1e-8)
        assert np.allclose(one.log_likelihood_increments, other.log_likelihood_increments, rtol=0, atol=1e-8)
        assert one.warnings == other.warnings
