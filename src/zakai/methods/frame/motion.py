"""A model as the frame filter takes it: the flow of the drift in both directions, and the noise of a substep.

For increments the law of x given the path y is that of `methods/particles/system.py`; its log weight per unit time V joins the
divergence of the drift, so that a density carried backwards along the flow needs one integral,

    u(x, t1) = u(phi(x), t0) exp(int_(t1)^(t0) (div f - V) dt),      phi the flow from t1 back to t0

Noise that depends on the state is a sum over weak points: with the flow psi_c of g(x) c over unit time,

    u(x) <- sum_q w_q u(psi_c^-1(x)) |psi_c^-1'(x)|,      c = node_q sqrt(d) R_j,      for one column R_j of a root of Q at a time

in the order 1, 2, ..., r, ..., 2, 1 with half of the variance before and after, so that a substep is of second order (where the
fields commute, each once).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

from zakai.methods.particles.events import Interval
from zakai.methods.particles.interval import Motion as Coefficients
from zakai.methods.particles.interval import noise_about_middle
from zakai.methods.particles.programs import Array, Expressions
from zakai.methods.particles.system import root
from zakai.methods.particles.system import system_of as formulas_of
from zakai.models.functions import without_jumps
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.numerics.particles.formulas import evaluate
from zakai.numerics.particles.motion import ADDITIVE, COMMUTING
from zakai.numerics.trains.carried import Likelihood, Path
from zakai.numerics.trains.kernels import flow

MOST_STEPS = 64  # Runge-Kutta steps of a path; a drift that needs more is not resolved by a substep
KICK_STEPS = 2  # of Runge-Kutta along a kick of points that measure the time step
PILOTS = 24  # points by which steps are chosen


class System:
    """The formulas of a model as programs, with the rate of the logarithm of a density as their last output."""

    def __init__(self, model: Model):
        self.base = formulas_of(model)
        f, V = list(self.base.formulas[: model.n]), (*self.base.formulas[model.n :], sp.S.Zero)[0]
        divergence = sum((without_jumps(part, symbol) for part, symbol in zip(f, model.x, strict=True)), sp.S.Zero)
        given, rate = self.base.given, divergence - V
        self.kicked = self.base.kind != ADDITIVE
        if self.kicked:
            # One program moves along f, with the switch one, and along g c, with the switch zero.
            switch, c = sp.Dummy("switch", real=True), [sp.Dummy(f"c{a}", real=True) for a in range(self.base.r)]
            field = list(model.diffusion * sp.Matrix(c))
            spread = sum((without_jumps(part, symbol) for part, symbol in zip(field, model.x, strict=True)), sp.S.Zero)
            f, rate, V = [switch * a + b for a, b in zip(f, field, strict=True)], switch * rate + spread, switch * V
            self.kick = Expressions([*field, *[sp.S.Zero] * (len(c) + 1)], model, given, more=c)
            given = (*given, switch, *c)
        self.backward = Expressions([*f, rate], model, given)
        self.forward = Expressions([*f, V], model, given)
        self.weighted = not self.base.sampled
        self.periods = np.where(self.base.angles, 2 * np.pi, 0.0)
        self.lower, self.upper = self.base.box
        self.order = order_of(model)


def order_of(model: Model) -> Array:
    """Return the order of the states (n,) in which those that the drift or a sensor couples nonlinearly are near each other.

    The rank between two axes grows with these couplings between the states on both sides; linear ones are in the frame.  The
    reverse Cuthill-McKee order is taken where coupled states have a smaller sum of distances than in the order of the model.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    place = {symbol: i for i, symbol in enumerate(model.x)}
    linked = np.zeros((model.n, model.n), bool)
    for part, own in [*((part, {i}) for i, part in enumerate(model.drift)), *((part, set[int]()) for part in model.observation)]:
        for symbol in part.free_symbols & set(place):
            others = {place[other] for other in part.diff(symbol).free_symbols & set(place)}
            members = [place[symbol], *others, *own] if others else []
            linked[np.ix_(members, members)] = True

    def length(order: Array) -> float:
        at = np.argsort(order)
        return float((linked * np.abs(at[:, None] - at)).sum())

    given, found = np.arange(model.n), reverse_cuthill_mckee(csr_array(linked), symmetric_mode=True).astype(np.int64)
    return found if length(found) < length(given) else given


def system_of(model: Model) -> System:
    """Return the programs of a model, made once."""
    return kept(model, System, lambda: System(model))


@dataclass(frozen=True)
class Motion:
    """The programs of a system for parameters (p,)."""

    system: System
    theta: Array

    @cached_property
    def coefficients(self) -> Coefficients:
        """The coefficients of the noise and the law of the observations."""
        return Coefficients(self.system.base, self.theta)

    @cached_property
    def backward(self) -> tuple[Any, ...]:
        """The drift and the rate of the logarithm of a density."""
        return tuple(self.system.backward.at(self.theta))

    @cached_property
    def _forward(self) -> tuple[Any, ...]:
        return tuple(self.system.forward.at(self.theta))

    @property
    def box(self) -> tuple[Array, Array]:
        """The ends of the domain."""
        return self.system.base.box

    def path(self, interval: Interval, t0: float, t1: float, values: Array, steps: int) -> Path:
        """Return about so many steps from t0 to t1, before or after it, without a jump of an input inside of a step."""
        low, high = min(t0, t1), max(t0, t1)
        if high <= low:
            return Path(np.zeros((0, 2)), np.zeros((0, 2, self.system.backward.width)))
        ends = low + (high - low) * np.arange(1, steps + 1) / steps
        ends[-1] = high
        if interval.inputs is not None:
            ends = np.unique(np.concatenate([ends, interval.inputs.within(low, high)]))
        times = np.column_stack([np.append(low, ends[:-1]), ends])
        given = self.coefficients.given_numbers(interval, times, values)
        if self.system.kicked:
            given = np.concatenate([given, np.ones((len(times), 2, 1)), np.zeros((len(times), 2, self.system.base.r))], axis=2)
        if t1 < t0:
            times, given = times[::-1, ::-1], given[::-1, ::-1]
        return Path(np.ascontiguousarray(times), np.ascontiguousarray(given))

    def ends(self, x: Array, path: Path) -> tuple[Array, Array]:
        """Return the ends of paths from points x (n, P), and the logarithms of their weights (P,)."""
        out = np.empty((len(x) + 1, x.shape[1]))
        flow(self._forward, self.box, tuple(path), np.ascontiguousarray(x), out)
        return out[:-1], out[-1]

    def steps(self, interval: Interval, x: Array, span: tuple[float, float], values: Array, error: float) -> int:
        """Return how many steps move points x (n, P) over a span with an error in units of their deviations."""
        if span[0] == span[1]:
            return 1
        points = x[:, :: (x.shape[1] // PILOTS) | 1]  # an odd distance leaves quasi-random points evenly spread
        scale = np.maximum(x.std(axis=1), 1e-12)[:, None]
        steps, last = 1, self.ends(points, self.path(interval, *span, values, 1))[0]
        while steps < MOST_STEPS:
            finer = self.ends(points, self.path(interval, *span, values, 2 * steps))[0]
            apart = np.abs(finer - last) / scale
            found = float(np.nanmax(apart, initial=0.0)) if np.isfinite(finer).all() else np.inf
            if found < error:
                return steps
            if found < 16 * error:
                return 2 * steps
            steps, last = 2 * steps, finer
        return steps

    def noise(
        self, interval: Interval, values: Array, t: float, length: float, about: tuple[Array, Array]
    ) -> tuple[Array, Array]:
        """Return the noise (n, n) of a substep, carried to its middle t, and df/dx (n, n) at a state (n,) by which it is carried.

        Args:
            interval: the interval.
            values: what is observed (m,).
            t: the middle.
            length: of the substep.
            about: the state and its standard deviations (n,).
        """
        base, coefficients = self.system.base, self.coefficients
        u = None if interval.inputs is None else interval.inputs.at(t, base.model.input_hold)
        P = np.zeros((base.m, base.m))
        if base.cross is not None:
            P = base.precision(t, interval.inside, self.theta, u)
        G = coefficients.covariance(t, P, u)
        if base.affine and base.cross is None:
            A = coefficients.constant_matrix
        else:  # the value at the interval's end is the limit from inside, as for the flows
            given = self.path(interval, t, t + 1e-9 * length, values, 1).given[0, 0]
            A = coefficients.matrix(*about, t, given)
        return noise_about_middle(A, G, length), A

    def kicks(self, interval: Interval, t: float, length: float) -> list[Array]:
        """Return the coefficients of the fields g (r,) for one deviation of each noise of a substep, in order."""
        base = self.system.base
        u = None if interval.inputs is None else interval.inputs.at(t, base.model.input_hold)
        P = np.zeros((base.m, base.m)) if base.cross is None else base.precision(t, interval.inside, self.theta, u)
        columns = list((root(base.own_noise(t, P, self.theta, u)) * np.sqrt(length)).T)
        if base.kind == COMMUTING or len(columns) < 2:
            return columns
        halves = [np.sqrt(0.5) * column for column in columns[:-1]]
        return [*halves, columns[-1], *halves[::-1]]

    def kick(self, interval: Interval, values: Array, middle: tuple[float, float], c: Array, steps: int) -> Path:
        """Return the path along g c, to be followed forwards; its clock goes over the substep about its middle.

        Args:
            interval: the interval.
            values: what is observed (m,).
            middle: of the substep, and its length, which is negative for the way back.
            c: coefficients (r,).
            steps: of Runge-Kutta.
        """
        t, length = middle
        row = self.coefficients.given_numbers(interval, np.array([[t, t]]), values)[0, 0]
        ends = t + length * (np.arange(steps + 1) / steps - 0.5)
        given = np.tile(np.concatenate([row, [0.0], c / abs(length)]), (steps, 2, 1))
        return Path(np.column_stack([ends[:-1], ends[1:]]), np.ascontiguousarray(given))

    def kicked(self, interval: Interval, values: Array, middle: tuple[float, float], c: Array, x: Array) -> Array:
        """Return points (n, P) after the flows along g c, with numbers c (r, P) of their own; for the rest see `kick`."""
        t, length = middle
        row = self.coefficients.given_numbers(interval, np.array([[t, t]]), values)[0, 0]
        ends = t + length * (np.arange(KICK_STEPS + 1) / KICK_STEPS - 0.5)
        path = Path(np.column_stack([ends[:-1], ends[1:]]), np.ascontiguousarray(np.tile(row, (KICK_STEPS, 2, 1))))
        start = np.concatenate([x, c / length])
        out = np.empty((len(start) + 1, x.shape[1]))
        flow(tuple(self.system.kick.at(self.theta)), self.box, tuple(path), start, out)
        return out[: len(x)]

    def likelihood(self, interval: Interval, values: Array) -> Likelihood:
        """Return the law of what is observed at the end of an interval; no term counts where nothing is."""
        base, t = self.system.base, interval.stop
        u = None if interval.inputs is None else interval.inputs.at(t, base.model.input_hold)
        if base.law is not None:
            given, counted = base.law.given(values, interval.seen, self.coefficients.law_parameters(t, u), u)
            return Likelihood(self.coefficients.law, given, counted, t, 1.0, 0.0)
        m, late = base.m, np.flatnonzero(interval.seen & ~interval.inside)
        P = np.zeros((m, m))
        if len(late):
            S, spans = base.noise(np.zeros(base.n), t, self.theta, u), interval.elapsed
            P[np.ix_(late, late)] = np.linalg.inv((S * np.minimum(spans[:, None], spans))[np.ix_(late, late)])
        r = interval.elapsed * (P @ values)
        P = P * np.outer(interval.elapsed, interval.elapsed)
        given = np.concatenate([[] if u is None else u, r, [P[pair] for pair in base.numbers.pairs]])
        return Likelihood(self.coefficients.law, given, np.array([float(len(late) > 0)]), t, 1.0, 0.0)

    def logs(self, likelihood: Likelihood, x: Array) -> Array:
        """Return the log likelihood (P,) at points x (n, P), -inf where there is no law."""
        used = likelihood.counted > 0
        if not used.any():
            return np.zeros(x.shape[1])
        out = np.empty((len(used), x.shape[1]))
        evaluate(likelihood.program, self.box, x, likelihood.time, likelihood.given, 0, x.shape[1], out)
        total = out[used].sum(axis=0)
        return np.where(np.isnan(total), -np.inf, total)
