"""The substeps of an interval by their measured error: pilots, in so many substeps and in twice as many with the same noise."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from zakai.methods.particles.events import Events, Interval
from zakai.methods.particles.interval import Motion, Scheme
from zakai.methods.particles.programs import Array
from zakai.numerics.particles.motion import ADDITIVE
from zakai.numerics.particles.random import key_of, normals
from zakai.numerics.particles.step_errors import StepErrors, step_errors

PILOTS = 128  # particles by which the time step is measured
# Of a mean or a standard deviation by one interval, in standard deviations, that a step is chosen for, or this share of the
# standard error of a mean where that is more, up to a largest one.
TIME_ERROR, OF_RANDOM_ERROR, MOST_TIME_ERROR = 0.005, 0.1, 0.1
MOST_SUBSTEPS = 64
# Times e that a deviation may shrink within a substep: where the noise of a whole one decays, s and 2 s substeps agree that there
# is none, and what an exact flow takes back is large in its middle.
DECAYED = 4.0
LEAST_CONTRACTION = 0.02  # ratio of deviations at the end and the start of an interval, below which errors are not judged by it


class Steps(NamedTuple):
    """The scheme of an interval, the shift (n,) of the mean that it leaves, and its error in standard deviations.

    `surely` is the error with what a finite number of pilots leaves open; not `measured` are those that follow from the last one.
    """

    scheme: Scheme
    shift: Array
    error: float
    surely: float
    measured: bool = True


class Pilots(NamedTuple):
    """What measures the time step.

    States (n, PILOTS), their mean (n,), deviations (n,), a whole number for the noise, and the error that is allowed.
    """

    states: Array
    mean: Array
    scale: Array
    key: int
    allowed: float


def least_substeps(motion: Motion, interval: Interval, values: Array, about: tuple[Array, Array]) -> tuple[int, int]:
    """Return the substeps in which noise decays by no more than e^`DECAYED`, and the drift without its linear part by e.

    Args:
        motion: the formulas.
        interval: the interval.
        values: the increments (m,).
        about: the mean and the standard deviations (n,).
    """
    length = interval.stop - interval.start
    noisy, rest = (rate * length for rate in motion.decay(interval, values, *about))
    return max(1, math.ceil(min(noisy / DECAYED, MOST_SUBSTEPS))), math.ceil(min(rest, MOST_SUBSTEPS))


def steps_of(motion: Motion, interval: Interval, values: Array, pilots: Pilots, guess: int) -> Steps:
    """Return the cheapest scheme whose error in the mean and the spread, in standard deviations, is at most the allowed one.

    Args:
        motion: the formulas.
        interval: the interval.
        values: the increments (m,).
        pilots: what it is measured with.
        guess: the first number of substeps to try.
    """
    system = motion.system
    fewest, resolved = least_substeps(motion, interval, values, (pilots.mean, pilots.scale))
    count = max(fewest, guess)
    found = Steps(Scheme(count, 4), np.full(system.n, np.nan), np.inf, np.inf)
    for turn in range(4):
        errors = _time_errors(motion, interval, values, pilots._replace(key=pilots.key + turn), count)
        # The flow is of a higher order than the noise: fewer substeps than half of what was measured may have any error.
        # A step over more than one time constant of what decays has errors that its halves do not foresee.
        least = max(-(-count // 2) if turn == 3 else 1, min(count, resolved), fewest)
        choices = [_needed(Scheme(count, stages), *one, pilots.allowed, least) for stages, one in errors.items()
                   if np.isfinite(one[0])]  # fmt: skip
        if not choices:
            if count >= MOST_SUBSTEPS:
                break
            count = min(4 * count, MOST_SUBSTEPS)
            continue
        found = min(choices, key=lambda one: (max(one.error, 1.001 * pilots.allowed), one.scheme.work, one.scheme.substeps))
        wanted = found.scheme.substeps
        if count <= 2 * wanted <= 4 * count:
            break
        count = max(wanted, int(np.sqrt(count * wanted)))
    return found


def _needed(measured: Scheme, error: float, shift: Array, surely: float, allowed: float, least: int) -> Steps:
    """Return the substeps that an error of second order in their length needs, at least so many."""
    count = measured.substeps
    wanted = int(np.clip(np.ceil(count * np.sqrt(error / allowed)), least, MOST_SUBSTEPS))
    share = (count / wanted) ** 2
    return Steps(Scheme(wanted, measured.stages), share * shift, share * error, share * surely)


def _time_errors(
    motion: Motion, interval: Interval, values: Array, pilots: Pilots, count: int
) -> dict[int, tuple[float, Array, float]]:
    """Return the errors of `count` substeps of 2 and of 4 stages, by the difference from twice as many, times 4/3.

    By the number of stages: the largest error of a mean or a deviation, in standard deviations, the shift of the mean (n,),
    and the error with that of the pilots.
    """
    system, found = motion.system, coupled(motion, interval, values, pilots, count)

    def change(stages: int) -> tuple[float, Array, float]:
        x, gained = found.by(motion, stages)
        shift, largest = np.empty(system.n), np.empty(2)
        errors = StepErrors(
            found.start, x, gained, found.finer, found.finer_gained, system.angles, pilots.scale, found.variances,
            system.owners,
        )
        step_errors(errors, LEAST_CONTRACTION, shift, largest)
        return 4 / 3 * float(largest[0]), 4 / 3 * shift, 4 / 3 * float(largest[1])

    return {2: change(2), 4: change(4)}


class Coupled(NamedTuple):
    """Pilots that twice as many substeps moved from `start` to `finer` (n, N), and the `coarse` events with the same `noise`.

    `variances` (n,) are by how much the noise of the coarse events has more variance at the end.
    """

    start: Array
    finer: Array
    finer_gained: Array
    coarse: Events
    noise: Array
    variances: Array

    def by(self, motion: Motion, stages: int) -> tuple[Array, Array]:
        """Return the ends (n, N) by the coarse events in so many stages, and the integrated log weights (N,)."""
        places = self.coarse.places.copy()
        places[:, 2] = stages
        return motion.advanced(self.coarse._replace(places=places), self.start, self.noise)


def coupled(motion: Motion, interval: Interval, values: Array, pilots: Pilots, count: int) -> Coupled:
    """Return pilots after an interval by 2 `count` substeps, and what moves them by `count` with the same noise."""
    system, mean, scale = motion.system, pilots.mean, pilots.scale
    (coarse, slopes), (fine, _) = (motion.linearised(interval, Scheme(k, 4), values, mean, scale) for k in (count, 2 * count))
    noise, start = np.empty((fine.width, pilots.states.shape[1])), pilots.states
    normals(key_of(pilots.key), 0, noise.shape[1], noise)
    if system.kind != ADDITIVE:
        noise, start = _exchanged(fine, noise, start)
    carried = 0.25 * (interval.stop - interval.start) / count * slopes
    halves = expm(carried), expm(-carried)
    shared = _coarse_noise(motion, coarse, fine, noise, halves)
    y, gained = motion.advanced(fine, start, noise)
    variances = np.zeros(system.n)
    if system.kind == ADDITIVE and not system.affine and fine.width and len(coarse.times) == count + 1:
        variances = _more_variance(coarse.roots, fine.roots, halves)
    return Coupled(start, y, gained, coarse, shared, variances)


def _more_variance(coarse: Array, fine: Array, halves: tuple[Array, Array]) -> Array:
    """Return by how much kicks of substeps (J, n, d) have more variance (n,) at the end than those of their halves (2 J, n, d).

    `halves` (J, n, n) carry them to the middle.  Pilots do not show it: the kicks of both are the same.
    """
    ahead, back = halves
    parts = ahead @ fine[::2], back @ fine[1::2]
    apart = coarse @ coarse.transpose(0, 2, 1) - sum(part @ part.transpose(0, 2, 1) for part in parts)
    total, half = np.zeros(apart.shape[1:]), ahead @ ahead
    for own, flow in zip(apart, half, strict=True):
        total = flow @ (flow @ total @ flow.T + own) @ flow.T
    return total.diagonal().copy()


def _exchanged(fine: Events, noise: Array, start: Array) -> tuple[Array, Array]:
    """Return pairs of pilots with equal starts, where one has the noise of both halves of each substep in the other order.

    Which half has which noise moves the end by a first-order difference that says nothing about the time step; in pairs it
    cancels.
    """
    half, width, count = start.shape[1] // 2, int(fine.rows[0, 1]), len(fine.rows)
    parts = noise.reshape(count, -1, noise.shape[1])[:, :, :half]
    other = parts.copy()
    other[0::2, :width], other[1::2, :width] = parts[1::2, :width], parts[0::2, :width]
    both = np.concatenate([parts, other], axis=2).reshape(len(noise), -1)
    return both, np.concatenate([start[:, :half], start[:, :half]], axis=1)


def _coarse_noise(motion: Motion, coarse: Events, fine: Events, noise: Array, halves: tuple[Array, Array]) -> Array:
    """Return the noise of the substeps that makes the same kicks as that of their halves, carried to the middle.

    `halves` (J, n, n) are the linearised flows over a quarter of a substep, and back.  What these do to kicks on their way says
    nothing about the time step, and in the mean of few pilots would hide what does.
    """
    count, pilots = len(coarse.rows), noise.shape[1]
    if motion.system.kind == ADDITIVE:
        if not fine.width:
            return np.zeros((0, pilots))
        kicks = fine.roots @ noise.reshape(2 * count, -1, pilots)
        both = halves[0] @ kicks[::2] + halves[1] @ kicks[1::2]
        shared = np.linalg.pinv(coarse.roots, rcond=1e-6) @ both
        return np.ascontiguousarray(shared.reshape(coarse.width, pilots))
    shared = np.zeros((coarse.width, pilots))
    for j in range(count):
        first, width, coin = coarse.rows[j]
        parts = [noise[begin : begin + own] for begin, own, _ in fine.rows[2 * j : 2 * j + 2]]
        shared[first : first + width] = (parts[0] + parts[1]) / np.sqrt(2)
        if coin:
            shared[first + width] = noise[fine.rows[2 * j, 0] + fine.rows[2 * j, 1]]
    return shared
