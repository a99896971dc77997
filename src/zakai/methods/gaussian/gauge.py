"""The gauge of a model as numbers, and what families of Gaussians become under it: u = e^phi v, with its moments.

If e^phi = sum_j e^{c_j + q_j.x} every Gaussian becomes a sum of tilted ones,

    e^{q.x} N(x; m, P) = e^{q.m + q'P q/2} N(x; m + P q, P).

Else phi depends on one or two directions z = D x, and the integrals over z are sums over equidistant points.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.algebra.gauges import gauge
from zakai.methods.gaussian.affine_system import Matrices
from zakai.methods.system.potential import potential_of
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.numerics.complex_step import cholesky
from zakai.numerics.families import Family, log_terms
from zakai.numerics.transition import Array, symmetric, transposed

# Standard deviations to each side, and points, of the sums over a direction of a general gauge.
_REACH, _POINTS = 9.0, {1: 145, 2: 49}


class Tilts(NamedTuple):
    """`directions` D (k, n); where e^phi is a sum of exponentials `slopes` q (K, n) and `logs` c (K,), else None."""

    directions: Array
    slopes: Array | None
    logs: Array | None


class _Formulas:
    """phi and its exponentials as functions of time and parameters."""

    def __init__(self, model: Model):
        form = gauge(model)
        assert form is not None
        self.trivial = not form.form.curved
        self.exact = form.slopes is not None
        self.count = form.directions.rows
        self.potential = potential_of(form.form, model)
        blocks = [form.directions]
        if form.slopes is not None and form.logs is not None:
            blocks += [form.slopes, form.logs]
        self.matrices = Matrices(blocks, model)


class Gauge:
    """phi for the parameters `theta`, at coordinates relative to an origin.

    `trivial`: phi = 0; `exact`: e^phi is a sum of exponentials; `count`: the number of directions.
    """

    def __init__(self, model: Model, theta: Array, origin: Array):
        self._formulas = kept(model, _Formulas, lambda: _Formulas(model))
        self.trivial, self.exact, self.count = self._formulas.trivial, self._formulas.exact, self._formulas.count
        self.theta, self.origin = theta, origin
        self._constant: list[Array] | None = None  # the matrices, where they do not depend on time

    def real(self) -> Gauge:
        """Return the same without derivatives."""
        other = object.__new__(Gauge)
        other.__dict__.update(self.__dict__)
        other.theta, other._constant = self.theta.real, None
        return other

    def potential(self, x: Array, t: Any) -> Array:
        """Return phi (...) at x (..., n)."""
        return self._formulas.potential(x + self.origin, t, self.theta)

    def at(self, times: Array) -> Tilts:
        """Return the directions, slopes and logarithms of the coefficients at times (J,)."""
        matrices = self._formulas.matrices
        if matrices.varying:
            blocks = matrices(times, self.theta)
        else:
            if self._constant is None:
                self._constant = matrices(np.zeros(1), self.theta)
            blocks = [np.broadcast_to(block, (len(times), *block.shape[1:])) for block in self._constant]
        if not self.exact:
            return Tilts(blocks[0], None, None)
        return Tilts(blocks[0], blocks[1], (blocks[2] + blocks[1] @ self.origin[:, None])[:, :, 0])

    def at_one(self, time: float) -> Tilts:
        """Return the same at one time."""
        return tilts_at(self.at(np.array([time])), 0)


def tilts_at(tilts: Tilts, k: int) -> Tilts:
    """Return the tilts at one of several times."""
    slopes, logs = tilts.slopes, tilts.logs
    return Tilts(tilts.directions[k], None if slopes is None else slopes[k], None if logs is None else logs[k])


def lifted(directions: Array, z: Array) -> Array:
    """Return a state x (..., n) with D x = z (..., k)."""
    return np.asarray(z @ np.linalg.solve(directions @ directions.T, directions))


class Posterior(NamedTuple):
    """The posterior u as a sum of Gaussians: its log-mass, `mean` and `cov`.

    `logs` (J, N, E) and `signs` (J, N, 1) are the weights of N(centres (J, E) + R (J) s (J, N), covs (J)), and `doubt`
    estimates the relative error of the sums over z.
    """

    log_mass: Any
    mean: Array
    cov: Array
    logs: Array
    signs: Array
    centres: Array
    covs: Array
    doubt: float


def posterior(gauge: Gauge, tilts: Tilts, t: Any, families: Family) -> Posterior:
    """Return e^phi times the families, with its first two moments; phi is that of `tilts` where they have slopes."""
    exact = tilts.slopes is not None
    centres, covs, extra = _exponential(tilts, families) if exact else _summed(gauge, tilts, t, families)
    logs = log_terms(families)[:, :, None] + extra
    signs = families.signs[:, :, None]
    top = np.max(logs.real)
    weights = signs * np.exp(logs - top)
    total = np.sum(weights)
    share = weights / total
    doubt = 0.0
    if not exact:
        # Twice the spacing squares the error of such a sum, or more.
        doubt = float(np.real(np.sum(weights * _checkerboard(gauge.count)) / total) ** 2)
    # Sums over the nodes are relative to a node near the mass, so that nothing large is subtracted.
    heaviest = np.argmax(np.max(logs.real, axis=2), axis=1)
    near = families.nodes[np.arange(len(heaviest)), heaviest]
    s = families.nodes - near[:, None]
    zeroth = np.sum(share, axis=1)
    first = transposed(share) @ s
    second = transposed(s) @ (share.sum(axis=2)[:, :, None] * s)
    here = centres + (families.response @ near[:, :, None])[:, :, 0][:, None]
    reference = np.einsum("je,jen->n", zeroth, here)
    displacement = first @ transposed(families.response)
    mean = reference + displacement.sum(axis=(0, 1))
    away = here - mean
    cross = np.einsum("jen,jem->nm", away, displacement)
    cov = (
        np.einsum("je,jen,jem->nm", zeroth, away, away)
        + cross
        + cross.T
        + (families.response @ second @ transposed(families.response)).sum(axis=0)
        + np.einsum("je,jnm->nm", zeroth, covs)
    )
    return Posterior(top + np.log(total), mean, symmetric(cov), logs, signs, centres, covs, doubt)


def _exponential(tilts: Tilts, families: Family) -> tuple[Array, Array, Array]:
    """Return (centres, covariances, log-factors) of the tilted Gaussians."""
    slopes, logs = tilts.slopes, tilts.logs
    assert slopes is not None and logs is not None
    pushed = slopes @ families.cov
    at_mean = families.mean @ slopes.T + 0.5 * (pushed * slopes).sum(axis=2)
    at_node = families.nodes @ transposed(slopes @ families.response)
    return families.mean[:, None] + pushed, families.cov, logs + at_mean[:, None] + at_node


def _checkerboard(count: int) -> Array:
    sign = (-1.0) ** np.arange(_POINTS[count])
    return sign if count == 1 else np.outer(sign, sign).ravel()


def _standard(count: int) -> tuple[Array, Array]:
    """Return equidistant points xi (E, k) and log-weights (E,) of the standard Gaussian."""
    line = np.linspace(-_REACH, _REACH, _POINTS[count])
    points = np.stack(np.meshgrid(*[line] * count, indexing="ij"), axis=-1).reshape(-1, count)
    return points, -0.5 * np.sum(points**2, axis=1) + count * np.log((line[1] - line[0]) / np.sqrt(2 * np.pi))


def _summed(gauge: Gauge, tilts: Tilts, t: Any, families: Family) -> tuple[Array, Array, Array]:
    """Return (centres, remaining covariances, log-factors) for x = m + R s + P D'C'^-1 xi + rest, C C' = D P D', xi standard."""
    points, log_weights = _standard(gauge.count)
    across = tilts.directions @ families.cov
    inner = across @ tilts.directions.T
    # Where z has no width there is nothing to sum over, and the rest of the covariance is all of it.
    size = inner.shape[-1]
    least = 1e-14 * np.trace(inner, axis1=1, axis2=2) * (size > 1) + 1e-300
    try:
        factor = cholesky(inner + least[:, None, None] * np.eye(size))
    except np.linalg.LinAlgError:
        factor = np.full(inner.shape, np.nan)
    with np.errstate(invalid="ignore"):
        along = transposed(np.linalg.solve(factor, across))
    displacement = points @ transposed(along)
    shifted = families.nodes @ transposed(families.response)
    x = families.mean[:, None, None] + shifted[:, :, None] + displacement[:, None]
    return families.mean[:, None] + displacement, families.cov - along @ transposed(along), gauge.potential(x, t) + log_weights
