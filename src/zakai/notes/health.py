"""Warnings: a sentence for each bound that a health figure exceeds, with what to change."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Bounds = Mapping[str, tuple[float, str]]


class Result(Protocol):
    """What is checked of a result."""

    @property
    def times(self) -> Array:
        """The times (K+1,)."""

    @property
    def state(self) -> tuple[str, ...]:
        """The names of the states (n,)."""

    @property
    def mean(self) -> Array:
        """The means (K+1, n)."""

    @property
    def cov(self) -> Array:
        """The covariances (K+1, n, n)."""

    @property
    def log_likelihood_increments(self) -> Array:
        """The evidence of each step (K+1,)."""

    @property
    def health(self) -> Mapping[str, Array]:
        """Figures of each step (K+1,)."""

    @property
    def bounds(self) -> Bounds:
        """The bounds of figures, with the words of their warnings."""


_MORE_OBSERVATIONS = "give more frequent observations"
_OTHER_METHOD = "take another method that holds"
_PARTICLES, _COMPARE = "take guided-particles", "compare with guided-particles"
_MORE_COMPONENTS = f"{_OTHER_METHOD}, or raise the option components"
_WIDER_PRIOR = "give a wider prior, if it is not meant so narrow"
NOTICEABLE = 1e-3  # deviations: an error of the mean within three digits of the deviation
SLIGHT = 0.05  # deviations: an error of the mean up to which its size says enough, without advice
VISIBLE = 0.1  # deviations: an error that draws can confirm
UNKNOWN = 1.0  # deviations: an estimated error as large as the density is wide says that it may be lost
MANY = 4  # states on a grid, which is too coarse for most densities then
OF_PARTICLES = 0.03  # deviations: the error of means by particles, unless another one is asked for; it is no advice below that
_OF_LOST = {"splitting_error": "the steps in time do not resolve the motion of the density"}
# What to change, for the figures whose words do not say it.
ADVICE = {
    "negative_variance": "give variances of the noise and of the prior that are nearer in size",
    "representation_error": _WIDER_PRIOR,
    "edge_weight": _WIDER_PRIOR,
    "gauge_error": _OTHER_METHOD,
    "tolerance_ratio": f"{_MORE_OBSERVATIONS}, or a larger tolerance (command: --option tolerance=...)",
    "tail_depth": "check that observation and its noise",
    "aliasing": _COMPARE,
    "off_grid_error": f"raise most_rank, or {_COMPARE}",
    "splitting_error": _COMPARE,
    "outside_tables": "extend the table",
    "unknown_draws": "compare with the method guided-particles",
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


def warnings_of_step(health: Mapping[str, Any], bounds: Bounds, lost: Mapping[str, float]) -> list[str]:
    """Return a sentence for every bound that one step exceeds.

    Args:
        health: The figures of the step.
        bounds: For a figure its bound, and the words of the warning.
        lost: For a figure the value above which the step has lost the density.
    """
    values = {name: float(health[name]) for name in health}
    gone = [name for name, limit in lost.items() if values.get(name, np.nan) > limit]
    said = []
    for name in gone[:1]:
        said.append(f"the density was lost ({name} is {values[name]:.2g} and exceeds {lost[name]:g}): {_words(name, bounds)}")
    for name, (bound, what) in bounds.items():
        value, error = values.get(name, np.nan), values.get("error_estimate", np.nan)
        if not value > bound or (gone and (name == "tolerance_ratio" or name in lost)):
            continue
        if name != "tolerance_ratio" or np.isnan(error):
            said.append(f"{name} is {value:.2g} and exceeds {bound:g}: {advised(name, what)}")
        elif error >= UNKNOWN:
            said.append(f"the density may be lost (error_estimate is {error:.2g} deviations); {_COMPARE}")
        elif NOTICEABLE < error <= SLIGHT:
            said.append(f"the mean may be off by up to {error:.1g} standard deviations (tolerance_ratio is {value:.2g})")
        elif error > NOTICEABLE:
            said.append(f"the mean may be off by up to {error:.1g} deviations (tolerance_ratio is {value:.2g}); {_COMPARE}")
    return said


def warnings_of_run(
    result: Result,
    lost: Mapping[str, float] | None = None,
    distances: Callable[[], Array | None] = lambda: None,
    asked: float | None = None,
) -> list[str]:
    """Return a sentence for every bound that a result exceeds, and for values that are not finite.

    Args:
        result: The result.
        lost: For a figure the value above which a step has lost the density.
        distances: Returns how far the moments are from those at a coarser tolerance, in deviations (K+1,), None where that is
            not known; it is called where the estimates of the method exceed their bounds.
        asked: The tolerance of the method, None where it has none.
    """
    limits: Mapping[str, float] = lost or {}
    said: list[str] = []
    first = _lost_by_figure(result, limits, said)
    bad: Array = ~np.isfinite(result.log_likelihood_increments)
    if bad.any():
        gone = int(np.argmax(bad))
        if gone <= first:
            said = []
        # A grid or a train of several states loses what particles may follow.
        instead = f"; where they are right, {_PARTICLES}" if len(result.state) > 1 and "tolerance_ratio" in result.bounds else ""
        said.append(
            f"the density was lost at t = {result.times[gone]:.12g}: nothing after that time can be trusted; check that "
            f"observation and its noise, and whether the drift leads to infinity in a finite time{instead}"
        )
        first = min(first, gone)
    else:
        without: Array = np.asarray(~np.isfinite(result.mean).all(axis=1) | ~np.isfinite(result.cov).all(axis=(1, 2)))
        if without.any():
            when = result.times[np.argmax(without)]
            said.append(
                f"no moments were found at {int(without.sum())} of {len(without)} times, first at t = {when:.12g}: "
                f"nothing there can be trusted; {_OTHER_METHOD}"
            )
    for name, (bound, what) in result.bounds.items():
        over = np.asarray(result.health[name] > bound) if name in result.health else np.zeros(0, bool)
        if name == "tolerance_ratio" and "error_estimate" in result.health:
            over[first:] = False
            said += _of_tolerance(result, over, distances, asked) if over.any() else []
            continue
        if name in limits:  # of later rows it is said that the density is lost
            over[first:] = False
        if over.any():
            times = len(over) - int(np.isnan(result.health[name][0]))  # a filter has no figure of the start
            worst = int(np.nanargmax(np.where(over, result.health[name], -np.inf)))
            said.append(
                f"{name} exceeds {bound:g} at {int(over.sum())} of {times} times, most at t = "
                f"{result.times[worst]:.12g} ({result.health[name][worst]:.2g}): {advised(name, what)}"
            )
    return said


def _lost_by_figure(result: Result, limits: Mapping[str, float], said: list[str]) -> int:
    """Return the first row at which a figure says that the density is lost, K+1 where none does; append its sentence."""
    rows = {name: np.flatnonzero(result.health[name] > limit) for name, limit in limits.items() if name in result.health}
    rows = {name: found for name, found in rows.items() if len(found)}
    if not rows:
        return len(result.times)
    name = min(rows, key=lambda name: int(rows[name][0]))
    first, count = int(rows[name][0]), len(np.unique(np.concatenate(list(rows.values()))))
    again = f", and at {count - 1} later times" if count > 2 else ", and at a later time" if count == 2 else ""
    what = _words(name, result.bounds)
    value, limit = float(result.health[name][first]), limits[name]
    said.append(
        f"the density was lost at t = {result.times[first]:.12g}{again}: later rows mean nothing ({name} is {value:.2g} there "
        f"and exceeds {limit:g}: {what})"
    )
    return first


def _of_tolerance(
    result: Result, over: Array, distances: Callable[[], Array | None], asked: float | None
) -> list[str]:
    """Return by how much the moments may be off, and from when on, where steps missed the tolerance; nothing if by little.

    The estimate of the method is a bound, and so is the distance from a result of a coarser tolerance: the smaller one counts.
    An error that is slight is said with its size and what was asked, without advice.
    """
    errors = np.nan_to_num(np.asarray(result.health["error_estimate"], float), nan=0.0)
    if not errors.max() > NOTICEABLE:
        return []
    apart = distances()
    errors = errors if apart is None else np.minimum(errors, apart)
    off = np.flatnonzero(errors > NOTICEABLE)
    if not len(off):
        return []
    ratio = float(np.nanmax(np.where(over, result.health["tolerance_ratio"], -np.inf)))
    figure = f"(the tolerance was missed at {_times(int(over.sum()))}, by up to {ratio:.2g} times: tolerance_ratio)"
    said, unknown = [], np.flatnonzero(errors >= UNKNOWN)
    end = int(unknown[0]) if len(unknown) else len(errors)
    advice = _COMPARE if len(result.state) < MANY else _PARTICLES
    if off[0] < end:
        last, largest = int(off[off < end][-1]), float(errors[off[0] : end].max())
        start, stop = (f"t = {result.times[k]:.12g}" for k in (off[0], last))
        when = f"from {start} on" if last + 1 == end else f"at {start}" if last == off[0] else f"from {start} to {stop}"
        if largest <= SLIGHT and not len(unknown):
            wanted = "" if asked is None else f"; asked: {asked:.1g}"
            size = f"{largest:.1g} standard deviations, {when}"
            return [f"the means may be off by about {size}{wanted} (tolerance_ratio: {ratio:.2g})"]
        size = f"{largest:.1g} deviations, {when}"
        change = advice if largest > (OF_PARTICLES if len(result.state) >= MANY else VISIBLE) else _MORE_OBSERVATIONS
        said.append(f"the means may be off by about {size} {figure}; {change}")
    if len(unknown):
        when = f"{result.times[end]:.12g}"
        said.append(
            f"the density may be lost from t = {when} on: the error may be {errors[end]:.1g} deviations there, and later rows "
            f"may mean nothing {figure}; {advice}"
        )
    return said


def _times(count: int) -> str:
    return "one time" if count == 1 else f"{count} times"


def _words(name: str, bounds: Bounds) -> str:
    """Return the words of a figure that says that the density is lost."""
    return advised(name, bounds[name][1] if name in bounds else _OF_LOST[name])


def advised(name: str, what: str) -> str:
    """Return the words of a figure with what to change."""
    what = what.split(". ")[0]  # one sentence
    return what if ";" in what or name not in ADVICE else f"{what}; {ADVICE[name]}"
