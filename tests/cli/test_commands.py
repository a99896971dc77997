"""The commands, end to end."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

import zakai as package
from zakai import _registry
from zakai.cli import simulating


def test_a_simulated_record_is_filtered_into_a_result_and_a_report(zakai, tmp_path):
    simulated = zakai(
        "simulate", "model.toml", "--until", "1", "--step", "0.1", "--seed", "3", "-o", "made.csv", "--truth", "truth.csv"
    )
    assert simulated.code == 0 and simulated.err == ""
    answer = zakai("filter", "model.toml", "made.csv", "-o", "r.nc", "--truth", "truth.csv", "--report", "r.html")
    assert answer.code == 0 and answer.err == ""
    result = package.load_result("r.nc")
    assert result.mean.shape == (11, 1)
    assert f"{result.log_likelihood:.6f}" in answer.out and result.method in answer.out
    assert "rms error" in (tmp_path / "r.html").read_text()
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "made.csv", "model.toml", "r.html", "r.nc", "record.csv", "truth.csv",
    ]  # fmt: skip


def test_the_command_and_the_function_give_the_same_numbers(zakai):
    options = ("--method", "limited-direct", "--option", "splitting=strang")
    assert zakai("filter", "model.toml", "record.csv", "-o", "r.nc", *options).code == 0
    model = package.load_model("model.toml")
    direct = package.filter(model, package.read_record("record.csv", model), "limited-direct")
    np.testing.assert_array_equal(package.load_result("r.nc").mean, direct.mean)


def test_the_same_seed_simulates_the_same_record_as_the_function(zakai, tmp_path):
    arguments = ("simulate", "gallery:kalman-bucy-2d", "--until", "0.5", "--step", "0.1", "--initial", "1, -2")
    assert zakai(*arguments, "--seed", "4", "-o", "a.csv", "--truth", "truth.csv").code == 0
    assert zakai(*arguments, "--seed", "5", "-o", "b.csv").code == 0
    model = package.load_model("gallery:kalman-bucy-2d")
    truth, record = package.simulate(model, [0.1, 0.2, 0.3, 0.4, 0.5], seed=4, initial=[1, -2])
    np.testing.assert_array_equal(package.read_record("a.csv", model).values, record.values)
    from zakai.records import read_truth

    np.testing.assert_array_equal(read_truth("truth.csv", model).values, truth.values)
    assert (tmp_path / "a.csv").read_text() != (tmp_path / "b.csv").read_text()


def test_the_clock_has_decimals_and_reaches_its_end():
    assert simulating.clock(0.0, 1.0, 0.1).tolist() == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]
    assert simulating.clock(0.5, 1.2, 0.25).tolist() == [0.75, 1.0]
    np.testing.assert_allclose(simulating.clock(0.0, 1.0, 1 / 3), [1 / 3, 2 / 3, 1.0], rtol=1e-15)


def test_a_negative_initial_state_is_a_value_and_not_an_option(zakai, tmp_path):
    arguments = ("--until", "1", "--step", "1", "--initial", "-0.5", "-o", "a.csv", "--truth", "b.csv")
    assert zakai("simulate", "model.toml", *arguments).code == 0
    assert "0.0,-0.5" in (tmp_path / "b.csv").read_text()


@pytest.mark.parametrize("name", ["spiral-sensor", "falling-body"])
def test_analyze_prints_a_page_json_or_latex(zakai, name):
    page = zakai("analyze", f"gallery:{name}")
    assert page.code == 0 and "omega_ij" in page.out.lower() and "limited-direct" in page.out
    assert set(json.loads(zakai("analyze", f"gallery:{name}", "--json").out)["methods"]) == set(_registry.METHODS)
    assert zakai("analyze", f"gallery:{name}", "--latex").out.startswith("\\begin{align*}")


def test_methods_of_a_record_adds_the_expected_time_of_those_that_hold(zakai, monkeypatch):
    monkeypatch.setattr("zakai.cli.inspecting.MOST_SECONDS", 600.0)  # kernels may be compiled
    lines = zakai("methods", "model.toml", "record.csv").out.splitlines()
    assert all("s for this record" in line for line in lines if "  holds" in line)
    assert not any("for this record" in line for line in lines if "fails" in line)
    assert any(line.startswith("kalman-bucy") and "holds; about 0." in line for line in lines)
    assert "for this record" not in zakai("methods", "model.toml").out
    wrong = zakai("methods", "model.toml", "nowhere.csv")
    assert wrong.code == 2 and "nowhere.csv" in wrong.err


def test_the_methods_of_a_record_take_its_columns(zakai, tmp_path):
    rows = [line.split(",") for line in (tmp_path / "record.csv").read_text().split()]
    (tmp_path / "wide.csv").write_text("\n".join(f"{row[0]},{'other' if k == 0 else 7},{row[1]}" for k, row in enumerate(rows)))
    assert zakai("methods", "model.toml", "wide.csv").code == 2
    assert "for this record" in zakai("methods", "model.toml", "wide.csv", "--columns", rows[0][1]).out


def test_methods_lists_every_method_and_says_which_hold(zakai):
    assert all(name in zakai("methods").out for name in (*_registry.METHODS, *_registry.AUTO))
    answer = zakai("methods", "gallery:cubic-sensor").out
    assert "fails: " in answer and "x**6" in answer and "auto takes: yau-yau" in answer
    assert "auto takes: benes" in zakai("methods", "gallery:benes").out


def test_gallery_lists_every_model_and_prints_one(zakai, tmp_path):
    listed = zakai("gallery").out
    assert all(name in listed for name in package.gallery.names())
    (tmp_path / "copy.toml").write_text(zakai("gallery", "spiral-sensor").out)
    assert package.load_model("copy.toml").name == package.load_model("gallery:spiral-sensor").name


def test_the_version_and_the_help_are_printed(zakai):
    assert zakai("--version").out == f"zakai {package.__version__}\n"
    commands = ["analyze", "simulate", "filter", "methods", "gallery", "reproduce"]
    assert all(command in zakai().out for command in commands)
    for command in commands:
        assert zakai(command, "--help").code == 0


def test_an_option_of_a_study_reaches_it_and_another_is_refused(zakai):
    for option, said in (
        ("paths=0", "option paths: 0 is not a whole number from 1"),
        ("path=3", 'cubic-sensor: there is no option "path"; there is: paths, steps, seed'),
        ("folder=here", "--option folder: is not an option of a study"),
    ):
        answer = zakai("reproduce", "cubic-sensor", "--option", option)
        assert answer.code == 2 and said in answer.err and len(answer.err.splitlines()) == 1


def test_a_stored_result_is_a_netcdf_file_for_other_programs_too(zakai):
    import xarray

    assert zakai("filter", "gallery:kalman-bucy-1d", "record.csv", "-o", "r.nc").code == 0
    with xarray.open_dataset("r.nc", engine="h5netcdf") as stored:
        result = package.load_result("r.nc")
        assert stored["mean"].dims == ("time", "state") and stored["state"].values.tolist() == ["x"]
        np.testing.assert_array_equal(stored["cov"].values, result.cov)
        assert stored.attrs["method"] == "kalman-bucy" and stored.attrs["log_likelihood"] == result.log_likelihood
        assert set(result.to_dataset().variables) == set(stored.variables)


def test_health_figures_of_version_0_1_are_read_by_their_new_names(zakai, tmp_path):
    import xarray

    from zakai.records import save_dataset

    assert zakai("filter", "model.toml", "record.csv", "-o", "new.nc", "--method", "kalman-bucy").code == 0
    old = package.load_result("new.nc").to_dataset()
    for name in ("missed", "surprise", "resolution"):
        old[name] = xarray.DataArray(np.arange(4.0), dims="time")
    save_dataset(old, "old.nc")
    health = package.load_result("old.nc").health
    assert {"tolerance_ratio", "tail_depth", "std_in_spacings"} <= set(health) and "missed" not in health
    assert health["tail_depth"].tolist() == [0.0, 1.0, 2.0, 3.0]


def test_the_package_is_a_command_too():
    answer = subprocess.run([sys.executable, "-m", "zakai", "--version"], capture_output=True, text=True, timeout=60)
    assert answer.returncode == 0 and answer.stdout == f"zakai {package.__version__}\n"


def test_warm_up_compiles_the_kernels_that_are_declared_and_prints_the_folder(zakai, monkeypatch, tmp_path):
    from zakai.numerics import compiled, kernel_cache

    taken = []
    few, usual = [lambda: taken.append("one"), lambda: taken.append("two")], compiled.compile_declared
    monkeypatch.setattr(compiled, "compile_declared", lambda: (monkeypatch.setattr(compiled, "_declared", few), usual())[1])
    monkeypatch.setattr(kernel_cache, "folder", lambda: tmp_path)
    answer = zakai("warm-up")
    assert (answer.code, answer.err, taken) == (0, "", ["one", "two"])
    assert answer.out == f"compiled  2 kernels in 0 s\nkept in   {tmp_path}\n"
    monkeypatch.setattr(kernel_cache, "folder", lambda: None)
    assert zakai("warm-up").code == 2


@pytest.mark.parametrize(
    ("names", "header"),
    [(["range", "bearing"], "time,range,bearing"), (None, "time,y,x"), (None, "time,y1,y2")],
)
def test_a_simulated_file_has_the_names_of_the_observations_and_is_read_by_them(zakai, tmp_path, names, header):
    plain = header == "time,y,x"
    keys = "" if names is None else f"observation_names = {names}\n"
    observation = '["y", "x"]' if plain else '["2*x", "x + y"]'
    (tmp_path / "two.toml").write_text(
        f'state = ["x", "y"]\ndrift = ["-x", "x - y"]\nobservation = {observation}\nobservation_kind = "samples"\n{keys}'
        '[prior]\nkind = "gaussian"\nmean = [0, 0]\ncov = [1, 1]\n'
    )
    assert zakai("simulate", "two.toml", "--until", "0.5", "--step", "0.1", "-o", "made.csv").code == 0
    lines = (tmp_path / "made.csv").read_text().split()
    assert lines[0] == header
    swapped = [",".join(cell for cell in (line.split(",")[i] for i in (0, 2, 1))) for line in lines]
    (tmp_path / "swapped.csv").write_text("\n".join(swapped))
    model = package.load_model(tmp_path / "two.toml")
    made, other = (package.read_record(tmp_path / name, model) for name in ("made.csv", "swapped.csv"))
    assert np.allclose(made.values, package.simulate(model, 0.1 * np.arange(1, 6), seed=0)[1].values, rtol=1e-12)
    assert np.array_equal(made.values, other.values) and not made._note and not other._note


def test_columns_that_go_by_position_are_named_before_the_record_is_filtered(zakai, tmp_path):
    prior = 'observation_kind = "increments"\n[prior]\nkind = "gaussian"\nmean = [0, 0]\ncov = [1, 1]\n'
    (tmp_path / "plane.toml").write_text(f'state = ["x", "y"]\ndrift = ["-x", "-y"]\nobservation = ["x", "y"]\n{prior}')
    (tmp_path / "named.csv").write_text("time,radar,lidar\n0.1,0.2,0.1\n0.2,0.1,0.3\n")
    refused = zakai("filter", "plane.toml", "named.csv", "-o", "r.nc", "--option", "order=2")
    first, last = refused.err.splitlines()
    assert first.startswith("warning: the columns radar, lidar of the record are taken by their position")
    assert refused.code == 2 and last.startswith("error: ")
    answer = zakai("filter", "plane.toml", "named.csv", "-o", "r.nc")
    assert answer.code == 0 and answer.err.count("by their position") == 1


def test_reproduce_without_a_name_lists_the_names(zakai):
    listed = zakai("reproduce")
    assert listed.code == 0 and "chen-luo-yau-2017" in listed.out.split() and "tracking" in listed.out.split()


def test_a_forecast_of_a_record_with_dates_takes_and_shows_dates(zakai, tmp_path):
    (tmp_path / "dates.csv").write_text("time,y1\n2025-03-30 00:00,0.1\n2025-03-30 00:30,0.2\n2025-03-30 01:00,0.3\n")
    own = ("model.toml", "dates.csv", "--unit", "h", "--origin", "2025-03-29T23:00", "-o", "f.nc")
    found = zakai("forecast", *own, "--until", "2025-03-30T06:00", "--step", "5")
    assert found.code == 0, found.err
    assert "  1 time, 2025-03-30 06:00:00 (t = 7)\n" in found.out
    assert package.load_result("f.nc").dates[-1] == np.datetime64("2025-03-30T06:00")
    soon = zakai("forecast", *own, "--until", "2025-03-30T01:00:01", "--step", repr(0.5 / 3600)).out
    assert "  2 times, 2025-03-30 01:00:00.5 (t = " in soon
    later = zakai("forecast", *own, "--until", "7", "--step", "2.5").out
    assert "  2 times, 2025-03-30 03:30:00 (t = 4.5) to 2025-03-30 06:00:00 (t = 7)" in later
    early = zakai("forecast", *own, "--until", "2025-03-30T00:10", "--step", "1").err
    assert "--until 2025-03-30T00:10: must be after the end of the record, 2025-03-30 01:00:00 (t = 2)" in early
    assert "  3, times 2025-03-30 00:00:00 (t = 1) to 2025-03-30 01:00:00 (t = 2)" in zakai("filter", *own).out
    numbers = ("forecast", "model.toml", "record.csv", "-o", "f.nc", "--step", "1", "--until")
    assert "--until 2025-03-30: is a date, and the times of the record are numbers" in zakai(*numbers, "2025-03-30").err
    assert "--until later: is neither a number nor a date" in zakai(*numbers, "later").err
