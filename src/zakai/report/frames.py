"""The binary container of pictures; `static/axes.js` describes and reads it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

_MAGIC = b"ZKF1"
_TYPES = ("float64", "float32", "uint16", "uint8")


def pack(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return a frame: a header in JSON, which names the arrays, and the arrays, little endian, each at a multiple of 8 bytes."""
    described, parts, offset = {}, [], 0
    for name, array in arrays.items():
        if array.dtype.name not in _TYPES:
            raise TypeError(f"{name}: a frame holds {', '.join(_TYPES)}, not {array.dtype}")
        data = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
        described[name] = {"type": array.dtype.name, "shape": list(array.shape), "offset": offset}
        parts.append(data + bytes(-len(data) % 8))
        offset += len(parts[-1])
    text = json.dumps({**header, "arrays": described}, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-(8 + len(text)) % 8)
    return b"".join([_MAGIC, len(text).to_bytes(4, "little"), text, *parts])


def unpack(frame: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the header and the arrays of a frame."""
    if frame[:4] != _MAGIC:
        raise ValueError("not a frame of zakai")
    start = 8 + int.from_bytes(frame[4:8], "little")
    header = json.loads(frame[8:start])
    arrays = {}
    for name, one in header["arrays"].items():
        kind, shape = np.dtype(one["type"]).newbyteorder("<"), tuple(one["shape"])
        count = int(np.prod(shape, dtype=int))
        arrays[name] = np.frombuffer(frame, kind, count, start + one["offset"]).reshape(shape)
    return header, arrays
