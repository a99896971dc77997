"""Exit codes: 0, 2, 3 and 130, and 1 for a bug in zakai; which text goes to which stream."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from zakai import Model
from zakai.cli import _interrupt, inspecting

USAGE = {
    "unknown command": ["filtre", "model.toml"],
    "unknown option": ["analyze", "model.toml", "--jsn"],
    "missing argument": ["analyze"],
    "missing output": ["filter", "model.toml", "record.csv"],
    "one argument too many": ["gallery", "benes", "encoder"],
    "text for a number": ["simulate", "model.toml", "--until", "later", "--step", "1", "-o", "a.csv"],
    "step of zero": ["simulate", "model.toml", "--until", "1", "--step", "0", "-o", "a.csv"],
    "endless": ["simulate", "model.toml", "--until", "inf", "--step", "1", "-o", "a.csv"],
    "too many": ["simulate", "model.toml", "--until", "1", "--step", "1e-300", "-o", "a.csv"],
    "until before the start": ["simulate", "model.toml", "--until", "-1", "--step", "1", "-o", "a.csv"],
    "step beyond the end": ["simulate", "model.toml", "--until", "1", "--step", "2", "-o", "a.csv"],
    "negative seed": ["simulate", "model.toml", "--until", "1", "--step", "1", "--seed", "-1", "-o", "a.csv"],
    "initial text": ["simulate", "model.toml", "--until", "1", "--step", "1", "--initial", "x", "-o", "a.csv"],
    "initial of another size": ["simulate", "model.toml", "--until", "1", "--step", "1", "--initial", "1,2", "-o", "a.csv"],
    "two forms": ["analyze", "model.toml", "--json", "--latex"],
    "unknown model": ["gallery", "nowhere"],
    "methods of no model": ["methods", "nowhere.toml"],
    "no folder": ["filter", "model.toml", "record.csv", "-o", "nowhere/result.nc"],
    "no folder for the report": ["filter", "model.toml", "record.csv", "-o", "result.nc", "--report", "nowhere/r.html"],
    "output is a folder": ["filter", "model.toml", "record.csv", "-o", "."],
    "output is an input": ["filter", "model.toml", "record.csv", "-o", "record.csv"],
    "output named twice": ["filter", "model.toml", "record.csv", "-o", "a", "--report", "a"],
    "unknown method": ["filter", "model.toml", "record.csv", "-o", "result.nc", "--method", "limited"],
    "unknown option of a method": ["filter", "model.toml", "record.csv", "-o", "result.nc", "--option", "kernal=1"],
    "wrong value of an option": ["filter", "model.toml", "record.csv", "-o", "result.nc", "--option", "kernel=flaw"],
    "option without a value": ["filter", "model.toml", "record.csv", "-o", "result.nc", "--option", "kernel"],
    "option given twice": ["filter", "model.toml", "record.csv", "-o", "r.nc", "--option", "order=1", "--option", "order=2"],
    "option that is none": ["filter", "model.toml", "record.csv", "-o", "result.nc", "--option", "method=auto"],
}


@pytest.mark.parametrize("arguments", USAGE.values(), ids=USAGE.keys())
def test_wrong_usage_is_one_line_and_code_2(zakai, tmp_path, arguments):
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    answer = zakai(*arguments)
    assert answer.code == 2, answer
    assert answer.out == "" and answer.err.startswith("error: ") and answer.err.count("\n") == 1, answer.err
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_an_unknown_option_is_answered_with_those_that_there_are(zakai):
    command = ("filter", "model.toml", "record.csv", "-o", "result.nc", "--method", "limited-direct", "--option", "spliting=lie")
    error = zakai(*command).err
    assert all(word in error for word in ("spliting", "splitting", "tolerance"))


def test_a_method_that_does_not_hold_is_code_3_and_says_what_fails(zakai, tmp_path):
    answer = zakai("filter", "gallery:cubic-sensor", "record.csv", "-o", "result.nc", "--method", "limited-direct")
    assert answer.code == 3
    assert answer.err.count("\n") == 2 and "x**6" in answer.err and "Assumption 3" in answer.err
    assert not (tmp_path / "result.nc").exists()


def test_a_system_for_which_the_method_does_not_hold_is_code_3_and_says_what_fails(zakai, tmp_path):
    names = ["a", "b", "c", "d", "e"]
    drift = [f"cos({name})" for name in (*names[1:], names[0])]
    prior = {"kind": "gaussian", "mean": [0.0] * 5, "cov": [[float(i == j) for i in range(5)] for j in range(5)]}
    keys = {"state": names, "drift": drift, "observation": ["a**3"], "observation_kind": "increments", "prior": prior}
    (tmp_path / "five.toml").write_text(Model(**keys).to_toml())
    answer = zakai("filter", "five.toml", "record.csv", "-o", "result.nc", "--method", "yau-yau")
    assert answer.code == 3
    assert answer.err.count("\n") == 2 and "at most four coordinates" in answer.err
    assert not (tmp_path / "result.nc").exists()


def test_a_report_needs_no_extra(zakai, tmp_path, monkeypatch):
    for library in ("matplotlib", "anywidget"):
        monkeypatch.setitem(sys.modules, library, None)
    answer = zakai("filter", "model.toml", "record.csv", "-o", "result.nc", "--report", "report.html")
    assert answer.code == 0 and "data-zakai" in (tmp_path / "report.html").read_text()


def test_warnings_go_to_stderr_and_the_code_is_0(zakai, monkeypatch):
    monkeypatch.setattr("zakai.engine.loop.warnings_of_run", lambda *_: ["the sky is falling"])
    answer = zakai("filter", "model.toml", "record.csv", "-o", "result.nc")
    assert answer.code == 0 and answer.err == "warning: the sky is falling\n"


def test_a_bug_leaves_with_its_traceback(zakai, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("ours")

    monkeypatch.setattr(inspecting, "gallery", broken)
    with pytest.raises(ZeroDivisionError):
        zakai("gallery")


def test_an_interruption_is_code_130_and_leaves_nothing(zakai, tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    before = sorted(tmp_path.iterdir())
    monkeypatch.setattr("zakai.records.netcdf.atomic_write", interrupted)
    answer = zakai("filter", "model.toml", "record.csv", "-o", "result.nc")
    assert answer.code == 130 and answer.err.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


def test_an_interruption_that_a_library_drops_is_seen_at_the_next_step(zakai, tmp_path, monkeypatch):
    monkeypatch.setattr(_interrupt, "_asked", False)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(KeyboardInterrupt):  # and dropped here
        _interrupt._note()
    answer = zakai("filter", "model.toml", "record.csv", "-o", "result.nc")
    assert answer.code == 130 and answer.err.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


def test_an_interruption_waits_for_a_compiler_but_not_for_ever(monkeypatch):
    timers = []
    monkeypatch.setattr(_interrupt, "_asked", False)
    monkeypatch.setattr(_interrupt, "_timed", True)
    monkeypatch.setattr(_interrupt.signal, "setitimer", lambda *given: timers.append(given), raising=False)

    def compiled():
        # A function whose module is part of a compiler.
        module = {"__name__": "numba.core.compiler", "note": _interrupt._note, "frame": sys._getframe}
        exec("def compile(): note(0, frame())", module)
        module["compile"]()

    compiled()
    assert len(timers) == 1 and _interrupt._asked
    with pytest.raises(KeyboardInterrupt):
        _interrupt._note(0, sys._getframe())
    monkeypatch.setattr(_interrupt, "PATIENCE", -1.0)
    with pytest.raises(KeyboardInterrupt):
        compiled()


def process(*arguments: str, **more):
    # A test run in the background of a shell is deaf to Ctrl-C, and so would its children be; mended in the child, because
    # a function between fork and exec would fork a process with threads.
    hear = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    command = f"{hear}; import sys; from zakai.cli import main; sys.exit(main())"
    return subprocess.Popen([sys.executable, "-c", command, *arguments], stderr=subprocess.PIPE, **more)


def test_control_c_is_code_130(tmp_path):
    rows = "".join(f"{k},0,0\n" for k in range(1, 20_000))
    (tmp_path / "record.csv").write_text("time,c,s\n" + rows)
    running = process("filter", "gallery:encoder", "record.csv", "-o", "result.nc", "--method", "general-direct", cwd=tmp_path)
    # The warning of a long computation comes when the first observations have been filtered.
    assert any(b"to shorten it" in line for line in iter(running.stderr.readline, b""))
    running.send_signal(signal.SIGINT)
    error = running.communicate(timeout=120)[1]
    assert running.returncode == 130, error
    assert error.count(b"\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["record.csv"]


def test_a_pipe_that_is_closed_is_code_0():
    read, write = os.pipe()
    os.close(read)
    running = process("analyze", "gallery:benes", stdout=write)
    os.close(write)
    assert running.communicate(timeout=60)[1] == b"" and running.returncode == 0


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a device that is always full")
def test_a_full_disk_behind_stdout_is_code_2():
    with open("/dev/full", "w") as full:
        running = process("gallery", stdout=full)
        error = running.communicate(timeout=60)[1]
    assert running.returncode == 2 and error.count(b"\n") == 1


def test_what_does_not_filter_loads_no_compiler():
    code = (
        "import sys; from zakai.cli import main\n"
        "for line in ('--version', '--help', 'gallery', 'methods', 'methods gallery:benes', 'analyze gallery:benes'):\n"
        "    assert main(line.split()) == 0 and not {'jax', 'numba'} & set(sys.modules), line"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL, timeout=60)
