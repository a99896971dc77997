"""Untrusted results: nothing is loaded that the file does not hold, no other file is opened, no code runs."""

from __future__ import annotations

import os
import resource
import shutil
import sys
import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray

from zakai.engine.stored import load_result
from zakai.errors import InputError
from zakai.records import load_dataset, save_dataset


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A small result."""
    path = tmp_path_factory.mktemp("result") / "good.nc"
    numbers = np.random.default_rng(0).normal(size=(6, 2))
    variables = {
        "mean": (("time", "state"), numbers),
        "variance": (("time", "state"), numbers**2),
        "log_likelihood_increment": (("time",), numbers[:, 0]),
        "edge_weight": (("time",), numbers[:, 1], {"description": "the weight at the edge"}),
    }
    coordinates = {"time": np.arange(6.0), "state": ["x", "v"], "state_": ["x", "v"]}
    save_dataset(xarray.Dataset(variables, coordinates, {"method": "kalman-bucy", "warnings": ""}), path)
    return path


def put(name="mean", **keys):
    def change(file):
        del file[name]
        return file.create_dataset(name, **keys)

    return change


def link(value):
    def change(file):
        del file["mean"]
        file["mean"] = value

    return change


def virtual(file):
    del file["mean"]
    layout = h5py.VirtualLayout((6, 2), "f8")
    layout[...] = h5py.VirtualSource("good.nc", "mean", (6, 2))
    file.create_virtual_dataset("mean", layout)


def attribute(value, name="method", of="/", count=1):
    def change(file):
        for i in range(count):
            file[of].attrs[f"{name}{i}" if count > 1 else name] = value

    return change


def twice(file):
    del file["mean"]
    mean = file.create_dataset("mean", data=np.zeros((6, 6)))
    for axis in mean.dims:
        axis.attach_scale(file["time"])


def long_words(file):
    file.create_dataset("long", shape=(9,), dtype=h5py.string_dtype())[...] = "x" * 1_000_000


BAD = {
    "a zip bomb": (put(shape=(10**10,), dtype="f8", chunks=(10**6,), compression="gzip"), "compressed"),
    "filled in": (put(shape=(10**9,), dtype="f8"), "not held in full"),
    "a quintillion": (put(shape=(10**18,), dtype="f8", chunks=(10**6,)), "compressed"),
    "32 dimensions": (put(shape=(1,) * 32, dtype="f8"), "not held in full"),
    "another file's bytes": (put(shape=(6, 2), dtype="f8", external=[("/etc/passwd", 0, 96)]), "not held in full"),
    "an external link": (link(h5py.ExternalLink("good.nc", "/mean")), "'mean' is not a variable"),
    "a soft link": (link(h5py.SoftLink("/variance")), "'mean' is not a variable"),
    "a virtual dataset": (virtual, "compressed or not held"),
    "a loop": (lambda file: file.create_group("g").__setitem__("up", file["/"]), "'g' is not a variable"),
    "references": (put(shape=(6, 2), dtype=h5py.ref_dtype), "neither numbers nor words"),
    "lists": (put(shape=(6, 2), dtype=h5py.vlen_dtype("f8")), "neither numbers nor words"),
    "records": (put(data=np.zeros((6, 2), dtype=[("a", "f8"), ("b", "i4")])), "neither numbers nor words"),
    "bytes": (put(data=np.zeros((6, 2), dtype="V8")), "neither numbers nor words"),
    "one dimension twice": (twice, "'mean' is over 'time, time'"),
    "a mean of its own": (lambda file: put(data=np.zeros(6))(file).make_scale("mean"), "'mean' is over 'mean'"),
    "a type": (lambda file: file.__setitem__("t", np.dtype("f8")), "'t' is not a variable"),
    "many variables": (lambda file: [file.create_dataset(f"v{i}", data=1.0) for i in range(300)], "more than 256 variables"),
    "many attributes": (attribute(1.0, count=300), "more than 64 attributes"),
    "attributes of a variable": (attribute(1.0, of="mean", count=100), "more than 64 attributes"),
    "a long attribute": (attribute("a" * 40_000_000), "much besides its variables"),
    "a longish attribute": (attribute("a" * 5_000_000), "longer than any"),
    "a list as an attribute": (attribute(np.arange(100.0)), "not one number or text"),
    "long words": (long_words, "more words than are read"),
    "no scales": (put(data=np.zeros((6, 2))), "is damaged or no NetCDF"),
    "other dimensions": (put("state", data=np.zeros(3)), "is damaged or no NetCDF"),
    "no variance": (lambda file: file.__delitem__("variance"), "has no variable 'variance'"),
    "a method that moves the cursor": (attribute("\x1b[2J"), "is no name"),
    "a model that is none": (attribute("state = [", name="model"), "is not TOML"),
    "another format": (attribute("zakai result 0", name="format"), "its attribute format is"),
}


@pytest.mark.parametrize(("change", "says"), BAD.values(), ids=BAD.keys())
def test_a_result_from_a_stranger_is_refused_in_one_line_and_little_memory(good, tmp_path, monkeypatch, change, says):
    shutil.copy(good, tmp_path / "good.nc")
    shutil.copy(good, tmp_path / "bad.nc")
    monkeypatch.chdir(tmp_path)
    with h5py.File("bad.nc", "r+") as file:
        change(file)
    tracemalloc.start()
    with pytest.raises(InputError, match=says) as caught:
        load_result("bad.nc")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert str(caught.value).startswith("bad.nc: ") and str(caught.value).isprintable() and len(str(caught.value)) < 300
    assert peak < 100 << 20


def test_what_follows_the_last_variable_is_not_read(good, tmp_path):
    shutil.copy(good, tmp_path / "long.nc")
    os.truncate(tmp_path / "long.nc", 1 << 36)
    with pytest.raises(InputError, match="much besides its variables"):
        load_dataset(tmp_path / "long.nc")


def test_attributes_that_tell_netcdf_readers_to_compute_change_no_number(good, tmp_path):
    shutil.copy(good, tmp_path / "scaled.nc")
    with h5py.File(tmp_path / "scaled.nc", "r+") as file:
        file["mean"].attrs.update({"scale_factor": 1e300, "dtype": "bool", "units": "days since never", "coordinates": "mean"})
    np.testing.assert_array_equal(load_result(tmp_path / "scaled.nc").mean, load_result(good).mean)


@pytest.mark.skipif(sys.platform != "linux", reason="limits of a process are those of Linux")
def test_a_file_that_hdf5_never_finishes_is_refused_in_time():
    path = Path(__file__).parents[2] / "fuzz" / "corpus" / "result" / "hdf5-never-ends"
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with pytest.raises(InputError, match="hdf5-never-ends: is damaged"):
        load_result(path)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 4


def test_a_file_cut_off_anywhere_is_refused(good, tmp_path):
    whole = good.read_bytes()
    for length in range(0, len(whole), 3001):
        (tmp_path / "cut.nc").write_bytes(whole[:length])
        with pytest.raises(InputError, match="is damaged"):
            load_result(tmp_path / "cut.nc")
