"""zakai reproduce"""

from __future__ import annotations

from pathlib import Path

from zakai.cli._progress import progress
from zakai.errors import InputError


def reproduce(name: str, folder: Path | None) -> None:
    """Run a published experiment."""
    from zakai import studies

    known = studies.names()
    if name not in known:
        raise InputError(f'there is no study "{name}"; there is: {", ".join(known)}')
    with progress(name) as advance:
        studies.reproduce(name, folder, advance)
