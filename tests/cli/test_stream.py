"""`zakai stream`: a line in, a line out, whatever the lines are."""

from __future__ import annotations

import io
import json
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import zakai as package
from zakai.records.checkpoint import read_checkpoint, write_checkpoint
from zakai.records.stream import LONGEST, lines_of

# A test run in the background of a shell ignores SIGINT, and so would its children.
HEAR = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
COMMAND = [sys.executable, "-c", f"{HEAR}; from zakai.cli import main; raise SystemExit(main())", "stream", "model.toml"]
LINES = [json.dumps({"time": k / 10, "y": [round(np.sin(k), 3)]}) for k in range(1, 13)]


@pytest.fixture
def stream(zakai, monkeypatch):
    """The command with these bytes on standard input."""

    def run(given, *arguments, model="model.toml"):
        content = given if isinstance(given, bytes) else "".join(line + "\n" for line in given).encode()
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(content)))
        return zakai("stream", model, *arguments)

    return run


def read(answer):
    return [json.loads(line) for line in answer.out.splitlines()]


def test_every_line_is_answered_with_what_a_record_gives(stream, tmp_path):
    answer = stream(LINES)
    assert answer.code == 0 and answer.err == ""
    model = package.load_model("model.toml")
    given = [json.loads(line) for line in LINES]
    record = package.Record([one["time"] for one in given], [one["y"] for one in given], "increments")
    result, answers = package.filter(model, record), read(answer)
    assert list(answers[0]) == ["time", "mean", "cov", "interval", "log_likelihood_increment", "health"]
    assert np.allclose([one["mean"] for one in answers], result.mean[1:], rtol=0, atol=1e-12)
    assert np.allclose([one["cov"] for one in answers], result.cov[1:], rtol=0, atol=1e-12)
    deviations = 1.959963984540054 * np.sqrt(result.variance[1:])
    both = np.stack([result.mean[1:] - deviations, result.mean[1:] + deviations], axis=2)
    assert np.allclose([one["interval"] for one in answers], both, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("header", "separator", "comma"),
    [
        ("Time,y1", ",", "."), ("t,angle", ",", "."), ("TIME;y1", ";", ","), ("time\ty1", "\t", ","), ('"Time";"y1"', ";", "."),
        ("\ufeffTime,y1\r", ",", "."), ("# from the sensor\n# Time;y1", ";", ","),
    ],
)  # fmt: skip
def test_a_stream_is_read_in_the_dialects_of_records(stream, header, separator, comma):
    given = [json.loads(line) for line in LINES]
    rows = [f"{one['time']}{separator}{one['y'][0]}".replace(".", comma) for one in given]
    assert stream([header, *rows[:5], "# a comment", *rows[5:]]).out == stream(LINES).out
    missing = stream([header, f"0{comma}1{separator}NA"])
    assert missing.err == "" and missing.out == stream(['{"time": 0.1, "y": [null]}']).out


def test_csv_is_read_as_json_lines_are(stream):
    rows = ["time,angle", *(f"{one['time']},{one['y'][0]}" for one in map(json.loads, LINES))]
    assert stream(rows).out == stream(LINES).out
    assert stream([rows[0], "", "0.1,", "0.2,nan"]).out == stream(['{"time": 0.1, "y": [null]}', '{"time": 0.2, "y": null}']).out
    wrong = stream(["time,a,b", "1,2,3"])
    assert wrong.code == 2 and "line 1: 3 columns; the model needs 2: time" in wrong.err and wrong.err.count("\n") == 1


@pytest.mark.parametrize(
    "first", ["hour,y1", "y1,time", "u,angle-1", "hour;y1", "y1\ttime", '"Hour","y1"', "0.1,0.5", "\ufeffhour,y1\r"]
)
def test_a_stream_that_begins_like_csv_without_its_header_is_refused_once(stream, first):
    answer = stream([first, "0.1,0.5", "0.2,0.6"])
    assert answer.code == 2 and answer.out == "" and answer.err.count("\n") == 1
    assert (
        answer.err.startswith("error: standard input: line 1: ")
        and "looks like CSV, whose first line must be a header" in answer.err
    )
    assert "first the column time, then 1 for" in answer.err
    assert "line 3" in stream(["", "", first]).err


FIRST = [
    '0.05, "y": [0.5]}',  # a line that was cut off at its beginning, which is the least to be expected of a first line
    "0.5]}",
    "0.5, null]}",
    '{"time": 0.05, "y": [0.5',
    '{"time": 0.05, "y',
    "[0.05, 0.5]",
    "0.05",
    "garbage",
    "connected to the sensor, waiting",
    "INFO: ready, waiting",
    "a,,b",
]


def test_dates_are_times_from_an_origin(stream):
    numbers = read(stream(['{"time": 6, "y": [0.5]}', '{"time": 30.5, "y": [0.2]}']))
    days = "2024-01-01T06:00", "2024-01-02T06:30"
    clock = "--unit", "h", "--origin", "2024-01-01"
    lines = [f'{{"time": "{day}", "y": [{y}]}}' for day, y in zip(days, (0.5, 0.2), strict=True)]
    rows = ["time,y", *(f"{day},{y}" for day, y in zip(days, (0.5, 0.2), strict=True))]
    for given in (lines, rows):
        found = read(stream(given, *clock))
        assert [row.pop("date")[:16] for row in found] == list(days)
        assert found == numbers
    answer = stream(['{"time": 6, "y": [0.5]}', "{}", lines[0]], *clock)
    assert "line 1: the time is 6; write dates as" in answer.err and len(read(answer)) == 1
    assert "give a number (for dates: --unit and --origin)" in stream(lines).err
    alone = stream(lines, "--unit", "h")
    assert alone.code == 2 and "give both" in alone.err and "date" not in numbers[0]


@pytest.mark.parametrize("first", FIRST)
def test_another_first_line_is_one_bad_line_before_lines_of_json(stream, first):
    answer = stream([first, *LINES])
    assert answer.code == 0 and answer.out == stream(LINES).out
    assert answer.err.startswith("error: line 1: ") and answer.err.count("\n") == 1


def test_columns_are_matched_by_the_names_of_the_observations_in_any_order(stream, tmp_path):
    model = (tmp_path / "model.toml").read_text().replace('observation = ["x"]', 'observation = ["x", "2*x"]')
    (tmp_path / "two.toml").write_text(model)
    good = stream(["time,y1,y2", "0.1,0.5,0.6"], model="two.toml")
    assert good.code == 0
    for header in ("y2,y1", "y2,x"):
        assert stream([f"time,{header}", "0.1,0.6,0.5"], model="two.toml").out == good.out
    assert stream(["time,Y2,Y1", "0.1,0.5,0.6"], model="two.toml").out == good.out  # other names: by their position
    assert "columns" in stream(["time,y2,y1", "0.1,0.6"], model="two.toml").err


BAD = [
    (b"garbage", "not JSON"),
    (b'{"time": 0.55, "y": [1, 2]}', "2 columns"),
    (b'{"time": 0.55}', '"y"'),
    (b"[0.55, 1]", "not an object"),
    (b'{"time": 0.55, "y": [1e300]}', "1e+300"),
    (b'{"time": 0.55, "y": [Infinity]}', "Infinity is not a JSON number; null says"),
    (b'{"time": 0.55, "y": [NaN]}', "NaN is not a JSON number; null says"),
    (b'{"time": 0.55, "y": -Infinity}', "-Infinity is not a JSON number"),
    (b'{"time": 0.55, "y": [0.1], "more": NaN}', "NaN is not a JSON number"),
    (b'{"time": 0.55, "y": [1e999]}', "observation 1 is beyond the range of numbers"),
    (b'{"time": 0.55, "y": ["1"]}', 'observation 1 is "1"; give a number, or null'),
    (b'{"time": 0.55, "y": ["\x7f"]}', 'observation 1 is "\\u007f"'),
    (b'{"time": 0.55, "y": [false]}', "observation 1 is false"),
    (b'{"time": 0.55, "y": [[1]]}', "observation 1 is a list"),
    (b'{"time": 0.55, "y": [{}]}', "observation 1 is an object"),
    (b'{"time": null, "y": [1]}', "the time is null; give a number"),
    (b'{"time": NaN, "y": [1]}', "NaN is not a JSON number"),
    (b'{"time": true, "y": [1]}', "the time is true"),
    (b'{"time": 0.25, "y": [1]}', "late by 0.25"),
    (b'{"time": 0.5, "y": [1]}', "repeats"),
    (b'{"time": 0.55, "time": 0.56, "y": [1]}', 'the key "time" stands twice'),
    (b'{"time": 0.55, "y": [1], "more": {"a": 1, "b": 2, "a": 1}}', 'the key "a" stands twice'),
    (b'{"time": 1' + b"0" * 5000 + b', "y": [1]}', "an integer of 5001 characters is too long"),
    (b'{"time": 1' + b"0" * 400 + b', "y": [1]}', "the time is 1000"),
    (b'{"time": 0.55, "y": ' + b"[" * 100_000 + b"]" * 100_000 + b"}", "nested too deep"),
    (b"[" * 5000, "JSON"),
    (b"\xff\xfe", "UTF-8"),
    (b"x" * (3 * LONGEST), "longer"),
]


def test_a_bad_line_is_said_by_its_number_and_leaves_the_filter_as_it_was(stream):
    good = [line.encode() for line in LINES]
    clean = stream(b"\n".join(good)).out
    answer = stream(b"\n".join([*good[:5], *(line for line, _ in BAD), *good[5:]]))
    assert answer.code == 0 and answer.out == clean
    said = answer.err.splitlines()
    assert len(said) == len(BAD)
    for number, (line, (_, words)) in enumerate(zip(said, BAD, strict=True), start=6):
        assert line.startswith(f"error: line {number}: ") and words in line and len(line) < 300, line
        assert line.isprintable()


def test_strict_stops_at_the_first_bad_line(stream):
    answer = stream([*LINES[:3], "garbage", *LINES[3:]], "--strict")
    assert answer.code == 2 and len(read(answer)) == 3
    assert answer.err.startswith("error: standard input: line 4: ") and answer.err.count("\n") == 1


def test_fewer_lines_and_fewer_fields_when_asked_for(stream):
    full = read(stream(LINES))
    answer = read(stream(LINES, "--every", "4", "--fields", "mean, time"))
    assert answer == [{"mean": one["mean"], "time": one["time"]} for one in full[3::4]]
    assert "no field" in stream(LINES, "--fields", "median").err
    assert stream(LINES, "--every", "0").code == 2
    assert "--checkpoint" in stream(LINES, "--checkpoint-every", "2").err


def test_a_method_that_does_not_hold_and_a_model_that_is_not_there_have_their_codes(stream):
    assert stream(LINES, "--method", "benes").code == 3
    assert stream(LINES, model="none.toml").code == 2
    assert stream(LINES, "--method", "kalman-bucy", "--option", "points=3").code == 2
    assert stream(LINES, "--method", "extended-kalman-bucy").code == 0


@pytest.mark.parametrize("every", [1, 4])
def test_a_restart_skips_what_the_checkpoint_knows_and_says_its_estimate_again(stream, tmp_path, every):
    whole = stream(LINES).out.splitlines()
    saved = ("--checkpoint", "state", "--checkpoint-every", str(every))
    first = stream(LINES[:9], *saved).out.splitlines()
    known = 9 // every * every
    assert first == whole[:9]
    for replayed in (0, 3, known):
        content = (tmp_path / "state").read_bytes()
        again = stream(LINES[replayed:10], *saved)
        assert again.out.splitlines() == whole[known - 1 : 10] and again.err == ""
        (tmp_path / "state").write_bytes(content)
    late = stream([*LINES, LINES[2]], *saved)
    assert "line 13" in late.err and "late" in late.err


@pytest.mark.parametrize("accepted", ["x", None, True, -1, 2.0, 10**30, [1]])
def test_a_checkpoint_that_does_not_say_how_many_lines_it_knows_is_refused(stream, accepted):
    assert stream(LINES[:3], "--checkpoint", "state").code == 0
    about, arrays = read_checkpoint("state")
    assert about["more"] == {"accepted": 3}
    write_checkpoint("state", {**about, "more": {"accepted": accepted}}, arrays)
    answer = stream(LINES, "--checkpoint", "state")
    assert answer.code == 2 and answer.out == "" and answer.err.count("\n") == 1
    assert "does not say how many observations" in answer.err


def test_a_checkpoint_that_does_not_fit_is_refused(stream, tmp_path):
    (tmp_path / "state").write_bytes(b"junk")
    answer = stream(LINES, "--checkpoint", "state")
    assert answer.code == 2 and "not a checkpoint" in answer.err and answer.out == ""
    assert (tmp_path / "state").read_bytes() == b"junk"
    assert "also an input" in stream(LINES, "--checkpoint", "model.toml").err
    assert stream(LINES, "--checkpoint", "none/state").code == 2


def test_lines_are_counted_and_bounded():
    long = b"a" * (5 * LONGEST) + b"\n"
    lines = list(lines_of(io.BytesIO(b'\xef\xbb\xbf{"time": 1, "y": 2}\r\n\n' + long + b'{"time": 2, "y": [null]}'), 1))
    assert [line.number for line in lines] == [1, 3, 4]
    assert lines[0].values == [2] and "longer" in lines[1].fault and lines[2].values == [None]


def fed(process, lines):
    process.stdin.write("".join(line + "\n" for line in lines).encode())
    process.stdin.flush()


def test_a_killed_stream_goes_on_with_the_same_bits_and_an_interrupted_one_says_130(stream, tmp_path):
    whole = stream(LINES).out.splitlines()
    start = dict(stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=tmp_path)
    killed = subprocess.Popen([*COMMAND, "--checkpoint", "state"], **start)
    fed(killed, LINES[:6])
    printed = [killed.stdout.readline().decode().rstrip() for _ in range(6)]  # each line is there before the next is sent
    fed(killed, LINES[6:8])
    time.sleep(0.002)
    killed.kill()
    printed += killed.communicate()[0].decode().splitlines()
    again = stream(LINES, "--checkpoint", "state").out.splitlines()
    assert printed == whole[: len(printed)] and again == whole[-len(again) :]
    assert len(printed) + len(again) >= len(whole)

    # An orderly exit may take longer than the 2 s after which an interruption is raised again.
    slowly = [part.replace("sys.exit(main())", "code = main(); time.sleep(2.2); sys.exit(code)") for part in COMMAND]
    slowly[2] = "import time; " + slowly[2]
    stopped = subprocess.Popen(slowly, **start)
    try:
        fed(stopped, LINES[:1])
        assert stopped.stdout.readline().decode().rstrip() == whole[0]
        stopped.send_signal(signal.SIGINT)
        assert stopped.wait(60) == 130
    finally:
        stopped.kill()
        stopped.communicate()


def test_a_reader_that_closes_the_pipe_is_no_error(tmp_path, stream):
    lines = [json.dumps({"time": k / 10, "y": [0.1]}) for k in range(1, 3000)]
    (tmp_path / "lines").write_text("".join(line + "\n" for line in lines))
    with open(tmp_path / "lines", "rb") as given:
        process = subprocess.Popen(COMMAND, stdin=given, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=tmp_path)
        process.stdout.readline()
        process.stdout.close()
        assert process.wait(30) == 0
        assert process.stderr.read() == b""
        process.stderr.close()
