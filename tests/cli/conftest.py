"""The command in this process, and files for it."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from zakai.cli import main

MODEL = """
name = "a walk"
state = ["x"]
drift = ["-a*x"]
observation = ["x"]
observation_kind = "increments"

[parameters]
a = 0.5

[prior]
kind = "gaussian"
mean = [0.0]
cov = [[1.0]]
"""
RECORD = "time,y\n0.1,0.2\n0.2,-0.1\n0.3,0.05\n"


class Answer(NamedTuple):
    code: int
    out: str
    err: str


@pytest.fixture
def zakai(capsys, tmp_path, monkeypatch):
    """The command, run in an empty folder that holds `model.toml` and `record.csv`."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.toml").write_text(MODEL)
    (tmp_path / "record.csv").write_text(RECORD)

    def run(*arguments: str) -> Answer:
        code = main([str(argument) for argument in arguments])
        return Answer(code, *capsys.readouterr())

    return run


@pytest.fixture
def refused(zakai, tmp_path):
    """Filtering that must end with exit code 2, one line that holds the words given, and no output file."""

    def run(*words: str, model: str = "model.toml", record: str = "record.csv", more: tuple[str, ...] = ()) -> str:
        before = sorted(path.name for path in tmp_path.iterdir())
        answer = zakai("filter", model, record, "-o", "result.nc", "--report", "report.html", *more)
        assert answer.code == 2, answer
        assert answer.out == ""
        assert answer.err.startswith("error: ") and answer.err.count("\n") == 1 and answer.err.endswith("\n"), answer.err
        assert len(answer.err) < 600
        assert answer.err.strip().isprintable()
        for word in words:
            assert word in answer.err, answer.err
        assert sorted(path.name for path in tmp_path.iterdir()) == before
        return answer.err

    return run
