"""From a record to what a step is given.

Every kind of record becomes, for each reading, a value with the time over which it was gathered; a reading that acts at one time
is a factor on the density,

    log factor(x) = linear . h(x, t) - h'(energy) h / 2 + constant.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.filters._protocol import Schedule
from zakai.models.compile import jax_function
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
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


def factors(
    model: Model, data: Data, schedule: Schedule, *, rates: bool, splitting: str, remove: bool, theta: Any = None
) -> Factors:
    """The factors of a run of intervals, for the parameters `theta` (p,), by default the model's; JAX may trace them.

    Readings that act inside enter as rates (`rates`: y runs linearly, for affine h) or as exp(h'S^-1 dy), in two halves or,
    with `splitting="lie"`, whole at the end.  The others are whole factors at the end; with `remove` the energy
    that the transition holds inside, h'S^-1 h dt / 2, is taken out again there.
    """
    count, m = data.values.shape
    theta = model.theta() if theta is None else theta
    xp = np if isinstance(theta, np.ndarray) else jnp
    seen = np.logical_not(np.isnan(data.values))
    inside = schedule.inside
    whole = np.asarray(inside.all(axis=1))[:, None]
    values = np.where(seen, data.values, 0.0)
    lengths = (data.stops - data.starts)[:, None]
    before, energy = np.zeros((count, m)), None
    after, constant = before, np.zeros(count)
    inputs = np.ones((count, 1 + (m if rates else 0)))
    noise_end = noise_at(model, data.stops, theta)
    if rates:
        with np.errstate(divide="ignore", invalid="ignore"):
            inputs[:, 1:] = np.where(inside, values / lengths, 0.0)
    elif splitting == "lie":
        after = xp.where(whole, _times(xp.linalg.inv(noise_end), values), 0.0)
    elif whole.any():
        before = xp.where(whole, 0.5 * _times(xp.linalg.inv(noise_at(model, data.starts, theta)), values), 0.0)
        after = xp.where(whole, 0.5 * _times(xp.linalg.inv(noise_end), values), 0.0)
    if remove and not rates and not whole.all():
        energy = -xp.where(whole[..., None], 0.0, xp.linalg.inv(noise_end) * lengths[..., None])
    at_end = seen & ~inside if rates else seen & ~whole
    if at_end.any():
        more = _at_end(xp, model.observation_kind, values, data.elapsed, at_end, noise_end)
        energy, after, constant = more[0] if energy is None else energy + more[0], after + more[1], constant + more[2]
    return Factors(before, after, energy, constant, inputs)


def noise_at(model: Model, times: np.ndarray, theta: Any) -> Any:
    """S (K, m, m) at the times (K,), for the parameters `theta` (p,), which JAX may trace."""
    m, origin = model.m, np.zeros(model.n)
    if isinstance(theta, np.ndarray):
        return np.broadcast_to(numpy_function(model.observation_noise, model, (m, m))(origin, times, theta), (len(times), m, m))
    return jax.vmap(jax_function(model.observation_noise, model, (m, m)), (None, 0, None))(origin, jnp.asarray(times), theta)


def _at_end(xp, kind, values, elapsed, at_end, noise):
    """(energy, after, constant) of the readings that act as whole factors at the end; a row may have none."""
    both = at_end[:, :, None] & at_end[:, None, :]
    # A coordinate without a reading has a unit variance of its own, which leaves the block of the others alone.
    alone = np.eye(values.shape[1]) * ~at_end[:, None, :]
    if kind == "samples":
        noise = xp.where(both, noise, 0.0) + alone
        precision = xp.where(both, xp.linalg.inv(noise), 0.0)
        after = _times(precision, values)
        log_volume = xp.linalg.slogdet(noise)[1] + np.log(2 * np.pi) * at_end.sum(axis=1)
        return precision, after, -0.5 * (values * after).sum(axis=1) - 0.5 * log_volume
    spans = np.where(at_end, elapsed, 0.0)
    # Increments that end together share the noise of the time that they have in common.
    precision = xp.linalg.inv(noise * np.minimum(spans[:, :, None], spans[:, None, :]) + alone)
    precision = xp.where(both, precision, 0.0)
    return precision * spans[:, :, None] * spans[:, None, :], spans * _times(precision, values), 0.0


def _times(matrices, vectors):
    return (matrices @ vectors[..., None])[..., 0]


class Whole(NamedTuple):
    """The whole likelihood of K intervals' readings, log factor(x) = linear . h - h'(energy) h / 2 + constant.

    `inside` (K,) is one where all of it was gathered over just the interval, so that it may act in parts, and zero where it acts
    at the end.
    """

    linear: Any
    energy: Any
    constant: Any
    inside: Any


def whole_factors(model: Model, data: Data, theta: Any) -> Whole:
    """The likelihoods for the parameters `theta` (p,), which JAX may trace; S is that in the middle of an increment's time."""
    xp = np if isinstance(theta, np.ndarray) else jnp
    seen = ~np.isnan(data.values)
    values = np.where(seen, data.values, 0.0)
    inside = (schedule_of(data, True).inside | ~seen).all(axis=1) & (data.stops > data.starts)
    times = np.where(inside, 0.5 * (data.starts + data.stops), data.stops)
    energy, linear, constant = _at_end(xp, model.observation_kind, values, data.elapsed, seen, noise_at(model, times, theta))
    return Whole(linear, energy, xp.broadcast_to(constant, (len(values),)), inside.astype(float))
