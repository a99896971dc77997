"""A study gives the numbers of its runs, whoever ran them, in whatever order, and however often it was ended."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray
from scipy import stats

import zakai
from zakai.errors import ConditionError, InputError
from zakai.studies import _batch, _workers
from zakai.studies.study import run_study
from zakai.studies.study_files import read_study

STUDY = """
name = "two filters"
models = ["gallery:kalman-bucy-1d"]
reference = "exact"
batch = 2

[seeds]
first = 3
count = 6

[times]
until = 0.5
step = 0.05

[methods.exact]
method = "kalman-bucy"

[methods.euler]
method = "extended-kalman-bucy"
options = { riccati = "euler" }
"""
FILES = ("study.nc", "summary.json")


def written(folder, text=STUDY):
    path = Path(folder) / "study.toml"
    path.write_text(text)
    return path


def numbers(folder):
    """The bytes of everything that no clock decides."""
    return [(Path(folder) / name).read_bytes() for name in FILES]


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """The study, run at one go: its file, folder and outcome."""
    folder = tmp_path_factory.mktemp("studies")
    path = written(folder)
    return path, folder / "out", run_study(path, folder / "out")


def test_the_figures_are_those_of_the_runs_one_by_one(done):
    _, folder, outcome = done
    model = zakai.load_model("gallery:kalman-bucy-1d")
    times = np.round(0.05 * np.arange(1, 11), 2)
    data = outcome.points[0]
    for seed in range(3, 9):
        truth, record = zakai.simulate(model, times, seed=seed)
        exact = zakai.filter(model, record, "kalman-bucy")
        euler = zakai.filter(model, record, "extended-kalman-bucy", riccati="euler")
        for label, result in (("exact", exact), ("euler", euler)):
            own = data.sel(run=str(seed), filter=label)
            error = truth.values[1:, 0] - result.mean[1:, 0]
            assert float(own["squared_error"]) == pytest.approx(np.mean(error**2), rel=1e-10)
            assert own["squared_error_at"].values == pytest.approx(error**2, rel=1e-10)
            assert float(own["nees"]) == pytest.approx(np.mean(error**2 / result.variance[1:, 0]), rel=1e-10)
            assert float(own["log_likelihood"]) == pytest.approx(result.log_likelihood, rel=1e-10)
            pit = stats.norm.cdf(error / np.sqrt(result.variance[1:, 0]))
            assert own["pit_at"].values[:, 0] == pytest.approx(pit, abs=1e-9)
            score = -stats.norm.logpdf(error, scale=np.sqrt(result.variance[1:, 0]))
            assert float(own["log_score"]) == pytest.approx(score.mean(), rel=1e-9)
            between = np.sqrt(np.mean((result.mean[1:, 0] - exact.mean[1:, 0]) ** 2))
            assert float(own["distance"]) == pytest.approx(between, abs=1e-12)
    said = outcome.summary["points"][0]["methods"]["euler"]["squared_error"]
    values = data["squared_error"].sel(filter="euler").values
    assert (said["mean"], said["median"], said["worst"]) == (values.mean(), np.median(values), values.max())
    assert json.loads((folder / "summary.json").read_text()) == outcome.summary
    costs = outcome.timing["points"][0]["methods"]["exact"]
    assert 0 < costs["seconds_per_observation"] < 10 and costs["first_call_seconds"] != 0


def test_the_table_of_the_file_is_what_xarray_reads(done):
    _, folder, outcome = done
    with xarray.open_dataset(folder / "study.nc", engine="h5netcdf") as table:
        assert dict(table.sizes) == {"point": 1, "run": 6, "filter": 2}
        np.testing.assert_array_equal(table["squared_error"][0], outcome.points[0]["squared_error"])
        assert table.attrs["reference"] == "exact"
    with xarray.open_dataset(folder / "study.nc", group="point-0", engine="h5netcdf") as curves:
        assert curves["nees_at"].dims == ("run", "filter", "sample")
        assert curves["sample"].values[-1] == 0.5


class Stop(Exception):
    pass


def test_what_was_interrupted_goes_on_and_ends_with_the_same_bytes(done, tmp_path):
    path, folder, _ = done

    def stop(finished, total):
        if finished >= 5:
            raise Stop

    with pytest.raises(Stop):
        run_study(path, tmp_path / "out", progress=stop)
    kept = sorted((tmp_path / "out" / "batches").iterdir())
    assert [entry.name for entry in kept] == ["00000.nc"]
    stamp = kept[0].stat().st_mtime_ns
    run_study(path, tmp_path / "out")
    assert numbers(tmp_path / "out") == numbers(folder)
    assert kept[0].stat().st_mtime_ns == stamp


def test_a_damaged_batch_is_run_again_and_what_a_killed_writer_left_is_removed(done, tmp_path):
    path, folder, _ = done
    shutil.copytree(folder, tmp_path / "out")
    damaged = tmp_path / "out" / "batches" / "00001.nc"
    damaged.write_bytes(damaged.read_bytes()[:3000])
    left = tmp_path / "out" / "batches" / ".00002.abcd.part.nc"
    left.write_bytes(b"half")
    run_study(path, tmp_path / "out")
    assert numbers(tmp_path / "out") == numbers(folder) and not left.exists()


def command(path, folder, *more):
    program = [sys.executable, "-c", "import sys; from zakai.cli import main; sys.exit(main(sys.argv[1:]))"]
    return subprocess.Popen([*program, "study", str(path), "-o", str(folder), *more], stdout=subprocess.DEVNULL)


def kill_when(process, parts, count):
    """SIGKILL as soon as so many batches are there; how many there were."""
    until = time.monotonic() + 120
    while time.monotonic() < until and process.poll() is None:
        found = len([entry for entry in parts.iterdir() if not entry.name.startswith(".")]) if parts.is_dir() else 0
        if found >= count:
            break
        time.sleep(0.005)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    return len([entry for entry in parts.iterdir() if not entry.name.startswith(".")])


def test_a_study_that_was_killed_ends_with_the_same_bytes(done, tmp_path):
    path, folder, _ = done
    process = command(path, tmp_path / "out")
    assert kill_when(process, tmp_path / "out" / "batches", 1) >= 1
    run_study(path, tmp_path / "out")
    assert numbers(tmp_path / "out") == numbers(folder)


def test_the_numbers_do_not_depend_on_the_number_of_cores(done, tmp_path, monkeypatch):
    path, folder, _ = done
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    run_study(path, tmp_path / "out")
    assert numbers(tmp_path / "out") == numbers(folder)


def test_a_folder_of_something_else_is_refused(done, tmp_path):
    path, folder, _ = done
    other = written(tmp_path, STUDY.replace("count = 6", "count = 7"))
    with pytest.raises(InputError, match="holds another study"):
        run_study(other, folder)
    with pytest.raises(InputError, match="holds 'study.toml' and no study"):
        run_study(other, tmp_path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["study.toml"]
    renamed = written(tmp_path, "# a comment\n" + STUDY.replace("two filters", "a title"))
    assert read_study(renamed).key() == read_study(path).key()


def test_a_study_begun_with_other_versions_is_refused(done, tmp_path):
    path, folder, _ = done
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["versions"]["version_numba"] = "0.0.1"
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(InputError, match="begun with numba 0.0.1"):
        run_study(path, tmp_path)


@pytest.mark.skipif(os.name == "nt", reason="no locks of this kind")
def test_two_processes_do_not_work_in_one_folder(done):
    from zakai.studies._store import Store

    path, folder, _ = done
    with Store(folder, read_study(path)), pytest.raises(InputError, match="another zakai is at work"):
        run_study(path, folder)
    run_study(path, folder)


def test_a_run_on_which_a_method_raises_is_a_failure_of_that_run_alone(done, tmp_path, monkeypatch):
    path, _, outcome = done
    model = zakai.load_model("gallery:kalman-bucy-1d")
    bad = zakai.simulate(model, np.round(0.05 * np.arange(1, 11), 2), seed=6)[1].values
    filter = _batch.run_filter

    def failing(model, records, method, **options):
        if method == "extended-kalman-bucy" and any(np.array_equal(record.values, bad) for record in records):
            raise ArithmeticError("no such number")
        return filter(model, records, method, **options)

    monkeypatch.setattr(_batch, "run_filter", failing)
    data = run_study(path, tmp_path).points[0]
    assert data["failed"].sel(filter="euler").values.tolist() == [0, 0, 0, 1, 0, 0]
    assert data["failed"].sel(filter="exact").values.tolist() == [0] * 6
    assert str(data["said"].sel(filter="euler", run="6").values) == "ArithmeticError: no such number"
    there = data["run"] != "6"
    for name in ("squared_error", "distance", "nis"):
        np.testing.assert_allclose(data[name][there.values], outcome.points[0][name][there.values], rtol=1e-10)
        assert np.isnan(data[name].sel(filter="euler", run="6"))
    figures = json.loads((tmp_path / "summary.json").read_text())["points"][0]["methods"]["euler"]
    assert figures["failures"] == 1 and figures["squared_error"]["runs"] == 5


def test_a_filter_that_draws_has_another_chance_in_every_batch(done, monkeypatch):
    options = {"kalman-bucy": {"seed": 5}, "extended-kalman-bucy": {}}
    monkeypatch.setattr(_batch._registry, "load", lambda name: SimpleNamespace(options=options[name]))
    study = done[2].study
    exact, euler = study.methods
    seeds = [_batch._with_own_draws(exact, study.job(index)).options["seed"] for index in range(3)]
    assert seeds == [5 + 3, 5 + 5, 5 + 7]
    assert _batch._with_own_draws(euler, study.job(1)) == euler


def test_a_machine_without_memory_ends_the_study_and_is_no_failure(done, tmp_path, monkeypatch):
    def failing(*arguments, **options):
        raise MemoryError

    monkeypatch.setattr(_batch, "run_filter", failing)
    with pytest.raises(InputError, match="smaller batch"):
        run_study(done[0], tmp_path)


EXPLODING = """
state = ["x"]
drift = ["x**3"]
observation = ["x"]
[prior]
kind = "gaussian"
mean = [0.0]
cov = [[1.0]]
"""


def test_a_run_without_a_truth_is_nobodys_number_and_a_lost_one_is_counted(tmp_path):
    (tmp_path / "model.toml").write_text(EXPLODING)
    text = STUDY.replace("gallery:kalman-bucy-1d", "model.toml").replace("until = 0.5", "until = 1.5")
    text = text.replace('reference = "exact"', "lost_above = 1e-3").replace('[methods.exact]\nmethod = "kalman-bucy"', "")
    outcome = run_study(written(tmp_path, text), tmp_path / "out")
    failed = outcome.points[0]["failed"].values[:, 0]
    words = [_batch.FAILURES[code] for code in failed]
    assert "no truth" in words and "lost" in words
    reason = str(outcome.points[0]["said"].values[words.index("no truth"), 0])
    assert "x**3" in reason or "drift" in reason
    assert outcome.summary["points"][0]["methods"]["euler"]["failures"] == (failed > 0).sum()


def test_records_from_files_are_the_runs(tmp_path):
    model = zakai.load_model("gallery:kalman-bucy-2d")
    times = 0.1 * np.arange(1, 8)
    errors, normalised = [], []
    for number in range(2):
        truth, record = zakai.simulate(model, times, seed=number)
        zakai.records.write_record(tmp_path / f"{number}.csv", record)
        zakai.records.write_truth(tmp_path / f"{number}-truth.csv", truth, model.state)
        result = zakai.filter(model, record, "kalman-bucy")
        gaps = truth.values[1:] - result.mean[1:]
        errors.append(np.mean(np.sum(gaps**2, axis=1)))
        normalised.append(np.mean([e @ np.linalg.inv(P) @ e for e, P in zip(gaps, result.cov[1:])]) / 2)
    head = 'models = ["gallery:kalman-bucy-2d"]\n[methods.kalman-bucy]\n'
    lists = "".join(f'[[records]]\nfile = "{number}.csv"\ntruth = "{number}-truth.csv"\n' for number in range(2))
    data = run_study(written(tmp_path, head + lists), tmp_path / "out").points[0]
    assert data["run"].values.tolist() == ["0.csv", "1.csv"]
    assert data["squared_error"].values[:, 0] == pytest.approx(errors, rel=1e-9)
    assert data["nees"].values[:, 0] == pytest.approx(normalised, rel=1e-9)
    without = head + '[[records]]\nfile = "0.csv"\n'
    outcome = run_study(written(tmp_path, without), tmp_path / "without")
    assert set(outcome.study.metrics) == {"nis"} and "squared_error" not in outcome.points[0]
    gap = (tmp_path / "1-truth.csv").read_text().splitlines()
    (tmp_path / "1-truth.csv").write_text("\n".join([*gap[:4], gap[4].split(",")[0] + ",,0.1", *gap[5:]]) + "\n")
    with pytest.raises(InputError, match="records.1.: .*1-truth.csv: the state at the time 0.3 is not known"):
        read_study(written(tmp_path, head + lists))
    with pytest.raises(InputError, match="metrics: nees needs the true states"):
        read_study(written(tmp_path, 'metrics = ["nees"]\n' + without))


def test_a_grid_of_parameters_is_a_point_each_on_the_same_seeds(tmp_path):
    text = STUDY.replace("[seeds]", "[parameters]\na = [0.1, 2]\nc = 1.5\n[seeds]").replace("count = 6", "count = 2")
    outcome = run_study(written(tmp_path, text), tmp_path / "out")
    assert [point.label for point in outcome.study.points] == [f"kalman-bucy-1d, a = {a}, c = 1.5" for a in ("0.1", "2")]
    model = zakai.load_model("gallery:kalman-bucy-1d").with_parameters(a=2, c=1.5)
    _, record = zakai.simulate(model, np.round(0.05 * np.arange(1, 11), 2), seed=4)
    likelihood = zakai.filter(model, record, "kalman-bucy").log_likelihood
    assert float(outcome.points[1]["log_likelihood"].sel(run="4", filter="exact")) == pytest.approx(likelihood, rel=1e-10)
    with xarray.open_dataset(tmp_path / "out" / "study.nc", engine="h5netcdf") as table:
        assert table["parameter_a"].values.tolist() == ["0.1", "2"]


def test_densities_give_the_scores_of_the_gaussians_that_they_are(done, tmp_path):
    text = STUDY.replace("batch = 2", "batch = 2\ndensities = 3").replace("count = 6", "count = 2")
    data = run_study(written(tmp_path, text), tmp_path / "out").points[0]
    moments = done[2].points[0].isel(run=slice(0, 2))
    assert data["scored"].values.tolist() == [0.2, 0.35, 0.5]
    np.testing.assert_allclose(data["pit_at"], moments["pit_at"].sel(scored=[0.2, 0.35, 0.5]), atol=1e-4)
    assert 0 < float(data["hellinger"].sel(filter="euler").max()) < 0.1
    np.testing.assert_allclose(data["hellinger"].values[:, 1], moments["hellinger"].values[:, 1], atol=5e-3)


BAD = {
    "no models": ('models = ["gallery:kalman-bucy-1d"]', "", "models: missing"),
    "a key that is none": ("batch = 2", "bacth = 2", "unknown key 'bacth'; did you mean 'batch'?"),
    "a model that is none": ("kalman-bucy-1d", "kalman-bucy-1", "models[0]: gallery:kalman-bucy-1: there is no such model"),
    "a file that is none": ("gallery:kalman-bucy-1d", "none.toml", "models[0]"),
    "a batch too large": ("batch = 2", "batch = 200", "batch: expected a whole number from 1 to 31"),
    "a seed that is none": ("first = 3", "first = -3", "seeds.first"),
    "no seeds at all": ("count = 6", "count = 0", "seeds.count"),
    "a key of seeds": ("count = 6", "counts = 6", "seeds: unknown key 'counts'; did you mean 'count'?"),
    "a step of zero": ("step = 0.05", "step = 0", "times.step 0: must be a positive number"),
    "a text for a time": ("until = 0.5", 'until = "soon"', "times.until: expected a number"),
    "a method that is none": ('"kalman-bucy"', '"kalman"', 'did you mean "kalman-bucy"'),
    "an option that is none": ("riccati =", "ricatti =", "has no option 'ricatti'; did you mean 'riccati'?"),
    "a value that is none": ('"euler" }', '"eulr" }', "methods.euler"),
    "a reference that is none": ('reference = "exact"', 'reference = "exakt"', "reference: 'exakt' is not a label"),
    "a metric that is none": ("batch = 2", 'metrics = ["nes"]', "metrics: there is no metric 'nes'; did you mean 'nees'?"),
    "a parameter that is none": ("[seeds]", "[parameters]\nb = [1]\n[seeds]", "parameters.b: no model has this parameter"),
    "an empty grid": ("[seeds]", "[parameters]\na = []\n[seeds]", "parameters.a: the list is empty"),
    "a model twice": ("1d\"]", "1d\", \"gallery:kalman-bucy-1d\"]", "is there twice"),
    "records and seeds": ("[seeds]", '[[records]]\nfile = "a.csv"\n[seeds]', "seeds: the records are given"),
    "no TOML": ("[seeds]", "[seeds", "is not TOML"),
    "a model 9,000 times": ('"gallery:kalman-bucy-1d"', '"gallery:kalman-bucy-1d",' * 9_000, "is there twice"),
    "a model 40,000 times": ('"gallery:kalman-bucy-1d"', '"gallery:kalman-bucy-1d",' * 40_000, "more than 10,000 points"),
    "a grid of many values": ("[seeds]", f"[parameters]\na = [{'1,' * 400_000}]\n[seeds]", "the list has 400,000 values"),
    "many methods": ("[seeds]", "".join(f"[methods.m{k}]\n" for k in range(8000)) + "[seeds]", "at most 100 fit"),
    "many tables": ("[seeds]", "[[a]]\n" * 100_000 + "[seeds]", "more than 8192 lines that begin with ["),
    "many seeds": ("count = 6", "count = 100000000", "seeds.count: expected a whole number from 1 to 1,000,000"),
    "many observations": ("step = 0.05", "step = 1e-8", "at most 10,000,000 are simulated"),
    "a key that moves the cursor": ("[seeds]", '[methods."\\u001b[2J"]\n[seeds]', "methods.'\\x1b[2J': label: expected a text"),
    "a key as long as a page": ("[seeds]", f"[methods.{'x' * 5000}]\noptions = 1\n[seeds]", "...': options: expected a table"),
    "nested without end": ("[seeds]", f"[methods.b.options]\na = {'[' * 5000}\n[seeds]", "nested too deep"),
}  # fmt: skip


@pytest.mark.parametrize("old, new, words", BAD.values(), ids=BAD.keys())
def test_a_study_that_cannot_be_is_refused_in_one_line(tmp_path, old, new, words):
    assert old in STUDY
    begun = time.process_time()
    with pytest.raises(InputError) as refused:
        read_study(written(tmp_path, STUDY.replace(old, new, 1)))
    said = str(refused.value)
    assert words in said and said.startswith(str(tmp_path / "study.toml") + ": ")
    assert said.isprintable() and len(said) < 400 + len(str(tmp_path)) and time.process_time() - begun < 2


def test_the_batches_of_a_million_runs_are_known_at_once(tmp_path):
    begun = time.process_time()
    study = read_study(written(tmp_path, STUDY.replace("count = 6", "count = 1000000")))
    assert len(study.batches) == 500_000 and study.job(400_000).runs == ("800003", "800004")
    assert time.process_time() - begun < 10


def test_a_study_file_that_is_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "study.toml")
    with pytest.raises(InputError, match="study.toml: is not a regular file; give a study file"):
        read_study(tmp_path / "study.toml")


def test_a_metric_of_a_reference_needs_one(tmp_path):
    text = STUDY.replace('reference = "exact"', 'metrics = ["distance"]')
    with pytest.raises(InputError, match="metrics: distance needs a reference"):
        read_study(written(tmp_path, text))


def test_a_method_that_does_not_hold_is_refused_before_anything_runs(tmp_path):
    text = STUDY.replace("gallery:kalman-bucy-1d", "gallery:cubic-sensor")
    with pytest.raises(ConditionError, match="methods.exact: .*kalman-bucy does not hold"):
        read_study(written(tmp_path, text))


def test_scheduler_and_processes_exclude_each_other(done, tmp_path):
    with pytest.raises(InputError, match="--scheduler or --processes"):
        run_study(done[0], tmp_path, scheduler="tcp://127.0.0.1:1", processes=2)
    with pytest.raises(InputError, match="must be at least 1"):
        run_study(done[0], tmp_path, processes=0)


def test_processes_give_the_same_bytes_though_one_of_them_dies(done, tmp_path):
    path, folder, _ = done
    killed = []

    def kill(finished, total):
        for worker in multiprocessing_children():
            if not killed and finished > 0:
                killed.append(worker.pid)
                os.kill(worker.pid, signal.SIGKILL)

    run_study(path, tmp_path / "out", processes=2, progress=kill)
    assert killed and numbers(tmp_path / "out") == numbers(folder)


def multiprocessing_children():
    import multiprocessing

    return multiprocessing.active_children()


@pytest.fixture
def cluster(tmp_path):
    """The address of a scheduler, and its two workers."""
    pytest.importorskip("distributed")
    started = []

    def start(what, *arguments):
        with (tmp_path / f"{len(started)}.log").open("w") as log:
            program = [sys.executable, "-m", f"distributed.cli.dask_{what}", *arguments, "--no-dashboard"]
            started.append(subprocess.Popen(program, stdout=log, stderr=log, cwd=tmp_path))

    try:
        address_file = tmp_path / "scheduler.json"
        start("scheduler", "--port", "0", "--scheduler-file", str(address_file))
        until = time.monotonic() + 60
        while not address_file.exists() and time.monotonic() < until:
            time.sleep(0.05)
        address = json.loads(address_file.read_text())["address"]
        for _ in range(2):
            start("worker", address, "--nthreads", "1", "--no-nanny")
        yield address, started[1:]
    finally:
        for process in started:
            if process.poll() is None:
                process.kill()
            process.wait()


def test_a_cluster_gives_the_same_bytes_though_a_worker_dies(cluster, tmp_path):
    path = written(tmp_path, STUDY.replace("count = 6", "count = 12"))
    address, (doomed, _) = cluster

    def kill(finished, total):
        if doomed.poll() is None:
            doomed.kill()
            doomed.wait()

    run_study(path, tmp_path / "out", scheduler=address, progress=kill)
    run_study(path, tmp_path / "here")
    assert doomed.poll() is not None and numbers(tmp_path / "out") == numbers(tmp_path / "here")


def test_a_scheduler_that_is_not_there_is_said(done, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(_workers, "_ANSWER", "1s")
    with pytest.raises(InputError, match="--scheduler tcp://127.0.0.1:1: no scheduler answers"):
        run_study(done[0], tmp_path, scheduler="tcp://127.0.0.1:1")


def test_the_example_of_the_documents_is_a_study():
    root = Path(__file__).parents[2]
    example = root / "examples" / "studies" / "spiral-sensor.toml"
    assert example.read_text().partition("name =")[2] in (root / "docs" / "how-to" / "compare-filters.md").read_text()
    study = read_study(example)
    assert len(study.batches) == 40 and len(study.methods) == 3


def test_a_batch_that_kills_its_workers_ends_the_study_with_advice():
    assert "smaller batch" in _workers._given_up(3)
