"""Files that are whole or not there: everything that `zakai` writes goes through here."""

from __future__ import annotations

import csv
import os
import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from zakai.errors import InputError

if TYPE_CHECKING:
    import numpy as np


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary file beside `path` that takes its place when the block ends well, and vanishes if not.

    The temporary file keeps the suffix of `path`, is on disk (fsync) before it is renamed, and is removed on
    every exception, an interruption included; what was at `path` before is then still there.

    Arguments:
        path: where the finished file is to be. Its folder must exist; a link is followed.

    Raises:
        InputError: the file cannot be written (no such folder, no permission, a full disk).

    Example:
        >>> import tempfile, pathlib
        >>> from zakai.records import atomic_write
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "note.txt"
        >>> with atomic_write(path) as temporary:
        ...     _ = temporary.write_text("all of it")
        >>> path.read_text()
        'all of it'
    """
    given = path
    with _one_line(given):
        path = Path(os.path.realpath(path))
        if path.exists() and not path.is_file():
            what = "is a folder" if path.is_dir() else "is not a regular file"
            raise InputError(f"{shown(given)}: cannot be written: it {what}; give the name of a file")
        temporary = path.with_name(f".{path.stem[:40]}.{secrets.token_hex(4)}.part{path.suffix}")
        # Not tempfile, whose files are private to their owner: a result has the permissions of any new file.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    try:
        with _one_line(given):
            yield temporary
            _sync(temporary)
            os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    with suppress(OSError):  # not every file system lets a folder be synced; the rename itself is done
        _sync(path.parent)


def default_names(m: int) -> list[str]:
    """The names of the columns of m observations where no others are given."""
    return [f"y{i + 1}" for i in range(m)]


def write_table(
    path: str | os.PathLike[str],
    times: np.ndarray,
    values: np.ndarray,
    names: Sequence[str],
    dates: np.ndarray | None = None,
) -> None:
    """Write times (K,), or dates (K,), and values (K, c) as CSV with a header of `time` and c names; as `write_record` does."""
    if len(names) != values.shape[1] or any(set(name) & set("\r\n\0") for name in names):
        raise InputError(f"{shown(path)}: names must be {values.shape[1]} names of one line each, one a column")
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerow(["time", *names])
        rows = (
            ",".join([time, *("" if value != value else repr(value) for value in row)]) + "\n"
            for part in (slice(start, start + 65536) for start in range(0, len(times), 65536))
            for time, row in zip(_texts(times[part] if dates is None else dates[part]), values[part].tolist())
        )
        while block := "".join(islice(rows, 4096)):
            file.write(block)


def _texts(times: np.ndarray) -> Iterator[str]:
    """Yield times in all digits, or dates to the microsecond."""
    return map(repr, times.tolist()) if times.dtype.kind == "f" else map(str, times.astype("datetime64[us]"))


def shown(path: str | os.PathLike[str]) -> str:
    """A path as it may appear in a one-line error."""
    return "".join(character if character.isprintable() else "?" for character in os.fsdecode(path))


@contextmanager
def _one_line(path: str | os.PathLike[str]) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError) as error:
        # A path with a NUL in it raises ValueError; any other one is a bug in the block that writes.
        if isinstance(error, ValueError) and "null" not in str(error):
            raise
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        fault = f"{shown(path)}: cannot be written: {reason}; choose another place or free some space"
        raise InputError(fault) from error


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
