"""One Gaussian over many intervals, compiled: what `zakai.numerics.families` does with a family of one node."""

from __future__ import annotations

import numpy as np

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.transition import Array


@helper
def _congruence(out: Array, matrix: Array, cov: Array, product: Array) -> None:  # pragma: no cover
    """Set `out`, which may be `cov`, to matrix cov matrix'; `product` (n, n) is overwritten."""
    n = len(cov)
    for i in range(n):
        for j in range(n):
            total = 0.0 * cov[i, j]
            for a in range(n):
                total += matrix[i, a] * cov[a, j]
            product[i, j] = total
    for i in range(n):
        for j in range(i + 1):
            total = 0.0 * cov[i, j]
            for a in range(n):
                total += product[i, a] * matrix[j, a]
            out[i, j] = total
    for i in range(n):
        for j in range(i):
            out[j, i] = out[i, j]


def _signature(number: str) -> str:
    vector, rows, stack = (f"{number}[{axes}::1]" for axes in ("", ":, ", ":, :, "))
    real = "f8[:, ::1]"
    stacks = ", ".join([stack] * 6)
    ends = f"{stack}, {stack}, {rows}, b1[:, ::1], {vector}, b1"
    return f"void(i8, {vector}, {rows}, f8[::1], {real}, {stacks}, {ends}, {real}, {rows}, {stack}, {vector})"


@kernel(_signature("f8"), _signature("c16"))
def segment(
    first: int, mean: Array, cov: Array, lengths: Array, frequencies: Array,
    flow: Array, offset: Array, noise: Array, information: Array, vector: Array, constant: Array,
    whiten: Array, slope: Array, intercept: Array, observed: Array, level: Array, relative: bool,
    values: Array, means: Array, covs: Array, gains: Array,
) -> None:  # fmt: skip  # pragma: no cover
    """Advance a Gaussian over the intervals from `first` on, one for each row of `values`.

    Args:
        first: The first interval; the arrays of what is prepared have a leading axis of intervals.
        mean: The mean (n,) before, and then after.
        cov: The covariance (n, n), likewise.
        lengths: The lengths of the intervals.
        frequencies: The factors (K, m) from observations to rates inside of an interval.
        flow: `Transition.map`; `offset`, `noise`, `information`, `vector` and `constant` are its other fields.
        whiten: What is observed at the end is `whiten` values = `slope` x + `intercept` + noise of variance one in the rows that
            are `observed`; `level` (K,) is added to the logarithm, and |whiten values|^2 / 2 where it is `relative`.
        values: The observations (R, m).
        means: The means (R, n) after each interval.
        covs: The covariances (R, n, n) after each interval.
        gains: The logarithms (R,) of what the mass gains in each interval.
    """
    count, m = values.shape
    n = len(mean)
    inputs = np.ones(1 + m)
    left, across, pull = np.empty((n, n), cov.dtype), np.empty((n, n), cov.dtype), np.empty(n, cov.dtype)
    for row in range(count):
        k = first + row
        total = level[k]
        if lengths[k] > 0.0:
            # exp(-x'Omega x / 2 + g.x + c): with W = (I + P Omega)^-1 the mean moves by W P (g - Omega m), P becomes W P.
            for j in range(m):
                inputs[1 + j] = values[row, j] * frequencies[k, j]
            size = 0.0
            for i in range(1 + m):
                for j in range(1 + m):
                    total += inputs[i] * constant[k, i, j] * inputs[j]
            for i in range(n):
                pull[i] = 0.0
                for j in range(1 + m):
                    pull[i] += vector[k, i, j] * inputs[j]
                size = max(size, abs(pull[i]))
                total += 0.5 * mean[i] * pull[i]
                for j in range(n):
                    pull[i] -= information[k, i, j] * mean[j]
                    size = max(size, abs(information[k, i, j]))
                total += 0.5 * mean[i] * pull[i]
            if size > 0.0:
                for i in range(n):
                    for j in range(n):
                        left[i, j] = 1.0 if i == j else 0.0
                        across[i, j] = cov[i, j]
                        for a in range(n):
                            left[i, j] += cov[i, a] * information[k, a, j]
                for i in range(n):
                    pivot = i
                    for j in range(i + 1, n):
                        if abs(left[j, i]) > abs(left[pivot, i]):
                            pivot = j
                    for j in range(n):
                        left[i, j], left[pivot, j] = left[pivot, j], left[i, j]
                        across[i, j], across[pivot, j] = across[pivot, j], across[i, j]
                    total -= 0.5 * np.log(-left[i, i] if left[i, i].real < 0.0 else left[i, i])
                    for j in range(n):
                        if j != i:
                            factor = left[j, i] / left[i, i]
                            for a in range(n):
                                left[j, a] -= factor * left[i, a]
                                across[j, a] -= factor * across[i, a]
                for i in range(n):
                    for j in range(n):
                        across[i, j] /= left[i, i]
                for i in range(n):
                    for j in range(n):
                        cov[i, j] = 0.5 * (across[i, j] + across[j, i])
                for i in range(n):
                    step = 0.0 * level[k]
                    for j in range(n):
                        step += cov[i, j] * pull[j]
                    total += 0.5 * pull[i] * step
                    mean[i] += step
            # x -> Psi x + b e, and noise is added.
            for i in range(n):
                pull[i] = 0.0
                for j in range(n):
                    pull[i] += flow[k, i, j] * mean[j]
                for j in range(1 + m):
                    pull[i] += offset[k, i, j] * inputs[j]
            _congruence(cov, flow[k], cov, across)
            for i in range(n):
                mean[i] = pull[i]
                for j in range(n):
                    cov[i, j] += noise[k, i, j]
        for r in range(m):
            if not observed[k, r]:
                continue
            # A Kalman update in Joseph's form, one coordinate after another.
            variance, away, white = 1.0, -intercept[k, r], 0.0
            for j in range(m):
                white += whiten[k, r, j] * values[row, j]
            away += white
            for i in range(n):
                pull[i] = 0.0
                for j in range(n):
                    pull[i] += cov[i, j] * slope[k, r, j]
                variance += slope[k, r, i] * pull[i]
                away -= slope[k, r, i] * mean[i]
            total -= 0.5 * (away * away / variance + np.log(variance))
            if relative:
                total += 0.5 * white * white
            for i in range(n):
                mean[i] += pull[i] * (away / variance)
                pull[i] /= variance
            for i in range(n):
                for j in range(n):
                    left[i, j] = (1.0 if i == j else 0.0) - pull[i] * slope[k, r, j]
            _congruence(cov, left, cov, across)
            for i in range(n):
                for j in range(n):
                    cov[i, j] += pull[i] * pull[j]
        gains[row] = total
        for i in range(n):
            means[row, i] = mean[i]
            for j in range(n):
                covs[row, i, j] = cov[i, j]
