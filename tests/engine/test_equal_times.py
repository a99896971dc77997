"""Samples of several sensors in rows of one time: a factor each, as if they stood in one row."""

from __future__ import annotations

import numpy as np
import pytest

import zakai
from zakai.errors import InputError
from zakai.records import read_record

NOISE = {"observation_kind": "samples", "observation_noise": [[0.2, 0], [0, 0.3]]}
WELL = zakai.Model(
    state=["x"], drift=["x - x**3"], observation=["x", "x**2"], prior={"kind": "gaussian", "mean": [0.3], "cov": [[1]]}, **NOISE
)
PENDULUM = zakai.Model(
    state=["x", "y"], drift=["y", "-sin(x)"], diffusion=[["0.3", 0], [0, "0.5"]], observation=["x", "sin(y)"],
    prior={"kind": "gaussian", "mean": [0.3, 0], "cov": [[1, 0], [0, 0.5]]}, **NOISE,
)  # fmt: skip
LINEAR = zakai.Model(
    state=["x"], drift=["-x"], observation=["x", "2*x"], prior={"kind": "gaussian", "mean": [0.3], "cov": [[1]]}, **NOISE
)
TIMES, VALUES = np.array([0.5, 1.0, 1.7]), np.array([[0.3, 0.5], [0.1, 0.2], [0.4, 0.6]])
SPLIT = np.full((6, 2), np.nan)
SPLIT[::2, 0], SPLIT[1::2, 1] = VALUES.T


@pytest.mark.parametrize(
    ("model", "method"), [(LINEAR, "kalman-bucy"), (WELL, "yau-yau"), (PENDULUM, "yau-yau"), (LINEAR, "gaussian-sum")]
)
def test_rows_of_one_time_are_two_factors(model, method):
    merged = zakai.filter(model, zakai.Record(TIMES, VALUES, "samples"), method)
    split = zakai.filter(model, zakai.Record(np.repeat(TIMES, 2), SPLIT, "samples"), method)
    np.testing.assert_allclose(split.mean[2::2], merged.mean[1:], atol=1e-4)
    assert split.log_likelihood == pytest.approx(merged.log_likelihood, abs=1e-4)
    online = zakai.online(model, method)
    estimates = [online.update(float(t), row).mean for t, row in zip(np.repeat(TIMES, 2), SPLIT, strict=True)]
    np.testing.assert_array_equal(estimates, split.mean[1:])
    smoothed = zakai.smooth(model, zakai.Record(np.repeat(TIMES, 2), SPLIT, "samples"), method)
    np.testing.assert_allclose(smoothed.mean[1::2], smoothed.mean[2::2], atol=1e-5)
    assert np.isfinite(split.residuals()).sum() == 6


def test_other_kinds_and_late_rows_are_refused_with_what_to_do(tmp_path):
    prior = {"kind": "gaussian", "mean": [0], "cov": [1]}
    increments = zakai.Model(state=["x"], drift=["-x"], observation=["x"], observation_kind="increments", prior=prior)
    unsaid = zakai.Record([1, 1], [0, 0])
    for make in (lambda: zakai.Record([1, 1], [0, 0], "increments"), lambda: zakai.filter(increments, unsaid)):
        with pytest.raises(InputError, match="row 1, counted from 0: the time 1.0 repeats .* merge them into one row"):
            make()
    (tmp_path / "record.csv").write_text("time,y\n1,0\n1,0\n")
    with pytest.raises(InputError, match="row 3: the time 1.0 repeats .* merge them into one row"):
        read_record(tmp_path / "record.csv", zakai.load_model("gallery:cubic-sensor"))
    (tmp_path / "record.csv").write_text("time,y1,y2\n1,0.2,\n1,,0.4\n")
    assert len(read_record(tmp_path / "record.csv", LINEAR)) == 2
    online = zakai.online(increments)
    online.update(1.0, 0.1)
    with pytest.raises(InputError, match="merge them into one"):
        online.update(1.0, 0.1)
    late = "the time 0.75 is late by 0.25: the last observation was at 1.0, which is kept; .* checkpoint"
    with pytest.raises(InputError, match=late):
        online.update(0.75, 0.1)


@pytest.mark.parametrize("kind", ["increments", "samples"])
@pytest.mark.parametrize("drift", ["t*x/4", "-x*cos(3*t)", "sin(x - t)"])
def test_irregular_times_and_gaps_give_the_same_bits_online_where_all_depends_on_time(drift, kind):
    model = zakai.Model(
        state=["x"], drift=[drift], diffusion=[["1 + t/5"]], observation=["sin(x)", "cos(x) + t"], observation_kind=kind,
        observation_noise=[["1 + t/3", "1/4"], ["1/4", "1"]], prior={"kind": "gaussian", "mean": [0.3], "cov": [[0.5]]},
    )  # fmt: skip
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.choice([0.02, 0.02, 0.05, 0.013], 24))
    values = (0.05 if kind == "increments" else 0.6) * rng.standard_normal((24, 2))
    values[[5, 6, 11], [0, 1, 0]] = np.nan
    values[17] = np.nan
    result, online = zakai.filter(model, zakai.Record(times, values, kind)), zakai.online(model)
    for k, (time, value) in enumerate(zip(times, values, strict=True), 1):
        estimate = online.update(time, value)
        assert estimate.mean.tolist() == result.mean[k].tolist() and estimate.cov[0, 0] == result.variance[k, 0], k
