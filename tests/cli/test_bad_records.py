"""Records and truths that cannot be used: exit code 2, one line that names the row, no output file."""

from __future__ import annotations

import pytest

from .conftest import MODEL, RECORD

BAD = {
    "empty": (b"", "empty"),
    "header only": (b"time,y\n", "no row"),
    "no header": (b"0.1,0.2\n0.2,0.1\n", "row 1"),
    "truncated row": (b"time,y\n0.1,0.2\n0.2", "row 3"),
    "truncated number": (b"time,y\n0.1,0.2\n0.2,1e", "row 3"),
    "too many columns": (b"time,y\n0.1,0.2,0.3\n", "row 2"),
    "another m": (b"time,y,z\n0.1,0.2,0.3\n", "row 1"),
    "NUL": (b"time,y\n0.1,0.2\n0.2,0\x00.1\n", "row 3"),
    "1e308": (b"time,y\n0.1,0.2\n0.2,1e308\n", "row 3"),
    "time of 1e308": (b"time,y\n0.1,0.2\n1e308,1\n", "row 3"),
    "beyond double": (b"time,y\n0.1,1e999\n", "row 2"),
    "infinite": (b"time,y\n0.1,inf\n", "row 2"),
    "text": (b"time,y\n0.1,a\n", "row 2"),
    "python": (b"time,y\n0.1,__import__('os')\n", "row 2"),
    "decreasing": (b"time,y\n0.2,1\n0.1,1\n", "row 3"),
    "twice": (b"time,y\n0.2,1\n0.2,1\n", "row 3"),
    "at the start": (b"time,y\n0,1\n", "row 2"),
    "before the start": (b"time,y\n-1,1\n", "row 2"),
    "no time": (b"time,y\n,1\n", "row 2"),
    "not UTF-8": (b"time,y\n0.1,\xff\n", "row 2"),
}


@pytest.mark.parametrize(("content", "row"), BAD.values(), ids=BAD.keys())
def test_a_bad_record_is_one_line_that_names_its_row(refused, tmp_path, content, row):
    (tmp_path / "record.csv").write_bytes(content)
    refused("record.csv", row)


def test_a_record_that_is_not_there_is_one_line(refused):
    refused("nowhere.csv", record="nowhere.csv")


TRUTHS = {
    "another name": ("time,z\n0,1\n", "row 1"),
    "another n": ("time,x,z\n0,1,1\n", "row 1"),
    "text": ("time,x\n0,one\n", "row 2"),
    "truncated": ("time,x\n0,1\n0.1", "row 3"),
    "other times": ("time,x\n7,1\n8,2\n", "times"),
}


@pytest.mark.parametrize(("content", "words"), TRUTHS.values(), ids=TRUTHS.keys())
def test_a_bad_truth_is_one_line_before_any_work(refused, tmp_path, content, words):
    (tmp_path / "truth.csv").write_text(content)
    refused("truth.csv", words, more=("--truth", "truth.csv"))


def test_windows_line_ends_a_byte_order_mark_and_gaps_are_accepted(zakai, tmp_path):
    (tmp_path / "record.csv").write_bytes(b"\xef\xbb\xbf" + RECORD.replace("-0.1", "").replace("\n", "\r\n").encode())
    answer = zakai("filter", "model.toml", "record.csv", "-o", "result.nc")
    assert answer.code == 0, answer
    assert (tmp_path / "result.nc").exists()


@pytest.mark.parametrize(("family", "value"), [("poisson", "-1"), ("poisson", "1.5"), ("bernoulli", "2")])
def test_a_value_that_the_family_cannot_have_is_named_with_its_row(refused, tmp_path, family, value):
    keys = f'observation_kind = "samples"\nobservation_family = "{family}"\n'
    (tmp_path / "model.toml").write_text(keys + MODEL.replace('observation_kind = "increments"\n', ""))
    (tmp_path / "record.csv").write_text(f"time,y\n0.1,1\n0.2,{value}\n")
    refused("record.csv", "row 3", family)


def test_angles_in_degrees_warn(zakai, tmp_path):
    keys = 'observation_kind = "samples"\nobservation_family = "von-mises"\nconcentration = "4"\n'
    (tmp_path / "model.toml").write_text(keys + MODEL.replace('observation_kind = "increments"\n', ""))
    (tmp_path / "record.csv").write_text("time,y\n0.1,175\n0.2,-179\n")
    assert "radians" in zakai("filter", "model.toml", "record.csv", "-o", "result.nc").err
    (tmp_path / "record.csv").write_text("time,y\n0.1,3.1\n0.2,-3.1\n")
    assert "radians" not in zakai("filter", "model.toml", "record.csv", "-o", "result.nc").err


@pytest.mark.parametrize("command", ["filter model.toml record.csv", "simulate model.toml --until 2 --step 0.5"])
def test_inputs_that_end_early_are_named_by_their_file(zakai, tmp_path, command):
    keys = MODEL.replace('drift = ["-a*x"]', 'drift = ["u - a*x"]\ninputs = ["u"]\ninput_hold = "linear"')
    (tmp_path / "model.toml").write_text(keys)
    (tmp_path / "record.csv").write_text("time,y\n1,0.2\n2,0.1\n")
    (tmp_path / "wind.csv").write_text("time,u\n0,1\n1,2\n")
    answer = zakai(*command.split(), "--inputs", "wind.csv", "-o", "out.csv")
    assert answer.code == 2
    assert answer.err.startswith("error: wind.csv: the last time 1 is before 2; ")
