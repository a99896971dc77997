"""Tasks that filter, and that draw a result."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import Any

from zakai.engine.driver import filter as run_filter
from zakai.errors import InputError
from zakai.records import Record
from zakai.report import words
from zakai.studio import pictures
from zakai.studio.session import Answer, Held, Report, Session, state_of

MOST_PAIRS = 45


def run(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Filter a record, keep the result under its name, and return what there is to say about it."""
    model = session.model(request)
    found = session.given(model, request)
    method, options = method_of(request)
    result = run_filter(model, found.record, method, progress=report, **options)
    held = Held(result, found.truth, found)
    session.keep(str(request.get("name") or "main"), held)
    return summary(held), {}


def keep(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Keep a result under a further name."""
    held = session.held(request, "of")
    session.keep(str(request.get("name")), held)
    return summary(held), {}


def method_of(request: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return the method that a request names, and its options: numbers, true, false and texts."""
    options: dict[str, Any] = {}
    for key, value in (request.get("options") or {}).items():
        if key in ("model", "record", "method", "keep", "progress", "inputs"):
            raise InputError(f"{key}: is not an option of a method")
        if value not in (None, ""):
            options[str(key)] = _value(value)
    return str(request.get("method") or "auto"), options


def _value(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    for kind in (int, float):
        try:
            return kind(value)
        except ValueError:
            continue
    return {"true": True, "false": False, "none": None}.get(value.lower(), value)


def summary(held: Held) -> dict[str, Any]:
    """Return a result in figures and words."""
    result = held.result
    health = []
    for name, figures in result.health.items():
        bound = words.health_bound(result, name)
        health.append(
            {
                "name": words.spoken(name),
                "about": words.health_words(result, name),
                "span": words.health_span(figures),
                "bound": bound,
            }
        )
    count = len(result.times) - 1
    names = list(result.state)
    error = result.log_likelihood_standard_error
    return {
        "method": result.method,
        "why": result.why,
        "kind": words.kind_of(result),
        "verdict": words.verdict(result),
        "warnings": list(result.warnings),
        "log_likelihood": result.log_likelihood,
        "log_likelihood_error": error,
        "observations": count,
        "states": names,
        "pairs": list(itertools.islice(itertools.combinations(names, 2), MOST_PAIRS)),
        "first": float(result.times[0]),
        "last": float(result.times[-1]),
        "health": health,
        "densities": result.has_densities,
        "unit": None if result.clock is None else result.clock.unit,
        "origin": None if result.clock is None else str(result.clock.origin)[:19],
        "truth": held.truth is not None,
    }


def picture(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Return the density of one state over the times that are seen."""
    held = session.held(request)
    view = pictures.View.of(request)
    return {}, pictures.density_picture(held.result, state_of(held.result, request), held.truth, view)


def joint(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Return the density of two states at several times."""
    held = session.held(request)
    pair = state_of(held.result, request, "across"), state_of(held.result, request, "up")
    return {}, pictures.joint_picture(held.result, pair, held.truth)


def rows_of(record: Record, start: int, stop: int) -> Record:
    """Return some rows of a record, with its inputs."""
    if start == 0 and stop == len(record):
        return record
    clock = {} if record.clock is None else record.clock._asdict()
    return Record(record.times[start:stop], record.values[start:stop], record.kind, record.inputs, **clock)


TASKS: dict[str, Callable[..., Answer]] = {"run": run, "keep": keep, "picture": picture, "joint": joint}
