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
    `variances` (n,) are by how much the noise of the coarse substeps has more variance at the end.
    """

    start: Array
    coarse: Array
    coarse_gained: Array
    fine: Array
    fine_gained: Array
    angles: Array
    scale: Array
    variances: Array


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


@kernel(types.void(types.NamedTuple((F2, F2, F1, F2, F1, types.boolean[::1], F1, F1), StepErrors), types.float64, F1, F1))
def step_errors(pilots: Any, least: float, shift: Array, largest: Array) -> None:
    """Write the shift of the mean (n,), and the largest error of a mean or a deviation without and with that of the pilots.

    What contracts in the interval is judged by the deviation at its end, but by no less than the share `least` of `scale`.
    """
    start, coarse, coarse_gained, fine, fine_gained, angles, scale, variances = pilots
    n, count = start.shape
    weight, parts = coarse_gained - fine_gained, np.empty((3, count))
    weight -= _mean(weight)
    largest[:] = 0.0
    for d in range(n):
        middle, began = _mean(fine[d]), math.sqrt(_variance(start[d]))
        spread = max(math.sqrt(_variance(fine[d])), 1e-9 * scale[d])
        judged = scale[d] * (min(max(spread / began, least), 1.0) if began > 0.0 else 1.0)
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
