"""Checkpoints: arrays and a few words about them, in a file that is whole or not there.

    zakai checkpoint 1                       the magic line: what kind of file, and the version of the format
    {"about": ..., "arrays": [...]}          one line of JSON, the arrays by name, type and shape
    ...                                      their bytes, little-endian, one after the other
    sha256 of all that stands before         32 bytes

Nothing in it is ever run.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from zakai.errors import InputError
from zakai.records.writing import atomic_write, shown

VERSION = 1
LARGEST = 2**31  # bytes
TYPES = ("<f8", "<i8", "|b1", "<i4", "<u4", "<f4")
_DIGEST = 32


def write_checkpoint(
    path: str | os.PathLike[str], about: Mapping[str, Any], arrays: Mapping[str, np.ndarray], kind: str = "checkpoint"
) -> None:
    """Write a checkpoint, or another `kind` of such a file, atomically: it takes the place of the last one when it is on disk.

    Arguments:
        path: the file; its folder must exist.
        about: what JSON can say.
        arrays: by their names, of numbers.
        kind: the kind of the file, which a reader must ask for.

    Raises:
        InputError: the file cannot be written, or would be too large to be read.

    Example:
        >>> import tempfile, pathlib, numpy as np
        >>> from zakai.records.checkpoint import read_checkpoint, write_checkpoint
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "state"
        >>> write_checkpoint(path, {"time": 0.5}, {"mean": np.array([1.0, 2.0])})
        >>> read_checkpoint(path)
        ({'time': 0.5}, {'mean': array([1., 2.])})
    """
    content = _packed(about, arrays, kind)
    if len(content) > LARGEST:
        raise InputError(f"{shown(path)}: would be larger than {LARGEST // 2**20} MiB; give fewer times")
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def _magic(kind: str) -> bytes:
    return f"zakai {kind} ".encode()


def _packed(about: Mapping[str, Any], arrays: Mapping[str, np.ndarray], kind: str) -> bytes:
    listed, parts = [], []
    for name, array in arrays.items():
        number = np.dtype(array.dtype).newbyteorder("<").str
        if number not in TYPES:
            raise TypeError(f"a {kind} holds no array of {array.dtype}")
        listed.append([name, number, list(array.shape)])
        parts.append(np.ascontiguousarray(array, dtype=number).tobytes())
    header = json.dumps({"about": about, "arrays": listed}, allow_nan=True).encode()
    content = b"".join([_magic(kind), str(VERSION).encode(), b"\n", header, b"\n", *parts])
    return content + hashlib.sha256(content).digest()


def read_checkpoint(path: str | os.PathLike[str], kind: str = "checkpoint") -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What a checkpoint, or another `kind` of such a file, says, and its arrays by their names.

    Raises:
        InputError: the file cannot be read, is no checkpoint, is damaged, or was written by a later version.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file():
            raise InputError(f"{shown(path)}: is not a regular file; name a {kind} file")
        if path.stat().st_size > LARGEST:
            raise InputError(f"{shown(path)}: is larger than {LARGEST // 2**20} MiB and no {kind} file; name another")
        with path.open("rb") as file:
            if not file.read(len(_magic(kind))) == _magic(kind):
                raise _foreign(shown(path), kind)
            file.seek(0)
            content = file.read()
    except OSError as error:
        raise InputError(f"{shown(path)}: cannot be read: {error.strerror}; name a {kind} file") from None
    return _unpacked(content, shown(path), kind)


def _foreign(name: str, kind: str) -> InputError:
    return InputError(f"{name}: is not a {kind} file; name another, or remove it to start again")


def _unpacked(content: bytes, name: str, what: str = "checkpoint") -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    begin = content[:64].find(b"\n") + 1
    number = content[len(_magic(what)) : begin - 1]
    if not content.startswith(_magic(what)) or not begin or not number.isdigit():
        raise _foreign(name, what)
    if int(number) != VERSION:
        raise InputError(
            f"{name}: is a {what} file of format {int(number)}, and this version of zakai reads format {VERSION}; use the "
            "version that wrote it, or remove it to start again"
        )
    damaged = InputError(f"{name}: the {what} file is damaged (its contents do not match its hash); remove it to start again")
    if hashlib.sha256(content[:-_DIGEST]).digest() != content[-_DIGEST:]:
        raise damaged
    # What follows was written by us, or by somebody who took the trouble to make it look so.
    try:
        end = content.index(b"\n", begin)
        header = json.loads(content[begin:end])
        about, listed = header["about"], header["arrays"]
        arrays, place = {}, end + 1
        for key, kind, shape in listed:
            if kind not in TYPES or not all(type(size) is int and size >= 0 for size in shape):
                raise damaged
            size = math.prod(shape) * np.dtype(kind).itemsize
            if not isinstance(key, str) or size > len(content) - _DIGEST - place:
                raise damaged
            arrays[key] = np.frombuffer(content[place : place + size], dtype=kind).reshape(shape).copy()
            place += size
    except (ValueError, KeyError, TypeError, RecursionError):
        raise damaged from None
    if place != len(content) - _DIGEST or not isinstance(about, dict):
        raise damaged
    return about, arrays
