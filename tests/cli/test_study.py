"""`zakai study`: its table, its folder, its exit codes."""

from __future__ import annotations

import json

import pytest

STUDY = """
models = ["gallery:kalman-bucy-1d"]
reference = "kalman-bucy"
batch = 2
[seeds]
count = 4
[times]
until = 0.5
step = 0.05
[methods.kalman-bucy]
[methods.extended]
method = "extended-kalman-bucy"
"""


@pytest.fixture
def study(zakai, tmp_path):
    """`zakai study` of the file above in an empty folder; other arguments and another text may be given."""

    def run(*more, text=STUDY):
        (tmp_path / "study.toml").write_text(text)
        return zakai("study", "study.toml", "-o", "out", *more)

    return run


def test_a_study_prints_a_line_for_every_method_and_writes_its_folder(study, tmp_path):
    answer = study()
    assert answer.code == 0 and answer.err == ""
    lines = answer.out.splitlines()
    assert lines[0].startswith("kalman-bucy-1d: 4 runs of 10 observations")
    figures = json.loads((tmp_path / "out" / "summary.json").read_text())["points"][0]["methods"]
    for label in ("kalman-bucy", "extended"):
        line = next(line for line in lines if line.startswith(f"{label} "))
        assert f"{figures[label]['squared_error']['median']:.4g}" in line
    assert {"study.nc", "summary.json", "timing.json", "manifest.json"} <= {entry.name for entry in (tmp_path / "out").iterdir()}
    again = study(text=STUDY.replace("count = 4", "count = 2"))
    assert again.code == 2 and "another study" in again.err and again.err.count("\n") == 1


def test_a_study_that_cannot_be_is_code_2_and_one_line(study, tmp_path):
    answer = study(text=STUDY.replace("batch", "bach"))
    assert (answer.code, answer.out) == (2, "")
    assert answer.err.count("\n") == 1 and "study.toml: unknown key 'bach'; did you mean 'batch'?" in answer.err
    assert not (tmp_path / "out").exists()


def test_a_method_that_does_not_hold_is_code_3(study):
    answer = study(text=STUDY.replace('kalman-bucy-1d', 'cubic-sensor'))
    assert answer.code == 3 and "methods.kalman-bucy" in answer.err and answer.err.count("\n") == 2


def test_an_interrupted_study_is_code_130_and_goes_on(study, tmp_path, monkeypatch):
    from contextlib import contextmanager

    from zakai.cli import studying

    @contextmanager
    def interrupted(what):
        def advance(done, total):
            if done >= total / 2 + 1:
                raise KeyboardInterrupt

        yield advance

    with monkeypatch.context() as patch:
        patch.setattr(studying, "progress", interrupted)
        assert study().code == 130
    assert [entry.name for entry in (tmp_path / "out" / "batches").iterdir()] == ["00000.nc"]
    monkeypatch.setattr(studying, "_pictures", lambda outcome: [])
    assert study().code == 0
