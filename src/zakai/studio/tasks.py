"""The tasks of the worker by their names: one function for each word in `do` of a request."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from zakai.errors import InputError
from zakai.studio import after, exports, inspecting, running, stream
from zakai.studio.session import Answer, Report, Session

TASKS: dict[str, Callable[..., Answer]] = {
    **inspecting.TASKS,
    **running.TASKS,
    **after.TASKS,
    **exports.TASKS,
    **stream.TASKS,
}


def carried_out(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Return the header and the arrays of the answer to a request."""
    name = str(request.get("do"))
    if name not in TASKS:
        raise InputError(f"there is no task {name[:40]!r}; reload the page")
    return TASKS[name](session, request, report)
