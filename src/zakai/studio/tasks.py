"""The tasks of the worker by their names: one function for each word in `do` of a request."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from zakai.errors import InputError
from zakai.studio import after, exports, inspecting, running, sliding, stream
from zakai.studio.session import Answer, Report, Session

TASKS: dict[str, Callable[..., Answer]] = {
    **inspecting.TASKS,
    **running.TASKS,
    **sliding.TASKS,
    **after.TASKS,
    **exports.TASKS,
    **stream.TASKS,
}
# What the values of a request are: an address may hold anything.
SHAPES: dict[str, type] = {
    **dict.fromkeys(("data", "values", "options", "labels", "changes"), Mapping),
    **dict.fromkeys(("names", "methods", "parameters"), list),
    "text": str,
}


def carried_out(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Return the header and the arrays of the answer to a request."""
    name = str(request.get("do"))
    if name not in TASKS:
        raise InputError(f"there is no task {name[:40]!r}; reload the page")
    wanted = request.get("data")
    inside = dict(wanted) if isinstance(wanted, Mapping) else {}
    simulated = inside.get("kind") != "file"
    inside_shapes = {"columns": list, "from": str, "time": str, "inputs": Mapping if simulated else list}
    for given, shapes in ((request, SHAPES), (inside, inside_shapes)):
        for key, shape in shapes.items():
            if given.get(key) is not None and not isinstance(given[key], shape):
                raise InputError(f"{key}: is not what the page sends; open the page again without what follows # in its address")
    return TASKS[name](session, request, report)
