"""The task that filters again while a parameter is dragged: coarsely, what is seen, and without what only gives warnings.

The method, its theorem and its formulas are those of the model on the page, in which the values of the parameters are replaced.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from zakai import _registry
from zakai.engine.driver import filter_planned, planned
from zakai.models.checks import check_noise_at, check_noise_within
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.records import Record
from zakai.studio import pictures
from zakai.studio.running import method_of, rows_of
from zakai.studio.session import Answer, Held, Report, Session, state_of

# The least tolerance, and times the method's own one where that is larger; and most columns of the picture.
COARSE, COARSER, FEW = 1e-2, 3.0, 400
WHOLE = 3_000  # rows that are filtered from the start; of more, those that are seen
BEFORE = 200  # rows before the first that is seen, in which the start of a part is forgotten


def slide(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Filter what is seen with other values of the parameters, coarsely, and return its picture."""
    held = session.held(request)
    view = pictures.View.of(request)
    view = view._replace(columns=min(view.columns, FEW))
    method, options = coarse(held.result, *method_of(request))
    part, record, whole = part_of(held, session.model({"text": request.get("text")}), view)
    values = session.model(request)  # refuses unknown names, and noise that is none
    plan = kept(part, slide, lambda: planned(part, None, method, options, by_value=False), (method, *sorted(options.items())))
    plan = plan.at(values.theta())
    times = np.append(values.start, record.times)
    check_noise_at(values, times)
    check_noise_within(values, times)
    (result,) = filter_planned([plan], [record], None, lambda *_: None, warned=False)
    extent = float(held.result.times[0]), float(held.result.times[-1])
    arrays = pictures.density_picture(result, state_of(result, request), held.truth, view, extent)
    return {"log_likelihood": result.log_likelihood if whole else None}, arrays


def coarse(result: Any, method: str, options: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return the method of a result, so that none is looked for, and a coarse tolerance where it has one."""
    if method == "auto" and result.method in _registry.METHODS:
        method = result.method
    names = [method] if method in _registry.METHODS else [block.method for block in result.blocks]
    every = [_registry.load(name).options for name in names if name in _registry.METHODS]
    if usual := [of["tolerance"] for of in every if "tolerance" in of]:
        own = [COARSER * tolerance for tolerance in usual if tolerance is not None]
        given = options.get("tolerance")
        options = {**options, "tolerance": max(COARSE, *own, given if isinstance(given, float) else 0.0)}
    return method, options


def part_of(held: Held, model: Model, view: pictures.View) -> tuple[Model, Record, bool]:
    """Return the model and the rows up to the end of a view, and whether these are all.

    Of a long record they begin a little before the view, with the density that the result has there.
    """
    record, result = held.given.record, held.result
    first, last = view.window or (record.times[0], record.times[-1])
    stop = min(len(record), int(np.searchsorted(record.times, last)) + 1)
    start = max(0, int(np.searchsorted(record.times, first)) - BEFORE)
    if stop <= WHOLE or start == 0 or record.kind == "path" or not result.has_densities:
        return model, rows_of(record, 0, stop), stop == len(record)

    def begun() -> tuple[Model, Any]:
        return model.with_prior(result.density(start), start=float(result.times[start])), result

    later, _ = kept(model, part_of, begun, (id(result), start))  # kept with the result, so that no other one has its id
    return later, rows_of(record, start, min(stop, start + BEFORE + WHOLE)), False


TASKS: dict[str, Callable[..., Answer]] = {"slide": slide}
