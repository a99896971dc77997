"""The text of files of at most 1 MiB."""

from __future__ import annotations

from pathlib import Path

from zakai.errors import InputError

MAX_BYTES = 1 << 20


def read_text(path: Path, shown: str, what: str = "model") -> str:
    """The text of a file of at most 1 MiB, which is to be a `what`; `shown` is what errors call it."""
    try:
        # A pipe would be waited for; a device can be endless.
        if path.exists() and not path.is_file():
            kind = "a folder" if path.is_dir() else "not a regular file"
            raise InputError(f"{shown}: is {kind}; give a {what} file")
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        hint = f"; give a {what} file (TOML)"
        if what == "table":
            hint = "; its path is relative to the model file"
        elif what == "model" and path.suffix == "":
            hint = "; the models of the gallery are named gallery:NAME"
        raise InputError(f"{shown}: there is no such file{hint}") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{shown}: cannot be read: {getattr(error, 'strerror', None) or 'not a path'}") from None
    return decoded(data, shown, what)


def decoded(data: bytes, source: str, what: str = "model") -> str:
    """The text of a file from its bytes; `source` is what errors call it."""
    if len(data) > MAX_BYTES:
        raise InputError(f"{source}: larger than 1 MiB, which no {what} file is")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{source}: byte {error.start + 1} is not UTF-8 text; a {what} file is TOML") from None
