"""An online filter as words and arrays, and back: all that decides what it reports next.

A state is stored field by field, and read back into the class of the state that the filter itself begins with; nothing that a
file says is executed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from zakai.engine.feed import Feed, Moment
from zakai.methods._protocol import Info
from zakai.models.features import OBSERVED_PATH
from zakai.models.model import Model
from zakai.records.inputs import Inputs

ROUNDING = 1e-9  # of a covariance
AGREES = 0.1  # share by which the reported moments and those of the density may differ: they are computed in two ways
LARGEST = 1e150
NEGATIVE = ("negative_variance", "indefinite_cov")  # health figures that report a negative variance


def stored(moment: Moment) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Return a moment as words and arrays."""
    arrays: list[np.ndarray] = []
    info = moment.info
    data = {
        "time": moment.time,
        "length": moment.length,
        "state": _encoded(moment.state, arrays),
        "info": None if info is None else _encoded(tuple(info[:3]), arrays),
        "health": None if info is None else {name: float(figure) for name, figure in info.health.items()},
        "values": list(moment.values),
        "times": list(moment.times),
        "notes": list(moment.notes),
        "inputs": None if moment.inputs is None else _encoded((moment.inputs.times, moment.inputs.values), arrays),
    }
    return data, arrays


def restored(feed: Feed, data: Mapping[str, Any], arrays: list[np.ndarray]) -> Moment:
    """Return the moment that words and arrays describe; it is not yet the filter's own.

    Raises:
        ValueError: they do not describe a moment of this filter.
    """
    try:
        with np.errstate(all="ignore"):
            return _restored(feed, data, arrays)
    except Exception as error:  # a forged file can make any part of a method fail
        raise ValueError(str(error)) from None


def _restored(feed: Feed, data: Mapping[str, Any], arrays: list[np.ndarray]) -> Moment:
    keys = ("time", "length", "state", "info", "health", "values", "times", "notes", "inputs")
    _check(isinstance(data, dict) and set(data) == set(keys))
    start, time, length = float(feed.setting.model.start), _number(data["time"]), _number(data["length"])
    _check(0.0 <= length <= time - start)
    numbered = iter(enumerate(arrays))
    state = _decoded(feed.now.state, data["state"], numbered)
    values, times = _numbers(data["values"], feed.m), _numbers(data["times"], feed.m)
    notes = data["notes"]
    _check(type(notes) is list and all(type(note) is str and note.isprintable() for note in notes))
    if feed.kind == "path":
        _check(all(start <= at <= time for at in times))
    else:
        _check(values == (0.0,) * feed.m and times == (start,) * feed.m)
    if data["info"] is None:
        _check(data["health"] is None and time == start)
        known = None if data["inputs"] is None else _inputs(feed.setting.model, time, data["inputs"], numbered)
        moment = Moment(time, length, state, None, values, times, tuple(notes), known)
        fresh, own = stored(feed.now._replace(inputs=known)), stored(moment)
        _check(fresh[0] == own[0] and all(a.tobytes() == b.tobytes() for a, b in zip(fresh[1], own[1], strict=True)))
        return moment
    n = feed.setting.model.n
    template = (0.0, np.zeros(n), np.zeros((n, n)))
    increment, mean, cov = _decoded(template, data["info"], numbered)
    health = data["health"]
    inputs = _inputs(feed.setting.model, time, data["inputs"], numbered)
    _check(next(numbered, None) is None and type(health) is dict and all(type(one) is float for one in health.values()))
    _check(time > start or (time == start and feed.kind == "samples"))
    moment = Moment(time, length, state, Info(increment, mean, cov, health), values, times, tuple(notes), inputs)
    _check(np.shape(mean) == (n,) and np.shape(cov) == (n, n))
    valid = feed.setting.method.valid
    _check(valid is None or valid(feed.empty, state))
    _check_believable(feed, moment)
    return moment


def _check_believable(feed: Feed, moment: Moment) -> None:
    """Raise ValueError where the state has no density with the reported moments, or the next step fails."""
    info, model = moment.info, feed.setting.model
    assert info is not None
    density = feed.density(moment)
    own, spread = density.mean(), density.cov()
    apart = np.abs(info.mean - own)
    angles = np.array([name in model.periodic for name in model.state])
    apart = np.where(angles, np.abs(np.angle(np.exp(1j * apart))), apart)
    wide, least = np.abs(np.diagonal(spread)), ROUNDING * (1 + np.square(own))
    _check(np.all(apart <= AGREES * np.sqrt(wide) + np.sqrt(least)))
    _check(np.all(np.abs(np.diagonal(info.cov) - wide) <= AGREES * wide + least))
    for mean, cov in ((info.mean, info.cov), (own, spread)):
        _check(np.isfinite(mean).all() and np.isfinite(cov).all())
        rounding = ROUNDING * (np.abs(cov).max() + np.square(mean).max())
        _check(np.diagonal(cov).min() >= -rounding or any(info.health.get(name, 0.0) > ROUNDING for name in NEGATIVE))
    _check(math.isfinite(float(info.log_likelihood_increment)) and np.isfinite(density.quantile([0.025, 0.975])).all())
    if moment.length > 0:
        follower = Feed(feed.setting)
        follower.now = moment
        # Where formulas contain what is observed, the next step needs an observation: y stays what it is.
        given = list(moment.values) if OBSERVED_PATH in model.features else [math.nan] * feed.m
        follower.moved(moment.time + moment.length, given, moment.inputs)


def _inputs(model: Model, time: float, data: Any, arrays: Iterator[tuple[int, np.ndarray]]) -> Inputs | None:
    """Return the known inputs from the time of a moment on."""
    if data is None:
        _check(not model.inputs)
        return None
    inputs = Inputs(*_decoded((np.zeros(0), np.zeros((0, 0))), data, arrays))
    inputs.check(model, time, time, time)
    return inputs


def _encoded(part: Any, arrays: list[np.ndarray]) -> Any:
    """Return a part of a state as JSON can hold it; its arrays are appended to the list."""
    part = part.item() if isinstance(part, np.generic) else part
    if part is None or isinstance(part, bool | int | float | str):
        return part
    if isinstance(part, np.ndarray):
        arrays.append(part)
        return {"array": len(arrays) - 1}
    return [_encoded(one, arrays) for one in part]


def _decoded(template: Any, data: Any, arrays: Iterator[tuple[int, np.ndarray]]) -> Any:
    """Return the part that JSON describes, of the kind of the template."""
    template = template.item() if isinstance(template, np.generic) else template
    if isinstance(data, dict):
        _check(set(data) == {"array"} and (template is None or isinstance(template, np.ndarray)))
        number, array = next(arrays, (None, np.zeros(0)))
        _check(type(data["array"]) is int and data["array"] == number)
        if template is not None:
            _check(array.dtype == np.asarray(template).dtype and array.ndim == np.ndim(template))
        return array
    if isinstance(data, list):
        _check(isinstance(template, tuple) and len(template) == len(data))
        parts = [_decoded(own, one, arrays) for own, one in zip(template, data, strict=True)]
        return type(template)(*parts) if hasattr(template, "_fields") else tuple(parts)
    if data is None:
        _check(template is None or isinstance(template, np.ndarray))
        return None
    _check(type(data) is type(template))
    _check(type(data) is not float or abs(data) <= LARGEST or data == template)  # the first may be infinite
    return data


def _check(holds: Any) -> None:
    if not holds:
        raise ValueError("not a moment of this filter")


def _number(data: Any) -> float:
    _check(type(data) is float and abs(data) <= LARGEST)
    return float(data)


def _numbers(data: Any, count: int) -> tuple[float, ...]:
    _check(type(data) is list and len(data) == count)
    return tuple(map(_number, data))
