"""Hu and Yau's statistics (a, b, c) from time 0, for constant coefficients: a form to verify with, not for long records.

With S = I (h and y are whitened first), P = x'M x/2 + m.x + k, eta = x'N x + e.x + ..., and a = a~ + C'y,

    b' = G a~ + D b,    a~' = M b - D'a~ - C'dy/dt,    b(0) = a~(0) = 0                                     (12), (13)
    c' = -b''G^-1 b'/2 + a.b' - d'G^-1 b' + b'N b/2 + e.b/2                                                  (14), corrected
    sigma(t, x) = exp(F(x) - S(x - b) - a~.x + c_h.y - c + a.b) u~(t, x - b)

(Hu and Yau 2002, Theorem 3).  u~ knows no data.  (b, a~) obey a Hamiltonian system and grow like e^{mu t}; what they multiply
cancels, and with it the digits of the mean, like eps e^{mu t}, and of the evidence, like eps e^{2 mu t}, both relative to the
size of the statistics.  That size is known with the data only: `lost_digits` is the resulting error of the evidence, in nats.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import expm

from zakai.densities import Density
from zakai.errors import InputError
from zakai.methods._protocol import Info
from zakai.methods.gaussian import families
from zakai.methods.gaussian.affine_system import AffineSystem, affine_system_of
from zakai.methods.gaussian.gauge import posterior, tilts_at
from zakai.methods.gaussian.gauged_density import density_of
from zakai.models.model import Model
from zakai.numerics.complex_step import cholesky, is_complex
from zakai.numerics.families import Family, weigh
from zakai.numerics.transition import Array
from zakai.records.schedule import Schedule

_LINE, _MASSES = np.polynomial.legendre.leggauss(10)
_NODES, _WEIGHTS = 0.5 * (_LINE + 1.0), 0.5 * _MASSES


class State(NamedTuple):
    """The state `own` of u~; the statistics b, a~ (n,), y (m,) and c; the `log_scale` of sigma, and the number of `steps`."""

    own: families.State
    b: Array
    a: Array
    y: Array
    c: Array
    log_scale: Array
    steps: float


class Constants(NamedTuple):
    """The letters of the equations, h whitened: c_h is `intercept`, `whiten` takes y to it."""

    d: Array
    inverse: Array
    N: Array
    e: Array
    hamiltonian: Array
    slope: Array
    intercept: Array
    whiten: Array


def constants(system: AffineSystem, theta: Array, origin: Array) -> Constants:
    """Return the constants of a model, relative to an origin."""
    D, d, G, Q, p, _, C, c, S = (array[0] for array in system.letters(np.zeros(1), theta, origin))
    whiten = np.linalg.inv(cholesky(S))
    C, c, d, p = whiten @ C, whiten @ c[:, 0], d[:, 0], p[:, 0]
    inverse = np.linalg.inv(G)
    M, m = C.T @ C - 2.0 * Q, C.T @ c - p
    N, e = M + D.T @ inverse @ D, 2.0 * (m + D.T @ inverse @ d)
    return Constants(d, inverse, N, e, np.block([[D, G], [M, -D.T]]), C, c, whiten)


@dataclass(frozen=True, eq=False)
class Prepared:
    """The families of u~, prepared as in the stepwise form, and the flow of (b, a~, dy/dt).

    `maps` (K, 11, 2n, 2n + m) is the flow to ten times in each interval and to its end.
    """

    base: families.Prepared
    constants: Constants
    maps: Array

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the warnings of a result."""
        return self.base.notes


def prepare(model: Model, schedule: Schedule, theta: Array, kind: type[AffineSystem], tolerance: float) -> Prepared:
    """Return the flow of u~ and of the statistics; InputError where they do not apply or would have lost their digits."""
    if len(schedule) and not schedule.inside.all():
        raise InputError(
            f'{model.source}: option form: "one-shot" needs every coordinate over every interval (increments, no gaps); '
            'take form="stepwise"'
        )
    plain = affine_system_of(model)
    if plain.varying or any(entry.has(model.t) for entry in model.drift):
        raise InputError(f'{model.source}: option form: "one-shot" needs constant coefficients; take form="stepwise"')
    base = families.prepare(model, schedule, theta, kind)
    covariance = plain.matrices(np.zeros(1), base.setup.theta.real)[2][0]
    if np.linalg.matrix_rank(covariance) < model.n:
        raise InputError(f'{model.source}: option form: "one-shot" needs a G that has an inverse; take form="stepwise"')
    found = constants(plain, base.setup.theta, base.setup.origin)
    rate = float(np.max(np.linalg.eigvals(found.hamiltonian.real).real, initial=0.0))
    stop = float(schedule.stops[-1]) if len(schedule) else model.start
    with np.errstate(over="ignore"):
        estimate = np.finfo(float).eps * np.exp(2.0 * rate * (stop - model.start))
    if estimate > tolerance:
        raise InputError(
            f'{model.source}: option form: "one-shot" would lose its digits by t = {stop:.12g}: its error estimate '
            f'eps exp(2 mu t) = {estimate:.1e} with mu = {rate:.3g} passes {tolerance:g} (option tolerance); take form="stepwise"'
        )
    return Prepared(base, found, _maps(found, base.lengths))


def _maps(found: Constants, lengths: Array) -> Array:
    """Return the flows of (b, a~) with constant dy/dt to the nodes and the end of every interval."""
    twice, m = len(found.hamiltonian), len(found.intercept)
    generator = np.zeros((twice + m, twice + m), found.hamiltonian.dtype)
    generator[:twice, :twice] = found.hamiltonian
    generator[twice // 2 : twice, twice:] = -found.slope.T
    times = lengths[:, None] * [*_NODES, 1.0]
    return np.asarray(expm(times[:, :, None, None] * generator)[:, :, :twice])


def init(prepared: Prepared, prior: Any) -> State:
    """Return the state of the prior, with statistics that are zero."""
    base = prepared.base
    kind = complex if is_complex(base.setup.theta) else float
    none, zero = np.zeros(base.model.n, kind), np.zeros((), kind)
    return State(families.init(base, prior), none, none, np.zeros(base.model.m, kind), zero, zero, 0.0)


def c_rate(k: Constants, b: Array, a: Array, b_rate: Array) -> Any:
    """Return (14) as corrected: the term that is printed with d_ji has d_i, d'G^-1 b'."""
    inner = k.inverse @ b_rate
    return -0.5 * b_rate @ inner + a @ b_rate - k.d @ inner + 0.5 * b @ k.N @ b + 0.5 * k.e @ b


@np.errstate(all="ignore")
def step(prepared: Prepared, k: int, state: State, values: Array) -> tuple[State, Info]:
    """Advance the statistics and u~ by one interval, then make sigma from both."""
    base, own, n = prepared.base, prepared.constants, len(state.b)
    length = base.lengths[k]
    rates = families.inputs_of(base, k, values)
    silent = np.zeros_like(rates)
    silent[0] = 1.0
    own_families = families.move_families(base, k, state.own.families, silent)
    rate = own.whiten @ rates[1:]
    inside = prepared.maps[k] @ np.concatenate([state.b, state.a, rate])
    growth = 0.0
    for weight, share, statistics in zip(_WEIGHTS, _NODES, inside[:-1], strict=True):
        b, a = statistics[:n], statistics[n:]
        b_rate = own.hamiltonian[:n] @ statistics
        growth = growth + weight * c_rate(own, b, a + own.slope.T @ (state.y + share * length * rate), b_rate)
    c = state.c + length * growth
    y = state.y + length * rate
    own_state = families.State(*own_families, state.own.log_error, state.own.edge, float(base.stops[k]))
    new = State(own_state, inside[-1, :n], inside[-1, n:], y, c, state.log_scale, state.steps + 1.0)
    sigma = _sigma(prepared, new)
    found = posterior(base.gauge, tilts_at(base.tilts, k), base.stops[k], sigma)
    health = families.health_of(own_state, sigma, found)
    health = {"lost_digits": rounding(prepared, new), **health}
    increment = found.log_mass - state.log_scale
    return new._replace(log_scale=np.asarray(found.log_mass)), Info(increment, found.mean + base.setup.origin, found.cov, health)


def rounding(prepared: Prepared, state: State) -> float:
    """Return the rounding, in nats, of the terms that cancel in the evidence: that of each interval grows with the statistics."""
    k = prepared.constants
    terms = k.intercept @ state.y, state.c, (np.abs(state.a) + np.abs(k.slope.T @ state.y)) @ np.abs(state.b)
    return float(state.steps * np.finfo(float).eps * sum(abs(term) for term in terms))


def _sigma(prepared: Prepared, state: State) -> Family:
    """Return e^-F sigma as families."""
    setup, k = prepared.base.setup, prepared.constants
    found = families.times_gauge(state.own.families, setup, -1.0)
    constant = k.intercept @ state.y - state.c + (state.a + k.slope.T @ state.y) @ state.b
    return weigh(found._replace(mean=found.mean + state.b), np.zeros((len(state.b),) * 2), -state.a, constant)


def stepwise(prepared: Prepared, state: State) -> families.State:
    """Return the same density as a state of the stepwise form."""
    found = _sigma(prepared, state)
    found = families.times_gauge(found._replace(log_mass=found.log_mass - state.log_scale), prepared.base.setup, 1.0)
    return families.State(*found, state.own.log_error, state.own.edge, state.own.time)


def density(prepared: Prepared, state: State) -> Density:
    """Return the posterior."""
    base = prepared.base
    sigma = Family(*(array.real for array in _sigma(prepared, state)))
    return density_of(base.model, base.gauge.real(), state.own.time, sigma)
