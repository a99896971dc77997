"""What the worker does for each request: one function for each word in `do`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from zakai.errors import InputError
from zakai.studio import after, exports, inspecting, live, running
from zakai.studio.session import Answer, Report, Session

TASKS: dict[str, Callable[..., Answer]] = {
    **inspecting.TASKS, **running.TASKS, **after.TASKS, **exports.TASKS, **live.TASKS,
}  # fmt: skip


def answer(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Return what a request asks for."""
    task = TASKS.get(str(request.get("do")))
    if task is None:
        raise InputError(f"there is no task {str(request.get('do'))[:40]!r}; reload the page")
    return task(session, request, report)
