"""A full disk, or Ctrl-C, when a file is about to be finished: what was there is still there, and nothing half-written."""

from __future__ import annotations

import errno
import io
import json
import os
import sys

import pytest

from zakai.records import writing

FILTER = ("filter", "model.toml", "record.csv", "--method", "kalman-bucy", "-o", "result.nc")
REPORT = (*FILTER, "--report", "report.html")
SIMULATE = ("simulate", "model.toml", "--until", "1", "--step", "0.1", "-o", "new.csv", "--truth", "truth.csv")


@pytest.fixture
def fails_at(monkeypatch):
    """Let the writing of the file of this suffix end so."""

    def arrange(suffix: str, end: BaseException) -> None:
        sync = writing._sync

        def failing(path):
            if path.suffix == suffix:
                raise end
            sync(path)

        monkeypatch.setattr(writing, "_sync", failing)

    return arrange


@pytest.mark.parametrize(
    ("arguments", "output"),
    [(FILTER, "result.nc"), (REPORT, "report.html"), (SIMULATE, "new.csv"), (SIMULATE, "truth.csv")],
    ids=["result", "report", "record", "truth"],
)
@pytest.mark.parametrize("end", [OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), KeyboardInterrupt()], ids=["full", "Ctrl-C"])
def test_what_was_there_stays_and_nothing_half_written_is_left(zakai, fails_at, tmp_path, arguments, output, end):
    outputs = {name for name in arguments if name.endswith((".nc", ".html", ".csv"))} - {"record.csv"}
    for name in outputs:
        (tmp_path / name).write_text("old")
    before = sorted(path.name for path in tmp_path.iterdir())
    fails_at("." + output.rpartition(".")[2], end)
    answer = zakai(*arguments)
    if isinstance(end, OSError):
        assert answer.code == 2 and answer.err.count("\n") == 1, answer
        assert "cannot be written: No space left on device; choose another place or free some space" in answer.err
    else:
        assert answer.code == 130
    assert (tmp_path / output).read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.parametrize("strict", [(), ("--strict",)], ids=["", "strict"])
def test_a_stream_whose_checkpoint_cannot_be_saved_answers_the_line_and_ends(zakai, monkeypatch, tmp_path, strict):
    lines = [json.dumps({"time": k / 10, "y": [k % 3 / 10]}) + "\n" for k in range(1, 7)]

    def stream(count):
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO("".join(lines[:count]).encode())))
        return zakai("stream", "model.toml", "--checkpoint", "state", "--checkpoint-every", "2", *strict)

    whole = stream(6).out.splitlines()
    (tmp_path / "state").unlink()
    stream(2)
    before, saved = sorted(path.name for path in tmp_path.iterdir()), (tmp_path / "state").read_bytes()
    with monkeypatch.context() as patch:

        def full(path):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        patch.setattr(writing, "_sync", full)
        answer = stream(6)
    assert answer.code == 2 and answer.out.splitlines() == whole[1:4]
    assert answer.err == "error: state: cannot be written: No space left on device; choose another place or free some space\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == before and (tmp_path / "state").read_bytes() == saved
    assert stream(6).out.splitlines() == whole[1:]  # once there is space
