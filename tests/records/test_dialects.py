"""Tables as spreadsheets and other programs write them."""

import numpy as np
import pytest

import zakai
from zakai.errors import InputError
from zakai.records import read_inputs, read_record

MODEL = zakai.Model(
    state=["x"], drift=["-x"], observation=["x", "2*x"], observation_kind="samples",
    observation_names=["range", "bearing"], prior={"kind": "gaussian", "mean": [0], "cov": [[1]]},
)  # fmt: skip
ROWS = np.array([[0.5, 1.25, -3.0], [1.0, np.nan, 0.002], [1.5, 7.0, np.nan]])


@pytest.mark.parametrize(
    "text",
    [
        "time,range,bearing\n0.5,1.25,-3\n1,,2e-3\n1.5,7,\n",
        "time;range;bearing\n0,5;1,25;-3\n1;;2e-3\n1,5;7;\n",
        "time;range;bearing\r\n0.5;1.25;-3\r\n1;NA;0,002\r\n1.5;7;null\r\n",
        "time\trange\tbearing\n0.5\t1.25\t-3\n1\t\t0.002\n1.5\t7\tNA\n",
        "Time,range,bearing\n0.5,1.25,-3\n1,NA,2e-3\n1.5,7,N/A\n",
        "Time [s],range,bearing\n0.5,1.25,-3\n1,NA,2e-3\n1.5,7,N/A\n",
        "t (h);range;bearing\n0,5;1,25;-3\n1;NA;0,002\n1,5;7;N/A\n",
        ",time,range,bearing\n0,0.5,1.25,-3\n1,1,NA,2e-3\n2,1.5,7,\n",
        "index;Time;bearing;range\n0;0,5;-3;1,25\n1;1;0,002;\n2;1,5;NA;7\n",
        "# a logger\n# 3 rows\n\ntime,range,bearing\n0.5,1.25,-3\n# a pause\n1,,2e-3\n1.5,7,\n",
        "# time,range,bearing\n0.5,1.25,-3\n1,nan,2e-3\n1.5,7,nan\n",
        '"time";"range";"bearing"\n"0,5";"1,25";"-3"\n1;;"2e-3"\n1,5;7;NA\n',
        "\ufefftime;range;bearing\n0,5;+1,25;-3,0\n1;None;,002\n1,5;7,;\n",
    ],
)
def test_what_is_unambiguous_is_read(tmp_path, text):
    (tmp_path / "record.csv").write_text(text)
    record = read_record(tmp_path / "record.csv", MODEL)
    np.testing.assert_array_equal(np.column_stack([record.times, record.values]), ROWS)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time range bearing\n0.5 1 2\n", "row 1: the first column is 'time range bearing'; .* separated by a space"),
        ("# c\ntime|range|bearing\n0.5|1|2\n", "row 2: .*separated by a bar; separate them by a comma, a semicolon, a tab"),
        ("time;range;bearing\n0,5;1.234,5;2\n", r"row 2: '1.234,5' in column 'range' is not a number"),
        ("# c\n\ntime;range;bearing\n0,5;1;2\n0,4;1;2\n", "row 5: the time 0.4 comes after"),
        ("time,range,bearing\n0,5,1,25,3\n", "row 2: 5 columns; expected 3"),
        ("# only\n# comments\n", "has no header"),
        ("time;range;bearing\n0,5;1;x\n", "row 2: 'x' in column 'bearing' is not a number"),
    ],
)
def test_what_is_not_is_named_with_its_row(tmp_path, text, words):
    (tmp_path / "record.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        read_record(tmp_path / "record.csv", MODEL)


def test_dates_and_inputs_may_be_written_so_too(tmp_path):
    (tmp_path / "record.csv").write_text("Time;range;bearing\n2024-01-31;0,5;NA\n2024-02-01;1,5;2\n")
    record = read_record(tmp_path / "record.csv", MODEL, unit="d")
    np.testing.assert_array_equal(np.column_stack([record.times, record.values]), [[0, 0.5, np.nan], [1, 1.5, 2]])
    heated = zakai.load_model("gallery:heated-room")
    (tmp_path / "inputs.csv").write_text("# heater in kW\ntime;outdoor;heater\n0;5;1,5\n")
    np.testing.assert_array_equal(read_inputs(tmp_path / "inputs.csv", heated).values, [[1.5, 5]])


def test_a_missing_value_may_end_a_line_in_the_middle(tmp_path):
    path = tmp_path / "record.csv"
    path.write_text("time,range\n0.5,1.25\n1,NA\n1.5,7\n", encoding="utf-8")
    model = zakai.Model(state=["x"], drift=["-x"], observation=["x"], observation_kind="samples")
    values = read_record(path, model).values[:, 0]
    assert np.array_equal(values, [1.25, np.nan, 7.0], equal_nan=True)
