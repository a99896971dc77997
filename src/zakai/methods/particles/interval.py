"""The events of an interval: flows of the drift, kicks of noise in the middle of substeps, and the observation at the end."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import expm

from zakai.methods.particles.programs import Array, Expressions
from zakai.methods.particles.system import System, roots
from zakai.numerics.particles.chunks import over_chunks
from zakai.numerics.particles.formulas import evaluate
from zakai.numerics.particles.motion import ADDITIVE, ORDERED, UPDATE, Arrival, advance
from zakai.numerics.particles.random import key_of, normals
from zakai.records.inputs import Inputs

PILOTS = 128  # particles by which the time step is measured
# Of a mean or a standard deviation by one interval, in standard deviations, that a step is chosen for, or this share of the
# standard error of a mean where that is more, up to a largest one.
TIME_ERROR, OF_RANDOM_ERROR, MOST_TIME_ERROR = 0.005, 0.1, 0.1
MOST_SUBSTEPS = 64
LEAST_CONTRACTION = 0.02  # ratio of deviations at the end and the start of an interval, below which errors are not judged by it
EXACT = 1e-3  # relative error of the flow of an affine system without time that is not measured
KEPT_LENGTHS = 64  # of substeps whose noise is kept
# Norm of df/dx times a substep above which it is reduced where f is not linear: noise that is carried far to the middle of a
# substep is amplified there, and a nonlinear flow does not take that back.
_CARRIED = 2.0
_SERIES = 4.0  # norm of A times the substep up to which the covariance of its noise is a series


class Interval(NamedTuple):
    """One interval of a schedule: its ends, what is observed at its stop, and the inputs."""

    start: float
    stop: float
    seen: Array
    inside: Array
    elapsed: Array
    inputs: Inputs | None

    def inputs_change(self, hold: str) -> bool:
        """Return whether an input, or with `hold` "linear" its slope, jumps at the start of the interval or inside of it."""
        if self.inputs is None:
            return False
        times = np.append(self.start, self.inputs.within(self.start, self.stop))
        if hold == "linear":
            return len(times) > 1 or bool(np.isin(self.start, self.inputs.times))
        return bool((self.inputs.at(times) != self.inputs.at(self.start, before=True)).any())


class Events(NamedTuple):
    """What the kernels run; see `numerics/particles/motion.py`."""

    times: Array
    places: Array
    given: Array
    roots: Array
    rows: Array

    @property
    def width(self) -> int:
        """The number of standard normal numbers of a particle."""
        return int(self.rows[-1].sum()) if len(self.rows) else 0


class Observed(NamedTuple):
    """What is observed at the end of an interval: the time, the numbers given to the law (L,), and which terms count (T,)."""

    time: float
    given: Array
    counted: Array


def with_update(events: Events, system: System, observed: Observed) -> Events:
    """Return the events of an interval and the update of the state by the observation at its end, where there is one."""
    if system.update is None:
        return events
    given = np.pad(events.given, ((0, 0), (0, 0), (0, system.width - events.given.shape[2])))
    if not observed.counted.any():
        return events._replace(given=given)
    row = np.zeros((1, 2, system.width))
    row[0, :, : len(observed.given)] = observed.given
    return events._replace(
        times=np.append(events.times, [[observed.time, observed.time]], axis=0),
        places=np.append(events.places, [[-1, -1, UPDATE]], axis=0),
        given=np.append(given, row, axis=0),
    )


class Scheme(NamedTuple):
    """The number of substeps of an interval, and the evaluations of the drift in a flow, 2 or 4."""

    substeps: int
    stages: int


@dataclass(frozen=True)
class Motion:
    """The formulas of a system for given parameters, as the kernels take them."""

    system: System
    theta: Array

    @cached_property
    def arrays(self) -> tuple[Any, ...]:
        """The drift, the fields of the noise, the ends of the domain, the kind of the noise, and the update of the state."""
        system = self.system
        update = Expressions([], system.model) if system.update is None else system.update
        drift, fields, update_ = (tuple(part.at(self.theta)) for part in (system.drift, system.fields, update))
        return drift, fields, system.box, system.kind, update_

    @cached_property
    def law(self) -> tuple[Any, ...]:
        """The law of a sample, or the factor of an increment gathered over more than its interval."""
        system = self.system
        return tuple(system.law.program(self.theta) if system.law is not None else system.factor.at(self.theta))  # type: ignore[union-attr]

    @cached_property
    def observe(self) -> tuple[Any, ...]:
        """The observation h."""
        return tuple(self.system.observe.at(self.theta))

    def advanced(self, events: Events, start: Array, noise: Array, ends: Array | None = None) -> tuple[Array, Array]:
        """Return states (n, N) after the events, and the integrated log weights (N,)."""
        out, gained = np.empty_like(start), np.empty(start.shape[1])
        ends = np.empty((0, *start.shape)) if ends is None else ends
        arrays = self.arrays, tuple(events), start, noise
        over_chunks(lambda low, high: advance(*arrays, low, high, Arrival(out, gained, ends)), len(gained))
        return out, gained

    def values(self, program: tuple[Any, ...], x: Array, t: float, given: Array) -> Array:
        """Return the outputs (k, N) of a program at points (n, N)."""
        out = np.empty((len(program[3]), x.shape[1]))
        over_chunks(lambda low, high: evaluate(program, self.system.box, x, t, given, low, high, out), x.shape[1])
        return out

    @cached_property
    def _kept_roots(self) -> dict[float, Array]:
        return {}

    def _root_of(self, step: float) -> Array:
        """Return the root of the noise of a substep of an affine system without time."""
        if step not in self._kept_roots:
            if len(self._kept_roots) >= KEPT_LENGTHS:
                self._kept_roots.clear()
            nothing = np.zeros((self.system.m, self.system.m))
            G = self.covariance(float(self.system.model.start), nothing, None)
            self._kept_roots[step] = roots(noise_about_middle(self.constant_matrix[None], G[None], step))[0]
        return self._kept_roots[step]

    def covariance(self, t: float, P: Array, u: Array | None) -> Array:
        """Return g (Q - C P C') g' (n, n) for noise that does not depend on the state."""
        system = self.system
        if system.cross is None and not system.timed:
            return self._constant_covariance
        g = system.diffusion(np.zeros(system.model.n), t, self.theta, u)
        return np.asarray(g @ system.own_noise(t, P, self.theta, u) @ g.T)

    @cached_property
    def _constant_covariance(self) -> Array:
        system, t = self.system, float(self.system.model.start)
        at = np.zeros(system.model.n)
        g, Q = system.diffusion(at, t, self.theta), system.process_noise(at, t, self.theta)
        return np.asarray(g @ Q @ g.T)

    @cached_property
    def constant_matrix(self) -> Array:
        """The matrix of an affine drift."""
        model = self.system.model
        given = np.zeros(self.system.drift.width)
        return np.asarray(self.matrices(np.zeros((1, model.n)), np.ones(model.n), float(model.start), given)[0])

    def matrices(self, x: Array, scale: Array, t: float, given: Array) -> Array:
        """Return df/dx (J, n, n) at points (J, n), by forward differences."""
        count, n = x.shape
        step = 1e-5 * scale
        points = np.repeat(x.T[:, :, None], n + 1, axis=2)
        points[np.arange(n), :, np.arange(1, n + 1)] += step[:, None]
        f = self.values(self.arrays[0], points.reshape(n, -1), t, given)[:n].reshape(n, count, n + 1)
        found = ((f[:, :, 1:] - f[:, :, :1]) / step).transpose(1, 0, 2)
        return np.where(np.isfinite(found), found, 0.0)

    def pace(self, interval: Interval, values: Array, mean: Array, scale: Array) -> float:
        """Return the largest drift of a mean (n,) at the start of an interval, in deviations (n,) by time."""
        given = self.given_numbers(interval, np.array([[interval.start, interval.stop]]), values)
        f = self.values(self.arrays[0], mean[:, None], interval.start, given[0, 0])[: len(mean), 0]
        return float(np.nan_to_num(np.abs(f) / scale, nan=np.inf).max())

    def events(self, interval: Interval, scheme: Scheme, values: Array, mean: Array, scale: Array) -> Events:
        """Return the events of an interval in equal substeps.

        Args:
            interval: the interval.
            scheme: the number of substeps, and the evaluations of the drift in a flow.
            values: the increments (m,), zero where nothing is observed.
            mean: the state (n,) about which the drift is linearised for the covariance of the noise.
            scale: standard deviations of the states (n,).
        """
        system, start, stop, count = self.system, interval.start, interval.stop, scheme.substeps
        length = stop - start
        if length <= 0:
            none = np.zeros((0, system.r if system.kind else system.n, 0))
            row = np.array([[start, start]])
            return Events(row, np.array([[-1, 0, 4]]), np.zeros((1, 2, system.drift.width)), none, np.zeros((0, 3), np.int64))
        step = length / count
        kicks = start + (np.arange(count) + 0.5) * step
        jumps = np.zeros(0) if interval.inputs is None else interval.inputs.within(start, stop)
        ends = np.unique(np.concatenate([kicks, jumps, [stop]]))
        times = np.column_stack([np.append(start, ends[:-1]), ends])
        kicked = np.searchsorted(kicks, ends)
        kicked = np.where((kicked < count) & (kicks[np.minimum(kicked, count - 1)] == ends), kicked, -1)
        places = np.column_stack([kicked, np.where(ends == stop, 0, -1), np.full(len(ends), scheme.stages)]).astype(np.int64)
        given = self.given_numbers(interval, times, values)
        roots = self._roots(interval, times, places, given, step, mean, scale)
        coin = int(system.kind == ORDERED)
        width = roots.shape[2]
        rows = np.column_stack([np.arange(count) * (width + coin), np.full(count, width), np.full(count, coin)]).astype(np.int64)
        return Events(times, places, given, roots, rows)

    def _inputs(self, interval: Interval, t: float, before: bool) -> Array | None:
        known = interval.inputs
        return None if known is None else known.at(t, self.system.model.input_hold, before=before)

    def given_numbers(self, interval: Interval, times: Array, values: Array) -> Array:
        """Return the given numbers of the drift (E, 2, L) at both ends of each flow."""
        system, length = self.system, interval.stop - interval.start
        given = np.zeros((len(times), 2, system.drift.width))
        known: Array | None = None
        if not given.shape[2]:
            return given
        for e, pair in enumerate(times):
            for side, t in enumerate(pair):
                if known is not None and not system.timed:
                    given[e, side] = known
                    continue
                u = self._inputs(interval, t, bool(side))
                parts = [np.zeros(0) if u is None else u]
                P = np.zeros((system.m, system.m))
                if not system.sampled:
                    P = system.precision(t, interval.inside, self.theta, u)
                    parts += [P @ np.where(interval.inside, values, 0.0) / length, [P[pair] for pair in system.numbers.pairs]]
                if system.root_pairs:
                    Q = system.own_noise(t, P, self.theta, u)
                    parts.append([Q[pair] for pair in system.root_pairs])
                given[e, side] = known = np.concatenate(parts)
        return given

    def _roots(
        self, interval: Interval, times: Array, places: Array, given: Array, step: float, mean: Array, scale: Array
    ) -> Array:
        """Return the roots of the noise of all substeps, (J, n, d), or (J, r, d) for the coefficients of fields."""
        system, kicks = self.system, np.flatnonzero(places[:, 0] >= 0)
        if system.kind == ADDITIVE and system.affine and not system.timed and system.cross is None:
            # Nothing but the length decides, and equal lengths are frequent.
            return np.repeat(self._root_of(step)[None], len(kicks), axis=0)
        covs = list[Array]()
        for e in kicks if system.timed else kicks[:1]:
            u = self._inputs(interval, times[e, 1], True)
            P = np.zeros((system.m, system.m))
            if system.cross is not None:
                P = system.precision(times[e, 1], interval.inside, self.theta, u)
            known = self.covariance if system.kind == ADDITIVE else self._own_noise
            covs.append(known(times[e, 1], P, u))
        G = np.array(covs)
        if system.kind != ADDITIVE:
            found = roots(G) * np.sqrt(step)
            return np.ascontiguousarray(found if system.timed else np.repeat(found, len(kicks), axis=0))
        A = self._slopes(times, places, given, mean, scale)
        if not system.affine:
            size = np.abs(A).sum(axis=2).max(axis=1) * step
            A = A * (_CARRIED / np.maximum(size, _CARRIED))[:, None, None]
        return np.ascontiguousarray(roots(noise_about_middle(A, np.broadcast_to(G, A.shape), step)))

    def _own_noise(self, t: float, P: Array, u: Array | None) -> Array:
        return self.system.own_noise(t, P, self.theta, u)

    def _slopes(self, times: Array, places: Array, given: Array, mean: Array, scale: Array) -> Array:
        """Return df/dx (J, n, n) at the kicks along the path of a state without noise."""
        system = self.system
        kicks = np.flatnonzero(places[:, 0] >= 0)
        if system.affine:
            return np.repeat(self.constant_matrix[None], len(kicks), axis=0)
        marked = np.column_stack([np.full(len(places), -1), places[:, 0], places[:, 2]]).astype(np.int64)
        none = Events(times, marked, given, np.zeros((0, system.n, 0)), np.zeros((0, 3), np.int64))
        ends = np.zeros((len(kicks), system.n, 1))
        self.advanced(none, np.ascontiguousarray(mean[:, None]), np.zeros((0, 1)), ends)
        if not (system.timed or system.driven):
            return self.matrices(ends[:, :, 0], scale, times[0, 1], given[0, 1])
        found = [self.matrices(ends[j, None, :, 0], scale, times[e, 1], given[e, 1]) for j, e in enumerate(kicks)]
        return np.concatenate(found)


def noise_about_middle(A: Array, G: Array, length: float) -> Array:
    """Return int exp(-s A) G exp(-s A') ds over (-length/2, length/2): the noise of a substep, carried to its middle.

    A and G are matrices (J, n, n).
    """
    size = float(np.abs(A).sum(axis=2).max(initial=0.0)) * length
    if size <= _SERIES:
        term, total, factor = G, length * G, length
        for k in range(1, 40):
            change = A @ term
            term = -(change + change.transpose(0, 2, 1))
            factor = factor * 0.5 * length / (k + 1)
            if k % 2 == 0:
                change = factor * term
                total = total + change
                if np.abs(change).max() <= 1e-15 * np.abs(total).max():
                    break
        return np.asarray(0.5 * (total + total.transpose(0, 2, 1)))
    n = A.shape[1]
    block = np.block([[-A, G], [np.zeros_like(A), A.transpose(0, 2, 1)]])
    E = expm(block * length)
    F = E[:, n:, n:].transpose(0, 2, 1)
    back = expm(-0.5 * length * A)
    Q = back @ (F @ E[:, :n, n:]) @ back.transpose(0, 2, 1)
    return np.asarray(0.5 * (Q + Q.transpose(0, 2, 1)))


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
    if system.sampled and system.affine and not system.driven:
        # One substep is exact but for the flow, whose error is bounded by that of the exponential series.
        size = 0.5 * float(np.abs(motion.constant_matrix).sum(axis=1).max()) * (interval.stop - interval.start)
        if size**5 / 60 <= EXACT:
            return Steps(Scheme(1, 4), np.zeros(system.n), size**5 / 60, size**5 / 60)
    n, count = system.n, max(1, guess)
    shift, error, surely = np.full(n, np.nan), np.inf, np.inf
    for turn in range(4):
        found = _time_errors(motion, interval, values, pilots._replace(key=pilots.key + turn), count)
        (other, fewer, other_surely), (error, shift, surely) = found
        if not np.isfinite(error):
            if count >= MOST_SUBSTEPS:
                break
            count = min(4 * count, MOST_SUBSTEPS)
            continue
        wanted = int(np.clip(np.ceil(count * np.sqrt(error / pilots.allowed)), 1, MOST_SUBSTEPS))
        if 2 * wanted < count and turn < 3:
            count, shift, error, surely = wanted, shift * (count / wanted) ** 2, error * (count / wanted) ** 2, np.inf
            continue
        reduced = (count / wanted) ** 2
        if other * reduced <= pilots.allowed:
            return Steps(Scheme(wanted, 2), fewer * reduced, other * reduced, other_surely * reduced)
        if wanted <= 2 * count:
            return Steps(Scheme(wanted, 4), shift * reduced, error * reduced, surely * reduced)
        count, shift, error, surely = wanted, shift * reduced, error * reduced, surely * reduced
    return Steps(Scheme(count, 4), shift, error, surely)


def _time_errors(
    motion: Motion, interval: Interval, values: Array, pilots: Pilots, count: int
) -> tuple[tuple[float, Array, float], tuple[float, Array, float]]:
    """Return the errors of `count` substeps of 2 and of 4 stages, by the difference from twice as many, times 4/3.

    The largest error of a mean or a deviation, in standard deviations, the shift of the mean (n,), and the error with that of the
    pilots.
    """
    system, mean, scale = motion.system, pilots.mean, pilots.scale
    coarse, fine = (motion.events(interval, Scheme(k, 4), values, mean, scale) for k in (count, 2 * count))
    noise = np.empty((fine.width, pilots.states.shape[1]))
    normals(key_of(pilots.key), 0, noise.shape[1], noise)
    shared = _coarse_noise(motion, coarse, fine, noise)
    y, finer = motion.advanced(fine, pilots.states, noise)
    centred = y - y.mean(axis=1, keepdims=True)
    spread = np.maximum(centred.std(axis=1), 1e-9 * scale)
    # What contracts in the interval is judged by the deviation at its end.
    began = pilots.states.std(axis=1)
    contracted = np.divide(spread, began, out=np.ones(len(began)), where=began > 0)
    judged = scale * np.clip(contracted, LEAST_CONTRACTION, 1.0)

    def change(stages: int) -> tuple[float, Array, float]:
        places = coarse.places.copy()
        places[:, 2] = stages
        x, gained = motion.advanced(coarse._replace(places=places), pilots.states, shared)
        d, weight = x - y, gained - finer
        if system.angles.any():
            d[system.angles] = np.remainder(d[system.angles] + np.pi, 2 * np.pi) - np.pi
        weighted = (weight - weight.mean()) * centred
        parts = (d, d * centred / spread[:, None], weighted)
        squares, noise = (np.array([f(part) for part in parts]) for f in (_squared_mean, _variance_of_mean))
        # What the number of pilots adds to a mean of zero is not subtracted: few cannot show that there is no error.
        largest = np.sqrt(squares.max(axis=0)) / judged
        surely = np.sqrt((squares + noise).max(axis=0)) / judged
        return 4 / 3 * float(largest.max()), 4 / 3 * (d + weighted).mean(axis=1), 4 / 3 * float(surely.max())

    return change(2), change(4)


def carried_shift(motion: Motion, events: Events, x: Array, shift: Array) -> Array:
    """Return what a shift (n,) of particles x (n, N) becomes in the mean after an interval, without noise.

    Between two modes the path of the mean itself would be unstable where no particle is.
    """
    count, angles = x.shape[1], motion.system.angles
    both = np.concatenate([x, x + shift[:, None]], axis=1)
    ends, _ = motion.advanced(events, both, np.zeros((events.width, 2 * count)))
    apart = ends[:, count:] - ends[:, :count]
    apart[angles] = np.remainder(apart[angles] + np.pi, 2 * np.pi) - np.pi
    found = apart.mean(axis=1)
    return np.where(np.isfinite(found), found, shift)


def _squared_mean(part: Array) -> Array:
    return np.asarray(part.mean(axis=1) ** 2)


def _variance_of_mean(part: Array) -> Array:
    return np.asarray(part.var(axis=1) / part.shape[1])


def _coarse_noise(motion: Motion, coarse: Events, fine: Events, noise: Array) -> Array:
    """Return the noise of the substeps that makes the same kicks as that of their halves."""
    system = motion.system
    shared = np.zeros((coarse.width, noise.shape[1]))
    back = np.linalg.pinv(coarse.roots, rcond=1e-6) if system.kind == ADDITIVE else coarse.roots
    for j in range(len(coarse.rows)):
        first, width, coin = coarse.rows[j]
        halves = []
        for i in (2 * j, 2 * j + 1):
            begin, own, _ = fine.rows[i]
            halves.append(noise[begin : begin + own])
        if system.kind == ADDITIVE:
            moved = sum(fine.roots[2 * j + i] @ halves[i] for i in range(2))
            shared[first : first + width] = back[j] @ moved
        else:
            shared[first : first + width] = (halves[0] + halves[1]) / np.sqrt(2)
            if coin:
                shared[first + width] = noise[fine.rows[2 * j, 0] + fine.rows[2 * j, 1]]
    return shared
