"""One Gaussian over many intervals, compiled: what `zakai.numerics.families` does with a family of one node."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.numerics.compiled import kernel
from zakai.numerics.small_matrices import congruence, dot, one_plus, solve, symmetrise
from zakai.numerics.transition import Array


class Loop(NamedTuple):
    """What is known of K intervals without data, as the compiled loops receive it: plain tuples, which Numba takes fastest.

    `motion` has the lengths (K,) of the intervals, the factors (K, m) from observations to rates inside of an interval, and the
    fields of `Transition`: flow (its `map`), offset, noise, information, vector and constant.

    `ends` has what is observed at the ends, `whiten` values = `slope` x + `intercept` + noise of variance one: whiten (K, m, m),
    slope (K, m, n), intercept (K, m), the rows that are observed (K, m), the level (K,) that is added to the logarithm, and
    whether |whiten values|^2 / 2 is added, too, because the evidence is relative to noise alone.
    """

    motion: tuple[Array, ...]
    ends: tuple[Any, ...]


def loop_signature(number: str) -> str:
    """Return the Numba types of the fields of a `Loop` with real or complex numbers."""
    vector, rows, stack = (f"{number}[{axes}::1]" for axes in ("", ":, ", ":, :, "))
    motion = f"Tuple((f8[::1], f8[:, ::1], {', '.join([stack] * 6)}))"
    return f"{motion}, Tuple(({stack}, {stack}, {rows}, b1[:, ::1], {vector}, b1))"


def _signature(number: str) -> str:
    vector, rows, stack = (f"{number}[{axes}::1]" for axes in ("", ":, ", ":, :, "))
    loop = loop_signature(number)
    return f"void(i8, {vector}, {rows}, {loop}, f8[:, ::1], Tuple(({rows}, {stack}, {vector})))"


@kernel(_signature("f8"), _signature("c16"))
def segment(
    first: int, mean: Array, cov: Array, motion: Any, ends: Any, values: Array, after: Any
) -> None:  # pragma: no cover
    """Advance a Gaussian over the intervals from `first` on, one for each row of `values`.

    Args:
        first: The first interval; the arrays of what is prepared have a leading axis of intervals.
        mean: The mean (n,) before, and then after.
        cov: The covariance (n, n), likewise.
        motion: As in `Loop`.
        ends: As in `Loop`.
        values: The observations (R, m).
        after: What is written: the means (R, n) and the covariances (R, n, n) after each interval, and the logarithms (R,) of
            what the mass gains in it.
    """
    lengths, frequencies, flow, offset, noise, information, vector, constant = motion
    whiten, slope, intercept, observed, level, relative = ends
    means, covs, gains = after
    m, n = values.shape[1], len(mean)
    inputs = np.ones(1 + m)
    left, across, pull = np.empty((n, n), cov.dtype), np.empty((n, n), cov.dtype), np.empty(n, cov.dtype)
    for row in range(len(values)):
        k = first + row
        total = level[k]
        if lengths[k] > 0.0:
            # exp(-x'Omega x / 2 + g.x + c): with W = (I + P Omega)^-1 the mean moves by W P (g - Omega m), P becomes W P.
            for j in range(m):
                inputs[1 + j] = values[row, j] * frequencies[k, j]
            for i in range(1 + m):
                total += inputs[i] * dot(constant[k, i], inputs)
            for i in range(n):
                pull[i] = dot(vector[k, i], inputs)
            total += 0.5 * dot(mean, pull)
            size = 0.0
            for i in range(n):
                size += abs(pull[i])
                pull[i] -= dot(information[k, i], mean)
                for j in range(n):
                    size += abs(information[k, i, j])
                    across[i, j] = cov[i, j]
            total += 0.5 * dot(mean, pull)
            if size > 0.0:
                one_plus(left, cov, information[k])
                total -= 0.5 * solve(left, across)
                symmetrise(cov, across)
                for i in range(n):
                    step = dot(cov[i], pull)
                    total += 0.5 * pull[i] * step
                    mean[i] += step
            # x -> Psi x + b e, and noise is added.
            for i in range(n):
                pull[i] = dot(flow[k, i], mean) + dot(offset[k, i], inputs)
            congruence(cov, flow[k], cov, across)
            for i in range(n):
                mean[i] = pull[i]
                for j in range(n):
                    cov[i, j] += noise[k, i, j]
        for r in range(m):
            if not observed[k, r]:
                continue
            # A Kalman update in Joseph's form, one coordinate after another.
            white = dot(whiten[k, r], values[row])
            away = white - intercept[k, r] - dot(slope[k, r], mean)
            variance = 1.0
            for i in range(n):
                pull[i] = dot(cov[i], slope[k, r])
                variance += slope[k, r, i] * pull[i]
            total -= 0.5 * (away * away / variance + np.log(variance))
            if relative:
                total += 0.5 * white * white
            for i in range(n):
                mean[i] += pull[i] * (away / variance)
                pull[i] /= variance
                for j in range(n):
                    left[i, j] = (1.0 if i == j else 0.0) - pull[i] * slope[k, r, j]
            congruence(cov, left, cov, across)
            for i in range(n):
                for j in range(n):
                    cov[i, j] += pull[i] * pull[j]
        gains[row] = total
        for i in range(n):
            means[row, i] = mean[i]
            for j in range(n):
                covs[row, i, j] = cov[i, j]
