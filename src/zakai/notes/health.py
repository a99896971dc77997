"""Warnings: a sentence for each bound that a health figure exceeds, with what to change."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from zakai.engine.results import FilterResult

Bounds = Mapping[str, tuple[float, str]]
_MORE_OBSERVATIONS = "give more frequent observations"
_OTHER_METHOD = "take another method that holds"
_MORE_COMPONENTS = f"{_OTHER_METHOD}, or raise the option components"
_WIDER_PRIOR = "give a wider prior, if it is not meant so narrow"
NOTICEABLE = 1e-3  # deviations: an error of the mean within three digits of the deviation
# What to change, for the figures whose words do not say it.
ADVICE = {
    "negative_variance": "give variances of the noise and of the prior that are nearer in size",
    "representation_error": _WIDER_PRIOR,
    "edge_weight": _WIDER_PRIOR,
    "gauge_error": _OTHER_METHOD,
    "tolerance_ratio": f"{_MORE_OBSERVATIONS}, or a larger tolerance (command: --option tolerance=...)",
    "tail_depth": "check that observation and its noise",
    "outside_tables": "extend the table",
    "without_law": "change the formula of the observation where it has no value",
    "mean_error": _MORE_COMPONENTS,
    "deviation_error": _MORE_COMPONENTS,
    "evidence_error": f"{_OTHER_METHOD}, or raise its accuracy",
    "start_error": _MORE_COMPONENTS,
    "nonlinearity": _MORE_COMPONENTS,
    "quadrature": _MORE_COMPONENTS,
    "pruned": _MORE_COMPONENTS,
    "merged": _MORE_COMPONENTS,
    "edge_mass": _OTHER_METHOD,
    "quadrature_error": _OTHER_METHOD,
    "time_quadrature_error": _MORE_OBSERVATIONS,
    "unfinished": _MORE_OBSERVATIONS,
    "linearisation": _OTHER_METHOD,
    "indefinite_cov": _MORE_OBSERVATIONS,
}


def warnings_of_step(health: Mapping[str, Any], bounds: Bounds) -> list[str]:
    """Return a sentence for every bound that one step exceeds."""
    return [
        f"{name} is {float(health[name]):.2g} and exceeds {bound:g}: {advised(name, what)}"
        for name, (bound, what) in bounds.items()
        if name in health and float(health[name]) > bound
    ]


def warnings_of_run(result: FilterResult) -> list[str]:
    """Return a sentence for every bound that a result exceeds, and for values that are not finite."""
    said = []
    bad = ~np.isfinite(result.log_likelihood_increments)
    if bad.any():
        time = result.times[np.argmax(bad)]
        said.append(
            f"the density was lost at t = {time:.12g}: nothing after that time can be trusted; check that "
            "observation and its noise, and whether the drift leads to infinity in a finite time"
        )
    else:
        lost = ~np.isfinite(result.mean).all(axis=1) | ~np.isfinite(result.cov).all(axis=(1, 2))
        if lost.any():
            first = result.times[np.argmax(lost)]
            said.append(
                f"no moments were found at {int(lost.sum())} of {len(lost)} times, first at t = {first:.12g}: "
                f"nothing there can be trusted; {_OTHER_METHOD}"
            )
    for name, (bound, what) in result.bounds.items():
        over = result.health[name] > bound if name in result.health else np.zeros(0, bool)
        if over.any() and name == "tolerance_ratio" and "error_estimate" in result.health:
            said += _of_tolerance(result, over)
        elif over.any():
            times = len(over) - int(np.isnan(result.health[name][0]))  # a filter has no figure of the start
            worst = int(np.nanargmax(np.where(over, result.health[name], -np.inf)))
            said.append(
                f"{name} exceeds {bound:g} at {int(over.sum())} of {times} times, most at t = "
                f"{result.times[worst]:.12g} ({result.health[name][worst]:.2g}): {advised(name, what)}"
            )
    return said


def _of_tolerance(result: FilterResult, over: np.ndarray) -> list[str]:
    """Return by how much the means may be off, and from when on, where steps missed the tolerance; nothing if by little.

    The estimate is a bound, which may be far above the error: beyond one deviation it says only that it knows nothing.
    """
    errors = np.nan_to_num(np.asarray(result.health["error_estimate"], float), nan=0.0)
    off = errors > NOTICEABLE
    if not off.any():
        return []
    first, worst = float(result.times[np.argmax(off)]), float(errors.max())
    ratio = float(np.nanmax(np.where(over, result.health["tolerance_ratio"], -np.inf)))
    size = f"by about {worst:.1g} deviations" if worst < 1.0 else "by an unknown amount"
    return [
        f"the means may be off {size}, from t = {first:.12g} on (tolerance_ratio exceeds 1 at {int(over.sum())} times, up to "
        f"{ratio:.2g}); compare with a result of tolerance=1e-2: digits that agree are right; {_MORE_OBSERVATIONS}"
    ]


def advised(name: str, what: str) -> str:
    """Return the words of a figure with what to change."""
    what = what.split(". ")[0]  # one sentence
    return what if ";" in what or name not in ADVICE else f"{what}; {ADVICE[name]}"
