"""What a file of a result holds beside moments: quantiles, and the record from which its densities are computed again."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from zakai.errors import InputError

if TYPE_CHECKING:
    from zakai.engine.plan import Plan
    from zakai.engine.results import FilterResult
    from zakai.records import Record

Variables = dict[str, tuple[list[str], np.ndarray, dict[str, Any]]]

LEVELS = (0.025, 0.05, 0.25, 0.5, 0.75, 0.95, 0.975)
MOST_QUANTILES = 20_000  # marginal densities whose quantiles are stored by default: a few seconds of work
DIMENSIONS = {
    "level": ("level",),
    "quantile": ("level", "time", "state"),
    "record_time": ("record_row",),
    "record_value": ("record_row", "record_column"),
    "input_time": ("input_row",),
    "input_value": ("input_row", "input_column"),
}


def quantiles_of(result: FilterResult, most: float = MOST_QUANTILES) -> Variables:
    """Return the quantiles of all marginal densities, or nothing where there are no densities or more than `most`."""
    if result._quantiles is not None:
        return _variables(dict(zip(("level", "quantile"), result._quantiles, strict=True)))
    if not result.has_densities or result.mean.size > most:
        return {}
    return _variables({"level": np.array(LEVELS), "quantile": result.quantile(LEVELS)})


def record_of(result: FilterResult, plan: Plan, record: Record) -> tuple[Variables, dict[str, str]]:
    """Return the record of a result and its request, from which it can be computed again.

    Raises:
        InputError: a forecast, or a result for another prior than the model's.
    """
    if result.attributes.get("kind") == "forecast":
        raise InputError("save: densities of a forecast are not stored; store the filtered result, and forecast again from it")
    if result.model is None:
        raise InputError("save: densities=True needs a result for the model's own prior; see Model.with_prior")
    method, options = plan.request
    try:
        request = json.dumps({"method": method, "options": dict(options), "kind": record.kind})
    except (TypeError, ValueError):
        raise InputError("save: densities=True stores options that are numbers and texts only") from None
    arrays = {"record_time": record.times, "record_value": record.values}
    if record.inputs is not None:
        inputs = record.inputs.since(result.model.start)
        arrays |= {"input_time": inputs.times, "input_value": inputs.values}
    return _variables(arrays), {"request": request}


def _variables(arrays: dict[str, np.ndarray]) -> Variables:
    return {name: (list(DIMENSIONS[name]), values, {}) for name, values in arrays.items()}
