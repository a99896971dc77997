"""What a result warns of beside its health figures: formulas without a value, angles in degrees, tables that end."""

from __future__ import annotations

from typing import Any

import numpy as np
import sympy as sp

from zakai.models._entries import formula
from zakai.models.angles import observed_angles
from zakai.models.features import formulas_of
from zakai.models.functions import TableFunction
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.models.numeric import explain_nonfinite, numpy_function
from zakai.records import Inputs, Record
from zakai.records.schedule import Schedule

_KEYS = ("drift", "diffusion", "observation")
FORGOTTEN = 1000.0  # ratio of the first interval to the longest other, which no schedule of observations has
ENDED = 10.0  # longest distances of inputs after which a record that goes on has lost them
_REACH, _TIMES = 3.0, 32  # deviations from the mean, and number of times, that are checked


def notes_on_formulas(model: Model, theta: np.ndarray, record: Record, mean: np.ndarray, variance: np.ndarray) -> list[str]:
    """Return a sentence for every formula that is not finite within three deviations of the mean, at some of the times.

    Args:
        model: The model.
        theta: The parameters (p,).
        record: The record, with K times.
        mean: (K+1, n), that of the prior first.
        variance: (K+1, n).
    """
    keys = [key for key in _KEYS if _is_partial(getattr(model, key), model)]
    if not keys:
        return []
    times = np.concatenate([[model.start], record.times])
    # Not symmetric, so that a removable singularity at the mean, as in sin(x)/x, is not hit.
    steps = np.linspace(-_REACH, _REACH, 12)[:, None, None] * np.eye(model.n)
    checked = np.unique(np.linspace(0, len(times) - 1, _TIMES).astype(int))
    notes = []
    for key in keys:
        for k in checked:
            points = (mean[k] + steps * np.sqrt(np.maximum(variance[k], 0.0))).reshape(-1, model.n)
            points = points[_inside(model, points) & np.isfinite(points).all(axis=1)]
            reason = why_not_finite(model, key, points, float(times[k]), theta, record.inputs)
            if reason:
                notes.append(f"{reason}, within {_REACH:g} deviations of the mean; give a [domain], or change the formula")
                break
    return notes


def why_not_finite(model: Model, key: str, points: np.ndarray, t: float, theta: np.ndarray, inputs: Inputs | None) -> str:
    """Return why the formulas of a key are not finite at one of the points (P, n), or nothing where they are."""
    formulas, u = getattr(model, key), None if inputs is None else inputs.at(t, model.input_hold)
    evaluate = kept(model, (why_not_finite, key), lambda: numpy_function(list(formulas), model))
    with np.errstate(all="ignore"):
        wrong = ~np.isfinite(evaluate(points, t, theta, u)).all(axis=-1)
    return explain_nonfinite(model, key, formulas, points[wrong][0], t, u) if wrong.any() else ""


def notes_on_start(schedule: Schedule) -> list[str]:
    """Return a sentence where the first interval is a thousand times as long as all others: a start that was forgotten.

    Times in seconds since 1970 with a start of zero begin with an interval of fifty years.
    """
    lengths = schedule.lengths
    later = lengths[1:].max(initial=0.0)
    if not schedule.seen.any() or not later > 0.0 or not lengths[0] > FORGOTTEN * later:
        return []
    first, last = float(schedule.starts[0]), float(schedule.stops[0])
    return [
        f"the first interval, from the model's start {first:.12g} to the first time {last:.12g}, is "
        f"{lengths[0] / later:.2g} times as long as the longest other; unless it is meant, give a start next to the "
        f"first time, as start = {last - float(later):.12g}"
    ]


def notes_on_inputs(model: Model, inputs: Inputs | None, last: float) -> list[str]:
    """Return a sentence where known inputs end long before the last time of the record, and their last values are held."""
    if inputs is None or len(inputs) < 3:
        return []
    end = float(inputs.times[-1])
    if not last - end > ENDED * float(np.diff(inputs.times).max()):
        return []
    return [
        f"the inputs {', '.join(model.inputs)} end at t = {end:.12g}, and their last values are held up to {last:.12g}; unless "
        f"it is meant, give them for all of the record, in its unit of time"
    ]


def notes_on_angles(model: Model, record: Record) -> list[str]:
    """Return a sentence where samples of an angle exceed a turn, as they do in degrees."""
    angles = np.array(observed_angles(model)) | (np.array(model.observation_family) == "von-mises")
    if not angles.any():
        return []
    largest = float(np.nanmax(np.abs(np.asarray(record.values, float)[:, angles]), initial=0.0))
    if largest <= 2 * np.pi + 1e-6:
        return []
    return [f"observed angles of up to {largest:g} are taken modulo 2 pi; give them in radians"]


def notes_on_tables(model: Model, theta: np.ndarray, record: Record) -> list[str]:
    """Return a sentence for every table of time or inputs alone that is constant beyond its range at a time of the record."""
    calls = {call for part in formulas_of(model) for call in part.atoms(TableFunction) if not call.has(*model.x)}
    notes = []
    for call in sorted(calls, key=str):
        times = np.concatenate([[model.start], record.times])
        u = None if record.inputs is None else record.inputs.at(times, model.input_hold)
        arguments = numpy_function(list(call.args), model)(np.zeros(model.n), times, theta, u)
        beyond = call.table.outside(*np.moveaxis(arguments, -1, 0))
        if beyond.any():
            when = f"at {int(beyond.sum())} of {len(times)} times, first at t = {times[beyond][0]:.12g}"
            notes.append(f"{formula(call)} is beyond the range of the table, where that is constant, {when}; extend the table")
    return notes


def notes_on_domain(model: Model, theta: np.ndarray, record: Record, result: Any, reflects: bool) -> list[str]:
    """Return a sentence for every end of a domain that several states may cross, unless the method `reflects` them there.

    They cross an end near which there is mass where the noise of that coordinate does not vanish, or its drift leads outwards.
    """
    notes: list[str] = []
    if model.n == 1 or not model.domain:
        return notes
    mean, variance = np.asarray(result.mean), np.asarray(result.variance)
    evaluate = kept(model, notes_on_domain, lambda: numpy_function([*model.drift, *model.covariance.diagonal()], model))
    for name, interval in model.domain.items():
        if reflects and interval.reflecting:
            continue
        i = model.state.index(name)
        for end, side in ((interval.lower, 1.0), (interval.upper, -1.0)):
            if not np.isfinite(end):
                continue
            distance = side * (mean[:, i] - end) / np.sqrt(np.maximum(variance[:, i], 1e-300))
            k = int(np.argmin(np.nan_to_num(distance, nan=np.inf)))
            point, t = mean[k].copy(), float(record.times[k - 1]) if k else model.start
            point[i] = end
            u = None if record.inputs is None else record.inputs.at(t, model.input_hold)
            with np.errstate(all="ignore"):
                found = np.nan_to_num(evaluate(point[None], t, theta, u)[0])
            if distance[k] < _REACH and (found[model.n + i] > 0 or side * found[i] < 0):
                notes.append(
                    f"domain: the process may cross the end {end:g} of {name!r}, which is not kept with several states: "
                    f"the density counts what lies beyond it; let the noise of {name!r} vanish there, or take its logarithm "
                    f"as the state"
                )
    return notes


def _is_partial(formulas: Any, model: Model) -> bool:
    """Return whether a formula has a part that may have no value at a real state."""
    state = set(model.x)
    return any(
        part.free_symbols & state
        for formula in formulas
        for part in formula.atoms(sp.log, sp.asin, sp.acos, sp.Pow)
        if not (isinstance(part, sp.Pow) and part.exp.is_integer and part.exp.is_nonnegative)
    )


def _inside(model: Model, points: np.ndarray) -> np.ndarray:
    inside = np.ones(len(points), bool)
    for name, interval in model.domain.items():
        inside &= interval.contains(points[:, model.state.index(name)])
    return inside
