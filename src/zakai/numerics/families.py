"""Families of Gaussians with one covariance: what an arbitrary density becomes, and stays, in a linear-quadratic system.

J families are

    v(x) = sum_j sum_i w_ji exp(rho_j.s_ji - s_ji'Pi_j s_ji / 2 + kappa_j) N(x; m_j + R_j s_ji, P_j)             (1)

with nodes s in k directions and signed weights w that never change.  The three operations below map them to families exactly, at
a cost that does not depend on the number of nodes: of the log-mass that each Gaussian gains, a quadratic function of its mean,
(rho, Pi) keep the part that depends on the node (Makowski 1986).  One Gaussian is a family of one node in no direction.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from zakai.numerics.complex_step import absolute
from zakai.numerics.transition import Array, Transition, symmetric, transposed


class Family(NamedTuple):
    """The arrays of equation (1).

    `nodes` s (J, N, k), `log_weights` log |w| and `signs` (J, N); `mean` m (J, n), `cov` P (J, n, n), `response` R (J, n, k),
    `tilt` rho (J, k), `curvature` Pi (J, k, k), `log_mass` kappa (J,).
    """

    nodes: Array
    log_weights: Array
    signs: Array
    mean: Array
    cov: Array
    response: Array
    tilt: Array
    curvature: Array
    log_mass: Array


def gaussians(log_weights: Array, means: Array, covs: Array) -> Family:
    """Return the families of J Gaussians of masses exp(`log_weights`) (J,), one node each; covariances may be singular."""
    count, n = means.shape
    one, none = np.zeros((count, 1)), np.zeros((count, 0))
    return Family(
        np.zeros((count, 1, 0)), one, one + 1.0, means, covs, np.zeros((count, n, 0)), none, np.zeros((count, 0, 0)), log_weights
    )


@cache
def _lapack() -> tuple[Any, Any]:
    # A command that filters nothing does not wait for SciPy.
    from scipy.linalg import lapack

    return lapack.dgesv, lapack.zgesv


@cache
def _identity(n: int) -> Array:
    return np.eye(n)


def solve(matrices: Array, right: Array) -> tuple[Array, Array]:
    """Return (matrices^-1 right, log |det matrices|) for (J, n, n) and (J, n, c); infinite where one is singular."""
    derivative = matrices.dtype.kind == "c" or right.dtype.kind == "c"
    gesv = _lapack()[derivative]
    count, n = matrices.shape[:2]
    solved = np.empty(right.shape, complex if derivative else float)
    diagonals = np.empty((count, n), solved.dtype)
    for j in range(count):
        factors, _, solved[j], singular = gesv(matrices[j], right[j])
        diagonals[j] = factors.diagonal()
        if singular:
            solved[j] = np.inf
    sizes = absolute(diagonals) if derivative else np.abs(diagonals)
    return solved, np.add.reduce(np.log(sizes), axis=1)


def _dot(a: Array, b: Array) -> Array:
    """Return a_j.b_j of vectors (J, n)."""
    return np.asarray(np.add.reduce(a * b, axis=1))


def _apply(matrices: Array, vectors: Array) -> Array:
    return (matrices @ vectors[..., None])[..., 0]


def _times(matrices: Array, right: Array) -> Array:
    """Return the products (J, n, p) of matrices (J, n, n) with one matrix (n, p), as one product."""
    count, n = matrices.shape[:2]
    return np.reshape(matrices.reshape(count * n, -1).dot(right), (count, n, -1))


def _mean_with_transpose(matrices: Array) -> Array:
    return 0.5 * (matrices + matrices.swapaxes(1, 2))


def weigh(family: Family, information: Array, vector: Array, constant: Any) -> Family:
    """Return the families times exp(-x'Omega x / 2 + g.x + c); `information` Omega (n, n), `vector` g (n,), `constant` c.

    With W = (I + P Omega)^-1 the mean moves by W P (g - Omega m), P becomes W P, R becomes W R.
    """
    nodes, log_weights, signs, mean, cov, response, tilt, curvature, log_mass = family
    n, k = response.shape[1:]
    solved, log_volume = solve(
        _identity(n) + _times(cov, information), np.concatenate([cov, response], axis=2) if k else cov
    )
    new_cov = _mean_with_transpose(solved[:, :, :n] if k else solved)
    slope = mean.dot(information)
    pull = vector - slope
    step = _apply(new_cov, pull)
    # m.(g - Omega m / 2) + pull'W P pull / 2
    log_mass = log_mass + (_dot(mean, vector + pull) + _dot(pull, step) - log_volume) * 0.5 + constant
    if k:
        new_response = solved[:, :, n:]
        tilt = tilt + _apply(transposed(new_response), pull)
        curvature = symmetric(curvature + transposed(response) @ information @ new_response)
        response = new_response
    return Family(nodes, log_weights, signs, mean + step, new_cov, response, tilt, curvature, log_mass)


def propagate(family: Family, matrix: Array, offset: Array, noise: Array) -> Family:
    """Return the families after x -> `matrix` x + `offset` (n,) and independent noise N(0, `noise`)."""
    nodes, log_weights, signs, mean, cov, response, tilt, curvature, log_mass = family
    backward = matrix.T
    cov = _mean_with_transpose(_times(_times(cov, backward).swapaxes(1, 2), backward)) + noise
    if response.shape[2]:
        response = matrix @ response
    return Family(nodes, log_weights, signs, mean.dot(backward) + offset, cov, response, tilt, curvature, log_mass)


def move(family: Family, transition: Transition, inputs: Array) -> Family:
    """Return the families after one transition with inputs e (k,)."""
    constant = inputs.dot(transition.constant.dot(inputs))
    if transition.information.any() or transition.vector.any():
        family = weigh(family, transition.information, transition.vector.dot(inputs), constant)
    else:
        family = family._replace(log_mass=family.log_mass + constant)
    return propagate(family, transition.map, transition.offset.dot(inputs), transition.noise)


def observe(family: Family, slope: Array, residual: Any) -> Family:
    """Return the families times exp(-(residual - h.x)^2 / 2), with `slope` h (n,): one observation with noise of variance one.

    A Kalman update in Joseph's form.  Observations that come together are used one after another, so that a very small noise in
    several sensors is no singular matrix.
    """
    nodes, log_weights, signs, mean, cov, response, tilt, curvature, log_mass = family
    across = cov.dot(slope)
    variance = across.dot(slope) + 1.0
    away = residual - mean.dot(slope)
    innovation = away / variance
    gain = across / variance[:, None]
    keep = _identity(len(slope)) - gain[:, :, None] * slope
    new_cov = _mean_with_transpose(keep @ cov @ keep.swapaxes(1, 2)) + gain[:, :, None] * gain[:, None, :]
    log_mass = log_mass - 0.5 * (away * innovation + np.log(variance))
    mean = mean + across * innovation[:, None]
    if response.shape[2]:
        seen = np.dot(slope, response)
        tilt = tilt + seen * innovation[:, None]
        curvature = curvature + seen[:, :, None] * (seen / variance[:, None])[:, None, :]
        response = response - gain[:, :, None] * seen[:, None, :]
    return Family(nodes, log_weights, signs, mean, new_cov, response, tilt, curvature, log_mass)


def exponents(family: Family) -> Array:
    """Return what the logarithm of each Gaussian's weight has gained, (J, N): rho.s - s'Pi s / 2 + kappa."""
    s = family.nodes
    quadratic = ((s @ family.curvature) * s).sum(axis=-1)
    return np.asarray((s @ family.tilt[:, :, None])[..., 0] - 0.5 * quadratic + family.log_mass[:, None])


def log_terms(family: Family) -> Array:
    """Return log |weight| (J, N) of each Gaussian."""
    return np.asarray(family.log_weights + exponents(family))
