"""Model files: TOML in, a Model out, and every error as one line that names the file and the key."""

from __future__ import annotations

import os
import re
import tomllib
from decimal import Decimal
from pathlib import Path
from typing import Any

from zakai.errors import InputError
from zakai.models import _gallery_texts
from zakai.models._errors import named
from zakai.models._text import MAX_BYTES, read_text
from zakai.models.model import Model

# Nine dotted parts are never a model's key, and the time of tomllib grows with the square of their number.
_LONG_KEY = re.compile(r"""(?<![A-Za-z0-9_-])(?:(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){9}""")

# A model has two tables; a row of numbers in a list of rows can look like the head of one.
_TABLE = re.compile(r"^[ \t]*\[", re.MULTILINE)
MOST_TABLES = 8_192


def load_model(source: str | os.PathLike[str]) -> Model:
    """Read a model from a model file or from the gallery.

    Args:
        source: the path of a TOML file of at most 1 MiB, or `gallery:NAME`.

    Returns:
        The model.

    Raises:
        InputError: the file cannot be read or is not a model; the line names the file and the key.

    Example:
        >>> load_model("gallery:spiral-sensor").state
        ('x',)
    """
    if isinstance(source, str) and source.startswith("gallery:"):
        return read_model(_gallery_texts.text(source.removeprefix("gallery:")), source)
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
