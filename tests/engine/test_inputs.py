"""Known inputs online, in checkpoints, in streams and in studies: what a record with the same inputs gives, to the bit."""

from __future__ import annotations

import io
import json
import sys

import numpy as np
import pytest

import zakai
from zakai.cli import main
from zakai.errors import InputError
from zakai.models.files import read_model

TEXT = """
name = "driven"
state = ["x"]
drift = ["-x + u"]
observation = ["x + u"]
observation_kind = "samples"
observation_noise = [["0.25"]]
inputs = ["u"]
input_hold = "{hold}"
[prior]
kind = "gaussian"
mean = [0.5]
cov = [[1.0]]
"""


def driven(hold):
    """Return dx = (-x + u) dt + dv with samples of x + u."""
    return read_model(TEXT.format(hold=hold), "driven.toml")


@pytest.fixture(params=["zero", "linear"])
def model(request):
    """The system with each of the two holds."""
    return driven(request.param)


def times_and_values(count=40):
    """Irregular times, and observations of which some are missing."""
    draw = np.random.default_rng(1)
    times = np.cumsum(10.0 ** draw.uniform(-3, 0.3, count))
    return times, np.where(draw.uniform(size=count) < 0.2, np.nan, draw.normal(size=count))


def inputs_until(last):
    """Inputs at times of their own."""
    draw = np.random.default_rng(2)
    times = np.concatenate([[0.0], np.cumsum(draw.uniform(0.05, 1.5, 60))])
    assert times[-1] > last
    return zakai.Inputs(times, draw.normal(size=len(times)))


def rows_of(estimates):
    """What estimates report, as arrays."""
    return np.array([[one.mean[0], one.cov[0, 0], one.log_likelihood_increment] for one in estimates])


def rows_of_result(result):
    """The same of a result."""
    return np.column_stack([result.mean[1:, 0], result.variance[1:, 0], result.log_likelihood_increments[1:]])


@pytest.mark.parametrize("chunk", [1, 3, 1024])
def test_online_and_in_chunks_the_numbers_are_those_of_a_record(model, chunk, monkeypatch):
    times, values = times_and_values()
    inputs = inputs_until(times[-1])
    record = zakai.Record(times, values, "samples", inputs)
    expected = rows_of_result(zakai.filter(model, record, method="kalman-bucy"))
    monkeypatch.setattr("zakai.engine.loop.CHUNK", chunk)
    assert rows_of_result(zakai.filter(driven(model.input_hold), record, method="kalman-bucy")).tobytes() == expected.tobytes()
    assert rows_of_result(zakai.filter(model, [record, record], method="kalman-bucy")[1]).tobytes() == expected.tobytes()
    first, always, late = (zakai.online(model, method="kalman-bucy") for _ in range(3))
    rows = []
    for k, (time, value) in enumerate(zip(times, values)):
        # The rows that have come since the last observation, and the next one, between which u is linear.
        last = np.searchsorted(inputs.times, time, "right") + 1
        since = 0 if k == 0 else int(np.searchsorted(inputs.times, times[k - 1], "right"))
        rows.append(
            (
                first.update(time, value, inputs if k == 0 else None),
                always.update(time, value, inputs),
                late.update(time, value, zakai.Inputs(inputs.times[since:last], inputs.values[since:last])),
            )
        )
    for one in zip(*rows):
        assert rows_of(one).tobytes() == expected.tobytes()


def test_values_hold_from_the_time_of_their_observation_and_the_first_from_the_start(model):
    times, values = times_and_values()
    u = np.sin(np.arange(len(times)))
    inputs = zakai.Inputs(np.concatenate([[0.0], times]), np.concatenate([u[:1], u]))
    expected = rows_of_result(zakai.filter(model, zakai.Record(times, values, "samples", inputs), method="kalman-bucy"))
    for given in (lambda one: {"u": one}, lambda one: [one], lambda one: float(one), np.atleast_1d):
        online = zakai.online(model, method="kalman-bucy")
        assert rows_of([online.update(t, z, given(one)) for t, z, one in zip(times, values, u)]).tobytes() == expected.tobytes()


def test_the_last_value_holds_and_a_linear_input_is_needed_at_each_time():
    zero, linear = (zakai.online(driven(hold), method="kalman-bucy") for hold in ("zero", "linear"))
    zero.update(1.0, 0.3, {"u": 2.0})
    zero.update(2.0, None)
    inputs = zakai.Inputs([0.0, 5.0], [2.0, 2.0])
    record = zakai.Record([1.0, 2.0], [0.3, np.nan], "samples", inputs)
    expected = rows_of_result(zakai.filter(driven("zero"), record, method="kalman-bucy"))[-1]
    assert rows_of([zero.last])[0].tobytes() == expected.tobytes()
    linear.update(1.0, 0.3, {"u": 2.0})
    for call in (lambda: linear.update(2.0, 0.1), lambda: linear.predict(2.0)):
        with pytest.raises(InputError, match='(update|predict): inputs: the last time 1 is before 2; with input_hold = "linear"'):
            call()
    before = linear.last
    ahead = linear.predict(2.0, {"u": 3.0})
    assert linear.last.time == before.time
    assert rows_of([ahead]).tobytes() == rows_of([linear.update(2.0, None, {"u": 3.0})]).tobytes()


def test_a_checkpoint_holds_the_inputs_that_are_needed(model, tmp_path):
    times, values = times_and_values()
    inputs = inputs_until(times[-1])
    record = zakai.Record(times, values, "samples", inputs)
    expected = rows_of_result(zakai.filter(model, record, method="kalman-bucy"))
    for count in (0, 1, 7, 39):
        online = zakai.online(model, method="kalman-bucy")
        for k in range(count):
            online.update(times[k], values[k], inputs if k == 0 else None)
        online.save(tmp_path / "state")
        follower = zakai.online(model, method="kalman-bucy")
        follower.restore(tmp_path / "state")
        known = inputs if count == 0 else None
        rest = rows_of([follower.update(times[k], values[k], known) for k in range(count, len(times))])
        assert rest.tobytes() == expected[count:].tobytes()
    assert len(online.feeds[0].now.inputs) < len(inputs)


def test_a_checkpoint_with_other_inputs_is_refused(tmp_path):
    from zakai.records.checkpoint import read_checkpoint, write_checkpoint

    online = zakai.online(driven("zero"), method="kalman-bucy")
    online.update(1.0, 0.3, {"u": 2.0})
    online.save(tmp_path / "state")
    about, arrays = read_checkpoint(tmp_path / "state")
    last = max(arrays, key=lambda name: int(name.rpartition("/")[2]))
    for change in (lambda a: a[:, :0], lambda a: np.full_like(a, np.nan), lambda a: np.hstack([a, a]), lambda a: a[:1]):
        write_checkpoint(tmp_path / "forged", about, {**arrays, last: change(arrays[last])})
        with pytest.raises(InputError, match="the checkpoint does not fit"):
            zakai.online(driven("zero"), method="kalman-bucy").restore(tmp_path / "forged")
    about["filters"][0]["inputs"] = None
    write_checkpoint(tmp_path / "forged", about, arrays)
    with pytest.raises(InputError, match="the checkpoint does not fit"):
        zakai.online(driven("zero"), method="kalman-bucy").restore(tmp_path / "forged")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (None, "update: inputs: u of .* are missing; give them with the first observation"),
        ({"v": 1.0}, "update: inputs: 'v' is not an input of .*; its inputs: u"),
        ({}, "update: inputs: u of .* are missing; give all inputs, or none"),
        ([1.0, 2.0], "update: inputs: 2 values; .* has 1: u"),
        ("1.0", "update: inputs: values must be real numbers"),
        ({"u": None}, "update: inputs: row 0, counted from 0: values must be finite"),
        (np.nan, "update: inputs: .* must be finite"),
        (zakai.Inputs([0.5], [1.0]), "update: inputs: the first time 0.5 is after the start 0 of"),
        (zakai.Inputs([0.0], [[1.0, 2.0]]), "update: inputs: 2 columns; .* has 1: u"),
    ],
)
def test_wrong_inputs_are_refused_and_the_filter_stays_as_it_was(given, words):
    online = zakai.online(driven("zero"), method="kalman-bucy")
    with pytest.raises(InputError, match=words):
        online.update(1.0, 0.3, given)
    assert online.time == 0.0
    online.update(1.0, 0.3, {"u": 2.0})
    if given is not None and not (isinstance(given, zakai.Inputs) and len(given.values[0]) == 1):
        with pytest.raises(InputError, match="update: inputs:"):
            online.update(2.0, 0.3, given)


def test_a_model_without_inputs_refuses_them():
    online = zakai.online(zakai.load_model("gallery:kalman-bucy-1d"))
    for call in (online.update, lambda time, value, inputs: online.predict(time, inputs)):
        with pytest.raises(InputError, match="inputs: .* has no inputs; leave them out"):
            call(0.1, 0.0, {"u": 1.0})


def test_offline_work_and_forecasts_keep_the_inputs(model, tmp_path):
    times, values = times_and_values()
    inputs = inputs_until(times[-1])
    record = zakai.Record(times, values, "samples", inputs)
    expected = zakai.filter(model, record, method="kalman-bucy")
    zakai.prepare(model, record, method="kalman-bucy").save(tmp_path / "prepared")
    again = zakai.Prepared.load(tmp_path / "prepared").filter(record)
    assert rows_of_result(again).tobytes() == rows_of_result(expected).tobytes()
    part = zakai.filter(model, zakai.Record(times[:30], values[:30], "samples", inputs), method="kalman-bucy")
    rest = zakai.Record(times, np.where(np.arange(40) < 30, values, np.nan), "samples", inputs)
    ahead = rows_of_result(zakai.filter(model, rest, method="kalman-bucy"))[30:]
    assert rows_of_result(part.forecast(times[30:])).tobytes() == ahead.tobytes()
    first = int(np.searchsorted(inputs.times, times[29]))
    later = zakai.Inputs(inputs.times[first:], inputs.values[first:])
    assert rows_of_result(part.forecast(times[30:], later)).tobytes() == ahead.tobytes()


def command(*arguments, given=""):
    """Run the command with this text on standard input."""
    sys.stdin = io.TextIOWrapper(io.BytesIO(given.encode()))
    return main([str(argument) for argument in arguments])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the model, and a record with its input in a column."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdin", sys.stdin)
    (tmp_path / "model.toml").write_text(TEXT.format(hold="zero"))
    times, values = times_and_values(12)
    rows = [
        [f"{t!r}", "" if np.isnan(z) else f"{z!r}", "" if k % 3 else f"{float(np.cos(k))!r}"]
        for k, (t, z) in enumerate(zip(times.tolist(), values.tolist()))
    ]
    (tmp_path / "record.csv").write_text("\n".join(["time,z,u", *(",".join(row) for row in rows)]) + "\n")
    return tmp_path


def test_a_stream_takes_inputs_in_its_lines_and_in_columns(folder, capsys):
    record = zakai.read_record("record.csv", zakai.load_model("model.toml"))
    result = zakai.filter(zakai.load_model("model.toml"), record, method="kalman-bucy")
    table = (folder / "record.csv").read_text()
    assert command("stream", "model.toml", "--method", "kalman-bucy", given=table) == 0
    out, err = capsys.readouterr()
    assert err == "" and [json.loads(line)["mean"][0] for line in out.splitlines()] == result.mean[1:, 0].tolist()
    cells = [line.split(",") for line in table.splitlines()[1:]]
    lines = [f'{{"time": {t}, "y": [{z or "null"}]' + (f', "inputs": {{"u": {u}}}' if u else "") + "}\n" for t, z, u in cells]
    assert command("stream", "model.toml", "--method", "kalman-bucy", given="".join(lines)) == 0
    assert capsys.readouterr() == (out, "")
    # A stream that goes on from a checkpoint has the last value.
    arguments = ("stream", "model.toml", "--method", "kalman-bucy", "--checkpoint", "state")
    assert command(*arguments, given="".join(lines[:5])) == 0 and command(*arguments, given="".join(lines)) == 0
    assert capsys.readouterr().out.splitlines()[5:] == out.splitlines()[4:]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('{"time": 1, "y": [1]}', "line 1: update: inputs: u of model.toml are missing"),
        ('{"time": 1, "y": [1], "inputs": [1]}', 'line 1: "inputs" is a list; give an object'),
        ('{"time": 1, "y": [1], "inputs": {"u": "1"}}', 'line 1: the input "u" is "1"; give a number'),
        ('{"time": 1, "y": [1], "inputs": {"u": 1, "u": 2}}', 'line 1: the key "u" stands twice'),
        ('{"time": 1, "y": [1], "inputs": {"v": 1}}', "line 1: update: inputs: 'v' is not an input"),
        ("time,u\n1,2", "line 1: 1 columns; the model needs 2: time, and one for each"),
        ("time,u,z\n1,2", "line 2: 2 columns; the header has 3"),
        ("time,u,z\n1,,2", "line 2: update: inputs: u of model.toml are missing"),
    ],
)
def test_a_wrong_line_is_named(folder, capsys, line, words):
    assert command("stream", "model.toml", "--method", "kalman-bucy", "--strict", given=line + "\n") == 2
    err = capsys.readouterr().err
    assert words in err and err.count("\n") == 1


STUDY = """
models = ["model.toml"]
[methods]
kalman-bucy = {}
[[records]]
file = "%s"
"""


def test_a_study_of_given_records_takes_inputs_from_a_file_or_from_their_columns(folder, capsys):
    record = zakai.read_record("record.csv", zakai.load_model("model.toml"))
    expected = zakai.filter(zakai.load_model("model.toml"), record, method="kalman-bucy").log_likelihood
    rows = [f"{t!r},{u!r}" for t, u in zip(record.inputs.times.tolist(), record.inputs.values[:, 0].tolist())]
    (folder / "u.csv").write_text("\n".join(["time,u", *rows]) + "\n")
    lines = [line.rpartition(",")[0] for line in (folder / "record.csv").read_text().splitlines()]
    (folder / "alone.csv").write_text("\n".join(lines) + "\n")
    for name, more in (("record.csv", ()), ("alone.csv", ("--inputs", "u.csv"))):
        (folder / "study.toml").write_text(STUDY % name)
        assert command("study", "study.toml", "-o", name[:-4], *more) == 0, capsys.readouterr().err
        import xarray

        with xarray.open_dataset(folder / name[:-4] / "study.nc", group=None) as data:
            assert float(data["log_likelihood"].values.ravel()[0]) == expected
    for name, more, words in (
        (
            "record.csv",
            ("--inputs", "u.csv"),
            "record.csv has columns for the inputs, and --inputs gives them too; give them once",
        ),
        ("alone.csv", (), "inputs: u of model.toml are missing"),
    ):
        (folder / "study.toml").write_text(STUDY % name)
        capsys.readouterr()
        assert command("study", "study.toml", "-o", "other", *more) == 2
        assert words in capsys.readouterr().err


def test_the_innovations_of_a_study_are_those_of_the_evidence(model):
    from zakai.studies.innovations import Innovations

    times, values = times_and_values()
    record = zakai.Record(times, values, "samples", inputs_until(times[-1]))
    result = zakai.filter(model, record, method="kalman-bucy")
    found, spread = Innovations(model)(record, result.mean, result.cov)
    seen = ~np.isnan(values)
    evidence = -0.5 * (found[:, 0] ** 2 / spread[:, 0, 0] + np.log(2 * np.pi * spread[:, 0, 0]))
    np.testing.assert_allclose(evidence[seen], result.log_likelihood_increments[1:][seen], atol=1e-4)


def test_a_method_of_the_package_agrees_online_and_after_a_checkpoint(model, tmp_path):
    times, values = times_and_values(10)
    inputs = inputs_until(times[-1])
    record = zakai.Record(times, values, "samples", inputs)
    result = zakai.filter(model, record, method="yau-yau")
    expected = rows_of_result(result)
    np.testing.assert_allclose(expected, rows_of_result(zakai.filter(model, record, method="kalman-bucy")), atol=1e-4)
    online, follower = (zakai.online(model, method="yau-yau") for _ in range(2))
    rows = [online.update(times[k], values[k], inputs if k == 0 else None) for k in range(5)]
    online.save(tmp_path / "state")
    follower.restore(tmp_path / "state")
    rows += [follower.update(times[k], values[k]) for k in range(5, 10)]
    assert rows_of(rows).tobytes() == expected.tobytes()


def test_inputs_may_be_given_wherever_a_record_is(model):
    times, values = times_and_values()
    inputs, alone = inputs_until(times[-1]), zakai.Record(times, values, "samples")
    together = zakai.Record(times, values, "samples", inputs)
    expected = rows_of_result(zakai.filter(model, together, "kalman-bucy")).tobytes()
    assert rows_of_result(zakai.filter(model, alone, "kalman-bucy", inputs=inputs)).tobytes() == expected
    two = zakai.filter(model, [alone, alone], "kalman-bucy", inputs=[inputs, inputs])
    assert [rows_of_result(one).tobytes() for one in two] == [expected, expected]
    assert rows_of_result(zakai.prepare(model, times, "kalman-bucy", inputs=inputs).filter(together)).tobytes() == expected
    smoothed = zakai.smooth(model, alone, "kalman-bucy", inputs=inputs)
    assert smoothed.mean.tobytes() == zakai.smooth(model, together, "kalman-bucy").mean.tobytes()
    online = zakai.online(model, "kalman-bucy", inputs=inputs)
    estimates = [online.update(float(time), float(value)) for time, value in zip(times, values, strict=True)]
    np.testing.assert_array_equal([one.mean for one in estimates], zakai.filter(model, together, "kalman-bucy").mean[1:])


def test_an_estimate_of_parameters_takes_inputs_beside_the_record():
    model = read_model(TEXT.format(hold="zero").replace('["-x + u"]', '["-a*x + u"]') + "[parameters]\na = 1.0\n", "driven.toml")
    times, values = times_and_values()
    inputs, alone = inputs_until(times[-1]), zakai.Record(times, values, "samples")
    together = zakai.Record(times, values, "samples", inputs)
    assert zakai.log_likelihood(model, alone, inputs=inputs)([0.7]) == zakai.log_likelihood(model, together)([0.7])
    assert zakai.fit(model, alone, inputs=inputs).estimates == zakai.fit(model, together).estimates


def test_an_input_that_acts_only_at_observations_may_begin_at_the_first_one():
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=["x"], observation_kind="samples", observation_noise=[["v**2"]], inputs=["v"],
        prior={"kind": "gaussian", "mean": [0], "cov": [[1]]},
    )  # fmt: skip
    plain = zakai.Model(
        state=["x"], drift=["-x"], observation=["x"], observation_kind="samples", observation_noise=[["0.25"]],
        prior={"kind": "gaussian", "mean": [0], "cov": [[1]]},
    )  # fmt: skip
    times, values = [0.4, 1.0], [0.3, -0.2]
    record = zakai.Record(times, values, "samples")
    found = zakai.filter(model, record, inputs=zakai.Inputs(times, [0.5, 0.5]))
    np.testing.assert_allclose(found.mean, zakai.filter(plain, record).mean, rtol=1e-12)
    online = zakai.online(model, inputs=zakai.Inputs(times, [0.5, 0.5]))
    np.testing.assert_array_equal([online.update(t, z).mean for t, z in zip(times, values, strict=True)], found.mean[1:])
    with pytest.raises(InputError, match="first time 0.5 is after the first observation at 0.4; give v from 0.4 on"):
        zakai.filter(model, record, inputs=zakai.Inputs([0.5], [0.5]))
    with pytest.raises(InputError, match="the first time 0.4 is after the start 0 of driven.toml; give u from 0 on"):
        zakai.filter(driven("zero"), record, inputs=zakai.Inputs(times, [0.5, 0.5]))


def test_columns_of_a_frame_are_inputs_that_hold_from_the_start(model, tmp_path):
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"time": [0.5, 1.0, 2.0], "u": [1.0, None, -1.0], "y": [0.2, None, 0.4]})
    record = zakai.Record.from_pandas(frame, "samples", inputs=["u"])
    np.testing.assert_array_equal(record.values, [[0.2], [np.nan], [0.4]])
    equal = zakai.Record([0.5, 1.0, 2.0], record.values, "samples", zakai.Inputs([0.0, 0.5, 2.0], [1.0, 1.0, -1.0]))
    expected = rows_of_result(zakai.filter(model, equal, "kalman-bucy"))
    np.testing.assert_array_equal(rows_of_result(zakai.filter(model, record, "kalman-bucy")), expected)
    online = zakai.online(model, "kalman-bucy", inputs=record.inputs)
    online.save(tmp_path / "begin")
    again = zakai.online(model, "kalman-bucy")
    again.restore(tmp_path / "begin")
    means = [again.update(*row).mean for row in [(0.5, 0.2), (1.0, None), (2.0, 0.4)]]
    np.testing.assert_array_equal(means, zakai.filter(model, equal, "kalman-bucy").mean[1:])
    zakai.prepare(model, record, "kalman-bucy").save(tmp_path / "prepared")
    np.testing.assert_array_equal(rows_of_result(zakai.Prepared.load(tmp_path / "prepared").filter(record)), expected)
    with pytest.raises(InputError, match="inputs: 'v' is not one of the columns u, y"):
        zakai.Record.from_pandas(frame, "samples", inputs=["v"])


def test_inputs_of_a_forecast_may_have_dates():
    model = driven("zero")
    dates = np.array(["2024-05-01", "2024-05-02"], "M8[D]")
    known = zakai.Inputs(dates, [0.3, 0.3], unit="d")
    record = zakai.Record(dates, [0.1, 0.2], "samples", known, unit="d")
    ahead = np.array(["2024-05-04"], "M8[D]")
    later = zakai.Inputs(np.array(["2024-05-03"], "M8[D]"), [2.0], unit="d")
    plain = zakai.filter(model, zakai.Record([0.0, 1.0], [0.1, 0.2], "samples", zakai.Inputs([0.0, 1.0], [0.3, 0.3])))
    expected = plain.forecast([3.0], zakai.Inputs([2.0], [2.0])).mean
    np.testing.assert_array_equal(zakai.filter(model, record).forecast(ahead, later).mean, expected)


def test_inputs_that_end_long_before_the_record_are_noted():
    times = 0.1 * np.arange(1, 41)
    hours = zakai.Inputs(np.arange(0, 41) / 600.0, np.zeros(41))  # in another unit of time
    record = zakai.Record(times, np.zeros(40), "samples", inputs=hours)
    (note,) = zakai.filter(driven("zero"), record).warnings
    assert "the inputs u end at t = 0.0666666666667, and their last values are held up to 4" in note
    switched = zakai.Inputs([0.0, 0.3, 0.4], [0.0, 1.0, 0.5])
    seldom = zakai.Inputs([0.0, 2.0, 3.0], [0.0, 1.0, 0.5])
    assert zakai.filter(driven("zero"), record, inputs=seldom).warnings == []
    assert len(zakai.filter(driven("zero"), record, inputs=switched).warnings) == 1
