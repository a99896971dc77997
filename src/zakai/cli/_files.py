"""Checks of the files of a command before the long work begins."""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import TemporaryFile

from zakai.errors import InputError
from zakai.records.writing import shown


def check_outputs(outputs: list[Path | None], inputs: list[Path | str | None]) -> None:
    """Check the outputs of a command.

    Raises:
        InputError: an output cannot be written, is also an input, or is named twice.
    """
    seen = {os.path.realpath(path): "is also an input" for path in inputs if path is not None}
    for path in outputs:
        if path is None:
            continue
        place = Path(os.path.realpath(path))
        if path.is_dir():
            raise InputError(f"{shown(path)}: is a folder; give the name of a file")
        if not place.parent.is_dir():
            raise InputError(f"{shown(path)}: there is no folder {shown(place.parent)}; make it first")
        try:
            with TemporaryFile(dir=place.parent):
                pass
        except OSError as error:
            fault = f"the folder {shown(place.parent)} cannot be written to: {error.strerror}"
            raise InputError(f"{shown(path)}: {fault}; choose another place") from None
        if str(place) in seen:
            raise InputError(f"{shown(path)}: {seen[str(place)]}; choose another name")
        seen[str(place)] = "is named for two outputs"
