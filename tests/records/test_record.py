import sys
from types import SimpleNamespace

import numpy as np
import pandas
import pytest
import xarray

from zakai.errors import InputError
from zakai.records import Record


def test_a_record_is_its_own_read_only_float64_copy():
    times, values = np.array([1, 2]), np.array([[1, 2], [3, 4]])
    record = Record(times, values, "rates")
    times[0] = 7
    assert record.times[0] == 1 and record.times.dtype == record.values.dtype == np.float64
    with pytest.raises(ValueError, match="read-only"):
        record.values[0, 0] = 0


@pytest.mark.parametrize(
    ("times", "values", "kind", "says"),
    [
        ([1.0], [[1.0]], "sample", "kind is 'sample'; it must be one of increments, path, rates, samples"),
        ([], [], "path", r"times has shape \(0,\); expected \(K,\) with at least one time"),
        ([[1.0]], [[1.0]], "path", r"times has shape \(1, 1\)"),
        ([1.0, 2.0], [[1.0]], "path", r"values has shape \(1, 1\); expected \(2, m\)"),
        ([1.0], np.empty((1, 0)), "path", r"values has shape \(1, 0\)"),
        ([1.0, 1.0], [1, 2], "path", "row 1, counted from 0: the time 1.0 repeats"),
        ([1.0, 2.0, 1.5], [1, 2, 3], "path", "row 2, counted from 0: the time 1.5 comes after the time 2.0"),
        ([1.0, np.nan, 3.0], [1, 2, 3], "path", "row 1, counted from 0: the time is missing"),
        ([1.0, np.inf], [1, 2], "path", "row 1, counted from 0: the time is inf"),
        ([1.0, 2.0], [[0, 1], [np.nan, -np.inf]], "path", "row 1, counted from 0: observation 2 is -inf"),
        ([1.0], [1e308], "path", "at most 1e[+]150"),
        (["1"], [1.0], "path", "times must be real numbers"),
        (np.array(["2013-01-01"], dtype="datetime64[ns]"), [1.0], "path", "times are dates; give the unit"),
        ([1.0], [1j], "path", "values must be real numbers"),
        ([1.0], [[object()]], "path", "values must be real numbers"),
        ([1.0, 2.0], [[1.0], [1.0, 2.0]], "path", "values must be real numbers"),
    ],
)
def test_what_no_record_may_hold_is_refused_in_one_line(times, values, kind, says):
    with pytest.raises(InputError, match=says) as caught:
        Record(times, values, kind)
    assert len(str(caught.value).splitlines()) == 1


def test_the_largest_value_can_be_squared_and_is_accepted():
    record = Record([1.0], [[1e150, -1e150]], "samples")
    assert np.isfinite((record.values**2).sum())


def test_a_record_is_checked_against_its_model():
    record = Record([1.0], [[1.0, 2.0]], "path")
    record.check(SimpleNamespace(m=2, observation_kind="path", start=0.5, inputs=()))
    for m, kind, start, says in [
        (1, "path", 0.5, r"shape \(1, 2\); the model needs \(1, 1\)"),
        (2, "rates", 0.5, "holds path; the model observes rates"),
        (2, "path", 1.0, "must be after the model's start 1.0"),
    ]:
        with pytest.raises(InputError, match=says):
            record.check(SimpleNamespace(m=m, observation_kind=kind, start=start, inputs=()))


def test_a_data_frame_gives_its_time_column_or_its_index():
    frame = pandas.DataFrame({"a": [1.0, None], "time": [1, 2], "b": pandas.array([None, 4], dtype="Int64")})
    for record in (
        Record.from_pandas(frame, "samples"),
        Record.from_pandas(frame.set_index("time"), "samples"),
    ):
        np.testing.assert_array_equal(record.times, [1, 2])
        np.testing.assert_array_equal(record.values, [[1, np.nan], [np.nan, 4]])


@pytest.mark.parametrize(
    ("frame", "says"),
    [
        ({"time": pandas.to_datetime(["2013-01-01"]), "y": [1.0]}, "times are dates; give the unit"),
        ({"time": [1.0], "y": ["1.0"]}, "column 'y' must be real numbers"),
        ({"time": [1.0]}, r"values has shape \(1, 0\)"),
    ],
)
def test_a_data_frame_of_text_or_of_dates_without_a_unit_is_refused(frame, says):
    with pytest.raises(InputError, match=says):
        Record.from_pandas(pandas.DataFrame(frame), "samples")
    with pytest.raises(InputError, match="takes a DataFrame, not dict"):
        Record.from_pandas(frame, "samples")


def test_a_missing_pandas_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match=r"pip install 'zakai\[pandas\]'"):
        Record.from_pandas(object(), "samples")


def test_an_array_and_a_dataset_of_xarray_give_the_same_record():
    array = xarray.DataArray(
        [[1.0, 3.0], [2.0, np.nan]], dims=("channel", "time"), coords={"time": [0.5, 1.5]}, name="y"
    )
    dataset = xarray.Dataset({"a": array[0], "b": array[1]})
    for data in (array, dataset):
        record = Record.from_xarray(data, "samples")
        np.testing.assert_array_equal(record.times, [0.5, 1.5])
        np.testing.assert_array_equal(record.values, [[1, 2], [3, np.nan]])
    with pytest.raises(InputError, match="no dimension time"):
        Record.from_xarray(array.drop_vars("time"), "samples")
    with pytest.raises(InputError, match=r"expected \(time,\) or \(time, channel\)"):
        Record.from_xarray(array.expand_dims("other"), "samples")
    with pytest.raises(InputError, match="takes a DataArray or a Dataset"):
        Record.from_xarray([1.0], "samples")


def test_a_masked_cell_was_not_observed():
    values = np.ma.array([[1.0], [9.0]], mask=[[False], [True]])
    assert np.isnan(Record([1.0, 2.0], values, "samples").values[1, 0])
    whole = np.ma.array([[1], [9]], mask=[[False], [True]])
    assert np.isnan(Record([1.0, 2.0], whole, "samples").values[1, 0])
