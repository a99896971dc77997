"""The server of the studio: who is answered, what is taken, and that a request can neither block nor break it."""

from __future__ import annotations

import logging
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from starlette.websockets import WebSocketDisconnect

import zakai
from studio.page import HOST, ORIGIN, PORT, Page, studio, unpacked
from zakai import _progress
from zakai.numerics import compiled
from zakai.studio.follow import Source
from zakai.studio.session import Session
from zakai.studio.worker import answer as computed
from zakai.studio.worker import saying

SPIRAL = zakai.gallery.text("spiral-sensor")
SIMULATED = {"kind": "simulate", "until": 1.0, "step": 0.02, "seed": 1}
LONG = {"text": zakai.gallery.text("lorenz"), "data": {"kind": "simulate", "until": 200.0, "step": 0.01, "seed": 0}}


@pytest.fixture(scope="module")
def served():
    client, token = studio()
    with client:
        yield client, token


@pytest.fixture
def page(served):
    client, token = served
    with client.websocket_connect(f"/{token}/socket", headers={"host": HOST, "origin": ORIGIN}) as socket:
        yield Page(client, token, socket)


WAYS = {
    "without a token": ("/", {}, "GET"),
    "with a wrong token": ("/?token=guessed", {}, "GET"),
    "with the token twice": ("/?token={token}&token=x", {}, "GET"),
    "by a name that resolves here": ("/?token={token}", {"host": f"attacker.example:{PORT}"}, "GET"),
    "with the host of another port": ("/?token={token}", {"host": f"127.0.0.1:{PORT + 1}"}, "GET"),
    "from another origin": ("/?token={token}", {"origin": "https://attacker.example"}, "GET"),
    "from another port of this machine": ("/{token}/record", {"origin": "http://127.0.0.1:9"}, "POST"),
    "by a form": ("/{token}/record", {"origin": "null", "content-type": "application/x-www-form-urlencoded"}, "POST"),
    "by a request that says no origin": ("/{token}/record", {"origin": ""}, "POST"),
    "by a script tag of another site": ("/{token}/app.js", {"sec-fetch-site": "cross-site", "origin": ""}, "GET"),
    "by a page of another port": ("/{token}/app.js", {"sec-fetch-site": "same-site", "origin": ""}, "GET"),
    "for the files without a token": ("/static/app.js", {}, "GET"),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_request_is_refused(served, way: str):
    client, token = served
    path, headers, method = WAYS[way]
    answer = client.request(
        method, path.format(token=token), headers={"host": HOST, **headers}, content=b"time,x\n1,2\n" * (method == "POST")
    )
    assert answer.status_code == 403
    assert "open the address that zakai studio printed" in answer.text


@pytest.mark.parametrize(
    ("path", "headers"),
    [
        ("/{token}/socket", {"host": HOST, "origin": "https://attacker.example"}),
        ("/{token}/socket", {"host": "attacker.example", "origin": "http://attacker.example"}),
        ("/guessed/socket", {"host": HOST, "origin": ORIGIN}),
        ("/{token}/socket", {"host": HOST, "origin": ""}),
        ("/socket", {"host": HOST, "origin": ORIGIN}),
    ],
)
def test_a_websocket_is_refused(served, path: str, headers: dict[str, str]):
    client, token = served
    with pytest.raises(WebSocketDisconnect), client.websocket_connect(path.format(token=token), headers=headers):
        pass


def test_the_page_is_answered_with_a_policy_that_loads_nothing_from_elsewhere(served):
    client, token = served
    answer = client.get(f"/?token={token}", headers={"host": HOST, "origin": ""})
    assert answer.status_code == 200
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy and "frame-ancestors 'none'" in policy
    assert not re.search(r"unsafe|https?:|\*", policy)
    assert not re.search(r"<script(?![^>]*src)|style=|\bon\w+=|https?://", answer.text)
    for name in ("app.js", "studio.css", "density.js", "axes.js", "panel.js", "icon.svg"):
        assert client.get(f"/{token}/{name}", headers={"host": HOST}).status_code == 200
    assert client.get(f"/{token}/..%2Fserver.py", headers={"host": HOST}).status_code == 404


def test_an_upload_is_bounded_and_a_bad_one_is_one_message(page: Page):
    assert page.upload(b"").json() == {"error": "the file is empty; drop a CSV file with a header"}
    assert "more than 1,000,000 rows" in page.upload(b"1\n" * 1_000_001).json()["error"]
    assert "larger than 64 MiB" in page.upload(b"x" * ((64 << 20) + 1)).json()["error"]
    for body in (
        b"\0\1\2",
        b"time,y1,y2\n1,2\n",
        b"time,y1,y2\n2,1,1\n1,1,1\n",
        b"a,b\n1,2\n",
        b"time," + b"c," * 300 + b"\n",
        b"\xff\xfe",
    ):
        number = page.upload(body).json()["file"]
        data = {"kind": "file", "file": number, "name": "mine.csv"}
        said = page.ask("columns", **data).get("error") or page.ask("describe", text=SPIRAL, data=data)["error"]
        assert said.startswith("mine.csv") and "\n" not in said
    other = {"kind": "file", "file": "../../etc/passwd"}
    assert "drop it again" in page.ask("describe", text=SPIRAL, data=other)["error"]


def test_a_record_of_a_file_is_filtered_as_by_the_library(page: Page, tmp_path):
    model = zakai.load_model("gallery:spiral-sensor")
    _, record = zakai.simulate(model, np.arange(1, 41) * 0.02, seed=7)
    record.to_csv(tmp_path / "r.csv", ["first", "second"])
    data = {"kind": "file", "file": page.upload((tmp_path / "r.csv").read_bytes()).json()["file"], "columns": ["second", "first"]}
    answer = page.ask("run", text=SPIRAL, data=data, name="main")
    swapped = zakai.Record(record.times, record.values[:, ::-1], "increments")
    assert answer["log_likelihood"] == zakai.filter(model, swapped).log_likelihood
    assert page.ask("picture", name="main")["frame"].size > 1000


def test_the_newest_of_several_requests_is_answered(page: Page):
    page.ask("run", text=SPIRAL, data=SIMULATED, name="main")
    for _ in range(20):
        last = page.send("picture", name="main", channel="picture")
    answered = []
    while not answered or answered[-1] != last:
        answered.append(page.receive()["id"])
    assert len(answered) < 20


def test_what_a_page_asked_for_ends_when_the_page_is_gone_and_goes_on_when_it_comes_back(monkeypatch):
    """A page that comes back in time finds its process, with the results that are kept there."""
    monkeypatch.setattr("zakai.studio.server.RELOAD", 1.0)
    client, token = studio()
    address = f"/{token}/socket"
    with client:
        runner = client.studio.runner
        with client.websocket_connect(address, headers={"host": HOST, "origin": ORIGIN}) as socket:
            before = Page(client, token, socket)
            before.ask("run", text=SPIRAL, data=SIMULATED, name="main")
        with client.websocket_connect(address, headers={"host": HOST, "origin": ORIGIN}) as socket:
            again = Page(client, token, socket)
            time.sleep(2.5)
            assert again.ask("picture", name="main")["frame"].size > 1000
            again.send("run", **LONG, method="yau-yau", name="other")
            while not runner.running:
                time.sleep(0.1)
        ends = time.monotonic() + 20.0
        while runner.running and time.monotonic() < ends:
            time.sleep(0.1)
        assert runner.running is None


def test_what_waits_is_answered_when_it_is_cancelled(page: Page):
    page.send("run", **LONG, method="yau-yau")
    waiting = page.send("predicted", name="main")
    time.sleep(0.5)
    page.send("cancel")
    while (answer := page.receive())["id"] != waiting:
        pass
    assert answer["cancelled"]


def test_a_run_is_cancelled_and_the_next_request_is_answered(page: Page):
    lorenz = zakai.gallery.text("lorenz")
    page.send("run", text=lorenz, data={"kind": "simulate", "until": 200.0, "step": 0.01, "seed": 0}, method="yau-yau")
    time.sleep(1.0)
    page.send("cancel")
    while not (answer := page.receive()).get("cancelled"):
        pass
    assert answer["error"] == "cancelled"
    assert page.ask("describe", text=SPIRAL, data=SIMULATED)["rows"] == 50


def test_text_that_takes_long_does_not_keep_the_next_one_waiting(page: Page):
    page.send("algebra", text=zakai.gallery.text("lorenz"))
    assert page.ask("check", text=SPIRAL)["model"]["state"] == ["x"]


def test_the_lines_for_a_shell_and_the_figures_of_a_record_do_not_wait_for_a_run(page: Page):
    data = {"kind": "simulate", "until": 200.0, "step": 0.01, "seed": 0}
    page.send("run", text=zakai.gallery.text("lorenz"), data=data, method="yau-yau")
    assert "zakai filter" in page.ask("shell", text=SPIRAL, data=SIMULATED)["text"]
    assert page.ask("describe", text=SPIRAL, data=SIMULATED)["rows"] == 50
    page.send("cancel")
    while not page.receive().get("cancelled"):
        pass


def test_a_task_that_fails_is_one_line_and_never_a_traceback(page: Page):
    page.ask("run", text=SPIRAL, data=SIMULATED, name="main")
    given = {"text": SPIRAL, "data": SIMULATED}
    for request in (
        {"do": "run", "text": SPIRAL},
        {"do": "picture", "name": "none"},
        {"do": "run", "text": None, "data": 3},
        {"do": "fit", **given},
        {"do": "__init__"},
        {"do": "export", "what": "/etc/passwd"},
        {"do": "run", "text": SPIRAL, "data": {"kind": "simulate", "until": 1e9, "step": 1e-9}},
        {"do": "slide", "text": SPIRAL, "name": "none"},
        {"do": "joint", "name": "main", "across": "x", "up": "x"},
        {"do": "run", **given, "options": {"x": 1}},
        {"do": "run", **given, "method": "benes"},
        {"do": "picture", "name": "main", "from": "a", "to": 1},
        {"do": "run", "text": SPIRAL, "data": {"kind": "simulate", "until": "much", "step": []}},
    ):
        said = page.ask(**request)["error"]
        assert "\n" not in said and "Traceback" not in said and "fault of zakai" not in said, request
    page.socket.send_text("[1, 2")
    assert "no request" in page.receive()["error"]


def test_a_task_that_needs_too_much_memory_ends_with_advice():
    program = """
from pathlib import Path
import numpy as np
from zakai.studio.session import Session
from zakai.studio.tasks import TASKS
from zakai.studio.worker import answer, limit_memory
TASKS["large"] = lambda *_: ({}, {"array": np.ones(1 << 29)})
limit_memory(2.0)
session = Session(Path())
session.results["main"] = None
print(answer(session, {"id": 1, "do": "large"}, 2.0, None), not session.results)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert "more memory than it may have (2 GiB)" in done.stdout and "--memory" in done.stdout and "True" in done.stdout


def test_a_task_says_that_kernels_are_compiled_while_they_are_and_what_takes_long():
    said: list[str] = []
    with saying(said.append):
        with compiled._compilation:
            time.sleep(1.5)
        time.sleep(0.5)
        logging.getLogger("zakai").warning("fit takes about %d s more", 20)
    compiling = "Kernels are being compiled, once for this machine; this takes up to a minute."
    assert said == [compiling, "", "fit takes about 20 s more"]
    said.clear()
    with saying(said.append):
        time.sleep(1.5)
    logging.getLogger("zakai").warning("afterwards")
    assert said == []


def test_a_profile_says_how_long_it_takes(monkeypatch, caplog, tmp_path):
    monkeypatch.setattr(_progress, "FIRST", 0.01)
    text = SPIRAL.replace('"t/40 * x"', '"-a*x"') + "[parameters]\na = 1.0\n"
    request = {"do": "profile", "text": text, "data": SIMULATED, "parameter": "a", "low": 0.5, "high": 2.0, "count": 5}
    computed(Session(tmp_path), request, 4.0, lambda *_: time.sleep(0.02))
    assert re.search(r"the profile of a takes (at most )?about \d+ to \d+ s more", caplog.text)


def test_a_worker_that_the_system_ends_is_replaced(served, page: Page):
    client, _ = served
    page.send("run", text=zakai.gallery.text("lorenz"), data={"kind": "simulate", "until": 200.0, "step": 0.01, "seed": 0})
    time.sleep(0.5)
    os.kill(client.studio.runner.process.pid, signal.SIGKILL)
    while "error" not in (answer := page.receive()):
        pass
    assert "it needed more memory than it may have" in answer["error"]
    assert page.ask("describe", text=SPIRAL, data=SIMULATED)["rows"] == 50


def test_a_file_that_grows_is_filtered_row_by_row(tmp_path):
    path = tmp_path / "growing.csv"
    model = zakai.load_model("gallery:spiral-sensor")
    _, record = zakai.simulate(model, np.arange(1, 31) * 0.02, seed=3)
    record.to_csv(tmp_path / "whole.csv")
    lines = (tmp_path / "whole.csv").read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:11]) + "0.2,much,1\n")
    client, token = studio(follow=Source(path))
    with client, client.websocket_connect(f"/{token}/socket", headers={"host": HOST, "origin": ORIGIN}) as socket:
        page = Page(client, token, socket)
        assert page.hello["follow"] == "growing.csv"
        page.send("follow", text=SPIRAL)
        while (answer := page.receive())["do"] != "stream-lines":
            assert "error" not in answer
        assert answer["count"] == 10 and "line 12: 'much' is not a number" in answer["faults"][0]
        with path.open("a") as file:
            file.write("".join(lines[11:]))
        while answer["count"] < 30:
            answer = page.receive()
        result = zakai.filter(model, record)
        assert answer["mean"] == pytest.approx(result.mean[-1], rel=1e-9) and answer["method"] == result.method
        assert page.ask("picture", name="stream")["frame"].size > 1000


def test_the_script_of_a_record_from_a_file_computes_the_same(page: Page, tmp_path):
    text = zakai.gallery.text("kalman-bucy-1d")
    data = {"kind": "file", "file": page.upload(b"time,y\n0.5,0.1\n1.25,\n2,-0.3\n").json()["file"], "name": "mine.csv"}
    answer = page.ask("run", text=text, data=data, name="main")
    script = page.ask("export", what="filter.py", text=text, data=data)["bytes"].tobytes()
    (tmp_path / "filter.py").write_bytes(script)
    done = subprocess.run([sys.executable, "filter.py"], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert f"log-likelihood {answer['log_likelihood']!r}" in done.stdout
    stored = page.ask("export", what="result.nc", name="main")["bytes"].tobytes()
    (tmp_path / "stored.nc").write_bytes(stored)
    assert zakai.load_result(tmp_path / "stored.nc").log_likelihood == answer["log_likelihood"]


HEATED = zakai.gallery.text("heated-room")


@pytest.mark.parametrize("simulated", [True, False])
def test_a_record_with_known_inputs_is_taken_away_whole(page: Page, tmp_path, simulated: bool):
    if simulated:
        data = {"kind": "simulate", "until": 3.0, "step": 0.5, "seed": 4, "inputs": {"heater": 1.5, "outdoor": -2}}
    else:
        rows = "time,outdoor,indoor,heater\n0.5,-2,19.5,1\n1,,19,\n1.5,-1,,0.5\n2.25,-1.5,18.5,2\n"
        number = page.upload(rows.encode()).json()["file"]
        data = {"kind": "file", "file": number, "name": "house.csv", "columns": ["indoor"], "inputs": ["heater", "outdoor"]}
    answer = page.ask("run", text=HEATED, data=data, name="main")
    assert "error" not in answer, answer
    (tmp_path / "model.toml").write_text(HEATED)
    (tmp_path / "record.csv").write_bytes(page.ask("export", what="record.csv", text=HEATED, data=data)["bytes"].tobytes())
    model = zakai.load_model(tmp_path / "model.toml")
    again = zakai.filter(model, zakai.read_record(tmp_path / "record.csv", model))
    assert again.log_likelihood == answer["log_likelihood"]
    (tmp_path / "filter.py").write_bytes(page.ask("export", what="filter.py", text=HEATED, data=data)["bytes"].tobytes())
    done = subprocess.run([sys.executable, "filter.py"], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert f"log-likelihood {answer['log_likelihood']!r}" in done.stdout
    lines = page.ask("shell", text=HEATED, data=data)["text"]
    done = subprocess.run(lines, cwd=tmp_path, shell=True, capture_output=True, text=True, check=True, env=shell_environment())
    assert zakai.load_result(tmp_path / "result.nc").log_likelihood == answer["log_likelihood"]


def shell_environment() -> dict[str, str]:
    """An environment in which `zakai` is the command of this interpreter."""
    return {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}


def test_true_states_of_a_file_are_shown_and_wrong_ones_are_one_line(page: Page):
    text = zakai.gallery.text("kalman-bucy-1d")
    number = page.upload(b"time,y\n0.5,0.1\n1.25,\n2,-0.3\n").json()["file"]
    truths = [b"time,x\n0,0.1\n0.5,0.2\n1.25,0.3\n2,0.2\n", b"time,x\n9,0.1\n", b"time,z\n0.5,0.1\n"]
    for truth, wrong in zip(truths, ["", "none of its times", "t.csv"]):
        named = {"file": page.upload(truth).json()["file"], "name": "t.csv"}
        data = {"kind": "file", "file": number, "name": "mine.csv", "truth": named}
        answer = page.ask("run", text=text, data=data, name="main")
        assert answer["truth"] if not wrong else wrong in answer["error"] and "\n" not in answer["error"]
        assert ".csv:" not in answer.get("error", "").replace("t.csv", "")


def test_what_is_not_valid_on_the_command_line_is_one_line():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        for arguments, words in (
            (["nosuch.toml"], "nosuch.toml"),
            (["gallery:benes", "nosuch.csv"], "nosuch.csv"),
            (["--port", port], "--port"),
        ):
            command = [sys.executable, "-m", "zakai", "studio", "--no-browser", *arguments]
            done = subprocess.run(command, capture_output=True, text=True, timeout=60)
            assert done.returncode == 2 and words in done.stderr and done.stderr.count("\n") == 1


@pytest.mark.parametrize("key", ["data", "values", "options", "text"])
@pytest.mark.parametrize("value", [5, "x", ["a", 1], {"kind": "file", "columns": 3}, {"kind": "simulate", "inputs": "u"}])
def test_an_address_that_holds_something_else_is_refused(key: str, value):
    given = {"text": SPIRAL, "data": SIMULATED, "do": "run", "id": 1, key: value}
    header = unpacked(computed(Session(Path()), given, 4.0, None))
    assert "error" in header and "fault of zakai" not in header["error"]


def test_the_script_of_a_record_with_dates_and_another_time_column_computes_the_same(page: Page, tmp_path):
    text = zakai.gallery.text("kalman-bucy-1d")
    rows = "level,stamp\n# a remark\n0.1,2024-01-01 00:30\n,2024-01-01 01:15\n-0.3,2024-01-01 02:00\n"
    number = page.upload(rows.encode()).json()["file"]
    dates = {"time": "stamp", "unit": "h", "origin": "2024-01-01"}
    data = {"kind": "file", "file": number, "name": "mine.csv", "columns": ["level"], **dates}
    assert page.ask("columns", **{**data, "time": None})["every"] == ["level", "stamp"]
    answer = page.ask("run", text=text, data=data, name="main")
    (tmp_path / "filter.py").write_bytes(page.ask("export", what="filter.py", text=text, data=data)["bytes"].tobytes())
    done = subprocess.run([sys.executable, "filter.py"], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert f"log-likelihood {answer['log_likelihood']!r}" in done.stdout
    assert "no column 'clock'" in page.ask("describe", text=text, data={**data, "time": "clock"})["error"]
    bad = page.upload(b"level,stamp\n0.1,1\n0.2,2\nmuch,3\n").json()["file"]
    wrong = {**data, "file": bad, "unit": None, "origin": None}
    assert page.ask("describe", text=text, data=wrong)["error"].startswith("mine.csv: row 4: 'much'")


@pytest.mark.parametrize(("step", "unit"), [("0.3", "s"), ("300", "min"), ("3600", "h"), ("86400", "d"), ("0.002", "ms")])
def test_the_unit_of_dates_suits_the_distances_of_the_rows(page: Page, step: str, unit: str):
    dates = np.datetime64("2024-01-01", "ns") + (np.arange(5) * float(step) * 1e9).astype("timedelta64[ns]")
    number = page.upload(("time,y\n" + "".join(f"{str(date)[:26]},1\n" for date in dates)).encode()).json()["file"]
    assert page.ask("columns", kind="file", file=number, name="mine.csv")["unit"] == unit


TABLED = """state = ["x"]  # of my own
drift = ["-x"]
observation = ["gain(x)"]
observation_kind = "samples"
[tables]
gain = { file = "gain.csv", kind = "linear" }
[prior]
kind = "gaussian"
mean = [0.0]
cov = [[0.5]]
"""


def test_the_script_of_a_model_with_a_table_in_a_file_holds_the_table(tmp_path):
    (tmp_path / "gain.csv").write_text("x,gain\n-3,-3\n0,1\n3,2\n")
    (tmp_path / "fresh").mkdir()
    client, token = studio(tables=tmp_path)
    given = {"data": {"kind": "simulate", "until": 1.0, "step": 0.1, "seed": 0}}
    with client, client.websocket_connect(f"/{token}/socket", headers={"host": HOST, "origin": ORIGIN}) as socket:
        page = Page(client, token, socket)
        answer = page.ask("run", text=TABLED, name="main", **given)
        script = page.ask("export", what="filter.py", text=TABLED, **given)["bytes"].tobytes()
        plain = TABLED.replace('file = "gain.csv", kind = "linear"', 'kind = "linear", x = [-3, 3], values = [-3, 2]')
        assert page.ask("export", what="model.toml", text=plain)["bytes"].tobytes().decode() == plain
    (tmp_path / "fresh" / "filter.py").write_bytes(script)
    done = subprocess.run([sys.executable, "filter.py"], cwd=tmp_path / "fresh", capture_output=True, text=True, check=True)
    assert f"log-likelihood {answer['log_likelihood']!r}" in done.stdout


def test_a_record_is_kept_while_the_model_changes(page: Page, tmp_path):
    data = {**SIMULATED, "from": SPIRAL}
    other = SPIRAL.replace("[[3.0]]", "[[1.0]]")
    assert other != SPIRAL
    answer = page.ask("run", text=other, data=data, name="main")
    drawn = page.ask("export", what="record.csv", text=SPIRAL, data=SIMULATED)["bytes"].tobytes()
    assert page.ask("export", what="record.csv", text=other, data=data)["bytes"].tobytes() == drawn
    (tmp_path / "filter.py").write_bytes(page.ask("export", what="filter.py", text=other, data=data)["bytes"].tobytes())
    done = subprocess.run([sys.executable, "filter.py"], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert f"log-likelihood {answer['log_likelihood']!r}" in done.stdout
    (tmp_path / "record.csv").write_bytes(drawn)
    (tmp_path / "model.toml").write_text(other)
    lines = page.ask("shell", text=other, data=data)["text"]
    subprocess.run(lines, cwd=tmp_path, shell=True, capture_output=True, check=True, env=shell_environment())
    assert zakai.load_result(tmp_path / "result.nc").log_likelihood == answer["log_likelihood"]
    said = page.ask("run", text=zakai.gallery.text("kalman-bucy-1d"), data=data)["error"]
    assert "press Simulate again" in said


def test_pictures_of_a_record_with_dates_count_in_dates(page: Page):
    """As the density does: the record, its observations with their predictions, and the residuals."""
    rows = "".join(f"2025-03-30 {8 + k // 4:02d}:{15 * (k % 4):02d},{0.1 * (k % 5)},0.2\n" for k in range(20))
    number = page.upload(f"time,a,b\n{rows}".encode()).json()["file"]
    data = {"kind": "file", "file": number, "name": "dates.csv", "columns": ["a", "b"], "unit": "h", "origin": "2025-03-30T07:00"}
    page.ask("run", text=SPIRAL, data=data, name="main")
    origin = (np.datetime64("2025-03-30T07:00") - np.datetime64("1970-01-01")) / np.timedelta64(1, "ms")
    described = page.ask("describe", text=SPIRAL, data=data)
    for answer in (described, page.ask("predicted", name="main"), page.ask("residuals", name="main")):
        assert answer["clock"] == pytest.approx({"origin": origin, "unit": 3600e3})
