"""What is observed at the ends of intervals, for affine observations with Gaussian noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from zakai.errors import InputError
from zakai.numerics.complex_step import cholesky
from zakai.numerics.transition import Array
from zakai.records.schedule import Schedule


class Ends(NamedTuple):
    """What is observed at the ends of K intervals, with noise of variance one: `whiten` (K, m, m) values = H x + c + noise.

    `observed` (K, m) marks the rows that count, `slope` is H (K, m, n), `intercept` c (K, m) and `constant` (K,) what the
    logarithm of the factor exp(-|whiten values - H x - c|^2 / 2) lacks.  The evidence of increments is relative to noise alone.
    """

    observed: Array
    slope: Array
    intercept: Array
    whiten: Array
    constant: Array
    relative: bool


def ends_of(
    sampled: bool, schedule: Schedule, at_end: Array, n: int, observation: Callable[[Schedule], tuple[Array, Array, Array]]
) -> Ends:
    """Return what is observed at the ends: the coordinates `at_end` (K, m); `observation` returns C, c and S there.

    Increments that end together share the noise of the time that they have in common, S min(elapsed_i, elapsed_j).
    """
    if not at_end.any():
        count, m = at_end.shape
        rows, zero = np.zeros((count, m)), np.zeros(count)
        return Ends(at_end, np.zeros((count, m, n)), rows, np.zeros((count, m, m)), zero, not sampled)
    slope, intercept, noise = observation(schedule)
    both = at_end[:, :, None] & at_end[:, None, :]
    spans = np.where(at_end, 1.0 if sampled else schedule.elapsed, 0.0)
    shared = 1.0 if sampled else np.minimum(spans[:, :, None], spans[:, None, :])
    try:
        factor = cholesky(np.where(both, noise * shared, 0.0) + np.eye(at_end.shape[1]) * ~at_end[:, None, :])
    except np.linalg.LinAlgError:
        first, last = schedule.stops[0], schedule.stops[-1]
        raise InputError(f"observation_noise: is not positive definite between t = {first:.12g} and {last:.12g}") from None
    whiten = np.linalg.inv(factor)
    logs = np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1) + 0.5 * np.log(2 * np.pi) * at_end.sum(axis=1)
    constant = -logs if sampled else np.zeros(len(logs))
    return Ends(
        np.ascontiguousarray(at_end),
        whiten @ (spans[:, :, None] * slope),
        (whiten @ (spans * intercept)[:, :, None])[:, :, 0],
        whiten,
        constant,
        not sampled,
    )
