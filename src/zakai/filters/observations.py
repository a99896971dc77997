"""From a record to what a step is given.

Every kind of record becomes, for each reading, a value with the time over which it was gathered; a reading that acts at one time
is a factor on the density,

    log factor(x) = linear . h(x, t) - h'(energy) h / 2 + constant.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai.filters._protocol import Schedule
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

    before: np.ndarray
    after: np.ndarray
    energy: np.ndarray | None
    constant: np.ndarray
    inputs: np.ndarray


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


def factors(model: Model, data: Data, schedule: Schedule, *, rates: bool, splitting: str, remove: bool) -> Factors:
    """The factors of a run of intervals.

    Readings that act inside enter as rates (`rates`: y runs linearly, for affine h) or as exp(h'S^-1 dy), in two halves or,
    with `splitting="lie"`, whole at the end.  The others are whole factors at the end; with `remove` the energy
    that the transition holds inside, h'S^-1 h dt / 2, is taken out again there.
    """
    count, m = data.values.shape
    before, after = np.zeros((count, m)), np.zeros((count, m))
    energy, constant = np.zeros((count, m, m)), np.zeros(count)
    inputs = np.ones((count, 1 + (m if rates else 0)))
    noise = numpy_function(model.observation_noise, model, model.observation_noise.shape)
    origin, theta = np.zeros(model.n), model.theta()
    noise_end = np.broadcast_to(noise(origin, data.stops, theta), (count, m, m))
    seen = np.logical_not(np.isnan(data.values))
    inside = schedule.inside
    whole = np.asarray(inside.all(axis=1))
    values = np.where(seen, data.values, 0.0)
    lengths = data.stops - data.starts
    if rates:
        with np.errstate(divide="ignore", invalid="ignore"):
            inputs[:, 1:] = np.where(inside, values / lengths[:, None], 0.0)
    elif splitting == "lie":
        after[whole] = _solve(noise_end[whole], values[whole])
    elif whole.any():
        noise_start = np.broadcast_to(noise(origin, data.starts, theta), (count, m, m))
        before[whole] = 0.5 * _solve(noise_start[whole], values[whole])
        after[whole] = 0.5 * _solve(noise_end[whole], values[whole])
    at_end = seen & ~inside if rates else seen & ~whole[:, None]
    if remove and not rates:
        energy[~whole] -= np.linalg.inv(noise_end[~whole]) * lengths[~whole, None, None]
    for pattern in np.unique(at_end[at_end.any(axis=1)], axis=0):
        rows = np.flatnonzero((at_end == pattern).all(axis=1))
        which = np.flatnonzero(pattern)
        block = np.ix_(rows, which, which)
        z = values[np.ix_(rows, which)]
        if model.observation_kind == "samples":
            precision = np.linalg.inv(noise_end[block])
            energy[block] += precision
            after[np.ix_(rows, which)] = np.einsum("kij,kj->ki", precision, z)
            log_volume = np.linalg.slogdet(2 * np.pi * noise_end[block])[1]
            constant[rows] = -0.5 * np.einsum("ki,kij,kj->k", z, precision, z) - 0.5 * log_volume
            continue
        spans = data.elapsed[np.ix_(rows, which)]
        # Increments that end together share the noise of the time that they have in common.
        precision = np.linalg.inv(noise_end[block] * np.minimum(spans[:, :, None], spans[:, None, :]))
        energy[block] += precision * spans[:, :, None] * spans[:, None, :]
        after[np.ix_(rows, which)] = spans * np.einsum("kij,kj->ki", precision, z)
    return Factors(before, after, energy if energy.any() else None, constant, inputs)


def _solve(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return np.linalg.solve(matrices, vectors[..., None])[..., 0]
