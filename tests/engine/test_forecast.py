"""Forecasts: the filter's own steps after the end of a record."""

import numpy as np
import pytest

import zakai

TIMES = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.1, 20))
AHEAD = TIMES[-1] + np.array([0.1, 0.5, 2.0])


@pytest.mark.parametrize("name", ["spiral-sensor", "benes", "kalman-bucy-2d"])
def test_a_forecast_equals_unobserved_rows_to_the_bit(name):
    model = zakai.load_model(f"gallery:{name}")
    _, record = zakai.simulate(model, TIMES, seed=1)
    result = zakai.filter(model, record)
    found = result.forecast(AHEAD)
    values = np.concatenate([record.values, np.full((3, model.m), np.nan)])
    longer = zakai.filter(model, zakai.Record(np.concatenate([TIMES, AHEAD]), values, record.kind))
    assert np.array_equal(found.mean[1:], longer.mean[-3:]) and np.array_equal(found.cov[1:], longer.cov[-3:])
    assert np.array_equal(found.times, [TIMES[-1], *AHEAD]) and np.array_equal(found.mean[0], result.mean[-1])


def test_a_forecast_of_a_linear_system_is_its_closed_form():
    model = _ornstein_uhlenbeck()
    _, record = zakai.simulate(model, TIMES, seed=1)
    result = zakai.filter(model, record)
    decay = np.exp(-0.5 * (AHEAD - TIMES[-1]))
    found = result.forecast(AHEAD)
    assert np.allclose(found.mean[1:, 0], decay * result.mean[-1, 0], atol=1e-12)
    assert np.allclose(found.variance[1:, 0], decay**2 * result.variance[-1, 0] + 1 - decay**2, atol=1e-12)
    assert np.array_equal(result.forecast(AHEAD[0]).mean, found.mean[:2])


def test_a_time_before_the_end_and_a_stored_result_are_refused(tmp_path):
    model = _ornstein_uhlenbeck()
    result = zakai.filter(model, zakai.simulate(model, TIMES, seed=1)[1])
    with pytest.raises(zakai.InputError, match="not after the end of the record"):
        result.forecast([TIMES[-1]])
    with pytest.raises(zakai.InputError, match="forecast: no times"):
        result.forecast([])
    result.save(tmp_path / "result.nc")
    with pytest.raises(zakai.InputError, match="filter the record again"):
        zakai.load_result(tmp_path / "result.nc").forecast(AHEAD)


def _ornstein_uhlenbeck():
    return zakai.Model(
        state=["x"], drift=["-0.5*x"], observation=["x"], observation_noise=[["0.2"]], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [1.0], "cov": [[1.0]]},
    )  # fmt: skip
