"""What the particle filter is prepared with, and what a step hands to the next."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from zakai.methods.particles.events import Interval
from zakai.methods.particles.interval import Motion
from zakai.methods.particles.islands import UNEVEN, Islands
from zakai.methods.particles.moments import Weighted
from zakai.methods.particles.programs import Array
from zakai.methods.particles.system import System, system_of
from zakai.methods.particles.window import Window, taken
from zakai.models.model import Model
from zakai.numerics.particles.population import systematic
from zakai.numerics.particles.random import key_of, uniform_number
from zakai.records.schedule import Schedule

NOISE, RESAMPLING, PILOT, GUIDE, MOVE, PRIOR, LEVELS = range(7)  # uses of random numbers
MOST_LEVELS = 60  # powers of the likelihood in an interval
BEFORE_MOVES = MOST_LEVELS + 1  # the number of the resampling before moves of the past


class Control(NamedTuple):
    """What decides the next step beside the particles.

    `interval` counts intervals; `substeps` with `stages`, whose `error` was measured in an interval of this `length`, where
    the drift moved the mean at this `pace` and df/dx had this `steepness`, and is `trusted` in so many more of those that
    were `granted`; `narrow` the ratio of the deviations after and before the last observation, `variance` of a mean times N,
    `losses` the sum of its means and `work` that of steps and moves, `excess` what has added up since the last move beyond
    `floor`, what that has left; `present` is the part of the last step, and of `known` such parts steps have left
    `remembered` to the next ones; `rate` is the acceptance of the last move, `doubtful_until` the number of resamplings until
    which standard errors are lower bounds, and `shifted` the variance of the log-likelihood by the time step; `rest` is the
    number of intervals in which the noise of the last ones is not drawn again, as it was in vain, and `failed` the last such one.
    """

    interval: int = 0
    substeps: int = 1
    stages: int = 4
    error: float = 0.0
    length: float = 0.0
    trusted: int = 0
    granted: int = 0
    narrow: float = 1.0
    variance: float = 0.0
    losses: float = 0.0
    work: float = 0.0
    excess: float = 0.0
    floor: float = 0.0
    rate: float = 1.0
    doubtful_until: int = 0
    shifted: float = 0.0
    pace: float = 0.0
    steepness: float = 0.0
    present: float = 0.0
    known: float = 0.0
    remembered: float = 0.0
    rest: int = 0
    failed: int = 0


class Cloud(NamedTuple):
    """Particles with their past while a step works on them.

    `parents` (N,) are those at the beginning of the step, None where these are the same.
    """

    particles: Array
    logs: Array
    window: Window
    islands: Islands
    parents: Array | None = None

    def resampled(self, weights: Array, count: int, key: Array) -> tuple[Cloud, Array]:
        """Return equally weighted particles by systematic resampling, and their ancestors."""
        ancestors = np.empty(count, np.int32)
        systematic(weights, uniform_number(key), ancestors)
        return self._taken(ancestors, self.islands.resampled(ancestors, ancestors)), ancestors

    def ordered(self, now: Weighted, count: int | None, key: Array) -> tuple[Cloud, Array]:
        """Return the particles, resampled to `count` where that is a number, and their numbers (N,) in order within islands."""
        islands, size = self.islands, len(now.weights)
        if count is None:
            rank = np.empty(size, np.int32)
            rank[islands.order(now, False)] = islands.rank
            return self, rank
        spread = islands.spread(now)
        uneven = spread.effective < UNEVEN
        order, places = islands.order(now, uneven), np.empty(count, np.int32)
        systematic(now.weights[order], uniform_number(key), places)
        ancestors = order[places].astype(np.int32)
        if uneven:
            islands, deal = islands.dealt(spread, count)
            ancestors = ancestors[deal]
            islands = islands._replace(founders=islands.founders[ancestors], age=islands.age + 1)
        else:
            islands = islands.resampled(places, ancestors)
        return self._taken(ancestors, islands), islands.rank

    def _taken(self, ancestors: Array, islands: Islands) -> Cloud:
        """Return equally weighted particles with these ancestors."""
        logs = np.full(len(ancestors), -np.log(len(ancestors)))
        parents = ancestors if self.parents is None else self.parents[ancestors]
        return Cloud(taken(self.particles, ancestors), logs, self.window.resampled(ancestors), islands, parents)


class State(NamedTuple):
    """The weighted particles and what continues them.

    `particles` (n, N), `log_weights` (N,) that sum to one, the past, the islands, the controls, `shift` (n,), the error of the
    mean by the time step, `last_shift` (n,), that of the last interval in which it was measured, and `last_scale` (n,), the
    standard deviations in which it was measured.
    """

    particles: Array
    log_weights: Array
    window: Window
    islands: Islands
    control: Control
    shift: Array
    last_shift: Array
    last_scale: Array


@dataclass(frozen=True)
class Rule:
    """The options: the smallest and the largest number of particles, the wanted standard error or none, and the seed.

    `split`: whether particles carry a Kalman filter for linear states even where draws leave a smaller error.
    """

    particles: int
    most: int
    tolerance: float | None
    seed: int
    split: bool

    @property
    def start(self) -> int:
        """The number of particles at the start: what the first observations lose is remembered longest."""
        return self.particles if self.tolerance is None else self.most


@dataclass(frozen=True)
class Prepared:
    """A system with its parameters, a schedule and the options."""

    system: System
    theta: Array
    schedule: Schedule
    rule: Rule
    notes: tuple[str, ...] = ()

    @property
    def model(self) -> Model:
        """The model."""
        return self.system.model

    @cached_property
    def motion(self) -> Motion:
        """The programs for these parameters."""
        return Motion(self.system, self.theta)

    @cached_property
    def plain(self) -> Prepared:
        """The same for particles that carry no Kalman filter."""
        return replace(self, system=system_of(self.model))

    def interval(self, k: int) -> Interval:
        """Return an interval of the schedule."""
        schedule = self.schedule
        start, stop = float(schedule.starts[k]), float(schedule.stops[k])
        inputs = None if schedule.inputs is None else schedule.inputs.part(start, stop)
        return Interval(start, stop, schedule.seen[k], schedule.inside[k], schedule.elapsed[k], inputs)

    def key(self, interval: int, use: int, more: int = 0) -> Array:
        """Return the key of the random numbers of one use in one interval."""
        return key_of(self.rule.seed, interval, use, more)
