"""Monte-Carlo studies, and reproductions of published experiments."""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib import import_module
from inspect import signature
from typing import Any

from zakai.errors import InputError
from zakai.studies._drawing import new_figure
from zakai.studies._published import Pictures

_STUDIES = {
    name: f"zakai.studies.{name.replace('-', '_')}"
    for name in (
        "chen-luo-yau-2017", "cubic-sensor", "yau-1993", "hu-yau-2002", "survey", "dong-chen-yau-2021", "lorenz-63-sakov-2012",
        "lorenz-63-ramgraber-2022", "heng-doob", "heng-controlled", "al-jarrah-2024", "tracking",
    )
}  # fmt: skip


def names() -> tuple[str, ...]:
    """The published experiments that can be reproduced."""
    return tuple(_STUDIES)


def reproduce(
    name: str,
    folder: str | os.PathLike[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> Any:
    """Run a published experiment again, print its figures beside ours, and give them back.

    name: one of `names()`. folder: where the pictures and the figures as JSON go; it is made if it is not there; None: nowhere.
    progress: called with the work done and all of it. options: those of the study, such as `paths=100`. Pictures are written as
    soon as they can be drawn, and every file that is written is said.

    Raises InputError for another name or option, a folder that cannot be made, or pictures without matplotlib.

    Example:
        figures = reproduce("chen-luo-yau-2017", "chen-luo-yau-2017", paths=20)
    """
    if name not in _STUDIES:
        raise InputError(f'there is no study "{name}"; there is: {", ".join(_STUDIES)}')
    run = import_module(_STUDIES[name]).run
    known = [key for key, one in signature(run).parameters.items() if one.kind is one.KEYWORD_ONLY]
    for option in options:
        if option not in known:
            raise InputError(f'{name}: there is no option "{option}"; there is: {", ".join(known)}')
    if folder is not None:
        new_figure(1.0, 1.0)  # a missing library is better said before the minutes of work than after
        try:
            os.makedirs(folder, exist_ok=True)
        except OSError as error:
            raise InputError(f"{os.fspath(folder)}: the folder cannot be made: {error.strerror}") from None
    study = run(progress, Pictures(folder), **options)
    print(study.text())
    if folder is not None:
        study.save(folder)
    return study
