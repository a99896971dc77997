"""Results that were written to files."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from zakai.engine.results import FilterResult
from zakai.engine.smoother import SmoothingResult
from zakai.engine.variables import DIMENSIONS
from zakai.errors import InputError
from zakai.models._errors import named
from zakai.models.files import read_model
from zakai.records.dates import Clock
from zakai.records.netcdf import load_variables
from zakai.records.writing import shown

_LONGEST_NAME = 64  # of a state, or a method
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
    """Read a result that its `save` wrote; densities are not stored.

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
    kind = str(attributes.get("kind", ""))
    return (SmoothingResult if kind == "smoothed" else FilterResult)(
        times=arrays["time"],
        mean=arrays["mean"],
        variance=arrays["variance"],
        log_likelihood_increments=arrays["log_likelihood_increment"],
        health={_RENAMED.get(name, name): values for name, values in arrays.items() if name not in known},
        warnings=[line for line in str(attributes.get("warnings", "")).split("\n") if line],
        method=method,
        why=str(attributes.get("why", "")),
        model=read_model(text, source) if text else None,
        state=state,
        attributes=_clock_attributes(attributes, source) | ({"kind": kind} if kind in _KINDS else {}),
        mean_standard_error=arrays.get("mean_standard_error"),
        log_likelihood_standard_error=_number(attributes, "log_likelihood_standard_error"),
        _cov=arrays.get("cov"),
        _no_density=f"{source}: a stored result has no densities; filter again to have them",
    )


def _number(attributes: Mapping[str, Any], name: str) -> float | None:
    """Return a number among the attributes of a file, None where there is none."""
    value = attributes.get(name)
    return float(value) if isinstance(value, float | int | np.number) and not isinstance(value, bool) else None


def _clock_attributes(attributes: Mapping[str, Any], source: str) -> dict[str, str]:
    """Return the unit and origin of dates that a file has, checked."""
    given = {name: str(attributes[name]) for name in ("time_unit", "time_origin") if name in attributes}
    if len(given) < 2:
        return {}
    with named(source):
        Clock.of(given["time_origin"], given["time_unit"])
    return given


def _check_layout(variables: Mapping[str, Any], source: str) -> None:
    """Raise InputError unless the variables are those of a result, over the right dimensions."""
    for name in ("time", "state", "mean", "variance", "log_likelihood_increment"):
        if name not in variables:
            raise InputError(f"{source}: has no variable {name!r}; give a result written by zakai filter")
    sizes = {name: np.size(variables[of][1]) for name, of in (("time", "time"), ("state", "state"), ("state_", "state"))}
    for name, (dimensions, values, _) in variables.items():
        expected = DIMENSIONS.get(name, ("time",))
        numbers = values.dtype.kind == "f" or name in ("state", "state_")
        if tuple(dimensions) != expected or not numbers or values.shape != tuple(sizes[axis] for axis in expected):
            over = ", ".join(map(str, dimensions))[:60]
            fault = f"{name[:40]!r} is over {over!r} of shape {values.shape}, or holds no floating-point numbers"
            raise InputError(f"{source}: {fault}; give a result written by zakai filter")
