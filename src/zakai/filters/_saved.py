"""A live filter as words and arrays, and back: all that decides what it says next.

A state is taken apart into the records (NamedTuples and dataclasses) that it is made of, by their names, and put together from
those alone: nothing that a file says is run.  What a state shares with what is prepared, a system of compiled functions, is
taken from there.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from zakai.errors import InputError
from zakai.filters._ahead import CHUNK, Clock, Key
from zakai.filters._compiled_step import Laid, Layout, Told, compiled, packed
from zakai.filters._live import Live, Moment


def taken_apart(tree: Any, arrays: list[np.ndarray]) -> Any:
    """A state as JSON can say it; its arrays are put into the list."""
    if tree is None or isinstance(tree, bool | int | float | str):
        return tree
    if isinstance(tree, dict):
        return {"dict": {key: taken_apart(part, arrays) for key, part in tree.items()}}
    fields = _fields(type(tree))
    if fields is not None:
        name = f"{type(tree).__module__}:{type(tree).__qualname__}"
        return {"record": name, "fields": {field: taken_apart(getattr(tree, field), arrays) for field in fields}}
    if hasattr(tree, "shape"):
        arrays.append(np.asarray(tree))
        return {"array": len(arrays) - 1}
    if isinstance(tree, tuple | list):
        return {"list" if isinstance(tree, list) else "tuple": [taken_apart(part, arrays) for part in tree]}
    return {"shared": type(tree).__name__}


def put_together(said: Any, arrays: list[np.ndarray], shared: Mapping[str, Any]) -> Any:
    """The state of which this was said; ValueError if it is none of ours."""
    if said is None or isinstance(said, bool | int | float | str):
        return said
    if not isinstance(said, dict):
        raise ValueError
    if "array" in said:
        return arrays[said["array"]]
    if "shared" in said:
        return shared[said["shared"]]
    if "dict" in said:
        return {key: put_together(part, arrays, shared) for key, part in said["dict"].items()}
    for kind in (tuple, list):
        if kind.__name__ in said:
            return kind(put_together(part, arrays, shared) for part in said[kind.__name__])
    module, _, name = said["record"].partition(":")
    cls = getattr(sys.modules.get(module), name, None) if module.startswith("zakai.") else None
    fields = _fields(cls) if isinstance(cls, type) else None
    if fields is None or set(fields) != set(said["fields"]):
        raise ValueError
    return cls(**{field: put_together(part, arrays, shared) for field, part in said["fields"].items()})  # type: ignore[misc]


def _fields(cls: type) -> tuple[str, ...] | None:
    """The names of what a record is made of, but for what it only remembers; None for anything else."""
    if issubclass(cls, tuple) and hasattr(cls, "_fields"):
        return cls._fields
    return tuple(field.name for field in dataclasses.fields(cls) if field.init) if dataclasses.is_dataclass(cls) else None


def saved(live: Live) -> tuple[dict[str, Any], list[np.ndarray]]:
    """A live filter as words and arrays."""
    now = live.now
    arrays: list[np.ndarray] = []
    said = {
        "time": now.time,
        "state": None if now.laid is None else taken_apart(now.laid.state, arrays),
        "told": None if now.told is None else taken_apart(now.told.info, arrays),
        "well": None if now.told is None else now.told.well,
        "left": now.left,
        "block": None if now.block is None else list(now.block.key),
        "ends": list(now.ends),
        "clock": [*now.clock[:3], None if now.clock.ahead is None else list(now.clock.ahead), now.clock.begun],
        "read": list(now.read),
        "read_at": list(now.read_at),
        "first": None if now.first is None else list(now.first),
        "notes": list(now.notes),
    }
    return said, arrays


def restore(live: Live, said: Mapping[str, Any], arrays: list[np.ndarray]) -> Moment:
    """The moment of a live filter out of words and arrays; it is not yet its own.  ValueError where they do not fit."""
    try:
        return _restored(live, said, arrays)
    except (KeyError, IndexError, TypeError, AttributeError, OverflowError, MemoryError) as error:
        raise ValueError(str(error)) from None


def _restored(live: Live, said: Mapping[str, Any], arrays: list[np.ndarray]) -> Moment:
    since, steps, seen, ahead, begun = said["clock"]
    clock = Clock(float(since), int(steps), tuple(seen), _key(ahead), bool(begun))
    first = None if said["first"] is None else tuple(map(float, said["first"]))
    ends = (float(said["ends"][0]), float(said["ends"][1]))
    rest = (clock, tuple(map(float, said["read"])), tuple(map(float, said["read_at"])), first, tuple(map(str, said["notes"])))
    time = float(said["time"])
    key = _key(said["block"])
    if key is None:
        return Moment(time, None, None, 0, None, ends, *rest)
    try:
        block = live.ahead.again(key, ends)
    except InputError as error:
        raise ValueError(str(error)) from None
    method = live.setting.method
    state = put_together(said["state"], arrays, shared_by(method.init(block.prepared, live.setting.prior)))
    info = put_together(said["told"], arrays, {})
    laid = Laid.of(state)
    told = Told(np.append(packed(info), float(said["well"])), 0, Layout.of(info))
    if first is None:
        laid = compiled(method, laid.layout, block.layout, live.m).begun(laid)
    return Moment(time, laid, told, int(said["left"]), block, ends, *rest)


def _key(said: Any) -> Key | None:
    if said is None:
        return None
    start, step, number, seen, elapsed = said
    if not (0 < float(step) < np.inf and 0 < int(number) <= CHUNK):
        raise ValueError("no intervals")
    return Key(float(start), float(step), int(number), tuple(seen), None if elapsed is None else tuple(elapsed))


def shared_by(tree: Any) -> dict[str, Any]:
    """What stands in a state that is neither a number nor made of records, by the name of its kind."""
    found: dict[str, Any] = {}
    fields = _fields(type(tree))
    if fields is not None:
        for field in fields:
            found.update(shared_by(getattr(tree, field)))
    elif isinstance(tree, tuple | list):
        for part in tree:
            found.update(shared_by(part))
    elif not (tree is None or isinstance(tree, bool | int | float | str) or hasattr(tree, "shape")):
        found[type(tree).__name__] = tree
    return found
