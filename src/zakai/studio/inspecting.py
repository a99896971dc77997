"""Tasks on a model and a record before they are filtered."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from zakai import _registry
from zakai.errors import InputError, ZakaiError
from zakai.models import gallery as gallery_models
from zakai.models.files import read_keys
from zakai.models.model import Model
from zakai.studio import data
from zakai.studio.session import MODEL, Answer, Report, Session
from zakai.studio.text import place_of_error, shown, with_values

MOST_TEXT = 1 << 20
EACH, MOST_SECONDS = 2.5, 8.0  # for which expected times are measured: of one method, and of all


def check(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Read a model's text: what it holds and its equations, or the error with its place; and its keys for the form."""
    text = str(request.get("text", ""))
    header: dict[str, Any] = {"form": _form(text)}
    try:
        model = session.model(request)
    except ZakaiError as error:
        message = " ".join(str(error).split()).removeprefix(f"{MODEL}: ")
        place = place_of_error(text, message) if len(text) <= MOST_TEXT else None
        return {**header, "fault": message, "place": None if place is None else place._asdict()}, {}
    return {**header, "model": _described(model)}, {}


def _form(text: str) -> Any:
    try:
        return shown(read_keys(text)) if len(text) <= MOST_TEXT else None
    except InputError:
        return None


def _described(model: Model) -> dict[str, Any]:
    from zakai.report.equations import equations

    return {
        "name": model.name,
        "state": list(model.state),
        "periodic": list(model.periodic),
        "observations": list(model.observation_names),
        "inputs": list(model.inputs),
        "kind": model.observation_kind,
        "kind_given": model.kind_given,
        "parameters": {name: float(value) for name, value in model.parameters.items()},
        "prior": model.prior is not None,
        "functions": list(model.functions),
        "start": model.start,
        "equations": equations(model),
    }


def write(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Return the model's text with other values of some keys."""
    changes = request.get("changes")
    if not isinstance(changes, Mapping):
        raise InputError("the form has no changes; reload the page")
    return {"text": with_values(str(request.get("text", "")), changes)}, {}


def gallery(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Return the models that come with zakai, each with a line about it and its text."""
    names = gallery_models.names()
    return {
        "models": [{"name": name, "about": gallery_models.describe(name), "text": gallery_models.text(name)} for name in names]
    }, {}


def columns(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Return the columns of a file."""
    return data.columns_of(request, session.folder), {}


def describe(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Return what a record holds."""
    model = session.model(request)
    found = session.given(model, request)
    return data.described(model, found)


def methods(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Return whether each method holds for a model, why not, and which one is taken."""
    from zakai.algebra.analysis import analyze
    from zakai.algebra.conditions import all_hold

    model = session.model(request)
    analysis = analyze(model)
    rows = []
    for name, conditions in analysis.methods.items():
        held = all_hold(conditions)
        why = [
            {"statement": one.statement, "holds": one.holds, "evidence": one.evidence, "source": one.source} for one in conditions
        ]
        options = dict(_registry.load(name).options) if name in _registry.METHODS else {}
        about = _registry.METHODS[name].summary if name in _registry.METHODS else ""
        rows.append({"name": name, "holds": held, "conditions": why, "about": about, "options": options})
    division = analysis.division
    return {
        "methods": rows,
        "recommended": analysis.recommended,
        "division": None if division is None else division.why,
        "explosion": None if analysis.explosion is None else str(analysis.explosion),
    }, {}


def expected(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Return how long some methods take for a record, in words; the measurement of all ends after a few seconds."""
    from zakai.diagnostics.expected_time import expected_seconds
    from zakai.numerics.compiled import working_time

    model = session.model(request)
    record = session.given(model, request).record
    began, times = working_time(), {}
    for name in request.get("methods") or []:
        left = MOST_SECONDS - (working_time() - began)
        if left <= 0:
            break
        try:
            times[str(name)] = str(expected_seconds(model, record, str(name), most=min(EACH, left)))
        except ZakaiError as error:
            times[str(name)] = f"refuses this record: {error}"
    return {"times": times}, {}


def algebra(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Return whether the estimation algebra is finite dimensional, with basis and certificate, and the page of the analysis."""
    from zakai.algebra.analysis import analyze

    analysis = analyze(session.model(request))
    found = analysis.algebra
    certificate = found.certificate
    return {
        "verdict": found.verdict,
        "dimension": found.dimension,
        "basis": [str(one) for one in found.basis],
        "rank": found.linear_rank,
        "certificate": None if certificate is None else str(certificate),
        "note": found.note,
        "parameters": found.parameters,
        "page": str(analysis),
    }, {}


TASKS: dict[str, Callable[..., Answer]] = {
    "check": check,
    "write": write,
    "gallery": gallery,
    "columns": columns,
    "describe": describe,
    "methods": methods,
    "expected": expected,
    "algebra": algebra,
}
