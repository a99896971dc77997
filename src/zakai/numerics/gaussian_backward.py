"""The backward pass of one Gaussian over many intervals, compiled.

The message is exp(-(x - a)'Lambda (x - a) / 2 + q.(x - a) + c).
"""

from __future__ import annotations

import numpy as np

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.transition import Array


@helper
def _eliminate(left: Array, right: Array) -> float:  # pragma: no cover
    """Set `right` (n, c) to left^-1 right, and return log |det left|; `left` (n, n) is overwritten."""
    n, width = right.shape
    total = 0.0
    for i in range(n):
        pivot = i
        for j in range(i + 1, n):
            if abs(left[j, i]) > abs(left[pivot, i]):
                pivot = j
        for j in range(n):
            left[i, j], left[pivot, j] = left[pivot, j], left[i, j]
        for j in range(width):
            right[i, j], right[pivot, j] = right[pivot, j], right[i, j]
        total += np.log(abs(left[i, i]))
        for j in range(n):
            if j != i:
                factor = left[j, i] / left[i, i]
                for a in range(i, n):
                    left[j, a] -= factor * left[i, a]
                for a in range(width):
                    right[j, a] -= factor * right[i, a]
    for i in range(n):
        for j in range(width):
            right[i, j] /= left[i, i]
    return total


@helper
def _weigh(
    centre: Array, information: Array, slope: Array, log: Array, means: Array, covs: Array, row: int, moved: Array, mass: Array
) -> None:  # pragma: no cover
    """Multiply a message and the Gaussian of a row; afterwards the message is about its mean, and their product has mass one.

    Args:
        centre: a (n,); with `information` Lambda (n, n), `slope` q (n,) and `log` c (1,) the message, in place.
        means: The means (R, n) and `covs` the covariances (R, n, n); the row becomes that of the product.
        covs: See `means`.
        row: The row.
        moved: Work space of n numbers.
        mass: (R,); the row becomes the logarithm of the mass of the product before.
    """
    n = len(centre)
    left, right = np.empty((n, n)), np.empty((n, n))
    for i in range(n):
        moved[i] = 0.0
        for j in range(n):
            moved[i] += information[i, j] * (means[row, j] - centre[j])
    for i in range(n):
        away = means[row, i] - centre[i]
        log[0] += (slope[i] - 0.5 * moved[i]) * away
        slope[i] -= moved[i]
        centre[i] = means[row, i]
    for i in range(n):
        for j in range(n):
            left[i, j] = 1.0 if i == j else 0.0
            right[i, j] = covs[row, i, j]
            for a in range(n):
                left[i, j] += covs[row, i, a] * information[a, j]
    total = log[0] - 0.5 * _eliminate(left, right)
    for i in range(n):
        moved[i] = 0.0
        for j in range(n):
            covs[row, i, j] = 0.5 * (right[i, j] + right[j, i])
            moved[i] += covs[row, i, j] * slope[j]
        total += 0.5 * slope[i] * moved[i]
        means[row, i] += moved[i]
    mass[row] = total
    log[0] -= total


@helper
def _retreat(
    k: int, centre: Array, information: Array, slope: Array, log: Array, lengths: Array, frequencies: Array,
    flow: Array, offset: Array, noise: Array, own: Array, vector: Array, constant: Array,
    whiten: Array, ends: Array, intercept: Array, observed: Array, level: Array, relative: bool,
    values: Array, row: int, inputs: Array,
) -> None:  # fmt: skip  # pragma: no cover
    """Take a message from the end of interval k to its start, in place.

    With W = (I + Gamma Lambda)^-1 and the shift s = Psi a + b - a of the centre, Lambda becomes Psi'Lambda W Psi + Omega,
    q becomes Psi'W'(q - Lambda s) + eta - Omega a, and c gains
    q'W s - s'Lambda W s / 2 + q'W Gamma q / 2 - log |I + Gamma Lambda| / 2.

    Args:
        k: The interval.
        centre: As for `_weigh`, with the following three.
        information: See `centre`.
        slope: See `centre`.
        log: See `centre`.
        lengths: As for `gaussian_step.segment`, with the following; `own` are the `Transition.information`, `ends` the slopes of
            what is observed at the ends.
        values: The observations (R, m), of which those of interval k are in this `row`.
        row: See `values`.
        inputs: Work space of 1 + m numbers.
    """
    n, m = len(centre), values.shape[1]
    for i in range(m):
        if not observed[k, i]:
            continue
        white, rest = 0.0, -intercept[k, i]
        for j in range(m):
            white += whiten[k, i, j] * values[row, j]
        for j in range(n):
            rest -= ends[k, i, j] * centre[j]
        rest += white
        log[0] -= 0.5 * rest * rest
        if relative:
            log[0] += 0.5 * white * white
        for a in range(n):
            slope[a] += rest * ends[k, i, a]
            for b in range(n):
                information[a, b] += ends[k, i, a] * ends[k, i, b]
    log[0] += level[k]
    if not lengths[k] > 0:
        return
    inputs[0] = 1.0
    for j in range(m):
        inputs[1 + j] = values[row, j] * frequencies[k, j]
    # The columns are W Psi, W s and W Gamma.
    left, right, shift, push = np.empty((n, n)), np.empty((n, 2 * n + 1)), np.empty(n), np.empty(n)
    for i in range(n):
        shift[i] = -centre[i]
        for j in range(len(inputs)):
            shift[i] += offset[k, i, j] * inputs[j]
        for j in range(n):
            shift[i] += flow[k, i, j] * centre[j]
            left[i, j] = 1.0 if i == j else 0.0
            for a in range(n):
                left[i, j] += noise[k, i, a] * information[a, j]
            right[i, j], right[i, n + 1 + j] = flow[k, i, j], noise[k, i, j]
        right[i, n] = shift[i]
    log[0] -= 0.5 * _eliminate(left, right)
    for i in range(n):
        push[i] = 0.0
        for j in range(n):
            push[i] += information[i, j] * right[j, n]
    for i in range(n):
        log[0] += slope[i] * right[i, n] - 0.5 * shift[i] * push[i]
        for j in range(n):
            log[0] += 0.25 * slope[i] * (right[i, n + 1 + j] + right[j, n + 1 + i]) * slope[j]
    for i in range(len(inputs)):
        for j in range(len(inputs)):
            log[0] += inputs[i] * constant[k, i, j] * inputs[j]
    # Lambda W Psi in place of W Gamma, which is not needed any more.
    for i in range(n):
        for j in range(n):
            right[i, n + 1 + j] = 0.0
            for a in range(n):
                right[i, n + 1 + j] += information[i, a] * right[a, j]
    for i in range(n):
        shift[i] = 0.0
        for j in range(n):
            shift[i] += slope[j] * right[j, i] - push[j] * flow[k, j, i]
            left[i, j] = own[k, i, j]
            for a in range(n):
                left[i, j] += flow[k, a, i] * right[a, n + 1 + j]
    for i in range(n):
        force, centred = 0.0, 0.0
        for j in range(len(inputs)):
            force += vector[k, i, j] * inputs[j]
        for j in range(n):
            centred += own[k, i, j] * centre[j]
            information[i, j] = 0.5 * (left[i, j] + left[j, i])
        slope[i] = shift[i] + force - centred
        log[0] += (force - 0.5 * centred) * centre[i]


_VECTOR, _ROWS, _STACK = "f8[::1]", "f8[:, ::1]", "f8[:, :, ::1]"
_ENDS = f"{_STACK}, {_STACK}, {_ROWS}, b1[:, ::1], {_VECTOR}, b1"
_MESSAGE = f"{_VECTOR}, {_ROWS}, {_VECTOR}, {_VECTOR}"


@kernel(
    f"void(i8, {_MESSAGE}, {_VECTOR}, {_ROWS}, {', '.join([_STACK] * 6)}, {_ENDS}, {_ROWS}, {_ROWS}, {_STACK}, {_VECTOR})"
)
def segment(
    first: int, centre: Array, information: Array, slope: Array, log: Array, lengths: Array, frequencies: Array,
    flow: Array, offset: Array, noise: Array, own: Array, vector: Array, constant: Array,
    whiten: Array, ends: Array, intercept: Array, observed: Array, level: Array, relative: bool,
    values: Array, means: Array, covs: Array, masses: Array,
) -> None:  # fmt: skip  # pragma: no cover
    """Smooth the Gaussians of intervals, from the last to the first, and take the message to the start of the first.

    Args:
        first: The first interval; `values` (R, m) are the observations of R intervals.
        centre: As for `_retreat`, with the following.
        means: The filtered means (R, n) and `covs` (R, n, n) at the ends of the intervals, which become the smoothed ones.
        covs: See `means`.
        masses: As for `_weigh`.
    """
    moved, inputs = np.empty(len(centre)), np.empty(1 + values.shape[1])
    for row in range(len(values) - 1, -1, -1):
        _weigh(centre, information, slope, log, means, covs, row, moved, masses)
        _retreat(
            first + row, centre, information, slope, log, lengths, frequencies, flow, offset, noise, own, vector, constant,
            whiten, ends, intercept, observed, level, relative, values, row, inputs,
        )  # fmt: skip
