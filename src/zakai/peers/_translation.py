"""A system in continuous time as the discrete-time model that filters of other libraries take.

Between readings an interval is cut into `substeps`; one of length d from t is a map and a Gaussian noise,

    scheme "euler"       x -> x + f(x, t) d + noise,  noise ~ N(0, G(t) d)                    first order in d
    scheme "midpoint"    half of the flow of f, noise ~ N(0, G(t + d/2) d), the other half    second order in d, in law

where half of the flow is one step of the explicit midpoint rule.  An increment dy = h dt + dw over a time T is the reading
dy / T = h(x) + noise of covariance S / T, taken at the end of its interval, which is first order in the interval; a sample is
what it is.  What is read is whitened, so that every library sees z = h(x) + N(0, I): of R = L L', the block of the coordinates
that were observed, z is L^-1 times the reading.  A coordinate that was not observed has z = 0 and h = 0 there, which says
nothing of the state.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.errors import InputError
from zakai.filters._formulas import Formulas, formulas
from zakai.filters._protocol import Schedule
from zakai.filters.observations import Data, noise_at
from zakai.models.compile import compile_model
from zakai.models.model import Model

SCHEMES = ("midpoint", "euler")
# Squared innovations are summed with a memory of 500 observations. The sum is in doubt beyond so many of the standard
# deviations that it has by chance, of no less than 25 coordinates: one rare reading is no divergence.
MEMORY, LEAST, DOUBTFUL = 500, 25, 4.5
DIVERGED = (
    "the innovations are larger than the filter's own variance says, by so many standard deviations of their running sum: "
    "it has lost the state, or the interval is too long for it"
)


class System:
    """The formulas of a model compiled for a peer; `rule` holds the peer's own static settings."""

    def __init__(self, model: Model, scheme: str, substeps: int, rule: Any):
        compiled = compile_model(model)
        self.drift, self.observation, self.covariance = compiled.drift, compiled.observation, compiled.covariance
        self.scheme, self.substeps, self.rule = scheme, substeps, rule
        self.n, self.m = model.n, model.m
        self.angles = tuple(model.state.index(name) for name in model.periodic)
        self.noiseless = model.covariance.is_zero_matrix is True

    def half_flow(self, x: Any, t: Any, length: Any, theta: Any) -> Any:
        """Half a substep of the drift by the explicit midpoint rule, from `t` on; `length` is that of the substep."""
        middle = x + 0.25 * length * self.drift(x, t, theta)
        return x + 0.5 * length * self.drift(middle, t + 0.25 * length, theta)

    def before_noise(self, x: Any, t: Any, length: Any, theta: Any) -> Any:
        """What the drift does to a state (n,) in a substep before its noise comes."""
        if self.scheme == "euler":
            return x + length * self.drift(x, t, theta)
        return self.half_flow(x, t, length, theta)

    def after_noise(self, x: Any, t: Any, length: Any, theta: Any) -> Any:
        """What the drift does in a substep after its noise came."""
        return x if self.scheme == "euler" else self.half_flow(x, t + 0.5 * length, length, theta)

    def noise_time(self, t: Any, length: Any) -> Any:
        """The time at which G is taken in a substep from `t`."""
        return t if self.scheme == "euler" else t + 0.5 * length


@lru_cache(maxsize=32)
def _system(of: Formulas, scheme: str, substeps: int, rule: Any) -> System:
    return System(of.model, scheme, substeps, rule)


def system_of(model: Model, scheme: str, substeps: int, rule: Any) -> System:
    """The compiled formulas, one object for all models that have them; InputError for a scheme or a number of substeps."""
    if scheme not in SCHEMES:
        raise InputError(f'option scheme: "{scheme}" is neither "midpoint" nor "euler"')
    return _system(formulas(model), scheme, whole_number("substeps", substeps, 1), rule)


def whole_number(option: str, value: Any, least: int, most: int = 10**9) -> int:
    """The value of an option that counts something; InputError for another one."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not least <= value <= most:
        raise InputError(f"option {option}: {value!r} is not a whole number from {least} to {most}")
    return int(value)


def real_number(option: str, value: Any, what: str, fits: Any) -> float:
    """The value of an option that measures something; InputError, with `what` it must be, for another one."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not fits(value):
        raise InputError(f"option {option}: {value!r} is not {what}")
    return float(value)


@partial(jax.tree_util.register_dataclass, data_fields=["start", "stop", "theta", "roots"], meta_fields=["system"])
@dataclass(frozen=True)
class Interval:
    """One interval: its ends, the parameters (p,), and, for peers that draw, a root of the noise of each substep."""

    start: Any
    stop: Any
    theta: Any
    roots: Any
    system: System


@dataclass(frozen=True, eq=False)
class Prepared:
    """The intervals, and for peers that draw the seed, which is not compiled in; nothing else is known without data."""

    model: Model
    system: System
    schedule: Schedule
    theta: Any
    intervals: Interval
    seed: int = 0
    notes: tuple[str, ...] = ()


class Reading(NamedTuple):
    """White readings: `values` (m,), `whiten` (m, m) with z = whiten (h + noise), how many were `seen`, and the logarithm of
    their density under pure noise, or zero where a record's evidence is relative to that (all but samples)."""

    values: Any
    whiten: Any
    seen: Any
    constant: Any


def readings(prepared: Prepared, data: Data) -> Reading:
    """What `step` is given for each interval; a singular covariance was refused with the model."""
    theta, model = prepared.theta, prepared.model
    xp: Any = np if isinstance(theta, np.ndarray) else jnp
    seen = ~np.isnan(data.values)
    values, noise = np.where(seen, data.values, 0.0), noise_at(model, data.stops, theta)
    if model.observation_kind != "samples":
        spans = np.where(seen, data.elapsed, 1.0)
        values = values / spans
        # Increments that end together share the noise of the time that they have in common.
        noise = noise * (np.minimum(spans[:, :, None], spans[:, None, :]) / (spans[:, :, None] * spans[:, None, :]))
    both = seen[:, :, None] & seen[:, None, :]
    alone = np.eye(values.shape[1]) * ~seen[:, None, :]
    factor = xp.linalg.cholesky(xp.where(both, noise, 0.0) + alone)
    whiten = xp.where(both, xp.linalg.inv(factor), 0.0)
    white = xp.einsum("kij,kj->ki", whiten, values)
    count = seen.sum(axis=1).astype(float)
    constant = xp.zeros(len(white))
    if model.observation_kind == "samples":
        log_volume = xp.log(xp.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
        constant = -0.5 * (white**2).sum(axis=1) - log_volume - 0.5 * np.log(2 * np.pi) * count
    return Reading(white, whiten, count, constant)


class Innovations(NamedTuple):
    """Running sums of the normalised squared innovations, less one per coordinate, and of the variance they have by chance."""

    excess: Any = 0.0
    variance: Any = 0.0


def innovations(sums: Innovations, reading: Reading, mean: Any, cov: Any) -> Innovations:
    """The sums after a reading whose predicted white value has `mean` (m,) and `cov` (m, m)."""
    residual = reading.values - mean
    squared = jnp.sum(residual**2 / cov[0, 0] if len(residual) == 1 else residual * jnp.linalg.solve(cov, residual))
    keep = 1.0 - 1.0 / MEMORY
    # A chi-square variable has twice its degrees of freedom as its variance.
    return Innovations(keep * sums.excess + squared - reading.seen, keep**2 * sums.variance + 2.0 * reading.seen)


def in_deviations(sums: Innovations) -> Any:
    """The excess in standard deviations of chance."""
    return sums.excess / jnp.sqrt(sums.variance + 2.0 * LEAST)
