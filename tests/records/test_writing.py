import os
import resource
import stat
from types import SimpleNamespace

import numpy as np
import pytest
import xarray
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from zakai.errors import InputError
from zakai.records import Record, atomic_write, load_dataset, read_record, save_dataset, write_record


@settings(deadline=None)
@given(
    values=arrays(
        float, st.tuples(st.integers(1, 8), st.just(2)), elements=st.floats(-1e150, 1e150) | st.just(np.nan)
    ),
    first=st.floats(-1e6, 1e6),
)
def test_a_record_comes_back_bit_for_bit(tmp_path_factory, values, first):
    path = tmp_path_factory.mktemp("record") / "record.csv"
    record = Record(first + np.arange(len(values)) / 3, values, "samples")
    record.to_csv(path)
    law, start = SimpleNamespace(is_gaussian=True), float(record.times[0])
    model = SimpleNamespace(m=2, observation_kind="samples", inputs=(), start=start, observation_law=law)
    again = read_record(path, model)
    assert again.times.tobytes() == record.times.tobytes()
    np.testing.assert_array_equal(again.values, record.values)
    np.testing.assert_array_equal(
        np.signbit(again.values[~np.isnan(values)]), np.signbit(values[~np.isnan(values)])
    )


def test_names_head_the_columns_and_must_be_one_a_column(tmp_path):
    record = Record([1.0], [[1.0, np.nan]], "path")
    write_record(tmp_path / "a.csv", record, ["east", "north, true"])
    assert (tmp_path / "a.csv").read_text() == 'time,east,"north, true"\n1.0,1.0,\n'
    for names in (["east"], ["east", "north\n"]):
        with pytest.raises(InputError, match="names must be 2 names of one line each"):
            write_record(tmp_path / "b.csv", record, names)
    assert os.listdir(tmp_path) == ["a.csv"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_nothing_half_written_is_left_and_the_old_file_stays(tmp_path, error):
    path = tmp_path / "result.txt"
    path.write_text("old")
    with pytest.raises(error), atomic_write(path) as temporary:
        temporary.write_text("half")
        raise error
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["result.txt"]


def test_the_temporary_file_is_beside_the_target_with_its_suffix(tmp_path):
    with atomic_write(tmp_path / "result.html") as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".html"
        temporary.write_text("new")
        assert not (tmp_path / "result.html").exists()
    assert (tmp_path / "result.html").read_text() == "new"


def test_permissions_are_those_of_any_new_file_and_links_are_followed(tmp_path):
    (tmp_path / "plain").touch()
    (tmp_path / "link").symlink_to(tmp_path / "result")
    with atomic_write(tmp_path / "link") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "result").read_text() == "new"
    assert stat.S_IMODE((tmp_path / "result").stat().st_mode) == stat.S_IMODE(
        (tmp_path / "plain").stat().st_mode
    )


@pytest.mark.parametrize(
    ("target", "says"),
    [
        ("missing/result.nc", "No such file or directory"),
        (".", "it is a folder"),
        ("/dev/null", "not a regular file"),
        ("nul\0.nc", "null"),
        ("x" * 300, "too long"),
    ],
)
def test_a_place_that_cannot_be_written_is_said_in_one_line(tmp_path, monkeypatch, target, says):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=says) as caught, atomic_write(target):
        raise AssertionError("the block must not begin")
    assert len(str(caught.value).splitlines()) == 1 and os.listdir(tmp_path) == []


@pytest.fixture
def small_disk():
    """No file of this process may pass 10 kB: what a full disk looks like to a writer."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_is_said_in_one_line_and_leaves_no_file(tmp_path, small_disk):
    record = Record(np.arange(5000.0), np.ones(5000), "samples")
    dataset = xarray.Dataset({"mean": ("time", np.random.default_rng(0).normal(size=5000))})
    for write in (
        lambda: record.to_csv(tmp_path / "a.csv"),
        lambda: save_dataset(dataset, tmp_path / "a.nc"),
    ):
        with pytest.raises(InputError, match="cannot be written: File too large") as caught:
            write()
        assert len(str(caught.value).splitlines()) == 1
    assert os.listdir(tmp_path) == []


def test_a_dataset_comes_back_whole_with_its_attributes(tmp_path):
    dataset = xarray.Dataset(
        {"mean": (("time", "state"), np.random.default_rng(1).normal(size=(4, 2)))},
        coords={
            "time": ("time", np.arange(4.0), {"units": "hours since 2013-01-01"}),
            "state": ["x", "theta"],
        },
        attrs={"method": "limited-direct", "model": 'name = "é"\n'},
    )
    save_dataset(dataset, tmp_path / "result.nc")
    again = load_dataset(tmp_path / "result.nc")
    assert "format" not in dataset.attrs
    xarray.testing.assert_identical(again, dataset.assign_attrs(format=again.attrs["format"]))
    (tmp_path / "result.nc").unlink()
    again["mean"].load()


def test_a_file_that_is_not_a_result_of_ours_is_refused(tmp_path):
    foreign = xarray.Dataset({"mean": ("time", [1.0])})
    foreign.to_netcdf(tmp_path / "foreign.nc", engine="h5netcdf")
    save_dataset(foreign, tmp_path / "ours.nc")
    (tmp_path / "cut.nc").write_bytes((tmp_path / "ours.nc").read_bytes()[:1000])
    (tmp_path / "text.nc").write_text("time,y\n1,2\n")
    (tmp_path / "empty.nc").touch()
    for name, says in [
        ("foreign.nc", "its attribute format is 'None', not 'zakai result 1'"),
        ("cut.nc", "is damaged or no NetCDF"),
        ("text.nc", "is damaged or no NetCDF"),
        ("empty.nc", "is damaged or no NetCDF"),
        ("missing.nc", "there is no such file"),
        ("", "is not a regular file"),
    ]:
        with pytest.raises(InputError, match=says) as caught:
            load_dataset(tmp_path / name)
        assert len(str(caught.value).splitlines()) == 1
