"""Every method by its name, loaded when it is asked for."""

from __future__ import annotations

import difflib
from importlib import import_module
from typing import Any

from zakai.errors import InputError

# name: the module that defines its METHOD, and its entry in algebra.theorems
METHODS = {
    "limited-direct": "zakai.filters.limited_direct",
    "extended-kalman-bucy": "zakai.filters.extended_kalman_bucy",
}
# What "auto" tries, most exact and cheapest first.
AUTO = ("limited-direct",)


def load(name: str) -> Any:
    """The METHOD of that name; InputError for an unknown one."""
    if name not in METHODS:
        close = difflib.get_close_matches(name, METHODS, n=1)
        hint = f'; did you mean "{close[0]}"?' if close else ""
        raise InputError(f'there is no method "{name}"{hint}; methods: auto, {", ".join(METHODS)}')
    return import_module(METHODS[name]).METHOD
