"""What the Gaussian-sum methods prepare: the transition of every interval, and the likelihood of its observations.

After the gauge u = e^phi v the density between observations obeys

    v_t = 1/2 G:Hess v - (L z + l).grad v + (z'Q z + p.z + r) v,      z = x - origin,

and a Gaussian stays one.  The origin is the mean of the prior, so that no coefficient subtracts large numbers.  For increments y
is linear between observations: for affine h its slope drives the equation, for nonlinear h its factor
exp(int h'S^-1 dt dy/length) is divided between both ends so that its first moment in time is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from zakai.algebra.systems import yau_system
from zakai.methods.gaussian.affine_system import Matrices, precision_of
from zakai.methods.sums.law import SampleLaw, has_own_law
from zakai.methods.system.input_pieces import pieces_of
from zakai.methods.system.outside_tables import OutsideTables
from zakai.methods.system.residuals import Factor as Residuals
from zakai.methods.system.residuals import Sensors
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model
from zakai.models.prior import DensityPrior
from zakai.numerics.complex_step import cholesky
from zakai.numerics.flow import Coefficients, FlowResult, composed, integrate
from zakai.numerics.sums.mixture import Array
from zakai.records.schedule import Schedule


class Factor(NamedTuple):
    """The factor of an interval's observations.

    With h_j = h(x, times_j), log factor(x) is

        at the start  sum_j dy'before_j h_j,
        at the end    sum_j (after_j dy).h_j - (h_j - spread dy)'energy_j (h_j - spread dy) / 2 + offset + dy'weight dy / 2.

    `times` (J,), `before`, `after` and `energy` (J, m, m) or None for zero, `spread` and `weight` (m, m).  Samples with a law of
    their own have `law`(z, dy) = log p(dy | z), of which the power `share` is taken; `energy` is then that of statistics.
    `inputs` (number of inputs,) are those at the end.
    """

    times: Array
    before: Array | None
    after: Array | None
    energy: Array | None
    spread: Array
    weight: Array
    offset: Any
    law: Callable[[Array, Array], Array] | None = None
    share: float = 1.0
    inputs: Array | None = None


class System:
    """The formulas of a model as NumPy functions of (z, t, theta), and the coefficients of its equation."""

    def __init__(self, model: Model, splitting: str):
        yau = yau_system(model)
        assert yau is not None
        self.model = model
        n, m = model.n, model.m
        self.n, self.m, self.lie = n, m, splitting == "lie"
        self.sampled = model.observation_kind == "samples"
        self.law = SampleLaw(model) if has_own_law(model) else None
        self.law_is_formula = model.log_density is not None
        self.affine, self.unobserved = yau.slope is not None and self.law is None, yau.unobserved is not None
        # Whether the increments drive the equation inside an interval.
        self.rates = self.affine and not self.sampled and not self.lie
        # Whether a part of the factor of an increment is at the start of its interval.
        self.halves = not self.lie and not self.rates and not self.sampled
        self.origin, self.scale = _centre(model)
        self.probes = self.origin + np.random.default_rng(0).standard_normal((8, n)) * self.scale
        self.form, self.sensors = yau.form, Sensors.of(model)
        centre = sp.Matrix([sp.Rational(float(value)) for value in self.origin])
        blocks = [yau.form.matrix, yau.form.offset + yau.form.matrix * centre, model.covariance]
        for q in (yau.unobserved or yau.full, yau.full or yau.unobserved):
            assert q is not None
            constant = q.constant + (q.linear.T * centre)[0] + (centre.T * q.matrix * centre)[0]
            blocks += [q.matrix, q.linear + 2 * q.matrix * centre, sp.Matrix([constant])]
        self._equation = Matrices(blocks, model)
        slope, intercept = yau.slope or sp.zeros(m, n), yau.intercept or sp.zeros(m, 1)
        self._sensor = Matrices([slope, intercept + slope * centre, model.observation_noise], model)
        parts = [self._equation, self._sensor] if self.rates else [self._equation]
        self.outside = OutsideTables(model)
        self.hold, driven = model.input_hold, any(part.driven for part in parts)
        # Whether a piece of an interval has one flow for each length: the inputs are constant in it.
        self.autonomous = not any(part.timed for part in parts) and (model.input_hold == "zero" or not driven)

    def observe(self, z: Array, t: Any, theta: Array, u: Array | None, values: Array | None = None) -> Array:
        """Return h (..., m) at points z (..., n) and inputs u, or the statistics of a law, for an observation if it is known."""
        if self.law is not None:
            return self.law.statistics(self.origin + z, t, theta, u, values)
        return np.asarray(self.sensors.observed(self.origin + z, t, theta, u))

    def noise(self, times: Array, theta: Array, u: Array | None) -> Array:
        """Return S (R, m, m) at times (R,) and inputs (R, number of inputs)."""
        return np.asarray(np.broadcast_to(self.sensors.noise(self.origin, times, theta, u), (len(times), self.m, self.m)))

    def precision(self, times: Array, theta: Array, u: Array | None) -> Array:
        """Return S^-1 (R, m, m) at times (R,), or the metric of the statistics of a law."""
        if self.law is not None:
            return np.broadcast_to(np.eye(len(self.law)), (len(times), len(self.law), len(self.law)))
        return np.linalg.inv(self.noise(times, theta, u))

    def start_precision(self, theta: Array) -> Array:
        """Return the same at the start with inputs of zero, before any are known; the identity where there is none."""
        none = np.zeros((1, len(self.model.u)))
        try:
            found: Array = self.precision(np.array([float(self.model.start)]), theta, none)[0]
            cholesky(found)
        except np.linalg.LinAlgError:
            return np.eye(self.m)
        return found

    def slope(self, t: float, theta: Array, u: Array | None) -> tuple[Array, Array]:
        """Return C (m, n) and c (m,) of an affine h = C z + c at a time."""
        C, c, _ = self._sensor(np.array([t]), theta, None if u is None else u[None])
        return C[0], c[0, :, 0]

    def end_inputs(self, schedule: Schedule) -> list[Array | None]:
        """Return the inputs at the ends of intervals; an increment ends before they jump."""
        if schedule.inputs is None:
            return [None] * len(schedule)
        return list(schedule.inputs.at(schedule.stops, self.hold, before=not self.sampled))

    def transitions(self, schedule: Schedule, theta: Array) -> FlowResult:
        """Return the transitions of all intervals, each composed of those of its pieces, and the errors of the pieces."""
        pieces = pieces_of(schedule, self.hold, len(self.model.u))
        inside = schedule.inside[pieces.row]
        whole = np.asarray(inside.all(axis=1))

        def coefficients(times: Array, rows: Array) -> Coefficients:
            u = pieces.inputs(times, rows)
            L, l, G, Q, p, r, Qf, pf, rf = self._equation(times, theta, u)
            if not self.rates:
                full = whole[rows, None, None]
                Q, p, r = (np.where(full, one, other) for one, other in ((Qf, Q), (pf, p), (rf, r)))
                return Coefficients(L, l, G, Q, p, r[:, 0])
            C, c, S = self._sensor(times, theta, u)
            precision = precision_of(S, inside[rows])
            gain = np.swapaxes(C, 1, 2) @ precision
            driven = precision @ c
            linear = np.concatenate([p - gain @ c, gain], axis=2)
            constant = np.concatenate([r[:, 0] - 0.5 * (c * driven).sum(axis=1), driven[:, :, 0]], axis=1)
            offset = np.concatenate([l, np.zeros((len(l), self.n, self.m))], axis=2)
            return Coefficients(L, offset, G, Q - 0.5 * gain @ C, linear, constant)

        if self.autonomous or not len(schedule):
            found = integrate(coefficients, np.zeros(len(pieces.row)), pieces.lengths, True)
        else:
            found = integrate(coefficients, pieces.starts, pieces.stops, False)
        return found._replace(transition=composed(found.transition, pieces.row, len(schedule)))

    def factors(self, schedule: Schedule, theta: Array) -> tuple[list[Factor], float]:
        """Return the factors of all intervals, and the largest error of their integrals over time."""
        nothing = np.zeros((self.m, self.m))
        none = Factor(np.zeros(1), None, None, None, nothing, nothing, 0.0)
        ends = self.end_inputs(schedule)
        if self.law is not None:
            return [self._of_law(self.law, schedule, k, theta, none, u) for k, u in enumerate(ends)], 0.0
        complete = Schedule(schedule.starts, schedule.stops, np.ones_like(schedule.seen), schedule.lengths[:, None] + nothing[0])
        half = nothing if self.sampled else 0.5 * np.linalg.inv(self.noise(schedule.stops[:1], theta, None))
        found, worst = [none] * len(schedule), 0.0
        for k in range(len(schedule)):
            inside, seen, length = schedule.inside[k], schedule.seen[k], float(schedule.lengths[k])
            whole = bool(inside.all()) and not self.sampled
            early = late = none
            if (whole and not self.rates) or not (whole or self.unobserved or self.rates or self.sampled) and length > 0:
                if any(self.sensors.varies):
                    *both, error = self.sensors.inside(complete, k, np.zeros(self.m), theta, self.probes)
                    worst = max(worst, error)
                    before, after = (_squares(end) / length for end in both)
                    times = both[0].times
                else:
                    before, after, times = half, half, schedule.stops[k : k + 1]
                start, end = (None, before + after) if self.lie else (before, after)
                early = none._replace(times=times, before=start, after=end)
                late = none._replace(times=times, energy=-length * (before + after))
            if whole and not self.rates:
                found[k] = early
                continue
            at_end = seen & ~inside if self.rates else seen
            if at_end.any():
                found[k] = self._at_end(schedule, k, theta, at_end, ends[k])
            if late.energy is not None:
                found[k] = _joined(found[k], late)
        return found, worst

    def _of_law(
        self, law: SampleLaw, schedule: Schedule, k: int, theta: Array, none: Factor, u: Array | None
    ) -> Factor:
        """Return the factor of the samples at the end of interval k."""
        seen, stop = schedule.seen[k], float(schedule.stops[k])
        if not seen.any():
            return none
        likelihood = law.likelihood(seen, stop, theta, u, self.origin)
        return none._replace(times=np.array([stop]), energy=law.energy(seen)[None], law=likelihood, inputs=u)

    def _at_end(self, schedule: Schedule, k: int, theta: Array, at_end: Array, u: Array | None) -> Factor:
        """Return the factor of observations that act at the end of interval k."""
        observed = self.sensors.at_end(schedule, k, np.zeros(self.m), theta, at_end, u)
        energy = _squares(observed)
        if self.sampled:
            nothing = np.zeros((self.m, self.m))
            return Factor(
                observed.times, None, None, energy, np.diag(1.0 * at_end), nothing, observed.constant, inputs=u
            )
        spans = np.where(schedule.inside[k], schedule.lengths[k], schedule.elapsed[k])
        spread = np.diag(np.where(at_end, 1.0 / np.where(at_end, spans, 1.0), 0.0))
        return Factor(observed.times, None, None, energy, spread, spread @ energy[0] @ spread, 0.0, inputs=u)


def _squares(factor: Residuals) -> Array:
    """Return R'R (J, m, m)."""
    return np.asarray(np.swapaxes(factor.roots, 1, 2) @ factor.roots)


def _joined(factor: Factor, other: Factor) -> Factor:
    """Return the product of a factor at the end with one that has an energy alone.

    (h - y)'E (h - y) = h'E h - 2 y'E h + y'E y
    """
    assert other.energy is not None
    if factor.energy is None:
        return other
    after = factor.energy @ factor.spread
    return Factor(
        np.concatenate([factor.times, other.times]),
        None,
        np.concatenate([after, np.zeros_like(other.energy)]),
        np.concatenate([factor.energy, other.energy]),
        np.zeros_like(factor.spread),
        factor.weight - factor.spread @ factor.energy.sum(axis=0) @ factor.spread,
        factor.offset,
        inputs=factor.inputs,
    )


def _centre(model: Model) -> tuple[Array, Array]:
    """Return the mean of the model's prior, zero for angles and where it is not known, and its standard deviations."""
    prior = model.prior
    if prior is None or isinstance(prior, DensityPrior):
        return np.zeros(model.n), np.ones(model.n)
    turning = np.array([name in model.periodic for name in model.state])
    return np.where(turning, 0.0, np.asarray(prior.mean, float)), np.sqrt(np.diag(prior.cov))


@once_for_a_model
def system_of(model: Model, splitting: str) -> System:
    """Return the system of a model."""
    return System(model, splitting)
