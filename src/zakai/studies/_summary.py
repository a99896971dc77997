"""What the runs of a study come to: figures for JSON, and the rows of its table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray

from zakai.studies import metrics
from zakai.studies._batch import COSTS, FAILURES
from zakai.studies.specification import Point, Study

_FIGURES = ("squared_error", "distance", "nees", "nis", "crps", "log_score", "hellinger")
LEVEL = 0.95


def summary(study: Study, points: Sequence[xarray.Dataset]) -> dict[str, Any]:
    """All figures of all points, none of which depends on the clock."""
    return {
        "name": study.name,
        "key": study.key(),
        "reference": study.reference,
        "runs": len(study.runs),
        "moments": "densities" if study.densities else "the Gaussians with the filters' moments",
        "points": [_point(study, point, data) for point, data in zip(study.points, points, strict=True)],
    }


def _point(study: Study, point: Point, data: xarray.Dataset) -> dict[str, Any]:
    return {
        "point": point.label,
        "model": point.model,
        "parameters": dict(point.parameters),
        "observations": int(data.attrs["observations"]),
        "states": [str(name) for name in data["state"].values],
        "methods": {
            entry.label: {"method": entry.method, "options": dict(entry.options), **_method(study, entry.label, data)}
            for entry in study.methods
        },
    }


def _method(study: Study, label: str, data: xarray.Dataset) -> dict[str, Any]:
    own = data.sel(filter=label)
    failed = own["failed"].values
    figures: dict[str, Any] = {
        "failures": int((failed > 0).sum()),
        "failed": {word: int((failed == code).sum()) for code, word in enumerate(FAILURES) if code and (failed == code).any()},
        "warned": int((own["warnings"].values > 0).sum()),
        "said": _commonest(own["said"].values),
    }
    figures |= {name: metrics.over_runs(own[name].values, failed > 0) for name in _FIGURES if name in own}
    likelihood = metrics.over_runs(own["log_likelihood"].values, failed > 0)
    figures["log_likelihood"] = {name: likelihood[name] for name in ("mean", "standard_error", "runs")}
    if "nees_at" in own:
        figures["nees"] |= _within(own["nees_at"].values[failed == 0], own.sizes["state"])
    if "pit_at" in own:
        figures["pit"] = _uniform(own["pit_at"].values[failed == 0])
    if "squared_error" in own and study.reference is not None:
        figures["squared_error"]["above_reference"] = _paired(own, data.sel(filter=study.reference))
    return figures


def _commonest(said: np.ndarray) -> str:
    """The sentence that was said most often, of failures and of warnings."""
    sentences, counts = np.unique([str(one) for one in said if one] or [""], return_counts=True)
    return str(sentences[np.argmax(counts)])


def _within(nees: np.ndarray, states: int) -> dict[str, Any]:
    """Chi-square bounds of NEES averaged over the runs at one time, a state, and the share of the times within them."""
    if not len(nees):
        return {"bounds": None, "within": None}
    low, high = (bound / states for bound in metrics.chi_square_bounds(states, len(nees), LEVEL))
    average = nees.mean(axis=0)
    return {"bounds": [low, high], "within": float(np.mean((average >= low) & (average <= high)))}


def _uniform(pit: np.ndarray) -> dict[str, Any]:
    """Uniformity over runs at the last time, of the state that is furthest from it; the probability is Bonferroni's."""
    if not len(pit):
        return {"distance": None, "probability": None}
    tests = [metrics.uniformity(pit[:, -1, state]) for state in range(pit.shape[-1])]
    distance, probability = max(tests)
    return {"distance": distance, "probability": min(1.0, probability * len(tests))}


def _paired(own: xarray.Dataset, reference: xarray.Dataset) -> dict[str, Any]:
    """The mean difference of the squared errors on the runs that neither lost, with its standard error."""
    difference = own["squared_error"].values - reference["squared_error"].values
    return metrics.over_runs(difference, (own["failed"].values > 0) | (reference["failed"].values > 0))


def timing(study: Study, points: Sequence[xarray.Dataset]) -> dict[str, Any]:
    """Seconds and bytes of every method at every point; they differ from machine to machine and from run to run."""
    return {
        "points": [
            {
                "point": point.label,
                "methods": {str(label): _costs(data.sel(filter=label)) for label in data["filter"].values},
            }
            for point, data in zip(study.points, points, strict=True)
        ]
    }


def _costs(own: xarray.Dataset) -> dict[str, float | None]:
    """Per observation the median over batches, of first calls the longest, of memory the most."""
    how: Mapping[str, Any] = {"seconds": np.nanmedian, "first_call": np.nanmax, "memory": np.nanmax}
    names = {"seconds": "seconds_per_observation", "first_call": "first_call_seconds", "memory": "memory_bytes"}
    found = {}
    for name in COSTS:
        values = np.atleast_1d(own[name].values)
        found[names[name]] = float(how[name](values)) if np.isfinite(values).any() else None
    return found
