"""Gaussian sums and what can be done to them.

    v(x) = sum_i s_i exp(log_weights_i) N(x; means_i, covs_i)

The signs s_i are one, except after a fit with negative parts.  Every function keeps a derivative by the complex step; decisions
are taken by the real parts.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.numerics.complex_step import absolute, angle, log_determinant

Array = np.ndarray[Any, np.dtype[Any]]


class Components(NamedTuple):
    """`log_weights` (K,), `means` (K, n), `covs` (K, n, n), `signs` (K,)."""

    log_weights: Array
    means: Array
    covs: Array
    signs: Array


def components(log_weights: Any, means: Any, covs: Any) -> Components:
    """Return a sum of positive Gaussians."""
    return Components(np.asarray(log_weights), np.asarray(means), np.asarray(covs), np.ones(len(log_weights)))


def selected(sum_: Components, index: Any) -> Components:
    """Return some of the components; `index` is what NumPy takes as an index."""
    return Components(sum_.log_weights[index], sum_.means[index], sum_.covs[index], sum_.signs[index])


def joined(*sums: Components) -> Components:
    """Return the components of several sums as one sum."""
    return Components(*(np.concatenate(arrays) for arrays in zip(*sums, strict=True)))


def shares(sum_: Components) -> tuple[Array, Any]:
    """Return the signed share (K,) of each component, of sum one, and the logarithm of the mass; a negative mass gives NaN."""
    top = float(np.max(sum_.log_weights.real, initial=-np.inf))
    top = top if np.isfinite(top) else 0.0
    parts = sum_.signs * np.exp(sum_.log_weights - top)
    mass = parts.sum()
    if mass.real < 0:
        mass = mass * np.nan
    return parts / mass, np.log(mass) + top


def moments(share: Array, means: Array, covs: Array, angles: tuple[int, ...] = ()) -> tuple[Array, Array]:
    """Return the mean (n,) and covariance (n, n) of a mixture; an angle has its mean direction and wrapped deviations."""
    nearest = means[np.argmax(share.real)] if len(share) else means.sum(axis=0)
    # Relative to the heaviest component, so that nothing large is subtracted.
    mean = nearest + share @ (means - nearest)
    for i in angles:
        size = share * np.exp(-0.5 * covs[:, i, i])
        sine, cosine = size @ np.sin(means[:, i]), size @ np.cos(means[:, i])
        # A uniform angle has no direction.
        mean[i] = 0.0 if sine.real**2 + cosine.real**2 <= 1e-18 else angle(sine, cosine)
    deviation = wrapped(means - mean, angles)
    n = means.shape[1]
    within = (share @ covs.reshape(len(share), n * n)).reshape(n, n)
    return mean, within + (share[:, None] * deviation).T @ deviation


def wrapped(difference: Array, angles: tuple[int, ...]) -> Array:
    """Return differences (..., n) whose angles are taken in (-pi, pi]."""
    if not angles:
        return difference
    turning = np.isin(np.arange(difference.shape[-1]), angles)
    return difference + 2 * np.pi * turning * ((np.pi - difference.real) // (2 * np.pi))


def dot(left: Array, right: Array) -> Array:
    """Return the sums of left * right over the last axis, which is short."""
    total = left[..., 0] * right[..., 0]
    for i in range(1, max(left.shape[-1], right.shape[-1])):
        total = total + left[..., i] * right[..., i]
    return np.asarray(total)


def regression(covs: Array, directions: Array) -> Array:
    """Return the gain B (K, n, k) with x = m + B z + rest, z ~ N(0, 1) white and spanning W'x, for `directions` W (n, k)."""
    n, k = directions.shape
    if n == 1:
        return np.asarray(np.sqrt(np.where(covs.real > 0, covs, 0.0)))
    across = covs @ directions
    # A direction without variance keeps a whitening of its own; B is then zero along it.
    floor = 1e-15 * sum((across[..., j] @ directions[:, j]).real for j in range(k)) + 1e-280
    columns: list[Array] = []
    for j in range(k):
        rest = across[..., j]
        for column in columns:
            rest = rest - (column @ directions[:, j])[:, None] * column
        columns.append(rest * ((rest @ directions[:, j]) + floor)[:, None] ** -0.5)
    return np.stack(columns, axis=-1)


def product(covs: Array, other: Array) -> Array:
    """Return covs (K, n, n) times one matrix (n, p)."""
    return np.asarray(covs * other if covs.shape[-1] == 1 and other.shape == (1, 1) else covs @ other)


def solve(matrices: Array, others: Array) -> Array:
    """Return the solutions (K, n, p) of linear systems of `matrices` (K, n, n); closed form for n = 1 and 2."""
    n = matrices.shape[-1]
    if n == 1:
        return np.asarray(others / matrices)
    if n == 2:
        a, b, c, d = (matrices[..., i, j, None] for i in (0, 1) for j in (0, 1))
        top, bottom = others[..., 0, :], others[..., 1, :]
        return np.asarray(np.stack([d * top - b * bottom, a * bottom - c * top], axis=-2) / (a * d - b * c)[..., None])
    return np.asarray(np.linalg.solve(matrices, others))


def log_volumes(matrices: Array) -> Array:
    """Return log |det| (K,) of small matrices (K, n, n); closed form for n = 1 and 2."""
    n = matrices.shape[-1]
    if n == 1:
        return np.asarray(np.log(absolute(matrices[..., 0, 0])))
    if n == 2:
        return np.asarray(np.log(absolute(matrices[..., 0, 0] * matrices[..., 1, 1] - matrices[..., 0, 1] * matrices[..., 1, 0])))
    return log_determinant(matrices)


def symmetric(matrices: Array) -> Array:
    """Return the symmetric parts of matrices (..., n, n)."""
    return 0.5 * (matrices + np.swapaxes(matrices, -1, -2))


def weighed(sum_: Components, logs: Any, slopes: Array, information: Array) -> Components:
    """Return each component times exp(log + slope.x - x'information x / 2); the arguments may be one for all components."""
    pulled = slopes - np.squeeze(information @ sum_.means[..., None], -1)
    system = np.eye(sum_.means.shape[1]) + sum_.covs @ information
    covs = symmetric(solve(system, sum_.covs))
    shift = dot(covs, pulled[:, None, :])
    logs = sum_.log_weights + logs + 0.5 * dot(sum_.means, slopes + pulled) + 0.5 * dot(pulled, shift)
    return Components(logs - 0.5 * log_volumes(system), sum_.means + shift, covs, sum_.signs)


def tilted(sum_: Components, constants: Array, slopes: Array) -> Components:
    """Return the sum times sum_j exp(c_j + q_j.x): J components for each of the sum, one after another.

        e^{c + q.x} N(x; m, P) = e^{c + q.m + q'P q / 2} N(x; m + P q, P)

    Args:
        sum_: The sum.
        constants: c (J,).
        slopes: q (J, n).
    """
    count = len(constants)
    across = np.swapaxes(product(sum_.covs, slopes.T), 1, 2)
    half = 0.5 * dot(across, slopes)
    logs = constants + sum_.means @ slopes.T + half + sum_.log_weights[:, None]
    means = sum_.means[:, None] + across
    return Components(
        logs.reshape(-1),
        means.reshape(len(sum_.signs) * count, -1),
        np.repeat(sum_.covs, count, axis=0),
        np.repeat(sum_.signs, count),
    )
