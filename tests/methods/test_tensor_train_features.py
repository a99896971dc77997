"""What a tensor train does beside filtering one record: batches, forecasts, residuals, domains."""

from __future__ import annotations

import numpy as np
import pytest

import zakai


def radar(**more):
    """Return a target that turns slowly, seen by range and bearing."""
    return zakai.Model(
        **{
            "state": ["px", "py", "s", "a"], "drift": ["s*cos(a)", "s*sin(a)", "0", "0.2"],
            "diffusion": [[0, 0], [0, 0], [0.2, 0], [0, 0.2]], "observation": ["sqrt(px**2 + py**2)", "atan2(py, px)"],
            "observation_kind": "samples", "observation_noise": [[0.05, 0], [0, 0.003]],
            "prior": {"kind": "gaussian", "mean": [4, 3, 1, 0.5], "cov": [0.3, 0.3, 0.04, 0.04]}, **more,
        },
    )  # fmt: skip


def test_a_batch_an_online_filter_and_a_restart_equal_a_record_to_the_bit(tmp_path):
    model, times = radar(), np.array([0.2, 0.5, 0.9])
    records = [zakai.simulate(model, times, seed=seed)[1] for seed in (1, 2)]
    values = records[1].values.copy()
    values[1, 0] = np.nan
    records[1] = zakai.Record(times, values, "samples")
    expected = zakai.filter(model, records[1], "tensor-train", tolerance=2e-2)
    other = zakai.filter(model, records, "tensor-train", tolerance=2e-2)[1]
    assert np.array_equal(other.mean, expected.mean) and np.array_equal(other.cov, expected.cov)
    assert np.array_equal(other.log_likelihood_increments, expected.log_likelihood_increments)
    online = zakai.online(model, "tensor-train", tolerance=2e-2)
    for k, (t, z) in enumerate(zip(times, values, strict=True), 1):
        if k == 2:
            online.save(tmp_path / "state")
            online = zakai.online(model, "tensor-train", tolerance=2e-2)
            online.restore(tmp_path / "state")
        estimate = online.update(t, z)
        assert np.array_equal(estimate.mean, expected.mean[k]) and np.array_equal(estimate.cov, expected.cov[k])
        assert estimate.log_likelihood_increment == expected.log_likelihood_increments[k]


def test_a_forecast_equals_unobserved_rows_to_the_bit():
    model, times = radar(), np.array([0.2, 0.5, 0.9, 1.2])
    _, record = zakai.simulate(model, times, seed=1)
    values = record.values.copy()
    values[2:] = np.nan
    whole = zakai.filter(model, zakai.Record(times, values, "samples"), "tensor-train", tolerance=2e-2)
    known = zakai.filter(model, zakai.Record(times[:2], values[:2], "samples"), "tensor-train", tolerance=2e-2)
    forecast = known.forecast(times[2:])
    assert np.array_equal(forecast.mean[-2:], whole.mean[-2:]) and np.array_equal(forecast.cov[-2:], whole.cov[-2:])


def test_residuals_and_predicted_observations_are_those_of_the_exact_filter():
    model = radar(
        drift=["s", "a", "0", "-0.3*a"], observation=["px + 0.2*py", "py"], observation_noise=[[0.05, 0], [0, 0.03]],
    )  # fmt: skip
    _, record = zakai.simulate(model, np.array([0.2, 0.5, 0.9]), seed=1)
    result, exact = zakai.filter(model, record, "tensor-train"), zakai.filter(model, record, "kalman-bucy")
    assert np.abs(result.residuals() - exact.residuals()).max() < 5e-3
    predicted, known = result.predict_observations(), exact.predict_observations()
    assert np.abs(predicted.mean - known.mean).max() < 5e-3
    assert np.abs(predicted.quantile([0.1, 0.9]) - known.quantile([0.1, 0.9])).max() < 2e-2


def population(**more):
    """Return a population and its growth, which are not negative."""
    return zakai.Model(
        **{
            "state": ["n", "g"], "drift": ["0.3 - n + g", "-g"], "diffusion": [["0.3*sqrt(n)", 0], [0, 0.2]],
            "observation": ["n"], "observation_kind": "samples", "observation_noise": [[0.02]],
            "prior": {"kind": "gaussian", "mean": [0.8, 0.0], "cov": [0.01, 0.04]}, "domain": {"n": {"lower": 0.0}}, **more,
        },
    )  # fmt: skip


def test_a_natural_end_is_silent_far_away_and_a_warning_where_it_may_be_crossed():
    far = zakai.filter(population(), zakai.Record([0.2, 0.4], [[0.8], [0.7]], "samples"), "tensor-train")
    assert not any("domain" in words for words in far.warnings)
    model = population(drift=["0.01 - n + g", "-g"], diffusion=[[0.3, 0], [0, 0.2]])
    near = zakai.filter(model, zakai.Record([0.2, 0.4, 0.6], [[0.3], [0.1], [0.05]], "samples"), "tensor-train")
    assert any("'n'" in words and "not kept with several states" in words for words in near.warnings)


def test_reflecting_ends_are_refused_with_advice():
    model = population(domain={"n": {"lower": 0.0, "upper": 2.0, "boundary": "reflecting"}})
    with pytest.raises(zakai.ConditionError, match="reflecting"):
        zakai.filter(model, zakai.Record([0.2], [[0.8]], "samples"), "tensor-train")
