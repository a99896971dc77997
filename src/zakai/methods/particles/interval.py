"""The events of an interval: flows of the drift, kicks of noise in the middle of substeps, and the observation at the end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from zakai.methods.particles.events import Events, Flows, Interval
from zakai.methods.particles.programs import Array, Expressions
from zakai.methods.particles.system import System, roots
from zakai.numerics.particles import noise as noise_kernels
from zakai.numerics.particles.chunks import over_chunks
from zakai.numerics.particles.formulas import evaluate
from zakai.numerics.particles.motion import ADDITIVE, ORDERED, Arrival, advance

# Measured: a line of a formula, and a coordinate in an evaluation of a flow, take 0.6 ns, a normal number 4 ns, and all that is
# done with a particle after an interval 60 ns.
NORMAL, EVERY = 7, 100


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
        """The drift, the noise's fields, the ends of the domain, the kind of the noise, the update of the state, and L."""
        system = self.system
        update = Expressions([], system.model) if system.update is None else system.update
        drift, fields, update_ = (tuple(part.at(self.theta)) for part in (system.drift, system.fields, update))
        return drift, fields, system.box, system.kind, update_, self.linear_part

    @cached_property
    def linear_part(self) -> Array:
        """L (n, n): the matrix of an affine drift, else the constant rates of states that decay, or (0, 0) for none."""
        system = self.system
        if system.linear_part is None:
            return np.zeros((0, 0))
        model = system.model
        L = np.asarray(system.linear_part(np.zeros(model.n), float(model.start), self.theta), float)
        return np.ascontiguousarray(L if system.affine else np.minimum(L, 0.0))

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
        return self.linear_part if self.linear_part.size else np.zeros((self.system.n, self.system.n))

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

    def decay(self, interval: Interval, values: Array, mean: Array, scale: Array) -> tuple[float, float]:
        """Return the rates at which a direction decays fastest at a mean (n,) at the start of an interval, or zero.

        The first one is that of directions that the noise reaches, the second one that of all without the linear part.
        """
        given = self.given_numbers(interval, np.array([[interval.start, interval.stop]]), values)
        A = self.linear_part
        if not self.system.affine:
            A = self.matrix(mean, scale, interval.start, given[0, 0])
        elif not A.size:
            return 0.0, 0.0
        noisy, rest = self.system.noisy, A - self.linear_part if self.linear_part.size else A
        return _decay(A[np.ix_(noisy, noisy)]), _decay(rest)

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


def _decay(A: Array) -> float:
    """Return the rate at which a direction decays fastest, or zero."""
    return max(0.0, -float(np.linalg.eigvals(A).real.min())) if A.size and np.isfinite(A).all() else 0.0


def noise_about_middle(A: Array, G: Array, length: float) -> Array:
    """Return int exp(-s A) G exp(-s A') ds (n, n) over (-length/2, length/2): the noise of a substep, carried to its middle."""
    found = np.empty_like(G)
    noise_kernels.noise_about_middle(A, np.ascontiguousarray(G), length, found)
    return found
