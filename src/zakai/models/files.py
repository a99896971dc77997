"""Model files: TOML in, a Model out, and every error as one line that names the file and the key."""

from __future__ import annotations

import os
import re
import tomllib
from decimal import Decimal
from pathlib import Path
from typing import Any

from zakai.errors import InputError
from zakai.models._errors import named
from zakai.models.model import Model

MAX_BYTES = 1 << 20
# Nine dotted parts are never a model's key, and the time of tomllib grows with the square of their number.
_LONG_KEY = re.compile(r"""(?<![A-Za-z0-9_-])(?:(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){9}""")

# A model has two tables; a row of numbers in a list of rows can look like the head of one.
_TABLE = re.compile(r"^[ \t]*\[", re.MULTILINE)
MOST_TABLES = 8_192


def load_model(source: str | os.PathLike[str]) -> Model:
    """Read a model from a model file or from the gallery.

    `source` is the path of a TOML file of at most 1 MiB, or `gallery:NAME`. Raises InputError, in one line
    that names the file and the key, for a file that cannot be read or is not a model.

        >>> load_model("gallery:spiral-sensor").state
        ('x',)
    """
    if isinstance(source, str) and source.startswith("gallery:"):
        from zakai.models import gallery

        return gallery.load(source.removeprefix("gallery:"))
    try:
        path = Path(source)
    except TypeError:
        raise InputError(f"a model is a path or gallery:NAME, got a {type(source).__name__}") from None
    shown = str(source) if str(source).isprintable() else ascii(str(source))
    return read_model(read_text(path, shown), shown, path.parent)


def read_model(text: str, source: str, folder: Path | None = None) -> Model:
    """The model in the text of a model file; `source` is what errors call it, `folder` where the files of tables are."""
    with named(source):
        if len(text) > MAX_BYTES:
            raise InputError("larger than 1 MiB, which no model file is")
        return Model._from_file(read_keys(text), source, text, folder)


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
        gallery = what == "model" and path.suffix == ""
        hint = "; the models of the gallery are named gallery:NAME" if gallery else f"; give a {what} file (TOML)"
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


def read_keys(text: str, what: str = "model") -> dict[str, Any]:
    """The keys of TOML that is to be a `what`, in bounded time."""
    if _LONG_KEY.search(text):
        raise InputError(f"is not a {what}: it has a key of nine or more parts with dots")
    if sum(1 for _ in _TABLE.finditer(text)) > MOST_TABLES:
        raise InputError(f"is not a {what}: it has more than {MOST_TABLES} lines that begin with [")
    try:
        # Decimals stay exact, and 1e999999999 is never computed.
        keys = tomllib.loads(text, parse_float=Decimal)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"is not TOML: {' '.join(str(error).split())[:200]}") from None
    except (ValueError, ArithmeticError):
        raise InputError("is not TOML: it holds a number that cannot be read") from None
    except RecursionError:
        raise InputError(f"is not a {what}: its lists are nested too deep") from None
    return keys
