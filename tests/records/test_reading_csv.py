import math
import os
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from zakai.errors import InputError
from zakai.records import Record, read_record


def model(m=2, kind="samples", start=0.0):
    return SimpleNamespace(m=m, observation_kind=kind, start=start, inputs=(), observation_law=SimpleNamespace(is_gaussian=True))


@pytest.fixture
def read(tmp_path):
    def read(content, **kwargs):
        path = tmp_path / "record.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_record(path, model(**kwargs))

    return read


GOOD = "time,a,b\n0,1.5,-2\n0.25,,nan\n1e1,.5,+3E-2\n"


def same(record):
    np.testing.assert_array_equal(record.times, [0.0, 0.25, 10.0])
    np.testing.assert_array_equal(record.values, [[1.5, -2], [np.nan, np.nan], [0.5, 0.03]])
    return True


def test_a_plain_file_is_read_with_its_gaps(read):
    record = read(GOOD)
    assert same(record) and record.kind == "samples"


@pytest.mark.parametrize(
    "content",
    [
        GOOD.replace("\n", "\r\n").encode(),
        b"\xef\xbb\xbf" + GOOD.encode(),
        b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode(),
        GOOD.rstrip("\n").encode(),
        GOOD.replace("\n", "\n\n").encode(),
        GOOD.replace("\n", "\n   \n").encode(),
        GOOD.replace(",", " , ").encode(),
        GOOD.replace("1.5", '"1.5"').replace("time,a", 'time,"a, the first"').encode(),
    ],
    ids=[
        "windows",
        "bom",
        "windows-bom",
        "no-last-newline",
        "blank-lines",
        "lines-of-spaces",
        "spaces",
        "quotes",
    ],
)
def test_windows_line_ends_a_byte_order_mark_blanks_and_quotes_change_nothing(read, content):
    assert same(read(content))


def test_the_careful_road_gives_the_same_numbers_as_the_fast_one(read):
    numbers = "time,y\n" + "".join(f"{k},{math.sin(k)!r}\n" for k in range(1, 500))
    fast, careful = read(numbers, m=1), read(numbers + " \n", m=1)
    np.testing.assert_array_equal(fast.values, careful.values)
    np.testing.assert_array_equal(fast.values[:, 0], [math.sin(k) for k in range(1, 500)])


@pytest.mark.parametrize(
    ("content", "row", "says"),
    [
        (
            "time,a,b\n1,2,3\n\n2,2,3\n1.5,2,3\n",
            5,
            "comes after the time 2.0; times must be strictly increasing: sort the rows",
        ),
        ("time,a,b\n1,2,3\n2,two,3\n3,x,y\n", 3, "'two' in column 'a' is not a number"),
        ("time,a,b\n2,2,3\n1,2,3\n3,x,y\n", 3, "strictly increasing"),
        ("time,a,b\n1,2,3\n2,2\n", 3, "2 columns; expected 3: 'time,a,b'"),
        ("time,a,b\n1,2,3\n2,2,3,4\n", 3, "4 columns; expected 3"),
        ("time,a,b\n1,2,3\n2,0.12", 3, "the file ends in this row"),
        ("time,a,b\n1,2,3\n2,-inf,3\n", 3, "observation 1 is -inf; values must be finite"),
        (
            "time,a,b\n1,2,3\n2,0,1e308\n",
            3,
            "observation 2 is 1e+308; values must be finite and at most 1e+150",
        ),
        ("time,a,b\n1,2,3\n2,0,1e999\n", 3, "observation 2 is inf"),
        ("time,a,b\n1,2,3\n1e200,0,1\n", 3, "the time is 1e+200"),
        ("time,a,b\n1,2,3\n,0,1\n", 3, "the time is missing"),
        ("time,a,b\n1,2,3\nnan,0,1\n", 3, "the time is missing"),
        ("time,a,b\n1,2,3\n2,1_000,1\n", 3, "'1_000' in column 'a' is not a number"),
        ("time,a,b\n1,2,3\n2,0x10,1\n", 3, "'0x10' in column 'a' is not a number"),
        ("time,a,b\n1,2,3\n2,\N{FULLWIDTH DIGIT ONE},1\n", 3, "is not a number"),
        ("time,a,b\n1,2,3\n2,1\0,1\n", 3, "NUL byte"),
        (b"time,a,b\n1,2,3\n2,\xff,1\n", 3, "not UTF-8"),
        (GOOD.encode("utf-16"), 1, "not UTF-8"),
        (b"\0" * 4096, 1, "NUL byte"),
        ("1,2,3\n2,3,4\n", 1, "the header must begin with time (is the header missing?)"),
        ("u,a,b\n1,2,3\n", 1, "the first column is 'u'; the header must begin with time"),
        ("time,a\n1,2\n", 1, "2 columns; the model needs 3: time, and one for each of its observations"),
        ("time:a:b\n1:2:3\n", 1, "the first column is 'time:a:b'"),
        ("\n1,2,3\n", 2, "the header must begin with time"),
    ],
)
def test_the_first_bad_row_is_named_by_its_line_number_in_one_line(read, content, row, says):
    with pytest.raises(InputError) as caught:
        read(content)
    text = str(caught.value)
    assert f"record.csv: row {row}: " in text and says in text and len(text.splitlines()) == 1


def test_names_are_free_but_for_our_own_which_are_taken_in_any_order(read):
    for names in ("y1,y2", "y2,y3", "y2,y2", "b,a", "Y2,Y1"):
        assert read(f"time,{names}\n1,2,3\n").values.tolist() == [[2.0, 3.0]]
    assert read("time,y2,y1\n1,2,3\n").values.tolist() == [[3.0, 2.0]]
    many = [f"y{i}" for i in (*range(1, 11), 12, 11)]
    assert read(f"time,{','.join(many)}\n{','.join(map(str, range(13)))}\n", m=12).values[0, -2:].tolist() == [12.0, 11.0]


@pytest.mark.parametrize("content", ["time,a,b\n", "time,a,b", "time,a,b\r\n\r\n \r\n"])
def test_a_header_without_rows_is_refused(read, content):
    with pytest.raises(InputError, match="has a header but no row"):
        read(content)


def test_an_empty_file_is_refused(read):
    with pytest.raises(InputError, match="is empty; expected a header"):
        read("")


@pytest.mark.parametrize("kind", ["increments", "path", "rates"])
def test_an_interval_needs_a_length_so_the_first_time_is_after_the_start(read, kind):
    with pytest.raises(InputError, match=r"row 3: the time 2\.0 must be after the model's start 2\.0"):
        read("time,y\n\n2,1\n3,1\n", m=1, kind=kind, start=2.0)
    assert read("time,y\n2.5,1\n3,1\n", m=1, kind=kind, start=2.0).kind == kind


def test_a_sample_may_be_taken_at_the_start_but_not_before(read):
    assert len(read("time,y\n2,1\n3,1\n", m=1, start=2.0)) == 2
    with pytest.raises(InputError, match=r"row 2: the time 1\.5 must be at or after the model's start"):
        read("time,y\n1.5,1\n3,1\n", m=1, start=2.0)


def test_a_file_that_is_not_there_and_a_folder_and_a_pipe_are_refused(tmp_path):
    with pytest.raises(InputError, match="nothing.csv: cannot be read: No such file"):
        read_record(tmp_path / "nothing.csv", model())
    with pytest.raises(InputError, match="is a folder"):
        read_record(tmp_path, model())
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="not a regular file"):
        read_record(tmp_path / "pipe", model())
    with pytest.raises(InputError, match="cannot be read"):
        read_record("nul\0.csv", model())


def test_a_long_cell_is_quoted_in_part(read):
    with pytest.raises(InputError) as caught:
        read("time,a,b\n1," + "x" * 10_000_000 + ",3\n")
    assert len(str(caught.value)) < 300


pieces = st.lists(
    st.sampled_from(
        [
            b"time,a,b\n",
            b"1",
            b"2.5",
            b",",
            b"\n",
            b"\r\n",
            b"nan",
            b"-inf",
            b'"',
            b"\0",
            b"\xff",
            b" ",
            b"1e308",
        ]
    )
)


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.one_of(st.binary(), pieces.map(b"".join), pieces.map(lambda p: b"time,a,b\n" + b"".join(p))))
@example(b'time,a,b\n"1,2,3\n4,5,6"\n')
@example(b"time,a,b\n1\n")
def test_any_bytes_give_a_record_or_one_line(read, content):
    try:
        record = read(content)
    except InputError as error:
        assert len(str(error).splitlines()) == 1 and "record.csv" in str(error) and str(error).isprintable()
    else:
        assert isinstance(record, Record) and record.values.shape == (len(record.times), 2)
