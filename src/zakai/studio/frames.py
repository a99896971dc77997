"""Answers as bytes: a header in JSON and arrays after it, as the worker writes and the page reads them.

    length of the header (4 bytes, little-endian), header (JSON, padded with blanks to a multiple of 8), arrays (each so padded)

The header's `arrays` has for each name its type, its shape and the place of its first byte after the header.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

TYPES = {"float64": "f8", "float32": "f4", "uint8": "u1", "int32": "i4"}
ENVELOPE = struct.Struct("<IIB")  # bytes of the frame, number of the request, whether it is the last answer to it


def packed(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray] | None = None) -> bytes:
    """Return a frame; numbers that JSON does not have become null."""
    places: dict[str, list[Any]] = {}
    parts, offset = [], 0
    for name, array in (arrays or {}).items():
        body = np.ascontiguousarray(array)
        data = body.tobytes()
        places[name] = [TYPES[str(body.dtype)], list(np.shape(array)), offset]
        parts.append(data + b"\0" * (-len(data) % 8))
        offset += len(parts[-1])
    text = json.dumps(plain({**header, "arrays": places}), allow_nan=False).encode()
    text += b" " * (-(len(text) + 4) % 8)
    return struct.pack("<I", len(text)) + text + b"".join(parts)


def plain(value: Any) -> Any:
    """Return a value in what JSON has: tuples as lists, NumPy's numbers as numbers, non-finite ones as null."""
    if isinstance(value, Mapping):
        return {str(key): plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
