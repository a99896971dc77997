"""What the frame filter is prepared with, and what a step hands to the next."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from zakai.methods.frame.errors import Error
from zakai.methods.frame.motion import Motion, System
from zakai.methods.particles.events import Interval
from zakai.methods.particles.programs import Array
from zakai.models.model import Model
from zakai.numerics.trains.cross import Options
from zakai.numerics.trains.grid import Grid
from zakai.numerics.trains.train import Train
from zakai.records.schedule import Schedule


class Substeps(NamedTuple):
    """How many `substeps` the last interval of a `length` above zero needed."""

    substeps: float
    length: float


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
    """A build: its grid, the control points and their counts, the accuracy, the ranks, and about which turn angles are (n,)."""

    grid: Grid
    control: tuple[Array, Array]
    options: Options
    ranks: list[int]
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
    tails: float
    top: float
    choice: Choice


class Choices:
    """What a first run chose in each interval: substeps, Runge-Kutta steps, frames, grids, control points.

    The log-likelihood of runs at other parameters that take them has jumps of cross interpolations alone, which are a tenth as
    large there: with choices of their own it jumps by some thousandths.  The grids hold densities of parameters within about a
    standard error.  Index sets are not kept: those of one parameter do not interpolate what a change of another adds.
    """

    def __init__(self, coarser: float = 1.0) -> None:
        """Keep choices, of runs with a tolerance that is as many times larger."""
        self.coarser = coarser
        self.made: dict[tuple[tuple[str, ...], int], Made | Choice] = {}


class Recent:
    """The density of the last state of a run, with the moments and points that were computed of it."""

    train: Train | None = None


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
    recent: Recent = field(default_factory=Recent, compare=False, repr=False)

    @property
    def model(self) -> Model:
        """The model."""
        return self.system.base.model

    @cached_property
    def motion(self) -> Motion:
        """The programs for these parameters."""
        return Motion(self.system, self.theta)

    def train(self, state: State) -> Train:
        """Return the density of a state."""
        known = self.recent.train
        return known if known is not None and known.cores is state.cores else state.train(self.system.periods)

    def interval(self, k: int) -> Interval:
        """Return an interval of the schedule."""
        schedule = self.schedule
        start, stop = float(schedule.starts[k]), float(schedule.stops[k])
        inputs = None if schedule.inputs is None else schedule.inputs.part(start, stop)
        return Interval(start, stop, schedule.seen[k], schedule.inside[k], schedule.elapsed[k], inputs)
