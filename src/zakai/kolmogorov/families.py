"""Families of Gaussians that share one covariance: what an arbitrary density becomes, and stays, in a linear-quadratic system.

A family is

    v(x) = sum_i w_i exp(rho.s_i - s_i'Pi s_i / 2 + kappa) N(x; m + Gamma s_i, P)                          (1)

with nodes s_i in k directions and signed weights w_i that never change.  One interval of a linear-quadratic equation and one
reading of an affine observation map a family to a family exactly, at a cost that does not depend on the number of nodes:
of the log-mass that each Gaussian gains, a quadratic function of its mean, (rho, Pi) keep the part that depends on the node.
This is Makowski's (1986) mixture over the initial state, in the recursion of `zakai.kolmogorov.flow`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.kolmogorov.flow import Flow, motion
from zakai.kolmogorov.linear_solve import solve

Array = Any


class Family(NamedTuple):
    """Equation (1): `nodes` s (N, k), `log_weights` log |w| and `signs` (N,); `mean` m (n,), `cov` P (n, n), `response` Gamma
    (n, k), `tilt` rho (k,), `bend` Pi (k, k), `log_mass` kappa.  Many families have a leading axis."""

    nodes: Array
    log_weights: Array
    signs: Array
    mean: Array
    cov: Array
    response: Array
    tilt: Array
    bend: Array
    log_mass: Array


def gaussian(mean: Array, cov: Array) -> Family:
    """The family of one node at N(mean, cov), which may be singular."""
    n = mean.shape[-1]
    empty = np.zeros((n, 0))
    return Family(np.zeros((1, 0)), np.zeros(1), np.ones(1), mean, cov, empty, empty[0], empty[:0], np.zeros(()))


def _symmetric(matrix: Array) -> Array:
    return 0.5 * (matrix + matrix.T)


def move(family: Family, flow: Flow, inputs: Array) -> Family:
    """One interval of the flow with inputs e, by equation (2) of `zakai.kolmogorov.flow`.

    With S = P + Sigma, M = (I - 2 S bend)^-1 and the inner covariance M S, the log-mass is a quadratic function of the mean
    with the gradient g = 2 bend m + A'b + B'a + action'e + 2 bend M S tilt and the Hessian 2 bend M.
    """
    n = family.mean.shape[0]
    moved = motion(flow, family.mean, inputs)
    spread = family.cov + flow.spread
    both, log_volume = solve(jnp.eye(n) - 2.0 * spread @ flow.bend, jnp.hstack([spread, family.response]))
    inner, response = _symmetric(both[:, :n]), both[:, n:]
    offset = inner @ moved.tilt
    log_mass = moved.log_mass + 0.5 * moved.tilt @ offset - 0.5 * log_volume + flow.log_volume
    costate = 0.5 * moved.tilt  # A'(B m + b) = bend m + A'b
    gradient = (
        costate
        + flow.lift.T @ moved.centre
        + flow.action.T @ inputs
        + 2.0 * flow.bend @ offset
    )
    return family._replace(
        mean=moved.centre + flow.map @ offset,
        cov=_symmetric(flow.map @ inner @ flow.map.T),
        response=flow.map @ response,
        tilt=family.tilt + family.response.T @ gradient,
        bend=_symmetric(family.bend - 2.0 * family.response.T @ flow.bend @ response),
        log_mass=family.log_mass + log_mass,
    )


def read(family: Family, slope: Array, intercept: Array, after: Array, energy: Array, constant: Array) -> Family:
    """A reading of h = C x + c: the factor exp(after.h - h'(energy) h / 2 + constant)."""
    n = family.mean.shape[0]
    information = slope.T @ energy @ slope
    at_mean = slope @ family.mean + intercept
    pull = slope.T @ (after - energy @ at_mean)
    system = jnp.eye(n) + family.cov @ information
    both, log_volume = solve(system, jnp.hstack([family.cov, family.response]))
    cov, response = _symmetric(both[:, :n]), both[:, n:]
    step = cov @ pull
    log_mass = after @ at_mean - 0.5 * at_mean @ energy @ at_mean + constant + 0.5 * pull @ step - 0.5 * log_volume
    return family._replace(
        mean=family.mean + step,
        cov=cov,
        response=response,
        # The gradient of the log-mass in m is M'pull and its Hessian -M'information, M = (I + P information)^-1.
        tilt=family.tilt + response.T @ pull,
        bend=_symmetric(family.bend + response.T @ information @ family.response),
        log_mass=family.log_mass + log_mass,
    )


def log_terms(family: Family) -> Array:
    """log |weight| (N,) of each Gaussian of the family."""
    s = family.nodes
    return (
        family.log_weights
        + s @ family.tilt
        - 0.5 * jnp.sum((s @ family.bend) * s, axis=-1)
        + family.log_mass
    )
