"""Known inputs: arrays, files of their own, and columns of a record."""

import numpy as np
import pytest

import zakai
from zakai.cli import main
from zakai.errors import InputError
from zakai.records import read_inputs, read_record

MODEL = zakai.load_model("gallery:heated-room")


def written(tmp_path, text, name="file.csv"):
    (tmp_path / name).write_text(text)
    return tmp_path / name


def test_values_hold_or_are_linear_between_their_times():
    inputs = zakai.Inputs([0.0, 1.0, 3.0], [[1.0, 10.0], [2.0, 20.0], [4.0, 0.0]])
    np.testing.assert_array_equal(inputs.at([0.0, 0.9, 1.0, 5.0])[:, 0], [1, 1, 2, 4])
    np.testing.assert_array_equal(inputs.at([1.0, 3.0], before=True)[:, 0], [1, 2])
    np.testing.assert_array_equal(inputs.at([0.5, 2.0], hold="linear"), [[1.5, 15], [3, 10]])
    np.testing.assert_array_equal(inputs.within(0.0, 3.0), [1.0])
    assert not inputs.values.flags.writeable


@pytest.mark.parametrize(
    ("times", "values", "words"),
    [
        ([0, 0], [1, 2], "row 1, counted from 0: time 0 does not increase"),
        ([0, 1], [1, np.nan], "row 1, counted from 0: values must be finite"),
        ([0, 1], [1], "expected"),
        ([], [], "at least one time"),
        (["a"], [1], "real numbers"),
    ],
)
def test_wrong_arrays_are_refused(times, values, words):
    with pytest.raises(InputError, match=f"^inputs: .*{words}"):
        zakai.Inputs(times, values)


def test_a_file_of_inputs_has_a_column_for_each_in_any_order(tmp_path):
    inputs = read_inputs(written(tmp_path, "time,outdoor,heater\n0,5,1\n2,4,0\n"), MODEL)
    np.testing.assert_array_equal(inputs.values, [[1, 5], [0, 4]])
    for text, words in [
        ("time,outdoor\n0,5\n", "row 1: no column for the input heater"),
        ("time,outdoor,heater\n0,5,\n", "row 2: an input is missing"),
        ("time,outdoor,heater,wind\n0,5,1,2\n", "row 1: 4 columns"),
        ("time,outdoor,heater\n1,5,1\n1,5,1\n", "row 3: the time 1.0 repeats"),
    ]:
        with pytest.raises(InputError, match=words):
            read_inputs(written(tmp_path, text), MODEL)


def test_columns_of_a_record_with_the_names_of_inputs_are_the_inputs(tmp_path):
    record = read_record(written(tmp_path, "time,heater,air,outdoor\n1,0.5,18,5\n2,,19,\n3,1,,4\n"), MODEL)
    np.testing.assert_array_equal(record.values, [[18], [19], [np.nan]])
    np.testing.assert_array_equal(record.inputs.times, [0, 1, 3])  # the first row holds from the start
    np.testing.assert_array_equal(record.inputs.values, [[0.5, 5], [0.5, 5], [1, 4]])
    for text, words in [
        ("time,heater,air\n1,0.5,18\n", "row 1: no column for the input outdoor"),
        ("time,heater,air,outdoor\n1,0.5,18,\n", "row 2: only some inputs"),
        ("time,heater,air,outdoor,more\n1,0.5,18,1,1\n", "row 1: 3 columns; the model needs 2: time, and one for each"),
    ]:
        with pytest.raises(InputError, match=words):
            read_record(written(tmp_path, text), MODEL)


def test_commands_take_inputs_and_name_those_that_are_missing(tmp_path, capsys):
    inputs = written(tmp_path, "time,heater,outdoor\n0,1,5\n2,0,4\n", "inputs.csv")
    record, result = tmp_path / "record.csv", str(tmp_path / "result.nc")
    simulated = ["simulate", "gallery:heated-room", "--until", "3", "--step", "0.5", "-o", str(record)]
    assert main(simulated) == 2
    assert "heater, outdoor of gallery:heated-room are missing" in capsys.readouterr().err
    assert main([*simulated, "--inputs", str(inputs)]) == 0
    assert main(["filter", "gallery:heated-room", str(record), "-o", result]) == 2
    assert "--inputs FILE.csv" in capsys.readouterr().err
    assert main(["filter", "gallery:benes", str(record), "-o", result, "--inputs", str(inputs)]) == 2
    assert "has no inputs" in capsys.readouterr().err


def test_a_study_names_the_inputs_that_it_lacks(tmp_path, capsys):
    text = 'models = ["gallery:heated-room"]\nseeds = {first = 0, count = 2}\ntimes = {until = 2, step = 0.5}\n'
    study = written(tmp_path, f'{text}[methods.a]\nmethod = "yau-yau"\n', "study.toml")
    assert main(["study", str(study), "-o", str(tmp_path / "folder")]) == 2
    assert "heater, outdoor of gallery:heated-room are missing" in capsys.readouterr().err
    inputs = written(tmp_path, "time,heater\n0,1\n", "inputs.csv")
    assert main(["study", str(study), "-o", str(tmp_path / "folder"), "--inputs", str(inputs)]) == 2
    assert "no column for the input outdoor" in capsys.readouterr().err
