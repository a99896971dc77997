"""The error of the time step by the same particles in substeps and in half of them."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import types

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.particles.formulas import F1, F2

Array = Any


class StepErrors(NamedTuple):
    """Pilots (n, P) at the start, after coarse and after fine substeps with the same noise, with the log weights (P,) of both.

    `angles` (n,) says which states are angles, `scale` (n,) are the standard deviations by which errors are judged, and
    `variances` (n,) are by how much the noise of the coarse substeps has more variance at the end.  A coordinate contracts as
    those in the first two columns of `owners` (n, 3) do, less than zero for none; the third one is the row of the variance that
    every particle carries of it.
    """

    start: Array
    coarse: Array
    coarse_gained: Array
    fine: Array
    fine_gained: Array
    angles: Array
    scale: Array
    variances: Array
    owners: Array


@helper
def _mean(row: Array) -> float:
    total = 0.0
    for i in range(row.size):
        total += row[i]
    return total / row.size


@helper
def _variance(row: Array) -> float:
    middle, total = _mean(row), 0.0
    for i in range(row.size):
        total += (row[i] - middle) ** 2
    return total / row.size


@helper
def _contraction(start: Array, end: Array, owners: Array, d: int, least: float) -> float:
    """Return the ratio of the deviations of a coordinate at the end and the start, one where that is more."""
    before, after, own = _variance(start[d]), _variance(end[d]), owners[d, 2]
    if own >= 0:
        before, after = before + _mean(start[own]), after + _mean(end[own])
    return min(max(math.sqrt(max(after, 0.0) / before), least), 1.0) if before > 0.0 else 1.0


_ERRORS = types.NamedTuple((F2, F2, F1, F2, F1, types.boolean[::1], F1, F1, types.int64[:, ::1]), StepErrors)


@kernel(types.void(_ERRORS, types.float64, F1, F1))
def step_errors(pilots: Any, least: float, shift: Array, largest: Array) -> None:
    """Write the shift of the mean (n,), and the largest error of a mean or a deviation without and with that of the pilots.

    What contracts in the interval is judged by the deviation at its end, but by no less than the share `least` of `scale`.
    """
    start, coarse, coarse_gained, fine, fine_gained, angles, scale, variances, owners = pilots
    n, count = start.shape
    weight, parts = coarse_gained - fine_gained, np.empty((3, count))
    weight -= _mean(weight)
    largest[:] = 0.0
    for d in range(n):
        middle, spread, judged = _mean(fine[d]), max(math.sqrt(_variance(fine[d])), 1e-9 * scale[d]), scale[d]
        for owner in owners[d, :2]:
            judged *= _contraction(start, fine, owners, owner, least) if owner >= 0 else 1.0
        for i in range(count):
            apart = coarse[d, i] - fine[d, i]
            if angles[d]:
                apart -= 2.0 * math.pi * math.floor(apart / (2.0 * math.pi) + 0.5)
            parts[0, i] = apart
            parts[1, i] = apart * (fine[d, i] - middle) / spread
            parts[1, i] += 0.5 * variances[d] / spread
            parts[2, i] = weight[i] * (fine[d, i] - middle)
        shift[d] = _mean(parts[0]) + _mean(parts[2])
        for part in range(3):
            square = _mean(parts[part]) ** 2
            # What the number of pilots adds to a mean of zero is not subtracted: few cannot show that there is no error.
            both = square + _variance(parts[part]) / count
            for k in range(2):
                error = math.sqrt(both if k else square) / judged
                largest[k] = error if error > largest[k] or error != error else largest[k]
