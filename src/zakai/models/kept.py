"""Values that are computed once for a model; they are stored in the model and end with it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import Lock
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from zakai.models.model import Model

Value = TypeVar("Value")
_LOCK = Lock()


def kept(model: Model, purpose: Any, make: Callable[[], Value], key: Hashable = None, most: int = 1) -> Value:
    """Return what `make` returns, from the cache of the model where it has been made before.

    Args:
        model: the model.
        purpose: what is made; each purpose has a cache of its own.
        make: returns the value for the key; two threads may both call it.
        key: what the value depends on besides the model.
        most: number of keys that are kept; the least recently used one is dropped.
    """
    with _LOCK:
        values: OrderedDict[Hashable, Any] = vars(model).setdefault("_kept", {}).setdefault(purpose, OrderedDict())
        if key in values:
            values.move_to_end(key)
            return values[key]
    value = make()
    with _LOCK:
        values[key] = value
        while len(values) > most:
            values.popitem(last=False)
    return value
