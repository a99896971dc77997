"""The events of an interval: flows of the drift, kicks of noise in the middle of substeps, and the observation at the end."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import expm

from zakai.methods.particles.events import Events, Flows, Interval
from zakai.methods.particles.programs import Array, Expressions
from zakai.methods.particles.system import System, roots
from zakai.numerics.particles import noise as noise_kernels
from zakai.numerics.particles.chunks import over_chunks
from zakai.numerics.particles.formulas import evaluate
from zakai.numerics.particles.motion import ADDITIVE, ORDERED, Arrival, advance
from zakai.numerics.particles.random import key_of, normals
from zakai.numerics.particles.step_errors import StepErrors, step_errors

PILOTS = 128  # particles by which the time step is measured
# Of a mean or a standard deviation by one interval, in standard deviations, that a step is chosen for, or this share of the
# standard error of a mean where that is more, up to a largest one.
TIME_ERROR, OF_RANDOM_ERROR, MOST_TIME_ERROR = 0.005, 0.1, 0.1
MOST_SUBSTEPS = 64
DECAYED = 4.0  # times e that a deviation may shrink within one of the substeps that are tried first
LEAST_CONTRACTION = 0.02  # ratio of deviations at the end and the start of an interval, below which errors are not judged by it
# Measured: a line of a formula, and a coordinate in an evaluation of a flow, take 0.6 ns, a normal number 4 ns, and all that is
# done with a particle after an interval 60 ns.
NORMAL, EVERY = 7, 100
EXACT = 1e-3  # relative error of the flow of an affine system without time that is not measured


class Scheme(NamedTuple):
    """The number of substeps of an interval, and the evaluations of the drift in a flow, 2 or 4."""

    substeps: int
    stages: int

    @property
    def work(self) -> int:
        """The evaluations of the drift; a kick with its normal numbers takes about as long as two."""
        return (self.substeps + 1) * (self.stages + 2)


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

    def law_parameters(self, t: float, u: Array | None) -> tuple[Array, Array]:
        """Return what the law of a sample receives of its parameters."""
        law = self.system.law
        assert law is not None
        return self._law_parameters if law.constant else law.parameters(t, self.theta, u)

    @cached_property
    def _law_parameters(self) -> tuple[Array, Array]:
        assert self.system.law is not None
        return self.system.law.parameters(float(self.system.model.start), self.theta, None)

    @cached_property
    def observe(self) -> tuple[Any, ...]:
        """The observation h."""
        return tuple(self.system.observe.at(self.theta))

    def operations(self, scheme: Scheme, width: int) -> int:
        """Return the operations on a particle in an interval whose kicks take so many normal numbers, in lines of formulas."""
        drift, fields, update = (len(self.arrays[i][0]) for i in (0, 1, 4))
        n, r, kind = self.system.n, self.system.r, self.system.kind
        flows, kicks = scheme.stages * (scheme.substeps + 1), scheme.substeps
        kick = NORMAL * width + (0 if kind == ADDITIVE else 4 * (fields + n + r) * (r if kind == ORDERED else 1))
        return EVERY + flows * (drift + n) + kicks * kick + update + len(self.law[0])

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
        n = self.system.model.n
        return self.matrix(np.zeros(n), np.ones(n), float(self.system.model.start), np.zeros(self.system.drift.width))

    def matrix(self, x: Array, scale: Array, t: float, given: Array) -> Array:
        """Return df/dx (n, n) at a point (n,), by forward differences."""
        found = np.empty((len(x), len(x)))
        noise_kernels.slopes(self.arrays[0], self.system.box, x, scale, t, given, found)
        return found

    def pace(self, interval: Interval, values: Array, mean: Array, scale: Array) -> float:
        """Return the largest drift of a mean (n,) at the start of an interval, in deviations (n,) by time."""
        given = self.given_numbers(interval, np.array([[interval.start, interval.stop]]), values)
        f = self.values(self.arrays[0], mean[:, None], interval.start, given[0, 0])[: len(mean), 0]
        largest = float((np.abs(f) / scale).max())
        return np.inf if np.isnan(largest) else largest

    def steepness(self, interval: Interval, values: Array, mean: Array, scale: Array) -> float:
        """Return the norm of df/dx at a mean (n,) at the start of an interval, with the states in deviations (n,)."""
        given = self.given_numbers(interval, np.array([[interval.start, interval.stop]]), values)
        A = self.matrix(mean, scale, interval.start, given[0, 0])
        return float(np.linalg.norm(A * scale / scale[:, None]))

    def decay(self, interval: Interval, values: Array, mean: Array, scale: Array) -> float:
        """Return the rate at which a direction decays fastest at a mean (n,) at the start of an interval, or zero."""
        given = self.given_numbers(interval, np.array([[interval.start, interval.stop]]), values)
        A = self.matrix(mean, scale, interval.start, given[0, 0])
        return max(0.0, -float(np.linalg.eigvals(A).real.min())) if np.isfinite(A).all() else 0.0

    def events(self, interval: Interval, scheme: Scheme, values: Array, mean: Array, scale: Array) -> Events:
        """Return the events of an interval in equal substeps.

        Args:
            interval: the interval.
            scheme: the number of substeps, and the evaluations of the drift in a flow.
            values: the increments (m,), zero where nothing is observed.
            mean: the state (n,) about which the drift is linearised for the covariance of the noise.
            scale: standard deviations of the states (n,).
        """
        return self.linearised(interval, scheme, values, mean, scale)[0]

    def linearised(
        self, interval: Interval, scheme: Scheme, values: Array, mean: Array, scale: Array
    ) -> tuple[Events, Array]:
        """Return the events of an interval, and df/dx (J, n, n) where the noise acts, with no entries where it has fields."""
        system, start, stop, count = self.system, interval.start, interval.stop, scheme.substeps
        length = stop - start
        if length <= 0:
            none = np.zeros((0, system.r if system.kind else system.n, 0))
            row = np.array([[start, start]])
            rows, given = np.zeros((0, 3), np.int64), np.zeros((1, 2, system.drift.width))
            return Events(row, np.array([[-1, 0, 4]]), given, none, rows, np.zeros((1, system.n))), none
        step = length / count
        ends = np.append(start + (np.arange(count) + 0.5) * step, stop)
        places = np.full((count + 1, 3), -1)
        places[:count, 0], places[count, 1] = np.arange(count), 0
        if interval.inputs is not None:
            jumps = interval.inputs.within(start, stop)
            order = np.argsort(np.append(ends, jumps), kind="stable")
            order = np.append(order[order != count], count)
            ends = np.append(ends, jumps)[order]
            places = np.append(places, np.full((len(jumps), 3), -1), axis=0)[order]
        places[:, 2] = scheme.stages
        times = np.empty((len(ends), 2))
        times[0, 0], times[1:, 0], times[:, 1] = start, ends[:-1], ends
        given = self.given_numbers(interval, times, values)
        roots, slopes = self._roots(interval, Flows(times, places, given), step, np.array([mean, scale]))
        coin = int(system.kind == ORDERED)
        width = roots.shape[2]
        rows = np.empty((count, 3), np.int64)
        rows[:, 0], rows[:, 1], rows[:, 2] = np.arange(count) * (width + coin), width, coin
        spreads = np.repeat(self._spread(roots, mean, start, given[0, 0])[None], len(times), axis=0)
        return Events(times, places, given, roots, rows, spreads), slopes

    def _spread(self, roots: Array, mean: Array, t: float, given: Array) -> Array:
        """Return the standard deviations (n,) of the noise of the first kick, of roots (J, n or r, d), at a mean."""
        if self.system.kind == ADDITIVE or not roots.size:
            return np.sqrt(np.sum(roots[:1] ** 2, axis=(0, 2))) if roots.size else np.zeros(self.system.n)
        points = np.concatenate([np.repeat(mean[:, None], roots.shape[2], axis=1), roots[0]])
        columns = self.values(self.arrays[1], points, t, given)[: self.system.n]
        return np.sqrt(np.sum(np.where(np.isfinite(columns), columns, 0.0) ** 2, axis=1))

    def _inputs(self, interval: Interval, t: float, before: bool) -> Array | None:
        known = interval.inputs
        return None if known is None else known.at(t, self.system.model.input_hold, before=before)

    def given_numbers(self, interval: Interval, times: Array, values: Array) -> Array:
        """Return the given numbers of the drift (E, 2, L) at both ends of each flow."""
        system, length = self.system, interval.stop - interval.start
        given = np.zeros((len(times), 2, system.drift.width))
        if not given.shape[2]:
            return given
        if not system.timed:
            given[:] = self._given(interval, interval.start, False, values, length)
            return given
        for e, pair in enumerate(times):
            for side, t in enumerate(pair):
                given[e, side] = self._given(interval, t, bool(side), values, length)
        return given

    def _given(self, interval: Interval, t: float, before: bool, values: Array, length: float) -> Array:
        """Return the given numbers (L,) of the drift at one time."""
        system, u = self.system, self._inputs(interval, t, before)
        parts = [np.zeros(0) if u is None else u]
        P = np.zeros((system.m, system.m))
        if not system.sampled:
            P = self.precision(t, interval.inside, u)
            parts += [P @ np.where(interval.inside, values, 0.0) / length, [P[pair] for pair in system.numbers.pairs]]
        if system.root_pairs:
            Q = system.own_noise(t, P, self.theta, u)
            parts.append([Q[pair] for pair in system.root_pairs])
        return np.concatenate(parts)

    @cached_property
    def _precisions(self) -> dict[bytes, Array]:
        return {}

    def precision(self, t: float, seen: Array, u: Array | None) -> Array:
        """Return the inverse (m, m) of the noise of the observed coordinates per unit time, zero elsewhere."""
        system = self.system
        if system.timed:
            return system.precision(t, seen, self.theta, u)
        key = seen.tobytes()
        if key not in self._precisions:
            self._precisions[key] = system.precision(t, seen, self.theta, u)
        return self._precisions[key]

    def _roots(self, interval: Interval, flows: Flows, step: float, about: Array) -> tuple[Array, Array]:
        """Return the roots of the noise of all substeps, (J, n, d), or (J, r, d) for the coefficients of fields, and slopes."""
        system, (times, places, given) = self.system, flows
        kicks = np.flatnonzero(places[:, 0] >= 0)
        if system.kind != ADDITIVE:
            if not system.timed and system.cross is None:
                return np.repeat(self._constant_root * np.sqrt(step), len(kicks), axis=0), np.zeros((0, 0, 0))
            found = roots(self._at_kicks(interval, times[kicks, 1], self._own_noise)) * np.sqrt(step)
            return found if system.timed else np.repeat(found, len(kicks), axis=0), np.zeros((0, 0, 0))
        if system.timed or system.cross is not None:
            G = self._at_kicks(interval, times[kicks, 1], self.covariance)
        else:
            G = self._constant_covariance[None]
        A = self.constant_matrix if system.affine else np.zeros((0, 0))
        slopes, out = np.empty((2, len(kicks), system.n, system.n))
        none = np.zeros((0, system.n, 0)), np.zeros((len(kicks), 3), np.int64)
        events = (times, places, given, *none, np.zeros((len(times), system.n)))
        width = noise_kernels.kick_roots(self.arrays, events, A, step, about, G, slopes, out)
        return np.ascontiguousarray(out[:, :, :width]), slopes

    @cached_property
    def _constant_root(self) -> Array:
        nothing = np.zeros((self.system.m, self.system.m))
        return roots(self.system.own_noise(float(self.system.model.start), nothing, self.theta, None)[None])

    def _at_kicks(self, interval: Interval, times: Array, noise: Callable[[float, Array, Array | None], Array]) -> Array:
        """Return the covariance of the noise at all kicks, or (1, ...) where it does not depend on time."""
        system, found = self.system, list[Array]()
        for t in times if system.timed else times[:1]:
            u = self._inputs(interval, t, True)
            P = np.zeros((system.m, system.m)) if system.cross is None else self.precision(t, interval.inside, u)
            found.append(noise(t, P, u))
        return np.array(found)

    def _own_noise(self, t: float, P: Array, u: Array | None) -> Array:
        return self.system.own_noise(t, P, self.theta, u)


def noise_about_middle(A: Array, G: Array, length: float) -> Array:
    """Return int exp(-s A) G exp(-s A') ds (n, n) over (-length/2, length/2): the noise of a substep, carried to its middle."""
    found = np.empty_like(G)
    noise_kernels.noise_about_middle(A, np.ascontiguousarray(G), length, found)
    return found


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
    # Where the noise of a whole substep decays, s and 2 s substeps agree that there is none.
    decays = motion.decay(interval, values, pilots.mean, pilots.scale) * (interval.stop - interval.start)
    count = max(1, guess, math.ceil(min(decays / DECAYED, MOST_SUBSTEPS)))
    found = Steps(Scheme(count, 4), np.full(system.n, np.nan), np.inf, np.inf)
    for turn in range(4):
        errors = _time_errors(motion, interval, values, pilots._replace(key=pilots.key + turn), count)
        # The flow is of a higher order than the noise: fewer substeps than half of what was measured may have any error.
        least = -(-count // 2) if turn == 3 else 1
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
    shared = _coarse_noise(motion, coarse, fine, noise, carried)
    y, gained = motion.advanced(fine, start, noise)
    variances = np.zeros(system.n)
    if system.kind == ADDITIVE and not system.affine and fine.width and len(coarse.times) == count + 1:
        variances = _more_variance(coarse.roots, fine.roots, carried)
    return Coupled(start, y, gained, coarse, shared, variances)


def _more_variance(coarse: Array, fine: Array, carried: Array) -> Array:
    """Return by how much kicks of substeps (J, n, d) have more variance (n,) at the end than those of their halves (2 J, n, d).

    `carried` (J, n, n) is df/dx times a quarter of a substep.  Pilots do not show it: the kicks of both are the same.
    """
    ahead, back = expm(carried), expm(-carried)
    halves = ahead @ fine[::2], back @ fine[1::2]
    apart = coarse @ coarse.transpose(0, 2, 1) - sum(half @ half.transpose(0, 2, 1) for half in halves)
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


def _coarse_noise(motion: Motion, coarse: Events, fine: Events, noise: Array, carried: Array) -> Array:
    """Return the noise of the substeps that makes the same kicks as that of their halves, carried to the middle.

    `carried` (J, n, n) is df/dx times a quarter of a substep.  What the linearised flow does to the kicks on their way says
    nothing about the time step, and in the mean of few pilots would hide what does.
    """
    count, pilots = len(coarse.rows), noise.shape[1]
    if motion.system.kind == ADDITIVE:
        if not fine.width:
            return np.zeros((0, pilots))
        kicks = fine.roots @ noise.reshape(2 * count, -1, pilots)
        both, apart = kicks[::2] + kicks[1::2], kicks[::2] - kicks[1::2]
        both += carried @ (apart + 0.5 * carried @ both)
        shared = np.linalg.pinv(coarse.roots, rcond=1e-6) @ both
        return np.ascontiguousarray(shared.reshape(coarse.width, pilots))
    shared = np.zeros((coarse.width, pilots))
    for j in range(count):
        first, width, coin = coarse.rows[j]
        halves = [noise[begin : begin + own] for begin, own, _ in fine.rows[2 * j : 2 * j + 2]]
        shared[first : first + width] = (halves[0] + halves[1]) / np.sqrt(2)
        if coin:
            shared[first + width] = noise[fine.rows[2 * j, 0] + fine.rows[2 * j, 1]]
    return shared
