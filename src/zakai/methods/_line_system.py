"""What one-state filters on a grid know without data: the formulas of a model, their tables on a grid, decompositions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from zakai.methods._line_yau import Kernels, YauLine
from zakai.methods._series_kernel import PowerSeries
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.numerics import line_window as lw
from zakai.numerics.line_operator import Spectral
from zakai.numerics.line_panels import GAUSS_NODES, GAUSS_WEIGHTS
from zakai.numerics.line_splitting import FACTOR, KERNEL, SPLIT
from zakai.records.schedule import Schedule

Array = Any

NOISE = 3e-15  # error of a density relative to its maximum, which matters in its tails
KEPT = 60  # tables and decompositions of grids that are kept for a model


class System:
    """The formulas of a model with one state as functions of points and times."""

    def __init__(self, model: Model):
        x, t = model.x[0], model.t
        self.m = model.m
        self.samples = model.observation_kind == "samples"
        self.drift = numpy_function(model.drift, model, (1,))
        self.slope = numpy_function([sp.diff(model.drift[0], x)], model, (1,))
        self.covariance = numpy_function(model.covariance, model, (1, 1))
        self.observation = numpy_function(model.observation, model, (model.m,))
        self.noise = numpy_function(model.observation_noise, model, (model.m, model.m))
        self.observation_slope = numpy_function([sp.diff(h, x) for h in model.observation], model, (model.m,))
        second = [sp.diff(h, x, 2) for h in model.observation]
        smooth = not any(h.has(sp.DiracDelta, sp.Derivative, sp.sign) for h in second)
        self.curvature = numpy_function(second, model, (model.m,)) if smooth else None
        self.moving = model.drift.has(t) or model.covariance.has(t)
        self.steady_observation = not model.observation.has(t)
        self.steady_noise = not model.observation_noise.has(t)
        self.varying = self.moving or not (self.samples or (self.steady_observation and self.steady_noise))


@lru_cache(maxsize=32)
def system_of(model: Model) -> System:
    """Return the functions of a model, made once."""
    return System(model)


@lru_cache(maxsize=8)
def _kept(model: Model, theta: bytes, kind: str) -> dict[Any, Any]:
    return {}


class State(NamedTuple):
    """The probabilities (N,) of the points of a grid, and an estimate of their relative error so far."""

    values: np.ndarray
    origin: float
    centre: float
    spacing: float
    unit: float
    closed: bool
    error: float

    @property
    def window(self) -> lw.Window:
        """The grid."""
        return lw.Window(
            float(self.origin), float(self.centre), float(self.spacing), len(self.values), bool(self.closed), float(self.unit)
        )


@dataclass(eq=False)
class Prepared:
    """What is known without data.

    `tolerance` is what substeps are chosen for, `promised` the error of a step above which a result warns; `negligible` the
    spectrum that need not be resolved; `generous` the size of a grid that is kept though fewer points would do; `kept` holds what
    was computed for single grids.
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
    divided: dict[int, Kernels | None] = field(default_factory=dict)

    @cached_property
    def kept(self) -> dict[Any, Any]:
        """What was computed for single grids, shared by all schedules of a model with these parameters."""
        return _kept(self.model, self.theta.tobytes(), self.theta.dtype.str)

    @cached_property
    def gaussian(self) -> bool:
        """Whether the compiled loop takes Gaussian kernels, else the decomposition of the operator."""
        steady = not self.system.varying
        return self.yau is not None and not (steady and not self.yau.affine)

    @property
    def largest(self) -> int:
        """The largest size of a grid."""
        return lw.LARGEST

    @cached_property
    def kinds(self) -> np.ndarray:
        """How the compiled loop takes each interval (K,): FACTOR, SPLIT or KERNEL; -1 where it does not."""
        return kinds_of(self)

    @cached_property
    def fast(self) -> list[bool]:
        """Which intervals (K,) the compiled loop may take."""
        found: list[bool] = (self.kinds >= 0).tolist()
        return found

    def parts(self, count: int) -> Kernels | None:
        """Return the kernels of `count` equal parts of the intervals that are split, for those without observations inside."""
        if count not in self.divided:
            schedule, split = self.schedule, self.kinds == SPLIT
            lengths, nothing = np.where(split, self.lengths, 0.0), np.zeros_like(self.inside)
            assert self.yau is not None
            self.divided[count] = self.yau.kernels(
                schedule.starts, lengths, nothing, self.theta, False, self.origin, self.series, count
            )
        return self.divided[count]

    @property
    def deepest(self) -> float:
        """The depth of the tails, as a logarithm below the maximum, down to which a density is accurate."""
        return float(np.log(max(self.promised / NOISE, 10.0)))

    def once(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return what `make` returns for a key, from the last ones that were kept; a value depends on its key alone."""
        found = self.kept.get(key)
        if found is None:
            found = make()
            while len(self.kept) >= KEPT:
                try:
                    self.kept.pop(next(iter(self.kept)), None)
                except (StopIteration, RuntimeError):  # another thread was faster
                    break
            self.kept[key] = found
        return found


def kinds_of(prepared: Prepared) -> np.ndarray:
    """Return how the compiled loop of `_line_fast` takes each interval (K,), -1 where it does not."""
    system, schedule, yau, kernels = prepared.system, prepared.schedule, prepared.yau, prepared.kernels
    positive = prepared.lengths > 0
    none = np.full(len(schedule), -1)
    if np.iscomplexobj(prepared.theta) or prepared.model.periodic or prepared.lie:
        return none
    splits = system.steady_observation and system.steady_noise and system.curvature is not None
    regular = positive & np.all(schedule.seen == prepared.inside, axis=1)
    if not prepared.gaussian or yau is None:
        if system.moving or not system.steady_observation:
            return none
        if system.samples:
            return np.where(positive, FACTOR, -1)
        return np.where(regular, SPLIT, -1) if splits else none
    if not yau.bare or not yau.steady_gauge:
        return none
    if kernels is None:
        whole = np.zeros(len(schedule), bool)
    else:
        whole = positive & (kernels.place >= 0) & (kernels.errors[kernels.place] == 0)
    if system.samples:
        return np.where(whole, FACTOR, -1) if system.steady_observation else none
    observed = schedule.seen.any(axis=1)
    split = SPLIT if splits else -1
    inside = np.where(whole, KERNEL, -1) if yau.affine else np.full(len(schedule), split)
    return np.where(observed, np.where(regular, inside, -1), np.where(whole, FACTOR, -1))


class Tables(NamedTuple):
    """f and h at the points of a grid where they do not depend on t: (N,), (m, N); and G."""

    drift: Array
    observation: Array
    covariance: Any


def finite(values: Array) -> Array:
    """Return the values with zero where a formula has no value."""
    return np.where(np.isfinite(values.real), values, 0.0)


def tables(prepared: Prepared, window: lw.Window) -> Tables:
    """Return the tables of a grid."""
    system, theta, start = prepared.system, prepared.theta, prepared.model.start

    def make() -> Tables:
        points = window.points[:, None]
        drift = finite(system.drift(points, start, theta)[:, 0])
        observation = system.observation(points, start, theta).T
        covariance = system.covariance(np.zeros(1), start, theta)[0, 0]
        return Tables(drift, observation, covariance)

    found: Tables = prepared.once(window, make)
    return found


def spectral(prepared: Prepared, window: lw.Window) -> Spectral | None:
    """Return the decomposition of the operator on a grid, if it has one."""
    found: tuple[Spectral | None] = prepared.once(("spectral", window), lambda: (_decomposed(prepared, window),))
    return found[0]


def _decomposed(prepared: Prepared, window: lw.Window) -> Spectral | None:
    known = tables(prepared, window)
    drift, covariance = known.drift, known.covariance
    system, theta, start = prepared.system, prepared.theta, prepared.model.start
    if system.moving or covariance.real <= 0 or window.size > lw.LARGEST:
        return None
    slope = system.slope(window.points[:, None], start, theta)[:, 0]
    nodes = (window.points[:, None] + window.spacing * GAUSS_NODES).reshape(-1, 1)
    inner = system.drift(nodes, start, theta).reshape(window.size, -1)
    if not np.isfinite(slope.real).all() or not np.isfinite(inner.real).all():
        return None
    steps = window.spacing * (inner @ GAUSS_WEIGHTS) / covariance
    if window.closed and abs(np.sum(steps).real) > 1e-12 * max(1.0, float(np.sum(np.abs(steps.real)))):
        return None
    gauge = np.concatenate([np.zeros(1), np.cumsum(steps[:-1])])
    return Spectral(window.closed, window.spacing, covariance, 0.5 * (drift**2 / covariance + slope), gauge)
