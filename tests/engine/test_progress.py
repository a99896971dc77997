"""Bars on long work: on a terminal only, one at a time, and none in a pipe."""

from __future__ import annotations

import io
import sys
import time

import numpy as np
import pytest

import zakai
from zakai._progress import bar

PRIOR = {"kind": "gaussian", "mean": [0], "cov": [[1]]}
MODEL = zakai.Model(state=["x"], drift=["-x"], observation=["x"], observation_kind="increments", prior=PRIOR)
RECORD = zakai.Record(0.01 * np.arange(1, 1001), np.zeros(1000))


class Terminal(io.StringIO):
    def isatty(self):
        return True


def on_a_terminal(monkeypatch):
    """Make standard error a terminal; called in the test, since pytest sets it again after the fixtures."""
    found = Terminal()
    monkeypatch.setattr(sys, "stderr", found)
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "80")
    return found


def test_a_terminal_has_a_bar_that_goes_away(monkeypatch):
    terminal = on_a_terminal(monkeypatch)
    monkeypatch.setattr(bar.__wrapped__, "__defaults__", (0.0,))
    zakai.filter(MODEL, RECORD)
    assert "filtering" in terminal.getvalue() and "/1000" in terminal.getvalue()
    assert terminal.getvalue().endswith("\x1b[2K")  # the line is erased


def test_short_work_has_no_bar(monkeypatch):
    terminal = on_a_terminal(monkeypatch)
    zakai.filter(MODEL, RECORD)
    assert terminal.getvalue() == ""


def test_a_pipe_has_no_bar(monkeypatch):
    found = io.StringIO()
    monkeypatch.setattr(sys, "stderr", found)
    monkeypatch.setattr(bar.__wrapped__, "__defaults__", (0.0,))
    zakai.filter(MODEL, RECORD)
    with bar("work") as advance:
        assert advance is None
    assert found.getvalue() == ""


def test_a_fit_counts_its_evaluations_and_its_filters_have_no_bar(monkeypatch):
    terminal = on_a_terminal(monkeypatch)
    monkeypatch.setattr(bar.__wrapped__, "__defaults__", (0.0,))
    model = zakai.load_model("gallery:kalman-bucy-1d")
    zakai.fit(model, zakai.simulate(model, 0.1 * np.arange(1, 21), seed=0)[1], ["a"])
    fitting, filtering = terminal.getvalue().find("fitting"), terminal.getvalue().find("filtering")
    assert 0 <= fitting and (filtering < 0 or fitting < filtering)


def test_a_bar_appears_in_the_middle_of_a_long_step(monkeypatch):
    terminal = on_a_terminal(monkeypatch)
    with bar("work", 0.05) as advance:
        advance(1, None)
        assert terminal.getvalue() == ""
        time.sleep(1.0)
        assert "work" in terminal.getvalue() and "1/?" in terminal.getvalue()


def test_a_caller_who_asks_for_the_progress_gets_it_and_no_bar(monkeypatch):
    terminal = on_a_terminal(monkeypatch)
    monkeypatch.setattr(bar.__wrapped__, "__defaults__", (0.0,))
    calls = []
    zakai.filter(MODEL, RECORD, progress=lambda done, total: calls.append((done, total)))
    assert calls[-1] == (1000, 1000) and terminal.getvalue() == ""


def test_work_that_fails_leaves_the_terminal_to_the_next_bar(monkeypatch):
    terminal = on_a_terminal(monkeypatch)
    with pytest.raises(ZeroDivisionError), bar("first", 0.0) as advance:
        advance(1, 3)
        1 / 0  # noqa: B018
    with bar("second", 0.0) as advance:
        advance(1, 3)
    assert "second" in terminal.getvalue()


@pytest.mark.parametrize("name", ["predict_observations", "residuals"])
def test_what_follows_a_filter_says_how_far_it_is(name):
    result, said = zakai.filter(MODEL, zakai.Record(0.01 * np.arange(1, 41), np.zeros(40))), []
    getattr(result, name)(progress=lambda done, total: said.append((done, total)))
    assert said == [(k, 40) for k in range(1, 41)]
