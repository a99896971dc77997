"""A live filter as words and arrays, and back: all that decides what it says next.

A state is taken apart into the records (NamedTuples and dataclasses) that it is made of, by their names, and put together from
those alone: nothing that a file says is run.  What a state shares with what is prepared, a system of compiled functions, is
taken from there.
"""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Iterator, Mapping
from copy import copy
from typing import Any

import numpy as np

from zakai.filters._ahead import CHUNK, Clock, Key
from zakai.filters._compiled_step import Laid, Layout, Told, compiled, packed
from zakai.filters._live import STEADY, Live, Moment, run_of
from zakai.filters._protocol import Info
from zakai.records.record import LARGEST

MOST_STEPS = 2**53
ROUNDING = 1e-9  # of a covariance
AGREES = 0.1  # share by which the moments that a step told and those of its density may differ: they are found in two ways
NEGATIVE = ("negative_variance", "indefinite_cov")  # the figures that say that one has a negative variance


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


def put_together(said: Any, arrays: Iterator[tuple[int, Any]], shared: Mapping[str, Any]) -> Any:
    """The state of which this was said, with the arrays by their numbers, each once; ValueError if it is none of ours."""
    if said is None or isinstance(said, bool | int | float | str):
        return said
    if not isinstance(said, dict):
        raise ValueError
    if "array" in said:
        number, array = next(arrays, (None, None))
        if type(said["array"]) is not int or said["array"] != number:
            raise ValueError
        return array
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
    return cls(**{field: put_together(said["fields"][field], arrays, shared) for field in fields})  # type: ignore[misc]


def _check_record(tree: Any) -> None:
    """ValueError where a record in a tree holds what its kind does not, or is none of ours by its own word."""
    if isinstance(tree, dict):
        tree = tuple(tree.values())
    fields = _fields(type(tree))
    for field in fields or ():
        _check(_is_a(getattr(tree, field), type(tree).__annotations__[field]))
    if fields is not None:
        _check(getattr(tree, "possible", True))
        tree = tuple(getattr(tree, field) for field in fields)
    for part in tree if isinstance(tree, tuple | list) else ():
        _check_record(part)


def _is_a(part: Any, annotation: Any) -> bool:
    """Whether a field of a record may hold this: one that is annotated as a plain value just that, any other no plain value."""
    kind = getattr(annotation, "__forward_arg__", annotation)  # what a NamedTuple makes of a string
    if kind == "tuple[int, ...]":
        return isinstance(part, tuple) and all(type(one) is int for one in part)
    if kind in ("bool", "int", "float", "str"):
        return type(part).__name__ == kind and (kind != "float" or math.isfinite(part))
    return not isinstance(part, bool | int | float | str)


def _fields(cls: type) -> tuple[str, ...] | None:
    """The names of what a record is made of, but for what it only remembers; None for anything else."""
    if issubclass(cls, tuple) and hasattr(cls, "_fields"):
        return cls._fields
    return tuple(field.name for field in dataclasses.fields(cls) if field.init) if dataclasses.is_dataclass(cls) else None


def saved(now: Moment) -> tuple[dict[str, Any], list[np.ndarray]]:
    """The moment of a live filter as words and arrays."""
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
        with np.errstate(all="ignore"):
            return _restored(live, said, arrays)
    except Exception as error:  # there is no end to what somebody may have made up, nor to what a method makes of that
        raise ValueError(str(error)) from None


def _restored(live: Live, said: Mapping[str, Any], arrays: list[np.ndarray]) -> Moment:
    if said["block"] is None or said["first"] is not None:
        return _at_the_start(live, said)
    start, time = live.setting.model.start, _number(said["time"])
    since, steps, before, ahead, begun = said["clock"]
    clock = Clock(_number(since), _count(steps, 0, MOST_STEPS), _seen(before, live.m, 0), _key(live, ahead, time), _flag(begun))
    key = _key(live, said["block"], time)
    begin, end = _numbers(said["ends"], 2)
    ends = begin, end
    read, read_at = (_numbers(said[name], live.m) for name in ("read", "read_at"))
    _check(key is not None and start <= begin < end == time and start <= clock.since <= time)
    assert key is not None
    unread = (live.path, read, read_at) == (False, (0.0,) * live.m, (start,) * live.m)
    _check(unread or (live.path and all(start <= at <= time for at in read_at)))
    _check(clock.steps == 0 or math.isfinite(clock.steps / (time - since)))
    block, row = live.ahead.again(key, ends), live.ahead.row(key, ends)
    _check(row is not None and said["notes"] == list(live.notes_of(block)))
    assert row is not None
    numbered = iter(enumerate(arrays))
    begun_with = live.setting.method.init(block.prepared, live.setting.prior)
    state = put_together(said["state"], numbered, shared_by(begun_with))
    info = put_together(said["told"], numbered, {})
    _check(type(state) is type(begun_with) and next(numbered, None) is None)
    _check_record((state, info))
    laid = Laid.of(state)
    step = compiled(live.setting.method, laid.layout, block.layout, live.m)
    told = Told(np.append(packed(info), float(_flag(said["well"]))), 0, Layout.of(info))
    _check(step.new == laid.layout and step.info == told.layout)
    if not live.adapts:
        first = Layout.of(begun_with)
        _check(laid.layout == first or laid.layout == compiled(live.setting.method, first, block.layout, live.m).new)
    longest = STEADY * run_of(state) if live.adapts else 1
    left = _count(said["left"], 0, longest - 1)
    moment = Moment(time, step.begun(laid), told, left, block, ends, clock, read, read_at, None, live.notes_of(block))
    _check_believable(live, moment, row, info)
    return moment


def _at_the_start(live: Live, said: Mapping[str, Any]) -> Moment:
    """The moment before the first interval, which the samples at the start decide."""
    fresh = copy(live)
    fresh.now = moment = Live(live.setting).now
    if said["first"] is not None:
        moment = fresh.moved(moment.time, [float(value) for value in said["first"]])
    _check(json.dumps(saved(moment)[0]) == json.dumps(said))
    return moment


def _check_believable(live: Live, moment: Moment, row: int, info: Info) -> None:
    """ValueError where the state is no density with moments, or cannot be gone on with."""
    density, model = live.density(moment), live.setting.model
    own, spread = density.mean(), density.cov()
    apart = np.abs(np.asarray(info.mean) - own)
    # Of an angle it is the way around the circle.
    angles = np.array([name in model.periodic for name in model.state])
    apart = np.where(angles, np.abs(np.angle(np.exp(1j * apart))), apart)
    wide, least = np.abs(np.diagonal(spread)), ROUNDING * (1 + np.square(own))
    _check(np.all(apart <= AGREES * np.sqrt(wide) + np.sqrt(least)))
    _check(np.all(np.abs(np.diagonal(info.cov) - wide) <= AGREES * wide + least))
    for mean, cov in ((info.mean, info.cov), (own, spread)):
        _check(np.isfinite(mean).all() and np.isfinite(cov).all())
        # Where rounding ate a variance, the figures of health say so.
        rounding = ROUNDING * (np.abs(cov).max() + np.square(mean).max())
        _check(np.diagonal(cov).min() >= -rounding or any(info.health.get(name, 0.0) > ROUNDING for name in NEGATIVE))
    _check(np.isfinite(info.log_likelihood_increment) and np.isfinite(density.quantile([0.025, 0.975])).all())
    assert moment.block is not None and moment.laid is not None
    # The last interval once more, without a reading.  Increments of zero leave something of every density, samples may not.
    _, verdict = copy(live)._step(moment.laid, moment.block, moment.block.rows[row])
    _check(verdict == verdict or live.kind == "samples")
    if live.setting.method.adapt is not None:
        live.setting.method.adapt(moment.block.prepared, moment.laid.state, slice(row, row + 1), None)


def _key(live: Live, said: Any, time: float) -> Key | None:
    """A key of intervals that this filter can have prepared by a time."""
    if said is None:
        return None
    _check(type(said) is list)
    start, step, number, seen, elapsed = said
    spans = None if elapsed is None else _numbers(elapsed, live.m)
    key = Key(_number(start), _number(step), _count(number, 1, CHUNK), _seen(seen, live.m), spans)
    _check(
        0 < key.step
        and (key.start <= time or (key.start == 0.0 and not live.ahead.varying))
        and math.isfinite((time - key.start) / key.step)
        and (spans is None or (live.path and min(spans) >= 0))
    )
    _check(key.number == 1 or (live.ahead.varying and spans is None))
    return key


def _check(holds: Any) -> None:
    if not holds:
        raise ValueError("not a moment of this filter")


def _number(said: Any) -> float:
    _check(type(said) is float and abs(said) <= LARGEST)
    return said


def _numbers(said: Any, count: int) -> tuple[float, ...]:
    _check(type(said) is list and len(said) == count)
    return tuple(map(_number, said))


def _count(said: Any, least: int, most: int) -> int:
    _check(type(said) is int and least <= said <= most)
    return said


def _flag(said: Any) -> bool:
    _check(type(said) is bool)
    return said


def _seen(said: Any, *counts: int) -> tuple[bool, ...]:
    _check(type(said) is list and len(said) in counts)
    return tuple(map(_flag, said))


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
