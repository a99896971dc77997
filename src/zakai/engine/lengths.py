"""Intervals in which the state moves so much that increments have another law than y linear between observations.

With y linear, a path over an interval of length d is weighted by exp(-1/2 int |h - dy/d|^2 / S dt), where the increment, the
integral of h and of noise, says nothing of how h changes within the interval.  With H = dh/dx, the change of the state, whose
covariance is d G, receives the precision d H'S^-1 H / 12.  The mean is off by up to about

    d^2 tr(H G H' S^-1) / 12

standard deviations of the state.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zakai.methods._protocol import Infos
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.records.schedule import Schedule

Array = NDArray[np.float64]
DIFFERS = 0.2  # standard deviations that a result reports


def notes_on_lengths(model: Model, theta: Array, schedule: Schedule, infos: Infos) -> list[str]:
    """Return a sentence on the intervals for which the formula above exceeds 0.2, if there are any.

    Args:
        model: The model.
        theta: The parameters (p,).
        schedule: The K intervals.
        infos: What the filter reports at their ends.
    """
    apart = _distances(model, theta, schedule, infos)
    over = apart > DIFFERS
    if not over.any():
        return []
    where = f"within {int(over.sum())} of {len(apart)} intervals (first at t = {schedule.stops[np.argmax(over)]:g})"
    size = f"{apart.max():.1g}" if apart.max() < 1 else "1 or more"
    return [
        f"y is taken as linear between observations, but the state moves {where} so much that the exact law of the increments "
        f"differs: means are off by up to about {size} standard deviations; give shorter intervals"
    ]


def _distances(model: Model, theta: Array, schedule: Schedule, infos: Infos) -> Array:
    """Return that formula (K,) for every interval, with the slopes of h over a standard deviation about the filtered mean."""
    n, m = model.n, model.m
    if model.observation_kind == "samples" or not len(schedule):
        return np.zeros(len(schedule))
    h, G, S = kept(
        model,
        _distances,
        lambda: (
            numpy_function(model.observation, model),
            numpy_function(model.covariance, model, (n, n)),
            numpy_function(model.observation_noise, model, (m, m)),
        ),
    )
    times, mean = schedule.stops, np.real(infos.mean)
    u = None if schedule.inputs is None else schedule.inputs.at(times, model.input_hold)
    inside = np.where(schedule.inside, schedule.elapsed, 0.0)
    with np.errstate(all="ignore"):
        reach = np.sqrt(np.diagonal(np.real(infos.cov), axis1=1, axis2=2))
        spread, middle, found = G(mean, times, theta, u), h(mean, times, theta, u), 0.0
        precision = np.linalg.inv(np.broadcast_to(S(np.zeros(n), times, theta), (len(times), m, m)))
        for side in (reach, -reach):
            ends = [h(mean + side * axis, times, theta, u) for axis in np.eye(n)]
            slopes = inside[:, :, None] * np.stack([(end - middle) / side[:, j, None] for j, end in enumerate(ends)], axis=2)
            found = found + np.einsum("kia,kab,kjb,kij->k", slopes, spread, slopes, precision) / 24.0
        return np.where(np.isfinite(found), found, 0.0)

