"""A system in continuous time as the discrete-time model that filters of other libraries take.

Between observations an interval is divided into `substeps`; one of length d from t is a map and a Gaussian noise,

    scheme "euler"       x -> x + f(x, t) d + noise,  noise ~ N(0, G(t) d)                    first order in d
    scheme "midpoint"    half of the flow of f, noise ~ N(0, G(t + d/2) d), the other half    second order in d, in law

(Ito; first order where g depends on the state), where half of the flow is one step of the explicit midpoint rule.  An increment
dy = h dt + dw over a time T is the observation dy / T = h(x) + noise of covariance S / T at the end of its interval, which is
first order in the interval; a sample is used as it is.  Observations are whitened, so that every library receives
z = h(x) + N(0, I): with R = L L' the covariance of the observed coordinates, z is L^-1 times the observation.  An unobserved
coordinate has z = 0 and h = 0, which carries no information.  Where S depends on the state, R is taken at a state near the one in
question; an observed angle has the image nearest to h there.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from zakai.methods._options import one_of, whole_number
from zakai.methods._protocol import Info, Infos
from zakai.models.angles import observed_angles
from zakai.models.checks import depends_on_state
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.peers import _float64  # noqa: F401
from zakai.peers._jax_functions import jax_function
from zakai.records.schedule import Schedule

import jax  # isort: skip
import jax.numpy as jnp  # isort: skip

SCHEMES = ("midpoint", "euler")
_IMAGES = 4  # of an observed angle on each side
# The sums of squared innovations forget over 500 observations.  They are reported where they exceed what is expected by so many
# of their standard deviations, which are taken as those of at least 25 coordinates: one rare observation is no divergence.
MEMORY, LEAST, DOUBTFUL = 500, 25, 4.5
DIVERGED = (
    "the innovations are larger than the filter's own variance says, by so many standard deviations of their running sum: "
    "it has lost the state, or the interval is too long for it"
)


class System:
    """The formulas of a model as JAX functions; `rule` holds the static settings of a filter."""

    def __init__(self, model: Model, scheme: str, substeps: int, rule: Any):
        self.drift, self.observation = jax_function(model.drift, model), jax_function(model.observation, model)
        self.covariance = jax_function(model.covariance, model, (model.n, model.n))
        self.scheme, self.substeps, self.rule = scheme, substeps, rule
        self.n, self.m = model.n, model.m
        # g where it depends on the state, and S of samples where that does.
        g, S = model.diffusion, model.observation_noise
        self.diffusion = jax_function(g, model, g.shape) if depends_on_state(g, model) else None
        self.noise = jax_function(S, model, S.shape) if depends_on_state(S, model) else None
        self.turning = np.flatnonzero(observed_angles(model))
        self.angles = tuple(model.state.index(name) for name in model.periodic)
        self.noiseless = model.covariance.is_zero_matrix is True

    def half_flow(self, x: Any, t: Any, length: Any, theta: Any) -> Any:
        """Return x after half a substep of the drift from `t`, by the explicit midpoint rule; `length` is that of the substep."""
        middle = x + 0.25 * length * self.drift(x, t, theta)
        return x + 0.5 * length * self.drift(middle, t + 0.25 * length, theta)

    def before_noise(self, x: Any, t: Any, length: Any, theta: Any) -> Any:
        """Return a state (n,) moved by the drift of a substep before its noise."""
        if self.scheme == "euler":
            return x + length * self.drift(x, t, theta)
        return self.half_flow(x, t, length, theta)

    def after_noise(self, x: Any, t: Any, length: Any, theta: Any) -> Any:
        """Return a state (n,) moved by the drift of a substep after its noise."""
        return x if self.scheme == "euler" else self.half_flow(x, t + 0.5 * length, length, theta)

    def noise_time(self, t: Any, length: Any) -> Any:
        """Return the time at which G is evaluated in a substep from `t`."""
        return t if self.scheme == "euler" else t + 0.5 * length


@dataclass(frozen=True)
class _Formulas:
    """A model, equal to every other with the same compiled formulas: what is compiled for one serves them all."""

    key: Hashable
    model: Model = field(compare=False, repr=False)


@lru_cache(maxsize=32)
def _system(formulas: _Formulas, scheme: str, substeps: int, rule: Any) -> System:
    return System(formulas.model, scheme, substeps, rule)


def system_of(model: Model, scheme: str, substeps: int, rule: Any) -> System:
    """Return the compiled formulas, one object for all models that have them.

    Raises:
        InputError: an unknown scheme or number of substeps.
    """
    one_of("scheme", scheme, SCHEMES)
    noise = model.observation_noise if depends_on_state(model.observation_noise, model) else None
    matrices = (model.drift, model.diffusion, model.covariance, model.observation, noise, observed_angles(model))
    tables = tuple(model.tables.items())
    names = (model.state, model.parameter_symbols, model.periodic, model.functions, tables)
    return _system(_Formulas((names, matrices), model), scheme, whole_number("substeps", substeps, 1), rule)


class Interval(NamedTuple):
    """One interval: its ends and its length, the parameters (p,), and for filters that draw a root of each substep's noise."""

    start: Any
    stop: Any
    length: Any
    theta: Any
    roots: Any


class Observation(NamedTuple):
    """A white observation.

    `values` (m,); `whiten` (m, m) with z = whiten (h + noise); `seen`, the number of observed coordinates; `constant`, the
    logarithm of the density under pure noise for samples, and zero for increments, whose evidence is relative to that; `raw`
    (m,), the values before they are whitened; `mask` (m,), which of them are observed.
    """

    values: Any
    whiten: Any
    seen: Any
    constant: Any
    raw: Any
    mask: Any


@dataclass(frozen=True, eq=False)
class Prepared:
    """The intervals of a schedule, and what whitens their observations.

    `spans` (K, m), the times over which observed increments were gathered, else one; `whiten` (K, m, m); `constants` (K,), the
    logarithms of the volumes of the noise of samples; `roots` (K, substeps, n, r).
    """

    model: Model
    system: System
    theta: np.ndarray
    schedule: Schedule
    lengths: np.ndarray
    spans: np.ndarray
    whiten: np.ndarray
    constants: np.ndarray
    roots: np.ndarray | None = None
    seed: int = 0
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, model: Model, system: System, schedule: Schedule, theta: np.ndarray, **extra: Any) -> Prepared:
        """Return what is prepared for a schedule."""
        seen, count = schedule.seen, len(schedule)
        noise = np.broadcast_to(np.eye(model.m), (count, model.m, model.m))
        if system.noise is None:
            function = numpy_function(model.observation_noise, model, (model.m, model.m))
            noise = np.broadcast_to(function(np.zeros(model.n), schedule.stops, theta), noise.shape)
        spans = np.ones(seen.shape)
        if model.observation_kind != "samples":
            spans = np.where(seen, schedule.elapsed, 1.0)
            # Increments that end together share the noise of the time that they have in common.
            noise = noise * (np.minimum(spans[:, :, None], spans[:, None, :]) / (spans[:, :, None] * spans[:, None, :]))
        both = seen[:, :, None] & seen[:, None, :]
        factor = np.linalg.cholesky(np.where(both, noise, 0.0) + np.eye(model.m) * ~seen[:, None, :])
        whiten = np.where(both, np.linalg.inv(factor), 0.0)
        constants = np.zeros(count)
        if model.observation_kind == "samples":
            log_volume = np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
            constants = -log_volume - 0.5 * np.log(2 * np.pi) * seen.sum(axis=1)
        return cls(model, system, theta, schedule, schedule.lengths, spans, whiten, constants, **extra)

    def intervals(self, rows: slice) -> Interval:
        """Return intervals with a leading axis."""
        starts, roots = self.schedule.starts[rows], None if self.roots is None else self.roots[rows]
        return Interval(starts, self.schedule.stops[rows], self.lengths[rows], np.tile(self.theta, (len(starts), 1)), roots)

    def observations(self, rows: slice, values: np.ndarray) -> Observation:
        """Return what is observed at the ends of intervals, with a leading axis."""
        whiten, constants = self.whiten[rows], self.constants[rows]
        raw, mask = values / self.spans[rows], self.schedule.seen[rows]
        white = (whiten @ raw[:, :, None])[:, :, 0]
        if self.model.observation_kind == "samples":
            constants = constants - 0.5 * (white[:, None, :] @ white[:, :, None])[:, 0, 0]
        return Observation(white, whiten, mask.sum(axis=1).astype(float), constants, raw, mask)


def seen_from(system: System, observation: Observation, x: Any, t: Any, theta: Any) -> tuple[Observation, Callable[[Any], Any]]:
    """Return an observation whitened by the noise at a state x (n,), with images of angles near to h(x), and the white h.

    Of angles h is the image near to h(x) too.  Without such noise and angles both are the same from every state.
    """
    whiten, constant, raw = observation.whiten, observation.constant, observation.raw
    if system.noise is None and not len(system.turning):
        return observation, lambda y: whiten @ system.observation(y, t, theta)
    constant = constant + 0.5 * observation.values @ observation.values
    if system.noise is not None:
        both = observation.mask[:, None] & observation.mask
        factor = jnp.linalg.cholesky(jnp.where(both, system.noise(x, t, theta), 0.0) + jnp.diag(1.0 - observation.mask))
        whiten = jnp.where(both, jnp.linalg.inv(factor), 0.0)
        constant = constant - jnp.sum(jnp.log(jnp.diag(factor)))
    centre = system.observation(x, t, theta)

    def near(values: Any) -> Any:
        apart = (values - centre)[system.turning]
        return values.at[system.turning].set(centre[system.turning] + jnp.pi - jnp.mod(jnp.pi - apart, 2 * jnp.pi))

    raw = jnp.where(observation.mask, near(raw), 0.0)
    values = whiten @ raw
    found = observation._replace(values=values, whiten=whiten, constant=constant - 0.5 * values @ values, raw=raw)
    return found, lambda y: whiten @ near(system.observation(y, t, theta))


def image_health(system: System, observation: Observation, expected: Any, spread: Any) -> dict[str, Any]:
    """Return the largest weight of another image of an angle relative to the nearest, where there are angles.

    `expected` (m,) and `spread` (m, m) are the mean and the covariance of the white observation.
    """
    if not len(system.turning):
        return {}
    unit = jnp.eye(system.m) - jnp.diag(1.0 * observation.mask)
    back = jnp.linalg.inv(observation.whiten + unit)
    variance = jnp.diag(back @ spread @ back.T)
    apart = jnp.abs(back @ (observation.values - expected))
    weights = jnp.exp(-np.pi * jnp.maximum(2 * np.pi - 2 * apart, 0.0) / variance)
    return {"other_image": jnp.max((observation.mask * weights)[system.turning])}


def log_density(system: System, observation: Observation, x: Any, t: Any, theta: Any) -> Any:
    """Return log p(z | x) relative to the constant of the observation; of angles the sum over their images."""
    seen, h = seen_from(system, observation, x, t, theta)
    value = h(x)
    found = seen.values @ value - 0.5 * value @ value + (seen.constant - observation.constant)
    for j in system.turning:
        apart = seen.raw[j] - system.observation(x, t, theta)[j]
        turns = 2 * np.pi * np.concatenate([np.arange(-_IMAGES, 0), np.arange(1, _IMAGES + 1)])
        # The noise of an angle with many images is independent of others, so that its precision is on the diagonal.
        others = jnp.exp(-0.5 * seen.whiten[j, j] ** 2 * turns * (turns + 2 * apart))
        found = found + jnp.log1p(observation.mask[j] * jnp.sum(others))
    return found


Advance = Callable[[System, Interval, Any, Observation], tuple[Any, Info]]


def compiled(advance: Advance, size: int) -> tuple[Callable[..., tuple[Any, Info]], Callable[..., tuple[list[Any], Infos]]]:
    """Return `step` and `segment` of a method from the function that advances a state over one interval.

    Both call one compiled loop of at most `size` intervals, whose number is an argument: it is compiled once for the formulas of
    a model and the sizes of a state, and a record gives the same bits as its observations one by one.
    """

    @partial(jax.jit, static_argnums=0)
    def loop(system: System, count: Any, intervals: Interval, state: Any, observations: Observation) -> Any:
        def at(k: Any) -> tuple[Interval, Observation]:
            return jax.tree.map(lambda parts: parts[k], (intervals, observations))

        def one(k: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
            interval, observation = at(k)
            new = advance(system, interval, carry[0], observation)
            return new[0], jax.tree.map(lambda kept, value: kept.at[k].set(value), carry[1], new)

        shapes = jax.eval_shape(lambda now: advance(system, at(0)[0], now, at(0)[1]), state)
        kept = jax.tree.map(lambda leaf: jnp.zeros((size, *leaf.shape), leaf.dtype), shapes)
        return jax.lax.fori_loop(0, count, one, (state, kept))[1]

    def padded(parts: np.ndarray) -> np.ndarray:
        return np.concatenate([parts, np.repeat(parts[-1:], size - len(parts), axis=0)]) if len(parts) < size else parts

    def segment(prepared: Prepared, rows: slice, state: Any, values: np.ndarray) -> tuple[list[Any], Infos]:
        states: list[Any] = []
        infos: list[Info] = []
        for first in range(rows.start, rows.stop, size):
            part = slice(first, min(first + size, rows.stop))
            count = part.stop - part.start
            given = prepared.intervals(part), prepared.observations(part, values[first - rows.start :][:count])
            intervals, observations = jax.tree.map(padded, given)
            state = jax.tree.map(np.asarray, state)
            found = jax.tree.map(np.asarray, loop(prepared.system, count, intervals, state, observations))
            states.extend(jax.tree.map(lambda leaf, k=k: leaf[k], found[0]) for k in range(count))
            infos.append(jax.tree.map(lambda leaf, count=count: leaf[:count], found[1]))
            state = states[-1]
        return states, Infos(*jax.tree.map(lambda *parts: np.concatenate(parts), *infos))

    def step(prepared: Prepared, k: int, state: Any, values: np.ndarray) -> tuple[Any, Info]:
        states, infos = segment(prepared, slice(k, k + 1), state, values[None])
        return states[0], Info(*jax.tree.map(lambda leaf: leaf[0], tuple(infos)))

    return step, segment


class Innovations(NamedTuple):
    """Sums of the normalised squared innovations minus their expectation, and of their variances."""

    excess: Any = 0.0
    variance: Any = 0.0


def innovations(sums: Innovations, observation: Observation, mean: Any, cov: Any) -> Innovations:
    """Return the sums after an observation whose predicted white value has `mean` (m,) and `cov` (m, m)."""
    residual = observation.values - mean
    squared = jnp.sum(residual**2 / cov[0, 0] if len(residual) == 1 else residual * jnp.linalg.solve(cov, residual))
    keep = 1.0 - 1.0 / MEMORY
    # A chi-square variable has twice its degrees of freedom as its variance.
    return Innovations(keep * sums.excess + squared - observation.seen, keep**2 * sums.variance + 2.0 * observation.seen)


def in_deviations(sums: Innovations) -> Any:
    """Return the excess in standard deviations."""
    return sums.excess / jnp.sqrt(sums.variance + 2.0 * LEAST)
