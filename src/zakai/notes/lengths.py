"""Intervals in which h changes so much that increments have another law than y linear between observations.

With y linear, a path over an interval of length d is weighted by exp(-1/2 int |h - dy/d|^2 / S dt), where the increment, the
integral of h and of noise, says nothing of how h changes within the interval.  With H = dh/dx, the change of the state, whose
covariance is d G, receives the precision d H'S^-1 H / 12.  The mean is off by up to about

    d^2 tr(H G H' S^-1) / 12

standard deviations of the state, and the log-likelihood by as much.  Motion that the drift or t brings adds to that: where they
change h by D within an interval, the log-likelihood is too small by d D'S^-1 D / 24, and the mean is off by up to about

    d |P^1/2 H'S^-1 D| / 12

standard deviations, where P is the covariance of the filter, and by the change of that loss over a standard deviation.

The losses of the log-likelihood have one sign, and add up over a record.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.methods._protocol import Infos
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.records.schedule import Schedule

Array = NDArray[np.float64]
MATTERS = 2.0  # nats of a record that a result reports: as evidence between two models they count as positive
STEP = 1e-3  # of the standard deviations, for the slopes of h
DIFFERS = 0.2  # standard deviations, or nats of an interval, that a result reports


class Distances(NamedTuple):
    """How much the means (K,), in standard deviations, and the log-likelihoods (K,) of intervals differ.

    `nats` is for the state at the mean, `shortfall` for its density.
    """

    means: Array
    nats: Array
    shortfall: Array


def notes_on_lengths(schedule: Schedule, distances: Distances) -> list[str]:
    """Return a sentence on the intervals for which one of the formulas above exceeds 0.2, if there are any.

    Args:
        schedule: The K intervals.
        distances: What `distances_of_lengths` returns.
    """
    means, nats, _ = distances
    over = np.maximum(means, nats) > DIFFERS
    if not over.any():
        return []
    where = f"within {int(over.sum())} of {len(over)} intervals (first at t = {schedule.stops[np.argmax(over)]:.12g})"
    return [
        f"y is taken as linear between observations, but h changes {where} so much that the exact law of the increments differs, "
        f"means by up to about {_size(means)} standard deviations, the log-likelihood of an interval by about {_size(nats)}: "
        f"give shorter intervals"
    ]


def notes_on_increments(times: Array, lost: Array | None) -> list[str]:
    """Return a sentence where the intervals of a record together lose more than two nats.

    Args:
        times: The times (K + 1,) of a result.
        lost: The nats (K + 1,) that are lost up to these times, None for samples.
    """
    if lost is None or not lost[-1] > MATTERS:
        return []
    first = times[np.argmax(lost > MATTERS)]
    return [
        "y is taken as linear between observations: the log-likelihood falls short of that of the exact law of the increments by "
        f"about {lost[-1]:.2g} nats in all (increment_law_error, more than {MATTERS:g} from t = {first:.12g} on); give shorter "
        "intervals"
    ]


def _size(distances: Array) -> str:
    return f"{distances.max():.1g}" if distances.max() < 1 else "1 or more"


def distances_of_lengths(model: Model, theta: Array, schedule: Schedule, infos: Infos) -> Distances:
    """Return by how much the intervals differ.

    Args:
        model: The model.
        theta: The parameters (p,).
        schedule: The K intervals.
        infos: What the filter reports at their ends.
    """
    n, m = model.n, model.m
    if model.observation_kind == "samples" or not len(schedule):
        return Distances(*np.zeros((3, len(schedule))))
    f, h, G, S = kept(
        model,
        distances_of_lengths,
        lambda: (
            numpy_function(model.drift, model),
            numpy_function(model.observation, model),
            numpy_function(model.covariance, model, (n, n)),
            numpy_function(model.observation_noise, model, (m, m)),
        ),
    )
    times, mean = schedule.stops, np.real(infos.mean)
    u = None if schedule.inputs is None else schedule.inputs.at(times, model.input_hold)
    inside = np.where(schedule.inside, schedule.elapsed, 0.0)
    length = np.max(inside, axis=1)
    with np.errstate(all="ignore"):
        reach = np.sqrt(np.diagonal(np.real(infos.cov), axis1=1, axis2=2))
        precision = np.linalg.inv(np.broadcast_to(S(np.zeros(n), times, theta, u), (len(times), m, m)))
        sides = [mean, *(mean + side * axis for side in (reach, -reach) for axis in np.eye(n))]
        seen, drift = np.stack([h(x, times, theta, u) for x in sides]), np.stack([f(x, times, theta, u) for x in sides])
        rate = np.nan_to_num(np.abs(drift[1:] - drift[0]) / reach).max(axis=(0, 2))  # fast changes of the drift end within it
        back = drift * (length / (1.0 + rate * length))[:, None]
        before = np.stack([h(x - moved, times - length, theta, u) for x, moved in zip(sides, back, strict=True)])
        change = np.where(inside > 0.0, seen - before, 0.0)
        motion = length / 24.0 * np.einsum("ika,kab,ikb->ik", change, precision, change)
        slopes = inside * (seen[1:] - seen[0]) / np.concatenate([reach, -reach], axis=1).T[:, :, None]
        slopes = slopes.reshape(2, n, len(times), m)
        noise = np.einsum("sika,kij,kab,sjkb->k", slopes, G(mean, times, theta, u), precision, slopes) / 24.0
        noise /= 1.0 + rate * length / 3.0
        pull = length * np.einsum("ka,kab,ikb->ik", change[0], precision, seen[1 : n + 1] - seen[n + 1 :]) / 24.0
        means = noise + np.linalg.norm(np.abs(pull) + np.abs(motion[1 : n + 1] - motion[n + 1 :]) / 2.0, axis=0)

        def loss(x: Array) -> Array:
            """Return the nats (K,) that an interval loses if its state is x (K, n) at the end."""
            steps = np.einsum("ki,ij->ikj", STEP * reach, np.eye(n))
            after = h(x, times, theta, u)
            change = after - h(x - f(x, times, theta, u) * (length / (1.0 + rate * length))[:, None], times - length, theta, u)
            change = np.where(inside > 0.0, change, 0.0)
            ahead, behind = h(x + steps, times, theta, u), h(x - steps, times, theta, u)
            slopes = inside * (ahead - behind) / (2.0 * STEP * reach.T[:, :, None])
            noise = np.einsum("ika,kij,kab,jkb->k", slopes, G(x, times, theta, u), precision, slopes)
            by_motion = length / 24.0 * np.einsum("ka,kab,kb->k", change, precision, change)
            return np.asarray(noise / (12.0 + 4.0 * rate * length) + by_motion)

        # -log E exp(-loss) over the density, by three Gauss-Hermite points along each axis.
        centre = lost = loss(mean)
        for axis in np.eye(n):
            above, below = (loss(mean + side * np.sqrt(3.0) * reach * axis) - centre for side in (1.0, -1.0))
            lost = lost - np.log((4.0 + np.exp(-above) + np.exp(-below)) / 6.0)
        return Distances(*(np.nan_to_num(part, posinf=0.0) for part in (means, noise + motion[0], lost)))

