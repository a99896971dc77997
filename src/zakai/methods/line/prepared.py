"""What one-state filters on a grid know without data: `Prepared`, what the compiled loop reads, and intervals cut into parts.

An interval is cut where few nodes do not resolve the coefficients in time, or where noise makes a density far wider.  The
observation is linear in time within an interval, so that each part has its share of an increment; a sample, or an increment that
was gathered over more than the interval, belongs to the last part.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np

from zakai.methods.line.cache import CacheKey, Derived, GridCache, grid_cache_of
from zakai.methods.line.model import System, finite
from zakai.methods.line.yau import Kernels, YauLine
from zakai.methods.system.notes import OMITTED
from zakai.methods.yau.kernel import PowerSeries
from zakai.models.model import Model
from zakai.models.prior import GaussianPrior
from zakai.numerics.arrays import Array
from zakai.numerics.complex_step import log_determinant
from zakai.numerics.line import window as lw
from zakai.numerics.line.averages import GAUSS_NODES, parts_needed, polynomials_at_nodes, probed
from zakai.numerics.line.gaussian_kernels import kernel_size, packed
from zakai.numerics.line.resolution import GROSS, MAGNUS
from zakai.numerics.line.steps import FACTOR, KERNEL, SPLIT, SPLIT_FACTOR, Limits, Mechanisms, Steps
from zakai.records.schedule import Schedule, lengths_of

T = TypeVar("T")
SHARE = 5e-3  # of the tolerance that the splitting of one interval may leave
INTERVALS_TOGETHER = 32  # intervals whose tables of coefficients in time, or likelihoods, are computed together
SHARED = 128  # points of the largest grid on which many steps share a decomposition
ROUNDS = 2  # of cutting, after which what is not resolved is left to adaptive substeps
_X = np.zeros(1)


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

    @classmethod
    def of(cls, values: Array, window: lw.Window, error: float, log_floor: float) -> State:
        """Return the state of probabilities on a grid."""
        return cls(values, window.origin, window.centre, window.spacing, window.unit, window.closed, error, log_floor)

    @property
    def window(self) -> lw.Window:
        """The grid."""
        return lw.Window(
            float(self.origin), float(self.centre), float(self.spacing), len(self.values), bool(self.closed), float(self.unit)
        )


class CoefficientsInTime(NamedTuple):
    """What the compiled loop knows of the coefficients in time of K intervals: see `steps.Steps`.

    `parts` (K,) are in how many parts of an interval the Gauss nodes would resolve them, 0 for never.
    """

    drifts: Array
    outputs: Array
    covariances: Array
    precisions: Array
    constants: Array
    parts: Array


class TimeInterval(NamedTuple):
    """Interval k: when it begins, its length, and which increments (m,) act inside at which rates (m,)."""

    k: int
    start: float
    length: float
    inside: np.ndarray
    rates: np.ndarray

    def part(self, first: float, last: float) -> TimeInterval:
        """Return the part between two times after the start."""
        return self._replace(start=self.start + first, length=last - first)


class Parts(NamedTuple):
    """The parts of all intervals: those of interval k are first[k] to first[k + 1] of `prepared`."""

    prepared: Prepared
    first: Array


@dataclass(frozen=True, eq=False)
class Prepared:
    """What is known without data.

    `tolerance` is what substeps are chosen for, `promised` the error of a step above which a result warns; `negligible` the
    spectrum that need not be resolved; `pieces` whether densities are polynomials between ends and kinks; `grid_cache` holds what
    was computed for single grids; `shares` (K,) are those of parts in the time of their intervals, and `cut_up` whether these are
    parts of one interval.
    """

    model: Model
    schedule: Schedule
    theta: np.ndarray
    system: System
    tolerance: float
    negligible: float
    promised: float
    yau: YauLine | None = None
    lie: bool = False
    origin: float = 0.0
    series: PowerSeries | None = None
    shares: np.ndarray | None = None
    pieces: bool = False
    cut_up: bool = False

    def over(self, schedule: Schedule, shares: np.ndarray | None = None, cut_up: bool = False) -> Prepared:
        """Return the same for another schedule with the same inputs; what does not depend on a schedule is shared."""
        for name in STEADY:
            getattr(self, name)
        result = object.__new__(Prepared)
        known = vars(self)
        vars(result).update({name: known[name] for name in FIELDS}, schedule=schedule, shares=shares, cut_up=cut_up)
        return result

    def for_interval(self, schedule: Schedule) -> Prepared:
        """Return the same for another interval with the same sensors, where only its length and coefficients in time are new."""
        if not self.timed or self.kernels is not None or self.parts is not None or not self.fast[0]:
            return self.over(schedule)
        result, system, lengths = object.__new__(Prepared), self.system, schedule.lengths
        known, before, (kinds, _, shares, _, _, kernels, *_) = vars(result), self.coefficients, self.steps
        known.update(vars(self), schedule=schedule, lengths=lengths)
        if system.resolved and system.steady_covariance and system.steady_noise and not system.samples:
            factors = polynomials_at_nodes(self.polynomials, schedule.starts, schedule.stops, lengths)  # only these are new
            c = CoefficientsInTime(factors[:, :-1], factors[:, : before.outputs.shape[1]], *before[2:])
        else:
            c = coefficients_of(result, before)
            if c.parts[0] != 1:
                return self.over(schedule)
        known.update(coefficients=c, steps=Steps(kinds, lengths, shares, *c[3:5], kernels, *c[:3]))
        return result

    @cached_property
    def lengths(self) -> np.ndarray:
        """The lengths (K,) of the intervals."""
        return self.schedule.lengths

    @cached_property
    def inside(self) -> np.ndarray:
        """Which increments act inside their intervals (K, m)."""
        return self.schedule.inside

    @cached_property
    def kernels(self) -> Kernels | None:
        """The Gaussian kernels of intervals whose equation is linear-quadratic, None where there is none."""
        if self.yau is None:
            return None
        inside = self.inside & (self.inside.all(axis=1, keepdims=True) if self.lie else True)
        return self.yau.kernels(self.schedule.starts, self.lengths, inside, self.theta, self.lie, self.origin, self.series)

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """What is to be said of the schedule."""
        return (OMITTED,) if self.system.cross is not None and (self.schedule.seen & ~self.inside).any() else ()

    @cached_property
    def grid_cache(self) -> GridCache:
        """What was computed for single grids, shared by all schedules of a model with these parameters and this method."""
        setting = self.pieces, self.tolerance, self.yau is None, self.kernels is None, self.series is None, self.lie, self.origin
        return grid_cache_of(self.model, self.theta.tobytes(), self.theta.dtype.str, setting)

    def interval(self, k: int, inside: np.ndarray, observed: np.ndarray) -> TimeInterval:
        """Return interval k, of a length above zero, in which increments act `inside` (m,)."""
        length = float(self.lengths[k])
        rates = np.where(inside & (not self.lie), observed, 0.0) / length
        return TimeInterval(k, float(self.schedule.starts[k]), length, inside, rates)

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
    def polynomials(self) -> np.ndarray:
        """The factors of the terms of f and h where they are polynomials of t (D, R), the highest power first, else nothing."""
        function = self.system.polynomials
        return np.zeros((0, 0)) if function is None else function(_X, self.model.start, self.theta)

    @cached_property
    def coefficients(self) -> CoefficientsInTime:
        """The coefficients in time of all intervals."""
        return coefficients_of(self)

    @cached_property
    def parts(self) -> Parts | None:
        """The parts of intervals in which the Gauss nodes do not resolve the coefficients, None where they do in all."""
        return parts_of(self)

    @property
    def largest(self) -> int:
        """The points of the largest grid of the compiled loop, and of any grid where a larger one does not help."""
        return lw.LARGE if self.gaussian else lw.LARGEST

    @property
    def generous(self) -> int:
        """The size of a grid that is retained though fewer points would do."""
        size = 2 * SHARED if self.kinked else SHARED  # with kinks a grid is finer, and another one takes long to prepare
        return lw.LARGE if self.timed and self.model.periodic else size

    def largest_for(self, check: lw.GridCheck | None = None, size: int = 0) -> int:
        """Return the points of the largest grid for a density with some figures on a grid of some size.

        The spectrum of kinks and that of noise fall slowly on every grid, what the largest grid of all does not resolve none
        does, and noise that grows with the state, and potentials within intervals, are too fast for a large one.
        """
        noisy, system = False, self.system
        if check is not None and check.aliasing > self.negligible:
            noisy = check.rough if check.aliasing < GROSS else size >= lw.SIZES[-1]
        slow = noisy or system.kinked_drift or not system.smooth_observation or system.state_dependent or not system.samples
        return self.largest if slow else lw.SIZES[-1]

    @cached_property
    def kinds(self) -> np.ndarray:
        """How the compiled loop takes each interval (K,): FACTOR, SPLIT or KERNEL; -1 where it does not."""
        return kinds_of(self)

    @cached_property
    def steps(self) -> Steps:
        """What the compiled loop reads of all intervals."""
        return steps_of(self)

    @cached_property
    def limits(self) -> Array:
        """What a step of the compiled loop must keep, as the fields of `steps.Limits`."""
        splitting = SHARE * self.tolerance if self.yau is None else MAGNUS * self.promised
        finest = 512.0 if self.system.samples else 256.0
        return np.array(Limits(self.negligible, self.promised, splitting, self.cut, self.generous, finest), float)

    @cached_property
    def mechanisms(self) -> Mechanisms:
        """What the compiled loop needs for this model."""
        system, yau, closed = self.system, self.yau, bool(self.model.periodic)
        whole = yau is not None and yau.unobserved and yau.steady_gauge and self.kernels is not None
        always = whole and yau is not None and (not system.moving if system.samples else yau.affine)
        splits = self.divides and not always
        return Mechanisms(whole, splits, splits and self.timed, system.samples, self.weak, closed)

    @cached_property
    def fast(self) -> list[bool]:
        """Which intervals (K,) the compiled loop may take."""
        return list((self.kinds >= 0).tolist())

    def deepest(self, floor: float) -> float:
        """Return the depth of the tails, as a logarithm below the maximum, to which a density with this floor is accurate."""
        return max(float(np.log(self.promised) - np.log(max(floor, 1e-300))), 2.3)

    def once(self, quantity: Derived, at: Hashable, make: Callable[[], T]) -> T:
        """Return the derived quantity of a grid, or of what else it is `at`, by `make` where the cache does not hold it.

        A value depends on its key alone.
        """
        key = CacheKey(quantity, at)
        entry = self.grid_cache.pop(key, None)
        if entry is None:
            value = make()
            self.grid_cache.insert(key, value)
            return value
        self.grid_cache[key] = entry  # the last one that was used is the last one to go
        value = entry[0]
        return value


# What of a `Prepared` does not depend on its schedule: what is computed, and with it the fields.
STEADY = ("divides", "gaussian", "timed", "weak", "mixed", "cut", "limits", "polynomials")
FIELDS = (*(field.name for field in fields(Prepared)), *STEADY)


def coefficients_of(prepared: Prepared, steady: CoefficientsInTime | None = None) -> CoefficientsInTime:
    """Return what the loop needs of the coefficients in time of all intervals; of one, `steady` has those that are constant."""
    schedule, system, theta = prepared.schedule, prepared.system, prepared.theta
    resolved, count, seen, m = system.resolved, len(schedule), schedule.seen, system.m
    starts, lengths, stops = schedule.starts[:, None], prepared.lengths[:, None], schedule.stops[:, None]
    if prepared.timed:
        t = np.minimum(starts + lengths * GAUSS_NODES, np.nextafter(stops, starts))
        if system.samples or not resolved:
            t = np.concatenate([t, stops] if resolved else [t, stops, probed(starts, stops)], axis=1)
    else:
        t = np.concatenate([np.full((count, 1), prepared.model.start), stops], axis=1)
    size = len(GAUSS_NODES) if prepared.timed else 1
    own, probes, ends = slice(size), slice(size + 1, None), slice(size, size + 1) if system.samples else slice(size)
    if not system.samples and system.steady_observation and system.steady_noise:
        ends = slice(1)

    def everywhere(function: Callable[..., np.ndarray], constant: bool) -> np.ndarray:
        """Return a function of time alone at all times."""
        if not constant:
            return function(_X, t, theta)
        value = function(_X, np.full((1, 1), prepared.model.start), theta)
        return np.broadcast_to(value, (*t.shape, *value.shape[2:]))

    def precision(noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if system.general:  # the loop takes only intervals without observations
            return np.zeros((*noise.shape[:2], m, m)), np.zeros(count)
        both = (seen[:, :, None] & seen[:, None])[:, None]
        block = np.where(both, noise, 0.0) + np.eye(m) * ~seen[:, None, :, None]
        constant = np.zeros(count)
        if system.samples:
            constant = -0.5 * (log_determinant(block[:, 0]) + np.log(2 * np.pi) * seen.sum(axis=1))
        return np.where(both, np.linalg.inv(block), 0.0), constant

    if prepared.mixed:  # the terms of the table are those at the nodes and at the end
        factors = np.broadcast_to(np.eye(size + 1), (count, size + 1, size + 1))
    else:
        assert system.separated is not None
        if resolved and prepared.timed:
            times = np.array(schedule.starts), np.array(schedule.stops), prepared.lengths
            factors = polynomials_at_nodes(prepared.polynomials, *times)[:, : t.shape[1]]
        else:
            factors = everywhere(system.separated[0], False)
    if steady is not None and system.steady_covariance:
        covariances = steady.covariances
    else:
        G = everywhere(system.covariance, system.steady_covariance)[..., 0, 0] if prepared.divides else np.zeros(t.shape)
        covariances = np.array(G[:, own], order="C")
    if steady is not None and system.steady_noise:
        precisions, constants = steady.precisions, steady.constants
    else:
        noise = everywhere(system.noise, system.steady_noise)
        precisions, constants = precision(noise[:, ends])
    if not prepared.timed or not count:
        parts = np.ones(count, int)
    elif resolved:
        parts = np.isfinite(factors).all(axis=(1, 2)).astype(int)
    else:
        terms = _mixed_terms(prepared, t) if prepared.mixed else factors
        parts = parts_needed(terms[:, probes], terms[:, own])
        if not system.steady_covariance:
            parts = np.maximum(parts, parts_needed(G[:, probes, None], G[:, own, None]))
        if not (system.samples or system.steady_noise):
            parts = np.maximum(parts, parts_needed(precision(noise[:, probes])[0], precisions))
    drifts, outputs = (np.array(factors[:, part], order="C") for part in (own, ends))
    return CoefficientsInTime(drifts, outputs, covariances, precisions, constants, parts)


def _mixed_terms(prepared: Prepared, t: np.ndarray) -> np.ndarray:
    """Return f, and h of increments, at times (K, T) and points where the state may be (K, T, C)."""
    system, prior = prepared.system, prepared.model.prior
    points = np.linspace(-np.pi, np.pi, 9)
    if isinstance(prior, GaussianPrior) and not prepared.model.domain and not prepared.model.periodic:
        points = float(prior.mean[0]) + np.linspace(-5.0, 5.0, 9) * float(np.sqrt(prior.cov[0, 0]))
    terms = system.drift(points[:, None], t[..., None], prepared.theta)
    if not system.samples:
        terms = np.concatenate([terms, system.observation(points[:, None], t[..., None], prepared.theta)], axis=-1)
    return np.asarray(finite(terms).reshape(*t.shape, -1))


def kinds_of(prepared: Prepared) -> np.ndarray:
    """Return how the compiled loop of `line/loop.py` takes each interval (K,), -1 where it does not."""
    system, schedule, yau, kernels = prepared.system, prepared.schedule, prepared.yau, prepared.kernels
    none = np.full(len(schedule), -1)
    if not len(schedule) or np.iscomplexobj(prepared.theta) or prepared.lie or (prepared.model.periodic and not system.samples):
        return none
    positive = prepared.lengths > 0
    if not prepared.gaussian:
        usable = system.samples and not system.moving and system.separated is not None
        return np.where(positive, FACTOR, -1) if usable else none
    if system.separated is None and not prepared.mixed:
        return none
    # Increments act inside of just their intervals, or not at all.
    regular, affine = system.samples or np.all(schedule.seen == prepared.inside, axis=1), yau is not None and yau.affine
    result = none
    if prepared.divides and (system.samples or not affine):
        split = positive & (prepared.coefficients.parts == 1) & regular
        result = np.where(split, SPLIT_FACTOR if system.samples else SPLIT, -1)
    if kernels is None or yau is None or not (yau.unobserved and yau.steady_gauge):
        return result
    whole = positive & (kernels.place >= 0) & (kernels.errors[kernels.place] == 0)
    silent = ~schedule.seen.any(axis=1)
    if system.samples:
        return np.where(whole & (silent | (not system.general)), FACTOR, result)
    return np.where(whole & silent, FACTOR, np.where(whole & regular & affine, KERNEL, result))


def steps_of(prepared: Prepared) -> Steps:
    """Return what the compiled loop reads of all intervals."""
    kinds, kernels, c = prepared.kinds, prepared.kernels, prepared.coefficients
    inputs = 1 + prepared.system.m
    parameters, precisions = np.full((len(kinds), kernel_size(inputs)), np.nan), c.precisions
    if prepared.gaussian and kernels is not None:
        here = np.flatnonzero((kinds == KERNEL) | (kinds == FACTOR))
        if len(here):
            parameters[here] = packed(kernels.transitions, kernels.place[here])
        precisions = np.where((kinds == KERNEL)[:, None, None, None], 0.0, precisions)
    shares = np.ones(len(kinds)) if prepared.shares is None else prepared.shares
    return Steps(kinds, np.ascontiguousarray(prepared.lengths), shares, precisions, c.constants, parameters, *c[:3])


def parts_of(prepared: Prepared) -> Parts | None:
    """Return the parts of the intervals of a schedule, None where no interval needs any."""
    if not prepared.timed or prepared.kernels is not None or np.iscomplexobj(prepared.theta):
        return None
    result, owner = prepared, np.arange(len(prepared.schedule))
    for _ in range(ROUNDS):
        schedule, needed = result.schedule, result.coefficients.parts
        if not ((needed > 1) & (result.lengths > 0)).any():
            break
        needed = np.where(result.lengths > 0, needed, 1)
        bounds = [_bounds(result, k, n) if n > 1 else [schedule.starts[k]] for k, n in enumerate(needed)]
        counts = np.array([len(bound) for bound in bounds])
        starts = np.concatenate(bounds)
        stops = np.append(starts[1:], schedule.stops[-1])
        ends = np.cumsum(counts) - 1
        stops[ends] = schedule.stops
        parent = np.repeat(np.arange(len(schedule)), counts)
        last = np.zeros(len(starts), bool)
        last[ends] = True
        whole, inside = lengths_of(starts, stops)[:, None], result.inside[parent]
        seen = schedule.seen[parent] & (inside | last[:, None])
        elapsed = np.where(inside, whole, np.where(seen, schedule.elapsed[parent], 0.0))
        schedule = Schedule(starts, stops, seen, elapsed, schedule.inputs)
        result = result.over(schedule)
        owner = owner[parent]
    if result is prepared:
        return None
    first = np.searchsorted(owner, np.arange(len(prepared.schedule) + 1))
    shares = np.where(result.lengths < prepared.lengths[owner], result.lengths / prepared.lengths[owner], 1.0)
    return Parts(result.over(result.schedule, shares), first)


def _bounds(prepared: Prepared, k: int, count: int) -> list[float]:
    """Return where the parts of an interval begin: where inputs have a jump or a kink, else in equal steps."""
    start, stop = float(prepared.schedule.starts[k]), float(prepared.schedule.stops[k])
    pieces = [first for first, _ in prepared.system.pieces(start, stop)]
    return pieces if len(pieces) > 1 else (start + (stop - start) / count * np.arange(count)).tolist()
