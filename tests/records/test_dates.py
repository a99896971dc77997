"""Dates as times: in records, files and results, and back."""

from __future__ import annotations

import datetime

import numpy as np
import pandas
import pytest
import xarray

import zakai
from zakai.errors import InputError

DATES = pandas.date_range("2024-03-30T18:00", periods=6, freq="6h")
VALUES = [0.3, np.nan, 0.1, -0.4, 0.2, 0.0]


def walk(unit="d"):
    return zakai.Model(
        name=f"time in {unit}", state=["x"], drift=["-x"], observation=["x"], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0], "cov": [[1]]},
    )  # fmt: skip


@pytest.mark.parametrize(
    "dates",
    [
        DATES,
        DATES.to_numpy(),
        DATES.to_series().reset_index(drop=True),
        DATES.to_pydatetime().tolist(),
        [date.isoformat() for date in DATES],
        DATES.tz_localize("UTC").tz_convert("Europe/Berlin"),  # a change of summer time lies between
        [date.tz_localize("UTC").tz_convert("Asia/Tokyo").isoformat() for date in DATES],
    ],
)
def test_dates_of_every_kind_are_the_same_times(dates):
    record = zakai.Record(dates, VALUES, "samples", unit="d")
    np.testing.assert_array_equal(record.times, 0.25 * np.arange(6))
    np.testing.assert_array_equal(record.dates, DATES.to_numpy("datetime64[ns]"))
    assert "times 2024-03-30T18:00:00 to 2024-04-01" in repr(record)


@pytest.mark.parametrize(
    ("unit", "seconds"), [("s", 1), ("min", 60), ("h", 3600), ("D", 86400), ("week", 604800), ("year", 365.25 * 86400)]
)
def test_a_unit_and_an_origin_give_the_times(unit, seconds):
    record = zakai.Record(DATES, VALUES, "samples", unit=unit, origin="2024-03-30")
    np.testing.assert_allclose(record.times, (18 + 6 * np.arange(6)) * 3600 / seconds, rtol=1e-15)


def test_dates_survive_times_that_are_no_binary_fractions():
    dates = np.datetime64("1990-01-01", "us") + np.arange(2000) * np.timedelta64(86_400_000_001, "us")
    record = zakai.Record(np.array([1.0]), [0.0], "samples", unit="d", origin=dates[0])
    np.testing.assert_array_equal(record.clock.dates(record.clock.times(dates.astype("datetime64[ns]"))), dates)


def test_a_result_with_dates_is_that_with_times_and_gives_the_dates_back(tmp_path):
    model = walk()
    dated = zakai.filter(model, zakai.Record(DATES, VALUES, "samples", unit="d"))
    plain = zakai.filter(model, zakai.Record(0.25 * np.arange(6), VALUES, "samples"))
    np.testing.assert_array_equal(dated.mean, plain.mean)
    dated.save(tmp_path / "result.nc")
    for result in (dated, zakai.load_result(tmp_path / "result.nc")):
        np.testing.assert_array_equal(result.dates[1:], DATES.to_numpy())
        assert result.to_dataset()["mean"].sel(time="2024-03-31T06").item() == plain.mean[3, 0]
        frame = result.to_dataframe()
        assert frame.index[-1] == DATES[-1] and frame["x"].iloc[-1] == plain.mean[-1, 0]
        assert frame["x_deviation"].iloc[-1] == np.sqrt(plain.variance[-1, 0])
    assert plain.dates is None and plain.to_dataframe().index[-1] == 1.25


def test_a_forecast_accepts_dates():
    result = zakai.filter(walk(), zakai.Record(DATES, VALUES, "samples", unit="d"))
    ahead = result.forecast(pandas.date_range("2024-04-01T06:00", periods=2, freq="12h"))
    np.testing.assert_array_equal(ahead.times, [1.25, 1.5, 2.0])
    assert ahead.dates[-1] == np.datetime64("2024-04-01T18:00")


def test_a_file_with_dates_is_read_and_written(tmp_path):
    record = zakai.Record(DATES, VALUES, "samples", unit="h")
    record.to_csv(tmp_path / "record.csv")
    (tmp_path / "other.csv").write_text(
        "time,y1\n2024-03-30 18:00,0.3\n2024-03-31,\n\n2024-03-31T08:00+02:00,0.1\n"
        '"2024-03-31 12:00",-0.4\n2024-03-31T18:00:00Z,0.2\n2024-04-01,0\n'
    )
    for name in ("record.csv", "other.csv"):
        found = zakai.read_record(tmp_path / name, walk("h"), unit="h")
        np.testing.assert_array_equal(found.times, record.times)
        np.testing.assert_array_equal(found.values, record.values)
        np.testing.assert_array_equal(found.dates, record.dates)


@pytest.mark.parametrize(
    ("row", "unit", "says"),
    [
        ("2024-13-01,1", "h", "row 3: '2024-13-01' in column 'time' is not a date; write it as 2024-01-31 or 2024-01-31T12:30"),
        ("2023-01-01,1", "h", "row 3: the time .* comes after the time 0.0; .* sort the rows"),
        ("0.5,1", "h", "row 3: '0.5' in column 'time' is not a date; .* omit the unit"),
        ("2024-02-01,1", None, "row 2: '2024-01-01' in column 'time' is not a number; for dates give .* --unit h"),
        ("2024-02-01,1", "month", "unit is 'month'; it must be one of ns, us, ms, s, min, h, d, week, year"),
    ],
)
def test_a_file_with_a_wrong_date_is_refused_in_one_line(tmp_path, row, unit, says):
    (tmp_path / "record.csv").write_text(f"time,y\n2024-01-01,0\n{row}\n")
    with pytest.raises(InputError, match=says) as caught:
        zakai.read_record(tmp_path / "record.csv", walk(), unit=unit)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("times", "keys", "says"),
    [
        (DATES, {}, "times are dates; give the unit of the model's time, as in unit='h'"),
        (DATES - DATES[0], {}, "times are durations; give the unit"),
        (np.arange(6.0), {"unit": "h"}, "times are numbers; give dates, or both unit and origin"),
        (DATES, {"unit": "fortnight"}, "unit is 'fortnight'; it must be one of ns"),
        (DATES, {"unit": "h", "origin": "soon"}, "origin is 'soon'; give the date at which t = 0"),
        ([*DATES[:5], pandas.NaT], {"unit": "h"}, "row 5, counted from 0: the time is missing"),
    ],
)
def test_a_record_with_wrong_dates_is_refused_in_one_line(times, keys, says):
    with pytest.raises(InputError, match=says) as caught:
        zakai.Record(times, VALUES, "samples", **keys)
    assert "\n" not in str(caught.value)


def test_increments_need_an_origin_before_the_first_date():
    prior = {"kind": "gaussian", "mean": [0], "cov": [[1]]}
    model = zakai.Model(state=["x"], drift=["-x"], observation=["x"], observation_kind="increments", prior=prior)
    with pytest.raises(InputError, match="give the date at which t = 0 as origin"):
        zakai.filter(model, zakai.Record(DATES, VALUES, unit="d"))
    found = zakai.filter(model, zakai.Record(DATES, VALUES, unit="d", origin=datetime.date(2024, 3, 30)))
    assert found.dates[0] == np.datetime64("2024-03-30") and found.times[1] == 0.75


def test_frames_and_arrays_with_dates_are_records():
    frame = pandas.DataFrame({"y": VALUES}, index=DATES)
    array = xarray.DataArray(VALUES, coords={"time": DATES}, dims="time")
    for record in (zakai.Record.from_pandas(frame, "samples", unit="h"), zakai.Record.from_xarray(array, "samples", "h")):
        np.testing.assert_array_equal(record.times, 6.0 * np.arange(6))


def test_durations_are_times_without_dates():
    record = zakai.Record(DATES - DATES[0], VALUES, "samples", unit="h")
    assert record.times[-1] == 30.0 and record.dates is None


HEATED = {
    "state": ["x"], "drift": ["u - x"], "observation": ["x"], "observation_kind": "samples", "inputs": ["u"],
    "prior": {"kind": "gaussian", "mean": [0], "cov": [[1]]},
}  # fmt: skip


def test_inputs_have_dates_of_their_own():
    """Their first date is not that of the record, whose origin counts."""
    model = zakai.Model(**HEATED)
    days = pandas.date_range("2024-03-29", periods=4, freq="D")
    inputs = zakai.Inputs(days, [1.0, -1.0, 2.0, 0.0], unit="d")
    assert inputs.times.tolist() == [0.0, 1.0, 2.0, 3.0] and inputs.origin == days[0]
    record = zakai.Record(DATES, VALUES, "samples", inputs, unit="d")
    numbers = zakai.Record(record.times, VALUES, "samples", zakai.Inputs([-1.75, -0.75, 0.25, 1.25], [1.0, -1.0, 2.0, 0.0]))
    np.testing.assert_array_equal(record.inputs.times, numbers.inputs.times)
    np.testing.assert_array_equal(zakai.filter(model, record).mean, zakai.filter(model, numbers).mean)


def test_inputs_in_a_file_have_the_dates_of_the_record(tmp_path, monkeypatch):
    from zakai.cli.filtering import record_with_inputs

    rows = "".join(f"{date.isoformat()},{value}\n" for date, value in zip(DATES, VALUES, strict=True) if value == value)
    (tmp_path / "record.csv").write_text("time,y1\n" + rows)
    (tmp_path / "inputs.csv").write_text("time,u\n2024-03-29,1.0\n2024-03-31,2.0\n")
    record = record_with_inputs(tmp_path / "record.csv", zakai.Model(**HEATED), tmp_path / "inputs.csv", "d", "2024-03-30T12:00")
    assert record.inputs.times.tolist() == [-1.5, 0.5] and record.times[0] == 0.25


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: zakai.Inputs(DATES, VALUES), "inputs: times are dates; give the unit"),
        (lambda: zakai.Inputs(DATES, VALUES, unit="fortnight"), "inputs: unit is 'fortnight'"),
        (lambda: zakai.Record([0.0], [1.0], "samples", zakai.Inputs(DATES[:1], [1.0], unit="h")), "give dates, a unit"),
        (lambda: zakai.online(walk(), unit="h"), "online: give both the unit"),
        (lambda: zakai.online(walk(), unit="h", origin="soon"), "online: origin is 'soon'"),
        (lambda: zakai.online(walk()).update("2024-01-01", 0.5), "give unit and origin to zakai.online"),
    ],
)
def test_wrong_dates_of_inputs_and_online_filters_are_refused_in_one_line(make, says):
    with pytest.raises(InputError, match=says) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_an_online_filter_takes_dates_and_gives_the_numbers_of_a_record():
    model = zakai.Model(**HEATED)
    inputs = zakai.Inputs(["2024-03-30", "2024-03-31"], [1.0, -1.0], unit="d")
    result = zakai.filter(model, zakai.Record(DATES, VALUES, "samples", inputs, unit="d", origin="2024-03-30"))
    online = zakai.online(model, unit="d", origin="2024-03-30")
    times = [DATES[0], DATES[1].to_pydatetime(), DATES[2].to_datetime64(), *(date.isoformat() for date in DATES[3:])]
    for k, (time, value) in enumerate(zip(times, VALUES, strict=True)):
        estimate = online.update(time, value, inputs if k == 0 else None)
        assert estimate.time == result.times[k + 1] and estimate.date == DATES[k]
        np.testing.assert_array_equal(estimate.mean, result.mean[k + 1])
    assert online.predict("2024-04-01").date == np.datetime64("2024-04-01")


def test_a_checkpoint_belongs_to_its_origin(tmp_path):
    online = zakai.online(walk(), unit="d", origin="2024-03-30")
    online.update(DATES[0], 0.3)
    online.save(tmp_path / "state")
    zakai.online(walk(), unit="d", origin="2024-03-30").restore(tmp_path / "state")
    with pytest.raises(InputError, match="another clock"):
        zakai.online(walk(), unit="d", origin="2024-03-29").restore(tmp_path / "state")


def test_warnings_of_a_record_with_dates_have_dates():
    """Of the filter, of the smoother and of online filtering alike."""
    values = np.where(np.arange(len(DATES)) == 2, -999.0, 0.1)
    record = zakai.Record(DATES, values, "samples", unit="d")
    online = zakai.online(walk(), unit="d", origin=DATES[0])
    said = [online.update(date, value).warnings for date, value in zip(DATES[1:], values[1:], strict=True)]
    for warnings in (zakai.filter(walk(), record).warnings, zakai.smooth(walk(), record).filtered.warnings, said[1]):
        assert any("be explained by the model" in one and f"{DATES[2]}" in one for one in warnings)
        assert not any("t = " in one for one in warnings)
    numbers = zakai.Record(record.times, values, "samples")
    assert any("at t = " in one for one in zakai.filter(walk(), numbers).warnings)
