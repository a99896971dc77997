"""Observations that no state of a model explains.

The evidence of an observation is compared with the largest density that its own law allows: of a sample that of p(z | x) at its
mode, for x near the filtered mean; of an increment dy that for the best h, dy'C^-1 dy / 2 relative to noise alone.  Whatever the
family, the difference is the negative logarithm of a probability, up to a few nats.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from zakai import _display
from zakai.methods._protocol import Infos
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.notes.health import Bounds
from zakai.records.schedule import Schedule

Array = NDArray[np.float64]
Losses = Mapping[str, float]
OF_START = ("start_error",)  # figures of the prior, which no observation explains
LARGEST = 200.0  # nats of a coordinate: 20 standard deviations
AT_ONCE = 32  # rows in which the mode of a log density is searched together
ROUNDS, CLOSE = 60, 0.5  # of that search: the most rounds, and the gain in nats that ends it
STEPS = np.concatenate([[0.0], *(sign * 2.0 ** np.arange(-40, 41) for sign in (-1.0, 1.0))])
FAR = 2.0 ** np.arange(20, 41, 10)  # distances from an observation at which a density must decay


def misfits(model: Model, theta: Array, schedule: Schedule, values: Array, infos: Infos) -> Array:
    """Return the nats (K,) by which the evidence of each observation falls short, zero up to 200 nats a coordinate.

    Args:
        model: The model.
        theta: The parameters (p,).
        schedule: The K intervals.
        values: Samples or increments (K, m), zero where there is none.
        infos: What the filter reports after each observation.
    """
    short = np.zeros(len(schedule))
    seen, evidence = schedule.seen, np.real(infos.log_likelihood_increment)
    with np.errstate(all="ignore"):
        if model.observation_kind != "samples":
            short = _largest_of_increments(model, theta, schedule, values) - evidence
        elif model.log_density is None:
            short = _largest_of_samples(model, theta, schedule, values, infos, slice(None)) - evidence
        else:  # the mode is searched: from the smallest evidence on, as long as a row falls short
            order = np.argsort(np.where(np.isfinite(evidence), evidence, np.inf), kind="stable")
            for start in range(0, len(order), AT_ONCE):
                rows = order[start : start + AT_ONCE]
                short[rows] = _largest_of_samples(model, theta, schedule, values, infos, rows) - evidence[rows]
                if not (short[rows] > LARGEST).any():
                    break
        return np.where(np.isfinite(short) & (short > LARGEST * np.maximum(seen.sum(axis=1), 1)), short, 0.0)


def notes_on_law(
    model: Model, theta: Array, schedule: Schedule, values: Array, infos: Infos, judged: tuple[Bounds, Losses] = ({}, {})
) -> tuple[list[str], int]:
    """Return sentences on a log density without finite mass over what is observed, else on the observations that fall short.

    Args:
        model: The model.
        theta: The parameters (p,).
        schedule: The K intervals.
        values: Samples or increments (K, m), zero where there is none.
        infos: What the filter reports after each observation.
        judged: The bounds of its figures, and the values above which the density is lost; what exceeds them from the first
            observation on that falls short is a part of the sentence.

    Returns:
        The sentences, and the number of the first observation that falls short, K where none does.
    """
    infinite = _infinite_mass(model, theta, schedule, values, infos)
    if infinite:
        return [
            f"observation_log_density has no finite mass over {infinite!r}: it is no density of {infinite!r}, and the "
            f"log-likelihood has no meaning; subtract the logarithm of its integral over {infinite!r} (of a count: of its "
            "sum over all counts; then this note does not apply)"
        ], len(schedule)
    short = misfits(model, theta, schedule, values, infos)
    if not short.any():
        return [], len(schedule)
    first = int(np.argmax(short > 0.0))
    return [_note_on_misfits(short, schedule.stops) + _consequences(infos, judged, schedule.stops, first)], first


def _infinite_mass(model: Model, theta: Array, schedule: Schedule, values: Array, infos: Infos) -> str:
    """Return the name of an observation in which the log density decays more slowly than 1 / |z|, "" where there is none.

    One row is checked, at the filtered mean.
    """
    rows = np.flatnonzero(schedule.seen.any(axis=1) & np.isfinite(infos.mean).all(axis=1))[:1]
    if model.log_density is None or not len(rows):
        return ""
    times = schedule.stops[rows]
    u = None if schedule.inputs is None else schedule.inputs.at(times, model.input_hold)
    for j, name in enumerate(model.observed):
        for sign in (-1.0, 1.0):
            z = np.repeat(values[rows], len(FAR), axis=0)
            z[:, j] += sign * FAR
            with np.errstate(all="ignore"):
                logs = model.observation_law.log_density(z, infos.mean[rows], times, theta, u)
                if (np.diff(logs) >= -np.diff(np.log(FAR))).all() or (logs == np.inf).any():
                    return name
    return ""


def _note_on_misfits(short: Array, times: Array) -> str:
    """Return a sentence on the observations at these times (K,) that fall short."""
    worst, first, count = int(np.argmax(short)), int(np.argmax(short > 0.0)), int(np.count_nonzero(short))
    which = f"{_display.counted(count, 'observation')} of {len(short)} cannot be explained by the model, "
    which += "" if first == worst else f"first at t = {times[first]:.12g}, "
    which = f"{which}most at " if len(short) > 1 else "the observation cannot be explained by the model, at "
    deviations = f"t = {times[worst]:.12g} ({np.sqrt(2 * short[worst]):.2g} standard deviations)"
    return f"{which}{deviations}; check that observation and its noise (a fill value must be nan, in a file NA or an empty cell)"


def _consequences(infos: Infos, judged: tuple[Bounds, Losses], times: Array, first: int) -> str:
    """Return the end of the sentence: the figures that exceed their bounds from the first observation that falls short on."""
    bounds, losses = judged
    later = {name: np.asarray(figures, float)[first:] for name, figures in infos.health.items()}
    lost = any((later[name] > limit).any() for name, limit in losses.items() if name in later)
    over = []
    for name in OF_START:
        later.pop(name, None)
    for name, bound in {**losses, **{name: bound for name, (bound, _) in bounds.items()}}.items():
        count = int((later[name] > bound).sum()) if name in later else 0
        if count:
            over.append(f"{name} exceeds {bound:g} at {_display.counted(count, 'time')}, up to {np.nanmax(later[name]):.2g}")
    if not over:
        return ""
    what = "the density was lost, and later rows mean nothing" if lost else "estimates may be wrong"
    return f"; from t = {times[first]:.12g} on {what} ({', '.join(over)})"


def _largest_of_increments(model: Model, theta: Array, schedule: Schedule, values: Array) -> Array:
    seen, spans, m = schedule.seen, schedule.elapsed, model.m
    function = kept(model, _largest_of_increments, lambda: numpy_function(model.observation_noise, model, (m, m)))
    u = None if schedule.inputs is None else schedule.inputs.at(schedule.stops, model.input_hold)
    noise = function(np.zeros(model.n), schedule.stops, theta, u)
    both = seen[:, :, None] & seen[:, None, :]
    cov = np.where(both, noise * np.minimum(spans[:, :, None], spans[:, None, :]), np.eye(m) * ~seen[:, None, :])
    return np.asarray(0.5 * (values * np.linalg.solve(cov, values[:, :, None])[:, :, 0]).sum(axis=1))


def _largest_of_samples(
    model: Model, theta: Array, schedule: Schedule, values: Array, infos: Infos, rows: NDArray[np.intp] | slice
) -> Array:
    """Return the largest log density (R,) of the samples of some rows given a state near the filtered mean."""
    times, seen, law = schedule.stops[rows], schedule.seen[rows], model.observation_law
    u = None if schedule.inputs is None else schedule.inputs.at(times, model.input_hold)

    def largest(x: Array) -> Array:
        if model.log_density is None:
            return law.largest(seen, x, times, theta, u)
        inputs = None if u is None else u[:, None]
        return _at_mode(lambda z: law.log_density(z, x[:, None], times[:, None], theta, inputs), values[rows])

    mean = infos.mean[rows]
    found = largest(mean)
    if not np.isfinite(found).all():  # no law at the mean, as between two modes
        reach = np.sqrt(np.diagonal(infos.cov[rows], axis1=1, axis2=2))
        for step in np.concatenate([np.eye(model.n), -np.eye(model.n)]):
            found = np.fmax(found, largest(mean + reach * step))
    return np.where(seen.any(axis=1), found, 0.0)


def _at_mode(log_density: Callable[[Array], Array], z: Array) -> Array:
    """Return the largest log density (R,) that a search at all scales finds from z (R, m); `log_density` takes (R, P, m)."""
    z, value, index = z.copy(), np.full(len(z), -np.inf), np.arange(len(z))
    for _ in range(ROUNDS):
        before = value
        for j in range(z.shape[1]):
            trials = np.repeat(z[:, None], 2 * len(STEPS), axis=1)
            trials[:, :, j] = np.concatenate([z[:, j, None] + STEPS, np.tile(STEPS, (len(z), 1))], axis=1)
            logs = log_density(trials)
            logs = np.where(np.isnan(logs) | (logs == np.inf), -np.inf, logs)
            choice = np.argmax(logs, axis=1)
            better = logs[index, choice] > value
            value = np.where(better, logs[index, choice], value)
            z = np.where(better[:, None], trials[index, choice], z)
        if not (value > before + CLOSE).any():
            break
    return value
