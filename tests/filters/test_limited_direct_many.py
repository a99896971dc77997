"""Many records on lattices of one size agree with the records one by one."""

from __future__ import annotations

import numpy as np
import pytest

import zakai


@pytest.mark.parametrize("name", ["spiral-sensor", "benes", pytest.param("wind-vane", marks=pytest.mark.slow)])
def test_many_records_agree_with_the_records_one_by_one(name):
    model = zakai.load_model(f"gallery:{name}")
    times = np.arange(1, 41) / 50
    records = [zakai.simulate(model, times, seed=seed)[1] for seed in range(6)]
    gaps = np.where(np.isin(np.arange(40), [7, 8])[:, None], np.nan, 0.0)
    records[3:] = [zakai.Record(times, record.values + gaps, record.kind) for record in records[3:]]
    together = zakai.filter(model, records, "limited-direct", keep="moments")
    for record, many in zip(records, together, strict=True):
        one = zakai.filter(model, record, "limited-direct", keep="moments")
        assert many.warnings == one.warnings
        assert np.abs(many.mean - one.mean).max() <= 1e-9
        assert np.abs(many.cov - one.cov).max() <= 1e-9
        assert many.log_likelihood == pytest.approx(one.log_likelihood, abs=1e-9)
