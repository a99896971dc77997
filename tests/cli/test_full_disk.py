"""A full disk, or Ctrl-C, when a file is about to be finished: what was there is still there, and nothing half-written."""

from __future__ import annotations

import errno
import os

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
        assert "cannot be written: No space left on device; choose another place or make room" in answer.err
    else:
        assert answer.code == 130
    assert (tmp_path / output).read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == before
