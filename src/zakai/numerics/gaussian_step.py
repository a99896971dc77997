"""One Gaussian over one interval, compiled: what `zakai.numerics.families` does with a family of one node."""

from __future__ import annotations

import numpy as np
from numba import njit

from zakai.numerics.compiled import kernel
from zakai.numerics.transition import Array


@njit(nogil=True, error_model="numpy")
def _congruence(out: Array, matrix: Array, cov: Array) -> None:  # pragma: no cover
    """Set `out` to the symmetric part of matrix cov matrix'; it may be `cov`."""
    n = len(cov)
    product = np.zeros((n, n))
    for i in range(n):
        for a in range(n):
            for j in range(n):
                product[i, j] += matrix[i, a] * cov[a, j]
    whole = np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            for a in range(n):
                whole[i, j] += product[i, a] * matrix[j, a]
    for i in range(n):
        for j in range(n):
            out[i, j] = 0.5 * (whole[i, j] + whole[j, i])


_STACK, _ROWS = "f8[:, :, ::1]", "f8[:, ::1]"


@kernel(
    f"f8(i8, f8[::1], f8[:, ::1], b1, {', '.join([_STACK] * 6)}, f8[::1], f8[::1], {_STACK}, {_STACK}, {_ROWS}, b1[:, ::1], "
    "f8[::1], b1)"
)
def advance(
    k: int, mean: Array, cov: Array, moves: bool,
    flow: Array, offset: Array, noise: Array, information: Array, vector: Array, constant: Array, inputs: Array,
    values: Array, whiten: Array, slope: Array, intercept: Array, observed: Array, level: Array, relative: bool,
) -> float:  # fmt: skip  # pragma: no cover
    """Advance `mean` (n,) and `cov` (n, n) in place over interval k, and return the logarithm of what their mass gains.

    Args:
        k: The interval; the arrays of `Transition` and of what is observed at the end have a leading axis of intervals.
        mean: The mean.
        cov: The covariance.
        moves: Whether the interval has a length.
        flow: `Transition.map`; `offset`, `noise`, `information`, `vector` and `constant` are its other fields.
        inputs: e (k,).
        values: What is observed at the end (m,): `whiten` values = `slope` x + `intercept` + noise of variance one in the rows
            that are `observed`; `level` (K,) is added to the logarithm, and |whiten values|^2 / 2 where it is `relative`.
    """
    n, m = len(mean), len(values)
    total = 0.0
    left, across, pull = np.empty((n, n)), np.empty((n, n)), np.empty(n)
    if moves:
        # exp(-x'Omega x / 2 + g.x + c): with W = (I + P Omega)^-1 the mean moves by W P (g - Omega m), P becomes W P.
        for i in range(len(inputs)):
            for j in range(len(inputs)):
                total += inputs[i] * constant[k, i, j] * inputs[j]
        size = 0.0
        for i in range(n):
            force = 0.0
            for j in range(len(inputs)):
                force += vector[k, i, j] * inputs[j]
            pull[i] = force
            for j in range(n):
                pull[i] -= information[k, i, j] * mean[j]
                size = max(size, abs(information[k, i, j]))
            total += 0.5 * mean[i] * (force + pull[i])
            size = max(size, abs(force))
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
                total -= 0.5 * np.log(abs(left[i, i]))
                for j in range(n):
                    if j != i:
                        factor = left[j, i] / left[i, i]
                        for a in range(i, n):
                            left[j, a] -= factor * left[i, a]
                        for a in range(n):
                            across[j, a] -= factor * across[i, a]
            for i in range(n):
                for j in range(n):
                    across[i, j] /= left[i, i]
            for i in range(n):
                step = 0.0
                for j in range(n):
                    cov[i, j] = 0.5 * (across[i, j] + across[j, i])
                    step += cov[i, j] * pull[j]
                total += 0.5 * pull[i] * step
                left[i, 0] = step
            for i in range(n):
                mean[i] += left[i, 0]
        # x -> Psi x + b e, and noise is added.
        for i in range(n):
            moved = 0.0
            for j in range(n):
                moved += flow[k, i, j] * mean[j]
            for j in range(len(inputs)):
                moved += offset[k, i, j] * inputs[j]
            pull[i] = moved
        mean[:] = pull
        _congruence(cov, flow[k], cov)
        for i in range(n):
            for j in range(n):
                cov[i, j] += noise[k, i, j]
    for row in range(m):
        if not observed[k, row]:
            continue
        # A Kalman update in Joseph's form, one coordinate after another.
        h = slope[k, row]
        variance, away, white = 1.0, -intercept[k, row], 0.0
        for j in range(m):
            white += whiten[k, row, j] * values[j]
        away += white
        for i in range(n):
            pull[i] = 0.0
            for j in range(n):
                pull[i] += cov[i, j] * h[j]
            variance += h[i] * pull[i]
            away -= h[i] * mean[i]
        total -= 0.5 * (away * away / variance + np.log(variance))
        if relative:
            total += 0.5 * white * white
        for i in range(n):
            mean[i] += pull[i] * (away / variance)
            pull[i] /= variance
        for i in range(n):
            for j in range(n):
                left[i, j] = (1.0 if i == j else 0.0) - pull[i] * h[j]
        _congruence(cov, left, cov)
        for i in range(n):
            for j in range(n):
                cov[i, j] += pull[i] * pull[j]
    return float(total + level[k])
