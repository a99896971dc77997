"""From a record to what a step is given.

Every kind of record becomes, for each reading, a value with the time over which it was gathered; a reading that acts at one time
is a factor on the density,

    log factor(x) = linear . h(x, t) - h'(energy) h / 2 + constant.
"""

from __future__ import annotations

from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.filters._protocol import Schedule
from zakai.models.compile import jax_function
from zakai.models.model import Model
from zakai.models.numeric import NumericFunction, numpy_function
from zakai.records import Record


class Data(NamedTuple):
    """Readings (K, m): `values` (nan where there is none), the time `elapsed` (K, m) over which an increment was gathered.

    For samples `values` are the samples and `elapsed` is zero.  `starts` and `stops` (K,) are those of the intervals.
    """

    starts: np.ndarray
    stops: np.ndarray
    values: np.ndarray
    elapsed: np.ndarray

    def part(self, rows: slice) -> Data:
        return Data(*(array[rows] for array in self))

    @property
    def filled(self) -> np.ndarray:
        """The values (K, m), zero where there is none."""
        return np.where(np.isnan(self.values), 0.0, self.values)


class Factors(NamedTuple):
    """What multiplies the density, for K intervals: `before` (K, m) at the start, `after` (K, m), `energy` (K, m, m), or None
    where it is zero throughout, and `constant` (K,) at the end, and the rates `inputs` (K, 1 + k) that act
    inside, the first of them one.
    """

    before: Any
    after: Any
    energy: Any
    constant: Any
    inputs: Any


class FactorRule(NamedTuple):
    """What Factors are but for the values (..., m) of the readings, zero where there are none, of which it makes them.

    `before` and `after` (..., m, m), or None for zero, and 1 / `spans` (..., m), or None for no inputs, multiply the values; the
    constant is `offset` (...) - values'(`weight`) values / 2.
    """

    before: Any
    after: Any
    energy: Any
    offset: Any
    weight: Any
    spans: Any

    def __call__(self, values: Any) -> Factors:
        xp = np if isinstance(values, np.ndarray) else jnp
        nothing = np.zeros(np.shape(values))
        inputs = xp.ones((*np.shape(values)[:-1], 1))
        if self.spans is not None:
            inputs = xp.concatenate([inputs, values / self.spans], axis=-1)
        return Factors(
            nothing if self.before is None else _times(self.before, values),
            nothing if self.after is None else _times(self.after, values),
            self.energy,
            _constant(self.offset, self.weight, values),
            inputs,
        )


def data_of(model: Model, record: Record) -> Data:
    """The record as increments with their times (or as samples)."""
    stops = np.asarray(record.times, float)
    starts = np.concatenate([[model.start], stops[:-1]])
    lengths = (stops - starts)[:, None]
    values = np.asarray(record.values, float)
    if record.kind == "samples":
        return Data(starts, stops, values, np.zeros_like(values))
    elapsed = np.broadcast_to(lengths, values.shape)
    if record.kind == "rates":
        values = values * lengths
    elif record.kind == "path":
        values, elapsed = _path_increments(model.start, stops, values)
    return Data(starts, stops, values, np.where(np.isnan(values), np.nan, elapsed))


def _path_increments(start: float, times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The increment of each coordinate, and the time, since its last reading."""
    seen = ~np.isnan(values)
    rows = np.arange(1, len(times) + 1)[:, None]
    last = np.maximum.accumulate(np.where(seen, rows, 0), axis=0)
    previous = np.concatenate([np.zeros((1, values.shape[1]), int), last[:-1]])
    padded = np.concatenate([np.zeros((1, values.shape[1])), np.nan_to_num(values)])
    clock = np.concatenate([[start], times])
    increments = values - np.take_along_axis(padded, previous, axis=0)
    return increments, np.where(seen, times[:, None] - clock[previous], np.nan)


def schedule_of(data: Data, per_coordinate: bool) -> Schedule:
    """When the readings come.  A reading acts inside its interval if it was gathered over just that interval; unless
    `per_coordinate`, all coordinates must."""
    lengths = (data.stops - data.starts)[:, None]
    inside = ~np.isnan(data.values) & (lengths > 0) & (np.abs(data.elapsed - lengths) <= 1e-9 * lengths)
    if not per_coordinate:
        inside = np.broadcast_to(inside.all(axis=1, keepdims=True), inside.shape)
    return Schedule(data.starts, data.stops, inside)


def factor_rule(
    model: Model, data: Data, schedule: Schedule, *, rates: bool, splitting: str, remove: bool, theta: Any = None
) -> FactorRule:
    """What the factors of a run of intervals are but for the values of the readings, of which `data` says where they are.

    For the parameters `theta` (p,), by default the model's; JAX may trace them.  Readings that act inside enter as rates
    (`rates`: y runs linearly, for affine h) or as exp(h'S^-1 dy), in two halves or, with `splitting="lie"`, whole at the end.
    The others are whole factors at the end; with `remove` the energy that the transition holds inside, h'S^-1 h dt / 2, is
    taken out again there.
    """
    count = len(data.stops)
    theta = model.theta() if theta is None else theta
    xp = np if isinstance(theta, np.ndarray) else jnp
    seen = np.logical_not(np.isnan(data.values))
    inside = schedule.inside
    whole = np.asarray(inside.all(axis=1))[:, None, None]
    lengths = (data.stops - data.starts)[:, None]
    before = after = energy = weight = spans = None
    offset = np.zeros(count)
    noise_end = noise_at(model, data.stops, theta)
    if rates:
        spans = np.where(inside, lengths, np.inf)
    elif splitting == "lie":
        after = _where_whole(xp, whole, _inverses(xp, noise_end))
    elif whole.any():
        after = _where_whole(xp, whole, 0.5 * _inverses(xp, noise_end))
        before = after
        if not _is_one(xp, noise_end):
            before = _where_whole(xp, whole, 0.5 * _inverses(xp, noise_at(model, data.starts, theta)))
    if remove and not rates and not whole.all():
        energy = -xp.where(whole, 0.0, _inverses(xp, noise_end) * lengths[..., None])
    at_end = seen & ~inside if rates else seen & ~whole[:, 0]
    if at_end.any():
        more = _at_end(xp, model.observation_kind, data.elapsed, at_end, noise_end)
        energy = more.energy if energy is None else energy + more.energy
        after = more.linear if after is None else after + more.linear
        offset, weight = offset + more.offset, more.weight
    return FactorRule(before, after, energy, offset, weight, spans)


def noise_at(model: Model, times: np.ndarray, theta: Any) -> Any:
    """S (K, m, m) at the times (K,), for the parameters `theta` (p,), which JAX may trace."""
    m, origin = model.m, np.zeros(model.n)
    if isinstance(theta, np.ndarray):
        noise, varies = _noise_of(model)
        # What does not depend on time is there once, in every row.
        return np.broadcast_to(noise(origin, times if varies else np.zeros(()), theta), (len(times), m, m))
    return jax.vmap(jax_function(model.observation_noise, model, (m, m)), (None, 0, None))(origin, jnp.asarray(times), theta)


_NOISE: WeakKeyDictionary[Model, tuple[NumericFunction, bool]] = WeakKeyDictionary()


def _noise_of(model: Model) -> tuple[NumericFunction, bool]:
    """S as a function, made once for each model, and whether it depends on time."""
    if model not in _NOISE:
        noise = numpy_function(model.observation_noise, model, (model.m, model.m))
        _NOISE[model] = noise, model.observation_noise.has(model.t)
    return _NOISE[model]


def _is_one(xp: Any, matrices: Any) -> bool:
    """Whether matrices (K, ...) are one, which is there once."""
    return xp is np and len(matrices) > 0 and matrices.strides[0] == 0


def _inverses(xp: Any, matrices: Any) -> Any:
    """The inverses of matrices (K, m, m); where all rows are one, of that."""
    return np.broadcast_to(np.linalg.inv(matrices[0]), matrices.shape) if _is_one(xp, matrices) else xp.linalg.inv(matrices)


def _where_whole(xp: Any, whole: np.ndarray, matrices: Any) -> Any:
    """The matrices (K, m, m) of the intervals in which all acts inside, and zero of the others."""
    return matrices if whole.all() else xp.where(whole, matrices, 0.0)


class _AtEnd(NamedTuple):
    """Readings that act as whole factors at the end: `energy`, and as in a FactorRule `linear`, `offset` and `weight`."""

    energy: Any
    linear: Any
    offset: Any
    weight: Any


def _at_end(xp: Any, kind: str, elapsed: np.ndarray, at_end: np.ndarray, noise: Any) -> _AtEnd:
    """The readings that act as whole factors at the end; a row may have none."""
    both = at_end[:, :, None] & at_end[:, None, :]
    # A coordinate without a reading has a unit variance of its own, which leaves the block of the others alone.
    alone = np.eye(at_end.shape[1]) * ~at_end[:, None, :]
    if kind == "samples":
        noise = xp.where(both, noise, 0.0) + alone
        precision = xp.where(both, xp.linalg.inv(noise), 0.0)
        log_volume = xp.linalg.slogdet(noise)[1] + np.log(2 * np.pi) * at_end.sum(axis=1)
        return _AtEnd(precision, precision, -0.5 * log_volume, precision)
    spans = np.where(at_end, elapsed, 0.0)
    # Increments that end together share the noise of the time that they have in common.
    precision = xp.linalg.inv(noise * np.minimum(spans[:, :, None], spans[:, None, :]) + alone)
    linear = spans[:, :, None] * xp.where(both, precision, 0.0)
    return _AtEnd(linear * spans[:, None, :], linear, np.zeros(len(spans)), None)


def _times(matrices: Any, vectors: Any) -> Any:
    return (matrices @ vectors[..., None])[..., 0]


def _constant(offset: Any, weight: Any, values: Any) -> Any:
    return offset if weight is None else offset - 0.5 * (values * _times(weight, values)).sum(axis=-1)


class Whole(NamedTuple):
    """The whole likelihood of K intervals' readings, log factor(x) = linear . h - h'(energy) h / 2 + constant.

    `inside` (K,) is one where all of it was gathered over just the interval, so that it may act in parts, and zero where it acts
    at the end.
    """

    linear: Any
    energy: Any
    constant: Any
    inside: Any


class WholeRule(NamedTuple):
    """What a Whole is but for the values; `linear`, `offset` and `weight` as in a FactorRule."""

    linear: Any
    energy: Any
    offset: Any
    weight: Any
    inside: Any

    def __call__(self, values: Any) -> Whole:
        return Whole(_times(self.linear, values), self.energy, _constant(self.offset, self.weight, values), self.inside)


def whole_rule(model: Model, data: Data, theta: Any) -> WholeRule:
    """What the likelihoods are but for the values of the readings, for the parameters `theta` (p,), which JAX may trace.

    `data` says where there are readings.  S is that in the middle of an increment's time.
    """
    xp = np if isinstance(theta, np.ndarray) else jnp
    seen = ~np.isnan(data.values)
    inside = (schedule_of(data, True).inside | ~seen).all(axis=1) & (data.stops > data.starts)
    times = np.where(inside, 0.5 * (data.starts + data.stops), data.stops)
    found = _at_end(xp, model.observation_kind, data.elapsed, seen, noise_at(model, times, theta))
    return WholeRule(found.linear, found.energy, found.offset, found.weight, inside.astype(float))
