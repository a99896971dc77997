"""The backward pass of one Gaussian over many intervals, compiled.

The message is exp(-(x - a)'Lambda (x - a) / 2 + q.(x - a) + c).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.gaussian.step import loop_signature
from zakai.numerics.small_matrices import dot, multiply, one_plus, solve, symmetrise
from zakai.numerics.transition import Array


@helper
def _weigh(message: Any, mean: Array, cov: Array) -> float:  # pragma: no cover
    """Multiply a message and a Gaussian, and return the logarithm of the mass of their product.

    Afterwards the message is about the Gaussian's mean, their product has mass one, and the moments are those of the product.

    Args:
        message: The centre a (n,), the information Lambda (n, n), the slope q (n,) and c (1,), in place.
        mean: The mean (n,) and `cov` the covariance (n, n), in place.
        cov: See `mean`.
    """
    centre, information, slope, log = message
    n = len(mean)
    away, left, right = np.empty(n), np.empty((n, n)), np.empty((n, n))
    for i in range(n):
        away[i], centre[i] = mean[i] - centre[i], mean[i]
        for j in range(n):
            right[i, j] = cov[i, j]
    for i in range(n):
        moved = dot(information[i], away)
        log[0] += (slope[i] - 0.5 * moved) * away[i]
        slope[i] -= moved
    one_plus(left, cov, information)
    total = log[0] - 0.5 * solve(left, right)
    symmetrise(cov, right)
    for i in range(n):
        moved = dot(cov[i], slope)
        total += 0.5 * slope[i] * moved
        mean[i] += moved
    log[0] -= total
    return total


@helper
def _retreat(k: int, message: Any, motion: Any, ends: Any, values: Array) -> None:  # pragma: no cover
    """Take a message from the end of interval k to its start, in place.

    With W = (I + Gamma Lambda)^-1 and the shift s = Psi a + b - a of the centre, Lambda becomes Psi'Lambda W Psi + Omega,
    q becomes Psi'W'(q - Lambda s) + eta - Omega a, and c gains
    q'W s - s'Lambda W s / 2 + q'W Gamma q / 2 - log |I + Gamma Lambda| / 2.

    Args:
        k: The interval.
        message: As for `_weigh`.
        motion: As in `Loop`, and `ends` too; the information of a transition is Omega.
        ends: See `motion`.
        values: The observations (m,).
    """
    centre, information, slope, log = message
    lengths, frequencies, flow, offset, noise, own, vector, constant = motion
    whiten, slopes, intercept, observed, level, relative = ends
    n, m = len(centre), len(values)
    for i in range(m):
        if not observed[k, i]:
            continue
        white = dot(whiten[k, i], values)
        rest = white - intercept[k, i] - dot(slopes[k, i], centre)
        log[0] -= 0.5 * rest * rest
        if relative:
            log[0] += 0.5 * white * white
        for a in range(n):
            slope[a] += rest * slopes[k, i, a]
            for b in range(n):
                information[a, b] += slopes[k, i, a] * slopes[k, i, b]
    log[0] += level[k]
    if not lengths[k] > 0:
        return
    inputs, pull = np.ones(1 + m), np.empty(n)
    for j in range(m):
        inputs[1 + j] = values[j] * frequencies[k, j]
    # The columns are W Psi, W Gamma and W s, and then Lambda times them.
    left, right, product = np.empty((n, n)), np.empty((n, 2 * n + 1)), np.empty((n, 2 * n + 1))
    for i in range(n):
        right[i, 2 * n] = dot(flow[k, i], centre) + dot(offset[k, i], inputs) - centre[i]
        for j in range(n):
            right[i, j], right[i, n + j] = flow[k, i, j], noise[k, i, j]
        pull[i] = right[i, 2 * n]
    one_plus(left, noise[k], information)
    log[0] -= 0.5 * solve(left, right)
    multiply(product, information, right)
    for i in range(n):
        log[0] += slope[i] * right[i, 2 * n] - 0.5 * pull[i] * product[i, 2 * n]
        for j in range(n):
            log[0] += 0.25 * slope[i] * (right[i, n + j] + right[j, n + i]) * slope[j]
    for i in range(1 + m):
        log[0] += inputs[i] * dot(constant[k, i], inputs)
    for i in range(n):
        force, centred = dot(vector[k, i], inputs), dot(own[k, i], centre)
        log[0] += (force - 0.5 * centred) * centre[i]
        pull[i] = force - centred
        for j in range(n):
            pull[i] += slope[j] * right[j, i] - flow[k, j, i] * product[j, 2 * n]
            left[i, j] = own[k, i, j]
            for a in range(n):
                left[i, j] += flow[k, a, i] * product[a, j]
    symmetrise(information, left)
    for i in range(n):
        slope[i] = pull[i]


_VECTOR, _ROWS, _STACK = "f8[::1]", "f8[:, ::1]", "f8[:, :, ::1]"
_MESSAGE = f"Tuple(({_VECTOR}, {_ROWS}, {_VECTOR}, {_VECTOR}))"


@kernel(f"void(i8, {_MESSAGE}, {loop_signature('f8')}, {_ROWS}, {_ROWS}, {_STACK}, {_VECTOR})")
def segment(
    first: int, message: Any, motion: Any, ends: Any, values: Array, means: Array, covs: Array, masses: Array
) -> None:  # pragma: no cover
    """Smooth the Gaussians of intervals, from the last to the first, and take the message to the start of the first.

    Args:
        first: The first interval; `values` (R, m) are the observations of R intervals.
        message: As for `_weigh`.
        motion: As in `Loop`, and `ends` too.
        ends: See `motion`.
        values: See `first`.
        means: The filtered means (R, n) and `covs` (R, n, n) at the ends of the intervals, which become the smoothed ones.
        covs: See `means`.
        masses: The logarithms (R,) of the masses of the products, as `_weigh` returns them.
    """
    for row in range(len(values) - 1, -1, -1):
        masses[row] = _weigh(message, means[row], covs[row])
        _retreat(first + row, message, motion, ends, values[row])
