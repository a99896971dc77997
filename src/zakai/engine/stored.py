"""Results that were written to files."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from zakai.engine import kept_record
from zakai.engine.driver import filter as run_filter
from zakai.engine.results import FilterResult
from zakai.engine.smoother import SmoothingResult, smooth
from zakai.engine.variables import DIMENSIONS
from zakai.engine.versions import other_versions, versions
from zakai.errors import InputError
from zakai.models._errors import named
from zakai.models.files import read_model
from zakai.models.model import Model
from zakai.records import Inputs, Record
from zakai.records.dates import Clock
from zakai.records.netcdf import load_variables
from zakai.records.writing import shown

_LONGEST_NAME = 64  # of a state, or a method
AGREES = 1e-3  # deviations by which a mean that is computed again may differ from the stored one
_KINDS = ("smoothed", "forecast")  # of results, beside those of filters
# Names that health figures had in version 0.1.
_RENAMED = {
    "missed": "tolerance_ratio",
    "lost": "tail_truncation",
    "surprise": "tail_depth",
    "exponent": "gauge_exponent",
    "splitting": "splitting_error",
    "resolution": "std_in_spacings",
    "negative": "negative_mass",
}


def load_result(path: str | os.PathLike[str]) -> FilterResult:
    """Read a result that its `save` wrote; it has densities where it was saved with `densities=True`.

    Args:
        path: the file.

    Returns:
        The result, a `SmoothingResult` where one was saved.

    Raises:
        InputError: the file is not such a result.

    Example:
        result.save("result.nc")
        zakai.load_result("result.nc").mean[-1]
    """
    return result_of(*load_variables(path), shown(path))


def result_of(variables: Mapping[str, Any], attributes: Mapping[str, Any], source: str) -> FilterResult:
    """Return the result that the variables and attributes of a file describe; `source` is its name in errors.

    Raises InputError where they describe none.
    """
    _check_layout(variables, source)
    arrays = {name: values for name, (_, values, _) in variables.items()}
    method, state = str(attributes.get("method", "")), tuple(str(name) for name in arrays["state"])
    for word in (method, *state):
        if not word.isprintable() or len(word) > _LONGEST_NAME:
            fault = f"{ascii(word[:40])} is no name of a method or a state"
            raise InputError(f"{source}: {fault}; give a result written by zakai filter")
    text = str(attributes.get("model", ""))
    known = {*DIMENSIONS, "log_likelihood_increment"}
    kind, model, clock = str(attributes.get("kind", "")), read_model(text, source) if text else None, _clock(attributes, source)
    compute = None if model is None else _again(arrays, attributes, model, clock, source)
    return (SmoothingResult if kind == "smoothed" else FilterResult)(
        times=arrays["time"],
        mean=arrays["mean"],
        variance=arrays["variance"],
        log_likelihood_increments=arrays["log_likelihood_increment"],
        health={_RENAMED.get(name, name): values for name, values in arrays.items() if name not in known},
        warnings=[line for line in str(attributes.get("warnings", "")).split("\n") if line],
        method=method,
        why=str(attributes.get("why", "")),
        model=model,
        state=state,
        attributes=_clock_attributes(clock) | ({"kind": kind} if kind in _KINDS else {}),
        mean_standard_error=arrays.get("mean_standard_error"),
        log_likelihood_standard_error=_number(attributes, "log_likelihood_standard_error"),
        _cov=arrays.get("cov"),
        _density=None if compute is None else lambda k: compute().density(k),
        _no_density=f"{source}: was stored without densities; save the result with densities=True, or filter again",
        _quantiles=(arrays["level"], arrays["quantile"]) if "quantile" in arrays else None,
        _again=compute,
    )


def _number(attributes: Mapping[str, Any], name: str) -> float | None:
    """Return a number among the attributes of a file, None where there is none."""
    value = attributes.get(name)
    return float(value) if isinstance(value, float | int | np.number) and not isinstance(value, bool) else None


def _again(
    arrays: Mapping[str, np.ndarray], attributes: Mapping[str, Any], model: Model, clock: Clock | None, source: str
) -> Callable[[], FilterResult] | None:
    """Return a function that computes a stored result again, None where the file holds no record."""
    if "record_time" not in arrays or "record_value" not in arrays or "request" not in attributes:
        return None
    done: list[FilterResult] = []

    def compute() -> FilterResult:
        if not done:
            done.append(_computed(arrays, attributes, model, clock, source))
        return done[0]

    return compute


def _computed(
    arrays: Mapping[str, np.ndarray], attributes: Mapping[str, Any], model: Model, clock: Clock | None, source: str
) -> FilterResult:
    damaged = InputError(f"{source}: its record or its options are damaged; filter the record again")
    try:
        request = json.loads(str(attributes["request"]))
        method, options, kind = request["method"], dict(request["options"]), request["kind"]
        inputs = Inputs(arrays["input_time"], arrays["input_value"]) if "input_time" in arrays else None
        unit, origin = (None, None) if clock is None else (clock.unit, clock.origin)
        record = Record(arrays["record_time"], arrays["record_value"], kind, inputs, unit, origin)
        if not isinstance(method, str):
            raise damaged
    except (KeyError, TypeError, ValueError):
        raise damaged from None
    with named(source):
        if attributes.get("kind") == "smoothed":
            found: FilterResult = smooth(model, record, method, **options)
        else:
            found = run_filter(model, record, method, keep="densities", **options)
    deviation = np.sqrt(np.maximum(arrays["variance"], np.finfo(float).tiny))
    if found.mean.shape != arrays["mean"].shape or not np.all(np.abs(found.mean - arrays["mean"]) <= AGREES * deviation):
        stored = {name: str(attributes.get(name)) for name in versions()}
        by = other_versions(stored) or "zakai on another machine"
        raise InputError(f"{source}: was computed with another version of {by} and differs now; filter the record again")
    return found


def _clock(attributes: Mapping[str, Any], source: str) -> Clock | None:
    """Return the unit and origin of dates that a file has, checked."""
    given = {name: str(attributes[name]) for name in ("time_unit", "time_origin") if name in attributes}
    if len(given) < 2:
        return None
    with named(source):
        return Clock.of(given["time_origin"], given["time_unit"])


def _clock_attributes(clock: Clock | None) -> dict[str, str]:
    return {} if clock is None else {f"time_{name}": str(value) for name, value in clock._asdict().items()}


def _check_layout(variables: Mapping[str, Any], source: str) -> None:
    """Raise InputError unless the variables are those of a result, over the right dimensions."""
    for name in ("time", "state", "mean", "variance", "log_likelihood_increment"):
        if name not in variables:
            raise InputError(f"{source}: has no variable {name!r}; give a result written by zakai filter")
    sizes = {name: np.size(variables[of][1]) for name, of in (("time", "time"), ("state", "state"), ("state_", "state"))}
    for name, axes in kept_record.DIMENSIONS.items():  # what is only in some files has the sizes that it brings
        if name in variables and variables[name][1].ndim == len(axes):
            sizes = dict(zip(axes, variables[name][1].shape, strict=True)) | sizes
    if "quantile" in variables and "level" not in variables:
        raise InputError(f"{source}: has quantiles without levels; give a result written by zakai filter")
    for name, (dimensions, values, _) in variables.items():
        expected = DIMENSIONS.get(name, ("time",))
        numbers = values.dtype.kind == "f" or name in ("state", "state_")
        if tuple(dimensions) != expected or not numbers or values.shape != tuple(sizes[axis] for axis in expected):
            over = ", ".join(map(str, dimensions))[:60]
            fault = f"{name[:40]!r} is over {over!r} of shape {values.shape}, or holds no floating-point numbers"
            raise InputError(f"{source}: {fault}; give a result written by zakai filter")
