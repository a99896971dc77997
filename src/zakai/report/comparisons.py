"""What the pictures of a study show, as numbers: one curve or one point for each method."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.studies import metrics

MOST = 0.9  # of the runs have an error below the thin line
LEVEL = 0.95
LEAST_SPAN = 5.0  # of a logarithmic axis, so that a difference of nothing does not look like one


class Curve(NamedTuple):
    """A figure over time for one method; `high` is what most runs stay below, or None."""

    label: str
    times: np.ndarray
    middle: np.ndarray
    high: np.ndarray | None = None


class Work(NamedTuple):
    """Cost against accuracy: seconds for an observation, root mean squared error with its standard error, distance."""

    label: str
    seconds: float
    error: float
    spread: float
    distance: float


def error_curves(data: Any) -> list[Curve]:
    """|x - m| over time: the median over the runs that did not fail, and what nine in ten of them stay below."""
    curves = []
    for label, values in _of_methods(data, "squared_error_at"):
        middle, high = np.sqrt(np.quantile(values, [0.5, MOST], axis=0))
        curves.append(Curve(label, data["sample"].values, middle, high))
    return curves


def nees_curves(data: Any) -> tuple[list[Curve], tuple[float, float]]:
    """NEES/n over time, the mean over the runs that did not fail, and its chi-square bounds for all runs."""
    states = data.sizes["state"]
    low, high = (bound / states for bound in metrics.chi_square_bounds(states, data.sizes["run"], LEVEL))
    curves = [Curve(label, data["sample"].values, values.mean(axis=0)) for label, values in _of_methods(data, "nees_at")]
    return curves, (low, high)


def _of_methods(data: Any, name: str) -> list[tuple[str, np.ndarray]]:
    """(label, values (runs, times)) for the methods with a run that did not fail."""
    if name not in data:
        return []
    found = []
    for label in data["filter"].values:
        own = data.sel(filter=label)
        values = own[name].values[own["failed"].values == 0]
        if len(values):
            found.append((str(label), values))
    return found


def works(figures: dict[str, Any], costs: dict[str, Any]) -> list[Work]:
    """A point for each method that has both an error and a time; a distance that is none is nan."""
    found = []
    for label, own in figures["methods"].items():
        squared, seconds = own.get("squared_error", {}), costs["methods"][label]["seconds_per_observation"]
        if squared.get("mean") is None or seconds is None:
            continue
        error = float(np.sqrt(squared["mean"]))
        spread = (squared["standard_error"] or 0.0) / (2 * error) if error > 0 else 0.0
        distance = own.get("distance", {}).get("mean") or float("nan")
        found.append(Work(label, seconds, error, spread, distance))
    return found


def log_range(values: list[float], margin: float = 1.4) -> tuple[float, float]:
    """Where a logarithmic axis begins and ends, with all positive values inside and a span that is not too small."""
    there = [value for value in values if np.isfinite(value) and value > 0] or [1.0]
    low, high = min(there) / margin, max(there) * margin
    wider = float(np.sqrt(max(1.0, LEAST_SPAN * low / high)))
    return low / wider, high * wider


def spans_decades(curves: list[Curve]) -> bool:
    """Whether the curves differ by more than a factor of twenty."""
    values = np.concatenate([curve.middle for curve in curves]) if curves else np.ones(1)
    values = values[np.isfinite(values)]
    return bool(values.size and values.min() > 0 and values.max() > 20 * values.min())
