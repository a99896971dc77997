"""The commands analyze, methods and gallery."""

from __future__ import annotations

import textwrap
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from zakai import _registry
from zakai.errors import InputError, ZakaiError

if TYPE_CHECKING:
    from zakai.models.model import Model
    from zakai.records import Record

EACH, MOST_SECONDS = 2.5, 8.0  # for which expected times are measured: of one method, and of all


def analyze(source: str, json: bool, latex: bool) -> None:
    """Print the analysis of a model."""
    from zakai.algebra.analysis import analyze
    from zakai.models.files import load_model

    if json and latex:
        raise InputError("--json and --latex: give one of them")
    analysis = analyze(load_model(source))
    print(analysis.to_json() if json else analysis.to_latex() if latex else analysis)


class RecordFile(NamedTuple):
    """The file of a record, and how it is read."""

    path: Path
    inputs: Path | None = None
    unit: str | None = None
    origin: str | None = None
    columns: str = ""


def methods(source: str | None, given: RecordFile | None = None) -> None:
    """Print the methods and, for a model, whether each holds and what fails; for a record, how long those take that hold."""
    if source is None:
        _columns([(name, entry.summary) for name, entry in _registry.METHODS.items()])
        print(f"\nauto takes the first that holds of: {', '.join(_registry.AUTO)}")
        print(f"\npeers, filters of other libraries to compare with; pip install 'zakai[{_registry.EXTRA}]':")
        _columns([(name, entry.summary) for name, entry in _registry.PEERS.items()])
        return
    from zakai.algebra.analysis import analyze
    from zakai.algebra.conditions import all_hold
    from zakai.models.files import load_model

    model = load_model(source)
    record = None if given is None else _record(given, model)
    analysis = analyze(model)
    rows, ends = [], time.monotonic() + MOST_SECONDS
    holding = [name for name, conditions in analysis.methods.items() if record is not None and all_hold(conditions)]
    # The method that auto takes is measured first, lest the others leave no time for it.
    ordered = sorted(holding, key=lambda name: name != analysis.recommended)
    times = {name: _expected(model, record, name, ends) for name in ordered} if record is not None else {}
    for name, conditions in analysis.methods.items():
        held = all_hold(conditions)
        open_ones = [c for c in conditions if c.holds is held]
        verdict = {True: "holds", False: "fails: ", None: "undecided: "}[held]
        words = verdict + ("" if held else f"{open_ones[0].statement} ({open_ones[0].evidence})")
        if held and name == "guided-particles":
            words += _split(model)
        if name in times:
            words += f"; {times[name]} for this record"
        rows.append((name, words))
    _columns(rows)
    print(f"\nauto takes: {analysis.recommended or 'none, for none that it tries holds'}")
    if analysis.why:
        print(textwrap.fill(analysis.why, 110, break_on_hyphens=False))


def _split(model: Model) -> str:
    """Return what particles do with states that are linear given the others, after a semicolon; "" where there are none."""
    from zakai.algebra.conditionally_linear import conditionally_linear
    from zakai.methods.particles.split import split_of

    found, split = conditionally_linear(model), split_of(model)
    if not found or not found.given:
        return ""
    if not split.linear:
        return f"; {', '.join(found)} linear given {', '.join(found.given)}, and drawn with moves of the past: {split.reason}"
    linear = [model.state[i] for i in split.linear]
    given = ", ".join(name for name in model.state if name not in linear)
    unless = ", if the path of these does not give them away within an interval, and" if split.coupled else ", if"
    return f"; each particle carries the mean and the covariance of {', '.join(linear)} given {given}{unless} that saves time"


def _record(given: RecordFile, model: Model) -> Record:
    """Read a record with its inputs."""
    from zakai.cli.filtering import record_with_inputs

    return record_with_inputs(given.path, model, given.inputs, given.unit, given.origin, given.columns)


def _expected(model: Model, record: Record, name: str, ends: float) -> str:
    """Return the expected time of a method for a record, or why there is none; it is measured before `ends`."""
    from zakai.diagnostics.expected_time import expected_seconds

    left = ends - time.monotonic()
    if left <= 0.0:
        return "time not measured"
    try:
        return str(expected_seconds(model, record, name, most=min(EACH, left)))
    except ZakaiError as error:
        return f"no time, for it refuses this record ({error})"


def gallery(name: str | None) -> None:
    """Print the names of the gallery, or one file of it."""
    from zakai.models import gallery

    if name is not None:
        print(gallery.text(name.removeprefix("gallery:")), end="")
        return
    _columns([(name, gallery.describe(name)) for name in gallery.names()])


def _columns(rows: list[tuple[str, str]]) -> None:
    width = max(len(name) for name, _ in rows) + 2
    for name, words in rows:
        print(textwrap.fill(words, 110, initial_indent=name.ljust(width), subsequent_indent=" " * width, break_long_words=False))


def warm_up() -> None:
    """Compile the kernels, and print how many and where they are kept."""
    from zakai.engine.warm_up import warm_up as compile_kernels

    found = compile_kernels()
    print(f"compiled  {found.kernels} kernels in {found.seconds:.0f} s")
    if found.folder is None:
        raise InputError(
            "warm-up: no folder for compiled kernels can be written, so that every process compiles them again; set "
            "NUMBA_CACHE_DIR to a folder that can be written"
        )
    print(f"kept in   {found.folder}")
