"""What a user takes away: files that hold or compute the same again without the studio."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from decimal import Decimal
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from zakai.errors import InputError
from zakai.models.files import read_keys
from zakai.records.writing import write_table
from zakai.studio.running import method_of
from zakai.studio.session import Answer, Held, Report, Session

EMBEDDED = 5_000  # numbers of a record that stand in a script itself


def export(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Return a file: its name, its type, and its bytes."""
    what = str(request.get("what"))
    makers: dict[str, Callable[..., bytes]] = {
        "model.toml": lambda: _text(session.model(request), request).encode(),
        "record.csv": lambda: _record(session.model(request), session.given(session.model(request), request)),
        "result.nc": lambda: _saved(session.held(request), "result.nc"),
        "result.csv": lambda: _saved(session.held(request), "result.csv"),
        "report.html": lambda: _report(session.held(request)),
        "filter.py": lambda: script(session, request).encode(),
    }
    if what not in makers:
        raise InputError(f"export: there is no file {what[:40]!r}; the files are {', '.join(makers)}")
    body = makers[what]()
    return {"name": what}, {"bytes": np.frombuffer(body, np.uint8)}


def _saved(held: Held, name: str) -> bytes:
    with TemporaryDirectory() as folder:
        held.result.save(Path(folder) / name)
        return (Path(folder) / name).read_bytes()


def _report(held: Held) -> bytes:
    with TemporaryDirectory() as folder:
        held.result.report(Path(folder) / "report.html", truth=held.truth)
        return (Path(folder) / "report.html").read_bytes()


def _record(model: Any, found: Any) -> bytes:
    """Return the record as CSV, with its known inputs as further columns."""
    record = found.record
    names, values = list(record.names or model.observation_names), record.values
    if record.inputs is not None:
        # They change at rows alone: a row whose time is not among theirs is empty.
        at = np.searchsorted(record.inputs.times, record.times, side="right") - 1
        known = record.inputs.values[np.maximum(at, 0)]
        changes = np.isin(record.times, record.inputs.times) & (np.diff(record.times, prepend=-np.inf) > 0)
        changes[0] = True  # holds from the start
        names += list(model.inputs)
        values = np.column_stack([values, np.where(changes[:, None], known, np.nan)])
    with TemporaryDirectory() as folder:
        path = Path(folder) / "record.csv"
        write_table(path, record.times, values, names, record.dates)
        return path.read_bytes()


def script(session: Session, request: Mapping[str, Any]) -> str:
    """Return a Python script that computes the same numbers, from nothing but zakai and, of a long record, its file."""
    model = session.model(request)
    found = session.given(model, request)
    wanted, record = request["data"], found.record
    method, options = method_of(request)
    text = _text(model, request)
    lines = [
        f'"""{_one_line(model.name or "A model")}: filtered as in zakai studio."""',
        "",
        "import tomllib",
        "from decimal import Decimal",
        "",
        "import numpy as np",
        "",
        "import zakai",
        "",
        f"MODEL = {_literal(text)}",
        "",
        "model = zakai.Model(**tomllib.loads(MODEL, parse_float=Decimal))",
    ]
    if _is_simulated(request):
        lines += _simulated(model, wanted, record)
    elif record.values.size + record.times.size <= EMBEDDED:
        lines += _embedded(model, record)
    else:
        lines.append(_from_file(wanted, found.name))
    arguments = "".join(f", {key}={value!r}" for key, value in options.items())
    lines += [
        f'result = zakai.filter(model, record, method="{method}"{arguments})',
        "for warning in result.warnings:",
        '    print("warning:", warning)',
        'print("method", result.method)',
        'print("log-likelihood", repr(result.log_likelihood))',
        'print("mean at the end", result.mean[-1].tolist())',
        'print("deviation at the end", np.sqrt(result.variance[-1]).tolist())',
        'result.save("result.nc")',
    ]
    return "\n".join(lines) + "\n"


def _is_simulated(request: Mapping[str, Any]) -> bool:
    """Return whether the record is simulated by the model of the request, not by another one or given as a file."""
    wanted = request["data"]
    return bool(wanted.get("kind") != "file" and wanted.get("from") in (None, request["text"]))


def _text(model: Any, request: Mapping[str, Any]) -> str:
    """Return the text of the page, or where the tables are in files a text that holds them."""
    files = any("file" in table for table in (read_keys(request["text"]).get("tables") or {}).values())
    return str(model.text if files else request["text"])


def _simulated(model: Any, wanted: Mapping[str, Any], record: Any) -> list[str]:
    from zakai.models.clock import clock

    until, step, seed = float(wanted["until"]), float(wanted["step"]), int(wanted.get("seed", 0))
    count = len(clock(model.start, until, step))
    digits = max(-int(Decimal(repr(number)).as_tuple().exponent) for number in (model.start, step))
    steps = f"{model.start!r} + {step!r} * np.arange(1, {count + 1})"
    lines = [f"times = np.round({steps}, {digits})" if 0 < digits < 12 else f"times = {steps}"]
    if record.inputs is not None:
        lines.append(f"inputs = zakai.Inputs({record.inputs.times.tolist()!r}, {record.inputs.values.tolist()!r})")
        return [*lines, f"truth, record = zakai.simulate(model, times, seed={seed}, inputs=inputs)"]
    return [*lines, f"truth, record = zakai.simulate(model, times, seed={seed})"]


def _embedded(model: Any, record: Any) -> list[str]:
    table = np.column_stack([record.times, record.values]).tolist()
    rows = ["    [" + ", ".join(map(repr, row)) + "]," for row in table]
    lines = ["nan = float('nan')", "rows = np.array([  # time, and what was observed", *rows, "])"]
    inputs = ""
    if record.inputs is not None:
        times, values = (f"np.array({part.tolist()!r})" for part in (record.inputs.times, record.inputs.values))
        lines.append(f"inputs = zakai.Inputs.of_rows({times}, {values})")
        inputs = ", inputs=inputs"
    clock = {} if record.clock is None else record.clock._asdict()
    dates = "".join(f", {key}={str(value)!r}" for key, value in clock.items())
    return [*lines, f'record = zakai.Record(rows[:, 0], rows[:, 1:], "{record.kind}"{inputs}{dates})']


def _from_file(wanted: Mapping[str, Any], name: str) -> str:
    more = "".join(f", {key}={wanted[key]!r}" for key in ("unit", "origin") if wanted.get(key))
    if wanted.get("kind") != "file" or wanted.get("time"):
        return f'record = zakai.read_record("record.csv", model{more})  # the record among the exports'
    columns = f", columns={list(wanted['columns'])!r}" if wanted.get("columns") else ""
    return f"record = zakai.read_record({name!r}, model{more}{columns})  # the file that was given to the studio"


def _literal(text: str) -> str:
    """Return a text as a Python literal, over several lines where that is plain."""
    if '"""' in text or "\\" in text or not text.isprintable() and any(not c.isprintable() and c != "\n" for c in text):
        return repr(text)
    return f'"""\\\n{text}"""' if not text.endswith('"') else repr(text)


def _one_line(text: str) -> str:
    return re.sub(r"[^\w .,:;()+-]", " ", text)[:100].strip()


def shell(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Return the lines for a shell that do the same with the files model.toml and record.csv."""
    model = session.model(request)
    wanted = request["data"]
    method, options = method_of(request)
    extra = "" if method == "auto" else f" --method {method}"
    extra += "".join(f" --option {key}={value}" for key, value in options.items())
    lines = []
    if not _is_simulated(request):
        extra += "".join(f" --{key} '{_one_line(str(wanted[key]))}'" for key in ("unit", "origin") if wanted.get(key))
    else:
        until, step, seed = wanted.get("until"), wanted.get("step"), wanted.get("seed", 0)
        known = ""
        if model.inputs:
            values = wanted.get("inputs") or {}
            row = ",".join(str(float(value)) for value in (model.start, *(values.get(name, 0) for name in model.inputs)))
            lines.append(f"printf 'time,{','.join(model.inputs)}\\n{row}\\n' > inputs.csv")
            known = " --inputs inputs.csv"
            extra += known
        lines.append(f"zakai simulate model.toml --until {until} --step {step} --seed {seed}{known} -o record.csv")
    lines.append(f"zakai filter model.toml record.csv -o result.nc{extra}")
    return {"text": "\n".join(lines)}, {}


TASKS: dict[str, Callable[..., Answer]] = {"export": export, "shell": shell}
