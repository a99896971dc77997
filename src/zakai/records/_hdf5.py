"""The contents of a result file, checked before it is loaded; as a program, whether it can be read at all.

A file can be made so that the HDF5 library crashes or never ends. An untrusted file is therefore read first by this module in
a process of its own, with limits of time and memory. The module imports nothing of zakai, so that the process starts fast.
"""

from __future__ import annotations

import math
import os
import signal
import sys
from contextlib import suppress
from typing import Any

import h5py
import numpy as np

# The attribute that marks a result file; its number changes with the layout.
FORMAT = "zakai result 1"
MOST_VARIABLES = 256
MOST_ATTRIBUTES = 64  # of the file, or of one variable
MOST_TEXT = 1 << 22  # bytes of one attribute, or of all the words of a variable; the longest is a model file
MOST_WORDS = 4096
READABLE = "can be read"
SECONDS, MEMORY = 0.7, 400 << 20  # for a small file; a large one has more of both
MOST_BESIDES = 1 << 25  # bytes of a file that belong to no variable
_ONLY_A_DIMENSION = "b'This is a netCDF dimension but not a netCDF variable"
_BOOKS = ("CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST", "_NCProperties", "_FillValue")

Variable = tuple[list[str], np.ndarray, dict[str, Any]]


class NotOursError(Exception):
    """What a file holds and no result does."""


def read(file: h5py.File) -> tuple[dict[str, Variable], dict[str, Any]]:
    """The variables of a file, each as its dimensions, values and attributes, and the attributes of the file.

    Every number that is loaded stands in the file: nothing is compressed, filled in or in another file.
    """
    if file.id.get_num_objs() > MOST_VARIABLES:
        raise NotOursError(f"it has more than {MOST_VARIABLES} variables")
    besides = file.id.get_filesize()
    for name in file:
        if not isinstance(file.get(name, getlink=True), h5py.HardLink) or file.get(name, getclass=True) is not h5py.Dataset:
            raise NotOursError(f"{name[:40]!r} is not a variable")
        besides -= file[name].id.get_storage_size()
    if besides > MOST_BESIDES:
        raise NotOursError("it holds much besides its variables")
    attributes = _attributes(file)
    if attributes.get("format") != FORMAT:
        raise NotOursError(f"its attribute format is {str(attributes.get('format'))[:40]!r}, not {FORMAT!r}")
    variables: dict[str, Variable] = {}
    for name, item in file.items():
        if not str(item.attrs.get("NAME", "")).startswith(_ONLY_A_DIMENSION):
            values, own = _values(item, name), _attributes(item)
            dimensions = [name] if item.is_scale else [axis[0].name.removeprefix("/") for axis in item.dims]
            variables[name] = (dimensions, values, own)
    return variables, attributes


def _values(item: h5py.Dataset, name: str) -> np.ndarray:
    words = h5py.check_string_dtype(item.dtype) is not None
    if not words and (item.dtype.kind not in "fiu" or item.dtype.itemsize > 8):
        raise NotOursError(f"{name[:40]!r} holds neither numbers nor words")
    plain = item.id.get_create_plist().get_layout() in (h5py.h5d.CONTIGUOUS, h5py.h5d.COMPACT)
    held = item.size <= MOST_WORDS if words else item.size * item.dtype.itemsize == item.id.get_storage_size()
    if not (plain and held and item.external is None):
        raise NotOursError(f"{name[:40]!r} is compressed or not held in full")
    if not words:
        return item[()]
    # One after the other: many may refer to one long word.
    found, left = [], MOST_TEXT
    for index in np.ndindex(item.shape):
        word = _text(item[index])
        left -= len(word)
        if left < 0:
            raise NotOursError(f"{name[:40]!r} holds more words than are read")
        found.append(word)
    return np.array(found, dtype=object).reshape(item.shape)


def _attributes(item: h5py.File | h5py.Dataset) -> dict[str, Any]:
    """The attributes that are one number or one text, but for those by which NetCDF keeps its books."""
    if h5py.h5a.get_num_attrs(item.id) > MOST_ATTRIBUTES:
        raise NotOursError(f"it has more than {MOST_ATTRIBUTES} attributes in one place")
    attributes: dict[str, Any] = {}
    for name in item.attrs:
        if name in _BOOKS or name.startswith("_Netcdf4"):
            continue
        kept = item.attrs.get_id(name)
        if math.prod(kept.shape) != 1 or kept.get_storage_size() > MOST_TEXT:
            raise NotOursError(f"the attribute {name[:40]!r} is not one number or text")
        value = item.attrs[name]
        value = value.item() if isinstance(value, np.generic | np.ndarray) else value
        attributes[name] = value if isinstance(value, int | float) else _text(value)
    return attributes


def _text(word: Any) -> str:
    text = word.decode() if isinstance(word, bytes) else str(word)
    if len(text.encode()) > MOST_TEXT:  # what is not UTF-8 cannot be encoded either
        raise NotOursError("a text in it is longer than any of a result")
    return text


def main(path: str) -> None:
    """Read the file and print what is wrong with it, if anything is; without an end where HDF5 goes astray."""
    size = os.stat(path).st_size
    with suppress(ImportError, AttributeError, ValueError, OSError):  # not every system has limits
        import resource

        signal.setitimer(signal.ITIMER_PROF, SECONDS + size / 1e8)  # of this process; at their end it is terminated
        resource.setrlimit(resource.RLIMIT_DATA, (2 * size + MEMORY,) * 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        with h5py.File(path, "r") as file:
            read(file)
    except NotOursError as error:
        print(f"{error}; give a result written by this version's zakai filter")
    except MemoryError:
        print("does not fit into the memory of this machine")
    except Exception:  # a damaged file can make HDF5 raise anything
        print("is damaged or no NetCDF; give a result of zakai filter")
    else:
        print(READABLE)


if __name__ == "__main__":
    main(sys.argv[1])
