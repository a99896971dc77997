"""A result as the variables and attributes of a file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from zakai.engine import kept_record

if TYPE_CHECKING:
    from zakai.engine.results import FilterResult

_LARGEST_COV = 32  # number of states up to which covariances are stored
# All others are over the time.
DIMENSIONS = {
    **{name: (name,) for name in ("time", "state", "state_")},
    **{name: ("time", "state") for name in ("mean", "variance", "mean_standard_error")},
    "cov": ("time", "state", "state_"),
    **kept_record.DIMENSIONS,
}


def variables_of(result: FilterResult) -> dict[str, tuple[list[str], np.ndarray, dict[str, Any]]]:
    """Return the variables of a file by name: their dimensions, values and attributes."""
    names = np.array(result.state, dtype=object)
    found = {
        "time": result.times,
        "state": names,
        "state_": names,
        "mean": result.mean,
        "variance": result.variance,
        "log_likelihood_increment": result.log_likelihood_increments,
    }
    if result.mean_standard_error is not None:
        found["mean_standard_error"] = result.mean_standard_error
    if len(names) <= _LARGEST_COV:
        found["cov"] = result.cov
    variables: dict[str, Any] = {name: (list(DIMENSIONS.get(name, ("time",))), array, {}) for name, array in found.items()}
    for name, values in result.health.items():
        variables[name] = (["time"], values, {"description": result.bounds.get(name, (0, name))[1]})
    return variables


def attributes_of(result: FilterResult) -> dict[str, Any]:
    """Return the attributes of a file."""
    clock = {} if result.clock is None else {f"time_{name}": str(value) for name, value in result.clock._asdict().items()}
    error = result.log_likelihood_standard_error
    return {
        **clock,
        **({} if error is None else {"log_likelihood_standard_error": error}),
        "method": result.method,
        "why": result.why,
        "log_likelihood": result.log_likelihood,
        "warnings": "\n".join(result.warnings),
        "model": result.model.text if result.model is not None else "",
        **result.attributes,
    }
