"""Columns are matched by the names of observations; the kind of an observation is asked for where nothing says it."""

import numpy as np
import pandas
import pytest
import xarray

import zakai
from zakai.errors import InputError

PRIOR = {"kind": "gaussian", "mean": [0.0, 0.0], "cov": [1.0, 1.0]}


def model_of(observation=("x", "y"), **keys):
    keys = {"observation_kind": "samples", **keys}
    return zakai.Model(state=["x", "y"], drift=["-x", "-y"], observation=list(observation), prior=PRIOR, **keys)


def record_file(tmp_path, text):
    path = tmp_path / "record.csv"
    path.write_text(text)
    return path


def notes(result):
    return [one for one in result.warnings if "position" in one]


def test_names_of_observations_are_the_states_else_y1_y2():
    assert model_of(["x", "x*y", "y"]).observation_names == ("x", "y2", "y")
    assert model_of(["x", "x"]).observation_names == ("y1", "y2")
    assert model_of(observation_names=["range", "bearing"]).observation_names == ("range", "bearing")
    states = zakai.Model(state=["y1", "y2"], drift=["0", "0"], observation=["y2", "y1"])
    assert states.observation_names == ("y1", "y2")  # a file of zakai simulate has y1 for the first observation
    custom = zakai.Model(
        state=["x"], drift=["-x"], observation_kind="samples", observation_log_density="-(z - x)**2", observed=["z"]
    )
    assert custom.observation_names == ("z",)


def test_names_are_kept_in_the_text_of_a_model():
    model = model_of(observation_names=["range", "bearing"])
    assert 'observation_names = ["range", "bearing"]' in model.text and "observation_names" not in model_of().text
    assert model.with_prior(PRIOR).observation_names == ("range", "bearing")


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["a"], "observation_names: "),
        (["a", "a"], "observation_names: 'a' is there twice"),
        (["time", "b"], "observation_names: 'time' is the name of the column of times"),
        (["", "b"], "observation_names: expected a name"),
        (["a\nb", "c"], "observation_names: expected a name"),
        ([1, 2], "observation_names: expected a name"),
    ],
)
def test_what_is_no_name_is_refused(names, words):
    with pytest.raises(zakai.InputError, match=words):
        model_of(observation_names=names)


def test_a_data_frame_in_another_order_does_not_exchange_the_sensors():
    frame = pandas.DataFrame({"y": [5.0], "x": [-5.0]}, index=[0.1])
    expected = zakai.filter(model_of(), zakai.Record([0.1], [[-5.0, 5.0]], "samples"))
    for record in (
        zakai.Record.from_pandas(frame, "samples"),
        zakai.Record.from_pandas(frame),
        zakai.Record.from_pandas(frame, columns=["x", "y"]),
        zakai.Record.from_xarray(xarray.Dataset.from_dataframe(frame.rename_axis("time"))),
        zakai.Record.from_xarray(
            xarray.DataArray([[5.0, -5.0]], dims=("time", "sensor"), coords={"time": [0.1], "sensor": ["y", "x"]})
        ),
        zakai.Record([0.1], [[5.0, -5.0]], names=["y", "x"]),
    ):
        found = zakai.filter(model_of(), record)
        assert found.mean.tolist() == expected.mean.tolist() and not notes(found)
        assert zakai.smooth(model_of(), record).mean[-1].tolist() == pytest.approx(expected.mean[-1].tolist(), abs=1e-9)
        assert found.record.values.tolist() == [[-5.0, 5.0]] and found.record.kind == "samples"


def test_a_file_in_another_order_does_not_exchange_the_sensors(tmp_path):
    for text in ("time,y,x\n0.1,5,-5\n", "time,x,y\n0.1,-5,5\n", "time,y2,y1\n0.1,5,-5\n"):
        record = zakai.read_record(record_file(tmp_path, text), model_of())
        assert record.values.tolist() == [[-5.0, 5.0]]
        assert not notes(zakai.filter(model_of(), record))


def test_other_names_are_taken_by_their_position_and_the_result_says_so_once(tmp_path):
    record = zakai.read_record(record_file(tmp_path, "time,radar,lidar\n0.1,-5,5\n"), model_of())
    for result in (zakai.filter(model_of(), record), zakai.smooth(model_of(), record)):
        (note,) = notes(result)
        assert "columns radar, lidar of the record are taken by their position as the observations x, y" in note
        assert 'observation_names = ["radar", "lidar"]' in note
    frame = pandas.DataFrame({"radar": [-5.0], "lidar": [5.0]}, index=[0.1])
    assert notes(zakai.filter(model_of(), zakai.Record.from_pandas(frame))) == [note]
    named = model_of(observation_names=["radar", "lidar"])
    assert not notes(zakai.filter(named, zakai.read_record(record_file(tmp_path, "time,lidar,radar\n0.1,5,-5\n"), named)))


def test_a_fit_says_it_once(tmp_path):
    model = zakai.Model(
        state=["x", "y"], drift=["-a*x", "-y"], observation=["x", "y"], observation_kind="samples", prior=PRIOR,
        parameters={"a": 1.0},
    )  # fmt: skip
    record = zakai.read_record(record_file(tmp_path, "time,p,q\n" + "".join(f"{k}.5,0.3,0.1\n" for k in range(9))), model)
    fitted = zakai.fit(model, record, bounds={"a": (0.1, 3.0)})
    assert len([one for one in fitted.warnings if "position" in one]) == 1


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("time,y,z", "the column 'y' is at the place of the observation x, and not all of the names x, y are there"),
        ("time,x,y,temperature", "4 columns; the model needs 3: .*; temperature is none of the observations x, y: .*columns="),
        ("time,x", "2 columns; the model needs 3"),
        ("time,x,x,y", "4 columns; the model needs 3"),
    ],
)
def test_columns_that_do_not_fit_are_named(tmp_path, header, words):
    row = ",".join("1" for _ in header.split(","))
    with pytest.raises(zakai.InputError, match=f"record.csv: row 1: {words}"):
        zakai.read_record(record_file(tmp_path, f"{header}\n{row}\n"), model_of())


def test_the_columns_that_are_asked_for_are_taken_in_their_order(tmp_path):
    path = record_file(tmp_path, "time,status,b,a\n0.1,good,5,-5\n0.2,bad,,1\n")
    record = zakai.read_record(path, model_of(), columns=["a", "b"])
    np.testing.assert_array_equal(record.values, [[-5.0, 5.0], [1.0, np.nan]])
    assert not notes(zakai.filter(model_of(), record))
    for columns, words in [
        (["a"], r"columns: 1 names; the model has 2 observations, x, y"),
        (["a", "c"], r"columns: 'c' is not a column; the columns are status, b, a"),
        (["a", "a"], r"columns: 'a' is there twice"),
        (["a", "status"], r"row 2: 'good' in column 'status' is not a number"),
    ]:
        with pytest.raises(zakai.InputError, match=words):
            zakai.read_record(path, model_of(), columns=columns)
    frame = pandas.DataFrame({"s": ["good"], "b": [5.0], "a": [-5.0]}, index=[0.1])
    assert zakai.Record.from_pandas(frame, columns=["a", "b"]).values.tolist() == [[-5.0, 5.0]]
    with pytest.raises(zakai.InputError, match="columns: 'c' is not one of the columns"):
        zakai.Record.from_pandas(frame, columns=["a", "c"])
    extra = frame.drop(columns="s").assign(more=1.0)
    with pytest.raises(zakai.InputError, match="record: 4 columns; .*a, b, more|record: 4 columns; .*none of the observations"):
        zakai.filter(model_of(), zakai.Record.from_pandas(extra))


def test_columns_of_inputs_stand_anywhere(tmp_path):
    model = zakai.Model(
        state=["x", "y"], drift=["u - x", "-y"], observation=["x", "y"], inputs=["u"], observation_kind="samples", prior=PRIOR
    )
    record = zakai.read_record(record_file(tmp_path, "time,y,u,x\n0.1,5,2,-5\n"), model)
    assert record.values.tolist() == [[-5.0, 5.0]] and record.inputs.values.tolist() == [[2.0], [2.0]]


def test_a_record_without_a_kind_takes_that_of_its_model():
    record = zakai.Record([1.0, 2.0], [[1.0, 0.0], [1.2, 0.1]])
    assert record.kind is None and "observations" in repr(record)
    for kind in ("samples", "increments", "path", "rates"):
        model = model_of(observation_kind=kind)
        expected = zakai.filter(model, zakai.Record(record.times, record.values, kind))
        assert zakai.filter(model, record).mean.tolist() == expected.mean.tolist()
        assert zakai.filter(model, [record, record])[1].mean.tolist() == expected.mean.tolist()
        assert zakai.prepare(model, record.times).filter(record).mean.tolist() == expected.mean.tolist()


def test_a_model_without_a_kind_is_analysed_and_simulated_and_asked_for_it(tmp_path):
    model = zakai.Model(state=["x"], drift=["-x"], observation=["x"], prior={"kind": "gaussian", "mean": [0], "cov": [[1]]})
    assert zakai.analyze(model).recommended
    truth, record = zakai.simulate(model, [0.1, 0.2], seed=0)
    assert record.kind == "increments" and np.isfinite(zakai.filter(model, record).mean).all()
    plain = zakai.Record([1, 2, 3], [1, 1.2, 0.8])
    asked = 'observation_kind: missing; give "samples" .* "increments" .* "path" .* "rates"'
    file = zakai.read_record(record_file(tmp_path, "time,x\n1,1\n2,1.2\n"), model)
    for ask in (
        lambda: zakai.filter(model, plain),
        lambda: zakai.filter(model, file),
        lambda: zakai.smooth(model, plain),
        lambda: zakai.prepare(model, [1.0, 2.0]),
        lambda: zakai.online(model),
    ):
        with pytest.raises(zakai.InputError, match=asked) as refused:
            ask()
        assert "\n" not in str(refused.value)
    with pytest.raises(
        zakai.InputError, match='record: holds samples, and the model does not say so; give it observation_kind = "s'
    ):
        zakai.filter(model, zakai.Record([1, 2, 3], [1, 1.2, 0.8], "samples"))
    assert (
        "observation_kind" not in model.text and 'observation_kind = "increments"' in model_of(observation_kind="increments").text
    )


def test_a_frame_with_a_column_of_text_asks_for_the_columns_of_the_observations():
    frame = pandas.DataFrame({"time": [1.0, 2.0], "status": ["ok", "chk"], "temp": [3.0, None], "volt": [1, 2], "P": [5.0, 6.0]})
    with pytest.raises(InputError, match=r"column 'status' holds no numbers; .* as in columns=\['temp', 'volt'\]"):
        zakai.Record.from_pandas(frame, "samples", inputs=["P"])
    assert zakai.Record.from_pandas(frame, "samples", columns=["temp"], inputs=["P"]).values.shape == (2, 1)


def test_a_file_without_the_column_of_an_input_says_which(tmp_path):
    keys = {"state": ["x"], "drift": ["T - x"], "observation": ["x"], "observation_kind": "samples", "inputs": ["T"]}
    (tmp_path / "record.csv").write_text("date,y1,heater\n2026-01-01,0.1,1\n2026-01-02,0.2,1\n")
    with pytest.raises(InputError, match="there is no column for the input T"):
        zakai.read_record(tmp_path / "record.csv", zakai.Model(**keys), unit="d")
