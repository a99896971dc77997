"""Answers of a worker as frames of `zakai.report.frames`, and the envelopes in which they reach the server."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from zakai.report.frames import pack

ENVELOPE = struct.Struct("<IIB")  # bytes of the frame, number of the request, whether it is the last answer to it


def packed(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray] | None = None) -> bytes:
    """Return a frame; numbers that JSON does not have become null."""
    return pack(plain(header), arrays or {})


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
