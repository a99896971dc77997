"""The optional libraries that draw, and one sentence for when they are not there."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from zakai.errors import InputError


def plotting(module: str) -> Any:
    """Import a module of the extra `plots`, or say how to install it."""
    try:
        return import_module(module)
    except ImportError as error:
        library = module.partition(".")[0]
        raise InputError(f'{library} is not installed; pictures need it: pip install "zakai[plots]"') from error
