"""Untrusted CSV files: refused in one line, in little time and memory, whatever their size."""

from __future__ import annotations

import io
import os
import time
import tracemalloc

import pytest

from zakai.errors import InputError
from zakai.records import csv

MIB = 1 << 20


class Endless(io.RawIOBase):
    """A file that never ends, of one byte after a head."""

    def __init__(self, head: bytes, byte: bytes, most: int):
        self._head, self._byte, self._left = head, byte, most

    def readable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:
        size = min(len(buffer), self._left)
        assert size, "it was read to its end"
        data = (self._head + self._byte * size)[:size]
        self._head, self._left = self._head[size:], self._left - size
        buffer[:size] = data
        return size


@pytest.mark.parametrize(
    ("head", "byte", "says"),
    [
        (b"", b"1", "row 1: is longer than 1,048,576 characters"),
        (b"", b"\0", "row 1: a NUL byte"),
        (b"", b"\xff", "row 1: bytes that are not UTF-8"),
        (b"time,y\n", b"1", "row 2: is longer"),
        (b"time,y\n1,2\n", b" ", "row 3: is longer"),
        (b"time,y\n1,2\n\n", b",", "row 4: is longer"),
        (b"time,y\n1,2\n", b'"', "row 3: is longer"),
        (b"time", b",", "row 1: is longer"),
        (b"time,y\n1,1e", b"9", "row 2: is longer"),
    ],
)
def test_an_endless_line_is_refused_before_it_is_held(head, byte, says):
    began = time.process_time()
    file = io.TextIOWrapper(io.BufferedReader(Endless(head, byte, 8 * MIB)), "utf-8-sig", "surrogateescape")
    with pytest.raises(InputError, match=f"^r.csv: {says}"):
        csv.table_of(file, "r.csv", 1, "observations")
    assert time.process_time() - began < 2


@pytest.mark.parametrize("cells", [b",1" * 500_000, b"," * 500_000, b'"' * 500_001], ids=["numbers", "gaps", "quotes"])
def test_half_a_million_columns_are_refused(tmp_path, cells):
    for content in (b"time" + cells + b"\n", b"time,y\n1" + cells + b"\n"):
        (tmp_path / "r.csv").write_bytes(content)
        tracemalloc.start()
        with pytest.raises(InputError, match="columns|first column"):
            csv.read_table(tmp_path / "r.csv", 1, "observations")
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 200 * MIB


def test_a_row_that_is_wrong_is_found_wherever_the_parts_of_a_long_file_meet(tmp_path, monkeypatch):
    rows = [f"{k},{k % 7}" for k in range(1, 40)]
    for at_once in (1, 5, 64, 10_000):
        monkeypatch.setattr(csv, "_AT_ONCE", at_once)
        for bad in (0, 17, 38):
            for row, says in (("0,1", "comes after|must be"), ("x,1", "not a number"), (f"{bad + 1},1,1", "3 columns")):
                lines = ["time,y", *rows[:bad], row, *rows[bad + 1 :]]
                (tmp_path / "r.csv").write_text("\n".join(lines) + "\n")
                if row == "0,1" and bad == 0:
                    assert len(csv.read_table(tmp_path / "r.csv", 1, "observations")[0]) == 39
                    continue
                with pytest.raises(InputError, match=f"row {bad + 2}: .*({says})"):
                    csv.read_table(tmp_path / "r.csv", 1, "observations")
        (tmp_path / "r.csv").write_text("time,y\r\n\r\n" + "\r\n\r\n".join(rows))
        table, first = csv.read_table(tmp_path / "r.csv", 1, "observations")
        assert first == 3 and table[:, 0].tolist() == list(range(1, 40))


def test_a_sparse_file_of_a_terabyte_is_refused_at_its_first_part(tmp_path):
    (tmp_path / "r.csv").touch()
    try:
        os.truncate(tmp_path / "r.csv", 1 << 40)
    except OSError:
        pytest.skip("this file system has no sparse files")
    with pytest.raises(InputError, match="row 1: a NUL byte"):
        csv.read_table(tmp_path / "r.csv", 1, "observations")
