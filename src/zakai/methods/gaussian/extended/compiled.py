"""What the compiled loop of the extended Kalman-Bucy filter receives (`numerics/linearised.py`)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.methods.gaussian.extended.linearised_system import jacobian
from zakai.methods.system.formula_arrays import arrays_of
from zakai.methods.system.input_pieces import Pieces
from zakai.models.angles import observed_angles
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.numerics.linearised import segment
from zakai.numerics.transition import Array

_KEPT = 8  # values of the parameters for which programs are kept


class Loop(NamedTuple):
    """The arguments of the loop: the programs, what is an angle, and arrays of all parts and of all intervals."""

    programs: tuple[Any, ...]
    periodic: Array
    angles: Array
    samples: bool
    first: Array
    parts: tuple[Array, ...]
    intervals: tuple[Array, ...]


def loop_of(
    model: Model, theta: Array, first: Array, parts: Pieces, rate_noise: Array, intervals: tuple[Array, ...]
) -> Loop | None:
    """Return what the loop receives, None for a model whose formulas no kernel evaluates.

    Args:
        model: The model.
        theta: The parameters (p,), real.
        first: The number (K + 1) of the first part of each interval.
        parts: The parts.
        rate_noise: The covariances (J, 2, m, m) of the rates in the halves of a part.
        intervals: As for `segment`, with a leading axis of all intervals.
    """
    programs = kept(model, Loop, lambda: _programs(model, theta), theta.tobytes(), _KEPT)
    if programs is None:
        return None
    lengths = parts.stops - parts.starts
    rates = parts.change / np.where(lengths > 0, lengths, 1.0)[:, None]  # an interval of length zero ends at a sample at the start
    each = tuple(np.array(part, float, order="C") for part in (parts.starts, lengths, parts.first, rates, rate_noise))
    kinds = (float, float, float, bool, bool, float, float)
    return Loop(
        programs,
        np.array([name in model.periodic for name in model.state]),
        np.array(observed_angles(model)),
        model.observation_kind == "samples",
        np.array(first, np.int64),
        each,
        tuple(np.array(part, kind, order="C") for part, kind in zip(intervals, kinds, strict=True)),
    )


def _programs(model: Model, theta: Array) -> tuple[Any, ...] | None:
    drift, observation = model.drift, model.observation
    slope, change = jacobian(drift, model.x), jacobian(drift, [model.t, *model.u])
    noise = list(model.observation_noise) if model.observation_noise.free_symbols & set(model.x) else []
    formulas = [
        [*drift, *slope, *model.covariance, *change],
        [*observation, *jacobian(observation, model.x)],
        list(drift),
        list(observation),
        noise,
    ]
    found = tuple(arrays_of(part, model, theta) for part in formulas)
    return None if any(part is None for part in found) else found


def advance(loop: Loop, rows: slice, mean: Array, cov: Array, values: Array) -> tuple[Array, Array, Array, Array]:
    """Return the means (R, n), the covariances (R, n, n), the gains (R,) and the figures (2, R) of a slice of intervals."""
    count, n = len(values), len(mean)
    means, covs, gains, figures = np.empty((count, n)), np.empty((count, n, n)), np.empty(count), np.empty((2, count))
    parts = (loop.first[rows.start : rows.stop + 1], *loop.parts)
    intervals = tuple(part[rows] for part in loop.intervals)
    kinds, observed = (loop.periodic, loop.angles, loop.samples), np.array(values, float, order="C")
    before = np.array(mean, float), np.array(cov, float, order="C")
    segment(loop.programs, kinds, parts, intervals, observed, *before, (means, covs, gains, figures))
    return means, covs, gains, figures
