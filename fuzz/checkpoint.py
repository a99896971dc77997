"""Checkpoints to words and arrays; half of the inputs are signed, that the fuzzer reaches what lies behind the hash."""

import hashlib
import json

import numpy as np

from fuzz.oracle import value_or_one_line
from zakai.errors import InputError
from zakai.records.checkpoint import VERSION, _magic, _packed, _unpacked


def one_input(data: bytes) -> None:
    if data[:1] == b"{":
        content = _magic("checkpoint") + str(VERSION).encode() + b"\n" + data
        data = content + hashlib.sha256(content).digest()
    found = value_or_one_line(lambda: _unpacked(data, "state"))
    if isinstance(found, InputError):
        assert str(found).startswith("state: ")
        return
    about, arrays = found
    assert sum(array.nbytes for array in arrays.values()) <= len(data)
    again, same = _unpacked(_packed(about, arrays, "checkpoint"), "again")
    assert json.dumps(again) == json.dumps(about) and list(same) == list(arrays)
    assert all(np.array_equal(same[name].view(np.uint8), arrays[name].view(np.uint8)) for name in arrays if arrays[name].ndim)
