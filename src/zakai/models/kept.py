"""Values that are computed once for a model; they are stored in the model and end with it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import wraps
from threading import Lock
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

if TYPE_CHECKING:
    from zakai.models.model import Model

Value = TypeVar("Value")
Rest = ParamSpec("Rest")
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


def once_for_a_model(function: Callable[Concatenate[Model, Rest], Value]) -> Callable[Concatenate[Model, Rest], Value]:
    """Return a function of a model, and of other hashable arguments, that stores its last eight values in the model."""

    @wraps(function)
    def found(model: Model, *others: Rest.args, **names: Rest.kwargs) -> Value:
        key = (*others, *sorted(names.items()))
        try:
            value: Value = vars(model)["_kept"][function][key]
        except KeyError:
            return kept(model, function, lambda: function(model, *others, **names), key, most=8)
        return value

    return found
