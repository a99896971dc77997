"""Hu and Yau's statistics (a, b, c) from time 0, for constant coefficients: a form to verify with, not to run on for long.

With S = I (h and y are whitened first), P = x'M x/2 + m.x + k, eta = x'N x + e.x + ..., and a = a~ + C'y,

    b' = G a~ + D b,    a~' = M b - D'a~ - C'dy/dt,    b(0) = a~(0) = 0                                     (12), (13)
    c' = -b''G^-1 b'/2 + a.b' - d'G^-1 b' + b'N b/2 + e.b/2                                                  (14), corrected
    sigma(t, x) = exp(F(x) - S(x - b) - a~.x + c_h.y - c + a.b) u~(t, x - b)

(Hu and Yau 2002, Theorem 3).  u~ knows no data.  (b, a~) obey a Hamiltonian system and grow like e^{mu t}; what they multiply
cancels, and with it the digits of the mean, like eps e^{mu t}, and of the evidence, like eps e^{2 mu t}, both relative to the
size of the statistics.  That size is known with the data only: `lost_digits` is what it makes of the evidence's, in nats.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import expm

from zakai import _float64  # noqa: F401
from zakai.densities import Density
from zakai.errors import InputError
from zakai.filters import _family_filter as base
from zakai.filters._affine_system import AffineSystem, affine_system_of
from zakai.filters._formulas import formulas
from zakai.filters._gauge import posterior
from zakai.filters._protocol import Info, Schedule
from zakai.filters.observations import Data, FactorRule, Factors
from zakai.kolmogorov.families import Family, move, read
from zakai.models.model import Model

_LINE, _MASSES = np.polynomial.legendre.leggauss(10)
_NODES, _WEIGHTS = 0.5 * (_LINE + 1.0), 0.5 * _MASSES


class Constants(NamedTuple):
    """The letters of the equations, h whitened: c_h is `intercept`, `whiten` takes y to it."""

    D: Any
    d: Any
    inverse: Any
    N: Any
    e: Any
    hamiltonian: Any
    slope: Any
    intercept: Any
    whiten: Any


def constants(system: AffineSystem, model: Model, theta: Any) -> Constants:
    """The constants of a model."""
    D, d, G, Q, p, _, C, c, S = system.matrices(model.start, theta)
    whiten = jnp.linalg.inv(jnp.linalg.cholesky(S))
    C, c, d, p = whiten @ C, whiten @ c[:, 0], d[:, 0], p[:, 0]
    inverse = jnp.linalg.inv(G)
    M, m = C.T @ C - 2.0 * Q, C.T @ c - p
    N, e = M + D.T @ inverse @ D, 2.0 * (m + D.T @ inverse @ d)
    return Constants(D, d, inverse, N, e, jnp.block([[D, G], [M, -D.T]]), C, c, whiten)


@dataclass(frozen=True, eq=False)
class Prepared:
    """The families of u~, prepared as in the stepwise form, and the statistics' own flow."""

    base: base.Prepared
    intervals: Interval

    @property
    def model(self) -> Model:
        return self.base.model

    @property
    def theta(self) -> Any:
        return self.base.theta


@partial(
    jax.tree_util.register_dataclass, data_fields=["base", "length", "maps", "constants"], meta_fields=[]
)
@dataclass(frozen=True)
class Interval:
    """One interval: that of the stepwise form, its length, and the flow of (b, a~, dy/dt) to ten points inside and its end."""

    base: base.Interval
    length: Any
    maps: Any
    constants: Constants


class State(NamedTuple):
    """u~ as families, and the statistics; `log_mass` is that of sigma, `steps` counts the intervals."""

    data_free: base.State
    b: Any
    a: Any
    y: Any
    c: Any
    log_mass: Any
    steps: Any


def prepare(model: Model, schedule: Schedule, system: AffineSystem, tolerance: float) -> Prepared:
    """The flow of u~ and of the statistics; InputError where they do not apply or would have lost their digits."""
    if not schedule.inside.all():
        raise InputError(
            f'{model.source}: option form: "one-shot" needs every coordinate over every interval (increments, no gaps); '
            'take form="stepwise"'
        )
    if system.varying or any(entry.has(model.t) for entry in model.drift):
        raise InputError(f'{model.source}: option form: "one-shot" needs constant coefficients; take form="stepwise"')
    plain = affine_system_of(formulas(model))
    covariance = plain.matrices(model.start, model.theta())[2]
    if np.linalg.matrix_rank(covariance) < model.n:
        raise InputError(f'{model.source}: option form: "one-shot" needs a G that has an inverse; take form="stepwise"')
    found = jax.tree.map(np.asarray, constants(plain, model, model.theta()))
    rate = float(np.max(np.linalg.eigvals(found.hamiltonian).real, initial=0.0))
    time = float(schedule.stops[-1] - model.start)
    with np.errstate(over="ignore"):
        estimate = np.finfo(float).eps * np.exp(2.0 * rate * time)
    if estimate > tolerance:
        raise InputError(
            f'{model.source}: option form: "one-shot" would lose its digits by t = {schedule.stops[-1]:g}: its error estimate '
            f'eps exp(2 mu t) = {estimate:.1e} with mu = {rate:.3g} passes {tolerance:g} (option tolerance); take form="stepwise"'
        )
    first = base.prepare(model, schedule, system)
    return Prepared(first, _interval(first))


def with_parameters(prepared: Prepared, theta: Any) -> Prepared:
    """The same for other parameters; traced by JAX."""
    first = base.with_parameters(prepared.base, theta)
    return replace(prepared, base=first, intervals=_interval(first))


def _interval(first: base.Prepared) -> Interval:
    found = constants(affine_system_of(formulas(first.model)), first.model, first.theta)
    lengths = first.schedule.stops - first.schedule.starts
    twice, m = len(found.hamiltonian), len(found.intercept)
    driven = jnp.vstack([jnp.zeros((twice // 2, m)), -found.slope.T])
    generator = jnp.block([[found.hamiltonian, driven], [jnp.zeros((m, twice + m))]])
    times = jnp.asarray(lengths)[:, None] * np.append(_NODES, 1.0)
    maps = jax.vmap(jax.vmap(lambda t: expm(t * generator)[:twice]))(times)
    repeated = jax.tree.map(lambda a: jnp.broadcast_to(a, (len(lengths), *jnp.shape(a))), found)
    return Interval(first.intervals, lengths, maps, repeated)


def observations(prepared: Prepared, data: Data) -> Factors:
    """The rates of y."""
    return base.observations(prepared.base, data)


def rule(prepared: Prepared, data: Data) -> FactorRule:
    """The same but for the values."""
    return base.rule(prepared.base, data)


def init(prepared: Prepared, prior: Any) -> State:
    """The prior, and statistics that are zero."""
    zero = jnp.zeros(prepared.model.n)
    return State(base.init(prepared.base, prior), zero, zero, jnp.zeros(prepared.model.m), *jnp.zeros((3,)))


def correct(prepared: Prepared, prior: Any, observation: Factors) -> tuple[State, Info]:
    """There are no samples in this form."""
    raise InputError(f'{prepared.model.source}: option form: "one-shot" takes no samples; take form="stepwise"')


def c_rate(k: Constants, b: Any, a: Any, b_rate: Any) -> Any:
    """(14) as corrected: the term that is printed with d_ji has d_i, d'G^-1 b'."""
    inner = k.inverse @ b_rate
    return -0.5 * b_rate @ inner + a @ b_rate - k.d @ inner + 0.5 * b @ k.N @ b + 0.5 * k.e @ b


def step(interval: Interval, state: State, observation: Factors) -> tuple[State, Info]:
    """One interval of the statistics and of u~, then sigma from both."""
    k, n = interval.constants, len(state.b)
    silent = jnp.zeros_like(observation.inputs).at[0].set(1.0)
    families, _ = jax.lax.scan(
        lambda now, flow: (jax.vmap(move, (0, None, None))(now, flow, silent), None),
        state.data_free.families,
        interval.base.flow,
    )
    rate = k.whiten @ observation.inputs[1:]
    inside = interval.maps @ jnp.concatenate([state.b, state.a, rate])

    def growth(values, share):
        b, a = values[:n], values[n:]
        b_rate = k.hamiltonian[:n] @ values
        return c_rate(k, b, a + k.slope.T @ (state.y + share * interval.length * rate), b_rate)

    c = state.c + interval.length * (_WEIGHTS @ jax.vmap(growth)(inside[:-1], jnp.asarray(_NODES)))
    b, a, y = inside[-1, :n], inside[-1, n:], state.y + interval.length * rate
    moved = state.data_free._replace(families=families, time=interval.base.stop)
    new = State(moved, b, a, y, c, state.log_mass, state.steps + 1.0)
    sigma = _sigma(interval.base.quadratic, k, new)
    found = posterior(interval.base.gauge, interval.base.tilts, interval.base.stop, interval.base.theta, sigma)
    health = base.health_of(moved._replace(families=sigma), found) | {"lost_digits": jax.lax.stop_gradient(_rounding(k, new))}
    increment = found.log_mass - state.log_mass
    return new._replace(log_mass=found.log_mass), Info(increment, found.mean, found.cov, health)


def _rounding(k: Constants, state: State) -> Any:
    """The rounding, in nats, of what cancels in the evidence: that of every interval grows along with the statistics."""
    terms = k.intercept @ state.y, state.c, (jnp.abs(state.a) + jnp.abs(k.slope.T @ state.y)) @ jnp.abs(state.b)
    return state.steps * np.finfo(float).eps * sum(jnp.abs(term) for term in terms)


def _sigma(quadratic: base.Quadratic | None, k: Constants, state: State) -> Family:
    """e^-F sigma as families."""
    families = state.data_free.families
    families = families if quadratic is None else quadratic.times(families, -1.0)
    shifted = families._replace(mean=families.mean + state.b)
    constant = k.intercept @ state.y - state.c + (state.a + k.slope.T @ state.y) @ state.b
    n = len(state.b)
    tilt = partial(
        read, slope=jnp.eye(n), intercept=jnp.zeros(n), after=-state.a, energy=jnp.zeros((n, n)), constant=constant
    )
    return jax.vmap(tilt)(shifted)


def density(prepared: Prepared, state: State) -> Density:
    """The posterior."""
    first = prepared.base
    time = state.data_free.time
    found = constants(affine_system_of(formulas(first.model)), first.model, first.theta)
    state = jax.tree.map(jnp.asarray, state)
    sigma = _sigma(first.system.quadratic(time, first.theta), found, state)
    return base.density_of(first.model, first.gauge, first.theta, time, sigma)
