"""Run zakai stream."""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from zakai.cli import _interrupt
from zakai.cli._files import check_outputs
from zakai.cli.filtering import options_of
from zakai.errors import InputError
from zakai.models.files import load_model
from zakai.records.dates import dated
from zakai.records.stream import Line, lines_of
from zakai.records.writing import shown

FIELDS: dict[str, Callable[[Any], Any]] = {
    "time": lambda estimate: estimate.time,
    "date": lambda estimate: str(estimate.date),
    "mean": lambda estimate: _plain(estimate.mean.tolist()),
    "cov": lambda estimate: _plain(estimate.cov.tolist()),
    "interval": lambda estimate: _plain(estimate.interval(0.95).tolist()),
    "log_likelihood_increment": lambda estimate: _plain(estimate.log_likelihood_increment),
    "health": lambda estimate: {name: _plain(figure) for name, figure in estimate.health.items()},
}
_NUMBERS = re.compile(r"[-+]?\d[\d.,]*(e[-+]?\d+)?")


def stream(
    source: str,
    method: str,
    settings: list[str],
    checkpoint: Path | None,
    checkpoint_every: int | None,
    strict: bool,
    every: int,
    fields: str,
    unit: str | None = None,
    origin: str | None = None,
) -> None:
    """Filter the lines of standard input, and print a line of JSON for each; wrong arguments are refused before the first."""
    if checkpoint is None and checkpoint_every is not None:
        raise InputError("--checkpoint-every: needs --checkpoint FILE")
    if (unit is None) != (origin is None):
        raise InputError("--unit and --origin: give both, the unit of the model's time and the date at which t = 0, or none")
    wanted = _wanted(fields, unit is not None)
    check_outputs([checkpoint], [source])
    options = options_of(settings)
    model = load_model(source)

    from zakai.engine.online import online

    found = online(model, method, unit=unit, origin=origin, **options)
    _Stream(found, wanted, every, checkpoint, checkpoint_every or 1, strict).run()


class _Stream:
    """An online filter between standard input and standard output."""

    def __init__(self, online: Any, fields: list[str], every: int, checkpoint: Path | None, save_every: int, strict: bool):
        self.online, self.fields, self.every, self.strict = online, fields, every, strict
        self.checkpoint, self.save_every = checkpoint, save_every
        self.accepted = 0
        self.warned: set[str] = set()
        self.skip_until: float | None = None

    def run(self) -> None:
        if self.checkpoint is not None and self.checkpoint.exists():
            self.accepted = _count(self.online.restore(self.checkpoint).get("accepted", 0), self.checkpoint)
            if self.accepted:
                self.skip_until = self.online.time
                self.show(self.online.last)
        _interrupt.insist()
        model = self.online.model
        for line in lines_of(sys.stdin.buffer, model.m, model.inputs, self.online.clock, model.observation_names):
            _interrupt.check()
            try:
                estimate = self.used(line)
            except InputError as error:
                fault = f"line {line.number}: {error}"
                if self.strict:
                    raise InputError(f"standard input: {fault}") from None
                print(f"error: {' '.join(fault.split())}", file=sys.stderr, flush=True)
                continue
            if estimate is not None:
                # First the answer, then the checkpoint: every line that a checkpoint has used was answered.
                self.show(estimate)
                if self.checkpoint is not None and self.accepted % self.save_every == 0:
                    self.online.save(self.checkpoint, {"accepted": self.accepted})

    def used(self, line: Line) -> Any:
        """Return the estimate after a line, or None where the checkpoint has used the line already.

        Raises:
            InputError: the line cannot be used.
        """
        if line.fault is not None:
            raise InputError(line.fault)
        if self.skip_until is not None and line.time <= self.skip_until:
            return None
        estimate = self.online.update(line.time, line.values, line.inputs)
        self.skip_until = None
        self.accepted += 1
        return estimate

    def show(self, estimate: Any) -> None:
        """Print an estimate if it is one of every N, and its new warnings."""
        for warning in estimate.warnings:
            kind = _NUMBERS.sub("0", warning)
            if kind not in self.warned:
                self.warned.add(kind)
                (when,) = dated([f"t = {estimate.time:.12g}"], self.online.clock)
                print(f"warning: from {when} on: {warning}", file=sys.stderr, flush=True)
        if self.accepted % self.every == 0:
            sys.stdout.write(json.dumps({name: FIELDS[name](estimate) for name in self.fields}, allow_nan=False) + "\n")
            sys.stdout.flush()


def _count(said: Any, checkpoint: Path) -> int:
    """Return the number of observations that a checkpoint has used."""
    if type(said) is not int or not 0 <= said < 2**53:
        raise InputError(f"{shown(checkpoint)}: does not say how many observations it knows; remove it to start again")
    return said


def _wanted(fields: str, dated: bool) -> list[str]:
    known = [name for name in FIELDS if dated or name != "date"]
    names = [name.strip() for name in fields.split(",")] if fields else known
    for name in names:
        if name not in known:
            raise InputError(f'--fields: there is no field "{name}"; the fields are {", ".join(known)}')
    return names


def _plain(value: Any) -> Any:
    """Return numbers as JSON holds them, with null for non-finite values."""
    if isinstance(value, list):
        return [_plain(part) for part in value]
    return value if math.isfinite(value) else None
