"""What one-state filters on a grid know without data: the formulas of a model, their tables on a grid, decompositions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from zakai.methods.line.model import System
from zakai.methods.line.yau import Kernels, YauLine
from zakai.methods.yau.kernel import PowerSeries
from zakai.models.model import Model
from zakai.numerics.line import window as lw
from zakai.numerics.line.segment import Limits, Mechanisms, Steps
from zakai.records.schedule import Schedule

Array = Any

NOISE = 3e-15  # error of a density relative to its maximum, which matters in its tails
KERNEL_SHARE = 2e-2  # of the promised error that the splitting of one interval may leave in `limited-direct`
SHARE = 5e-3  # of the tolerance that the splitting of one interval may leave
KEPT_BYTES = 96 * 2**20  # of tables and decompositions of grids, which are kept for a model


@lru_cache(maxsize=8)
def _kept(model: Model, theta: bytes, kind: str, setting: Any) -> Kept:
    return Kept()


class Kept(dict[Any, tuple[Any, int]]):
    """Values and their bytes, in the order of their last use; `bytes` is about their sum, which threads may miscount."""

    bytes = 0

    def insert(self, key: Any, value: Any) -> None:
        """Store a value, and drop those that were used long ago where all are large."""
        self[key] = value, (size := _bytes_of(value))
        self.bytes += size
        if self.bytes > KEPT_BYTES:
            self.bytes = sum(size for _, size in list(self.values()))
            while self.bytes > 0.75 * KEPT_BYTES and len(self) > 1:
                try:
                    self.bytes -= self.pop(next(iter(self)), (None, 0))[1]
                except (StopIteration, RuntimeError):  # another thread was faster
                    break


class State(NamedTuple):
    """The probabilities (N,) of the points of a grid, and an estimate of their relative error so far.

    `log_floor` is the logarithm of the error of small values, relative to the largest.
    """

    values: np.ndarray
    origin: float
    centre: float
    spacing: float
    unit: float
    closed: bool
    error: float
    log_floor: float

    @property
    def window(self) -> lw.Window:
        """The grid."""
        return lw.Window(
            float(self.origin), float(self.centre), float(self.spacing), len(self.values), bool(self.closed), float(self.unit)
        )


class Coefficients(NamedTuple):
    """What the compiled loop knows of the coefficients in time of K intervals: see `line_segment.Steps`.

    `parts` (K,) are in how many parts of an interval the Gauss nodes would resolve them, 0 for never.
    """

    drifts: Array
    outputs: Array
    covariances: Array
    precisions: Array
    constants: Array
    parts: Array


@dataclass(eq=False)
class Prepared:
    """What is known without data.

    `tolerance` is what substeps are chosen for, `promised` the error of a step above which a result warns; `negligible` the
    spectrum that need not be resolved; `generous` the size of a grid that is kept though fewer points would do; `pieces` whether
    densities are polynomials between ends and kinks; `kept` holds what was computed for single grids; `shares` (K,) are those of
    parts in the time of their intervals, and `cut_up` whether these are parts of one interval.
    """

    model: Model
    schedule: Schedule
    theta: np.ndarray
    system: System
    tolerance: float
    lengths: np.ndarray
    inside: np.ndarray
    negligible: float
    generous: int
    promised: float
    yau: YauLine | None = None
    kernels: Kernels | None = None
    lie: bool = False
    origin: float = 0.0
    series: PowerSeries | None = None
    notes: tuple[str, ...] = ()
    shares: np.ndarray | None = None
    pieces: bool = False
    cut_up: bool = False

    @cached_property
    def kept(self) -> Kept:
        """What was computed for single grids, shared by all schedules of a model with these parameters and this method."""
        setting = self.pieces, self.tolerance, self.yau is None, self.kernels is None, self.series is None, self.lie, self.origin
        return _kept(self.model, self.theta.tobytes(), self.theta.dtype.str, setting)

    @cached_property
    def real(self) -> Prepared:
        """The same at the real part of the parameters, whose tables all directions of a gradient share."""
        return replace(self, theta=self.theta.real.copy())

    @cached_property
    def divides(self) -> bool:
        """Whether the compiled loop can split the transition into diffusion and a potential."""
        system = self.system
        smooth = not (system.state_dependent or system.general or system.rough) and system.slope is not None
        return smooth and system.cross is None and not (self.model.periodic and not system.samples)

    @cached_property
    def gaussian(self) -> bool:
        """Whether the compiled loop takes Gaussian kernels and splits, else the decomposition of the operator."""
        if self.yau is not None:
            return not self.model.periodic or (self.yau.flat and self.system.samples)
        return self.divides and (self.system.moving or not self.system.samples)

    @cached_property
    def timed(self) -> bool:
        """Whether coefficients vary within an interval that the compiled loop splits."""
        system = self.system
        affine = self.yau is not None and self.yau.affine and self.yau.unobserved and not system.samples
        steady = not system.moving and system.steady_observation and (system.samples or system.steady_noise)
        return self.gaussian and self.divides and not steady and not affine

    @cached_property
    def weak(self) -> bool:
        """Whether the likelihoods of samples have kinks and act in the weak sense."""
        system = self.system
        kinked = system.samples and system.kinked_observation and system.steady_observation and not system.general
        return kinked and not self.model.periodic and not np.iscomplexobj(self.theta)

    @property
    def smoothing(self) -> bool:
        """Whether all kinks are those of likelihoods: a transition smooths them, and a finer grid has no more of them."""
        return self.weak and not self.system.rough

    @property
    def kinked(self) -> bool:
        """Whether densities have kinks."""
        return self.weak or self.system.kinked_drift

    @cached_property
    def mixed(self) -> bool:
        """Whether f or h are not known as sums of products of functions of t and of x."""
        return self.timed and self.system.separated is None

    @cached_property
    def cut(self) -> float:
        """The density relative to its maximum that a grid must hold."""
        kernels = self.yau is not None and self.yau.unobserved and self.yau.steady_gauge
        if not self.gaussian or not (self.divides or kernels) or self.lie or np.iscomplexobj(self.theta):
            return lw.CUT
        if self.model.periodic:
            return 1e-280  # a grid around the circle holds every value
        return 1e-32 if self.system.samples else lw.DEEP

    @cached_property
    def coefficients(self) -> Coefficients:
        """The coefficients in time of all intervals."""
        from zakai.methods.line.steps import coefficients_of

        return coefficients_of(self)

    @cached_property
    def parts(self) -> Parts | None:
        """The parts of intervals in which the Gauss nodes do not resolve the coefficients, None where they do in all."""
        from zakai.methods.line.parts import parts_of

        return parts_of(self)

    @property
    def largest(self) -> int:
        """The points of the largest grid of the compiled loop, and of any grid where a larger one does not help."""
        return lw.LARGE if self.gaussian else lw.LARGEST

    def largest_for(self, look: lw.Figures | None = None, size: int = 0) -> int:
        """Return the points of the largest grid for a density with some figures on a grid of some size.

        The spectrum of kinks and that of noise fall slowly on every grid, what the largest grid of all does not resolve none
        does, and noise that grows with the state, and potentials within intervals, are too fast for a large one.
        """
        noisy, system = False, self.system
        if look is not None and look.aliasing > self.negligible:
            noisy = look.rough if look.aliasing < lw.GROSS else size >= lw.SIZES[-1]
        slow = noisy or system.kinked_drift or not system.smooth_observation or system.state_dependent or not system.samples
        return self.largest if slow else lw.SIZES[-1]

    @cached_property
    def kinds(self) -> np.ndarray:
        """How the compiled loop takes each interval (K,): FACTOR, SPLIT or KERNEL; -1 where it does not."""
        from zakai.methods.line.steps import kinds_of

        return kinds_of(self)

    @cached_property
    def steps(self) -> Steps:
        """What the compiled loop reads of all intervals."""
        from zakai.methods.line.steps import steps_of

        return steps_of(self)

    @cached_property
    def limits(self) -> Array:
        """What a step of the compiled loop must keep, as the fields of `line_segment.Limits`."""
        splitting = SHARE * self.tolerance if self.yau is None else KERNEL_SHARE * self.promised
        generous = lw.LARGE if self.timed and self.model.periodic else self.generous
        finest = 512.0 if self.system.samples else 256.0
        return np.array(Limits(self.negligible, self.promised, splitting, self.cut, generous, finest), float)

    @cached_property
    def mechanisms(self) -> Mechanisms:
        """What the compiled loop needs for this model."""
        system, yau, closed = self.system, self.yau, bool(self.model.periodic)
        whole = yau is not None and yau.unobserved and yau.steady_gauge and self.kernels is not None
        always = whole and yau is not None and (not system.moving if system.samples else yau.affine)
        return Mechanisms(whole, self.divides and not always, system.samples, self.weak, closed)

    @cached_property
    def fast(self) -> list[bool]:
        """Which intervals (K,) the compiled loop may take."""
        found: list[bool] = (self.kinds >= 0).tolist()
        return found

    def deepest(self, floor: float) -> float:
        """Return the depth of the tails, as a logarithm below the maximum, to which a density with this floor is accurate."""
        return max(float(np.log(self.promised) - np.log(max(floor, 1e-300))), 2.3)

    def once(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return what `make` returns for a key, from the last ones that were kept; a value depends on its key alone."""
        found = self.kept.pop(key, None)
        if found is None:
            value = make()
            self.kept.insert(key, value)
            return value
        self.kept[key] = found  # the last one that was used is the last one to go
        return found[0]


def _bytes_of(value: Any) -> int:
    """Return the bytes of the arrays in a value and in the attributes of its objects."""
    if isinstance(value, tuple | list):
        return sum(map(_bytes_of, value))
    if isinstance(value, np.ndarray):
        return value.nbytes
    return 64 + sum(map(_bytes_of, getattr(value, "__dict__", {}).values()))


class Parts(NamedTuple):
    """The parts of all intervals: those of interval k are first[k] to first[k + 1] of `prepared`."""

    prepared: Prepared
    first: Array
