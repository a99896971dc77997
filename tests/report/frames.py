"""Reads the frames of pictures as their description says, sharing no code with what writes them."""

from __future__ import annotations

import base64
import json
import re
import struct
import zlib

import numpy as np


def read(frame):
    """(header, arrays) of a frame."""
    magic, size = struct.unpack_from("<4sI", frame)
    assert magic == b"ZKF1" and size % 8 == 0
    header = json.loads(frame[8 : 8 + size])
    arrays = {}
    for name, one in header["arrays"].items():
        start = 8 + size + one["offset"]
        assert one["offset"] % 8 == 0
        kind = {"float64": "<f8", "float32": "<f4", "uint16": "<u2", "uint8": "u1"}[one["type"]]
        count = int(np.prod(one["shape"]))
        arrays[name] = np.frombuffer(frame[start : start + count * np.dtype(kind).itemsize], kind).reshape(one["shape"])
    return header, arrays


def on_page(text):
    """The frames of a page by their names."""
    found = re.findall(r'<script type="application/octet-stream" id="([^"]*)">([^<]*)</script>', text)
    return {name: read(zlib.decompress(base64.b64decode(packed))) for name, packed in found}


def without_scripts(text):
    """A page without the one script that runs and without frames."""
    assert len(re.findall(r"<script>", text)) == 1
    return re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)


def series(frame, panel=0):
    """The series of one panel of a chart, with their arrays in place of their names."""
    header, arrays = frame
    named = ("x", "y", "low", "high", "spread")
    return [
        {key: arrays[value] if key in named and isinstance(value, str) else value for key, value in one.items()}
        for one in header["panels"][panel]["series"]
    ]
