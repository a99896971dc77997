"""What the frame filter is prepared with, and what a step hands to the next."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from zakai.methods.frame.errors import Error
from zakai.methods.frame.motion import Motion, System
from zakai.methods.particles.interval import Interval
from zakai.methods.particles.programs import Array
from zakai.models.model import Model
from zakai.numerics.trains.cross import Options
from zakai.numerics.trains.grid import Grid
from zakai.numerics.trains.train import Train
from zakai.records.schedule import Schedule

# Ratio of an interval's length to that of the last comparison of s and 2 s substeps, from which another one is made: in a long
# interval a density is wider, and its substeps have other errors than in a short one.
LONGER = 2.0


class Substeps(NamedTuple):
    """How intervals are divided, by the last comparison of s and 2 s substeps, in the interval `audited`.

    So many `substeps` leave the `error` in L1 in an interval of that `length`, for a density whose covariance has the `root`
    (n, n) at the start; with `both`, s and 2 s are always extrapolated.  The errors of such intervals have one sign, that of
    `relative`, the error of the prediction: they displace a density, whatever its width.
    """

    substeps: float
    length: float
    audited: int
    both: bool
    error: float
    relative: Error
    root: Array

    @classmethod
    def one(cls, n: int, audited: int) -> Substeps:
        """Return one substep for every interval."""
        return cls(1.0, 0.0, audited, False, 0.0, Error.zero(n), np.eye(n))

    def narrowed(self, root: Array) -> tuple[float, Error]:
        """Return by what factor the errors are larger in a density of that root, at least one, and its error."""
        relative, size = self.relative.along(np.linalg.solve(root, self.root)), self.relative.size
        return max(1.0, relative.size / size) if size > 0 else 1.0, relative

    def needed(self, length: float) -> float:
        """Return how many substeps an interval needs; substeps of length d have an error in proportion to `length` d^2."""
        ratio = length / self.length if self.length > 0 else 0.0
        return self.substeps * ratio * math.sqrt(min(max(ratio, 1.0), LONGER))

    def factor(self, length: float, count: int) -> float:
        """Return what so many substeps leave in an interval, in terms of the error."""
        return (length / self.length) ** 3 * (self.substeps / count) ** 2 if self.length > 0 else 0.0


class Control(NamedTuple):
    """What decides the next step beside the density.

    The number of intervals, the substeps, the estimated error, and the factor of the tolerance where ranks met their limit.
    """

    interval: int
    time: Substeps
    error: Error
    looser: float = 1.0


class State(NamedTuple):
    """The density as a train of mass one: its `cores`, its grid, and the controls."""

    cores: tuple[Array, ...]
    centre: Array
    basis: Array
    low: Array
    step: Array
    closed: Array
    control: Control

    def train(self, periods: Array) -> Train:
        """Return the density."""
        sizes = np.array([core.shape[1] for core in self.cores])
        return Train(Grid(self.centre, self.basis, self.low, self.step, sizes, self.closed), self.cores, periods)

    @classmethod
    def of(cls, train: Train, control: Control) -> State:
        """Return the state of a density."""
        grid = train.grid
        return cls(train.cores, grid.centre, grid.basis, grid.low, grid.step, grid.closed, control)


class Choice(NamedTuple):
    """A build: its grid, the control points and their counts, the accuracy, the rank, and about which turn angles are (n,)."""

    grid: Grid
    control: tuple[Array, Array]
    options: Options
    rank: int
    turn: Array


class Half(NamedTuple):
    """A flow over half of a substep: its Runge-Kutta steps, the log that divides its weights, and the build after it.

    `about` is where the noise is linearised; the last flow of an interval has neither noise nor a build.
    """

    steps: int
    top: float
    about: tuple[Array, Array] | None = None
    choice: Choice | None = None


class Made(NamedTuple):
    """The choices of an interval: the halves of each prediction that was used, and the build after the observation."""

    motions: tuple[tuple[Half, ...], ...]
    tails: bool
    top: float
    choice: Choice


class Choices:
    """What a first run chose in each interval: substeps, Runge-Kutta steps, frames, grids, control points.

    The log-likelihood of runs at other parameters that take them has jumps of cross interpolations alone, which are a tenth as
    large there: with choices of their own it jumps by some thousandths.  The grids hold densities of parameters within about a
    standard error.  Index sets are not kept: those of one parameter do not interpolate what a change of another adds.
    """

    def __init__(self) -> None:
        self.made: dict[tuple[tuple[str, ...], int], Made | Choice] = {}


@dataclass(frozen=True)
class Prepared:
    """A system with its parameters, a schedule and the options."""

    system: System
    theta: Array
    schedule: Schedule
    tolerance: float
    most_rank: int
    choices: Choices | None = None
    notes: tuple[str, ...] = ()

    @property
    def model(self) -> Model:
        """The model."""
        return self.system.base.model

    @cached_property
    def motion(self) -> Motion:
        """The programs for these parameters."""
        return Motion(self.system, self.theta)

    def interval(self, k: int) -> Interval:
        """Return an interval of the schedule."""
        schedule = self.schedule
        start, stop = float(schedule.starts[k]), float(schedule.stops[k])
        inputs = None if schedule.inputs is None else schedule.inputs.part(start, stop)
        return Interval(start, stop, schedule.seen[k], schedule.inside[k], schedule.elapsed[k], inputs)
