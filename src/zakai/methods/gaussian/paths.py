"""Draws of the state at the start of an interval given that at its end, for families and sums of Gaussians.

Of v, which is u without the gauge, the kernel of an interval is Gaussian (`numerics/transition.py`, equation 2).  Given z at the
end, the state x at the start has a density proportional to v(x) times this kernel, and the gauge at z is a constant.  With a
family weighed by exp(-x'Omega x / 2 + (eta e).x), of Gaussians N(m, P), and z = Psi x + b e + N(0, Gamma),

    x given z is N(m + K (z - Psi m - b e), (I - K Psi) P (I - K Psi)' + K Gamma K'),   K = P Psi' (Psi P Psi' + Gamma)^+,

where the weight of each Gaussian is multiplied by its density of z.  P and Gamma may be singular.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai.errors import InputError
from zakai.methods.gaussian.families import Prepared, State, inputs_of
from zakai.numerics.families import log_terms, weigh
from zakai.numerics.sums.mixture import wrapped
from zakai.numerics.transition import Array, Transition, at

SINGULAR = 1e-13  # of the largest eigenvalue of a correlation matrix: an eigenvalue that is zero
FEWEST = 1e-3  # share of the proposals that a density with negative weights must accept


class Gaussians(NamedTuple):
    """Gaussians of one covariance given z: log |weights| (P, N), means (P, N, n), and a square root (n, n) of the covariance."""

    logs: Array
    means: Array
    root: Array


def draw(prepared: Prepared, k: int, later: Array, values: Array, state: State, rng: np.random.Generator) -> tuple[Array, float]:
    """Return draws (P, n) of the state at the start of interval k given those at its end, which are exact."""
    if prepared.lengths[k] == 0:
        return later, 0.0
    own, inputs, origin = at(prepared.transitions, k), inputs_of(prepared, k, values), prepared.setup.origin
    families = weigh(state.families, own.information, own.vector @ inputs, 0.0)
    logs, z = log_terms(families), later - origin - own.offset @ inputs
    moved = families.nodes @ families.response.swapaxes(1, 2)
    parts = [given_end(logs[j], families.mean[j] + moved[j], families.cov[j], own, z) for j in range(len(logs))]
    return drawn(prepared.model.source, parts, state.signs, rng) + origin, 0.0


def given_end(logs: Array, means: Array, cov: Array, own: Transition, z: Array, angles: tuple[int, ...] = ()) -> Gaussians:
    """Return Gaussians of one covariance given z (P, n) after a transition without inputs; z has some `angles`."""
    matrix, noise = own.map, own.noise
    total = matrix @ cov @ matrix.T + noise
    scale = np.sqrt(np.maximum(np.diag(total), 0.0))
    scale = np.where(scale > 0, scale, 1.0)
    sizes, axes = np.linalg.eigh(total / scale[:, None] / scale)
    used = sizes > SINGULAR * sizes[-1]
    whiten = (axes[:, used] / np.sqrt(sizes[used])).T / scale
    gain = cov @ matrix.T @ whiten.T @ whiten
    keep = np.eye(len(cov)) - gain @ matrix
    away = wrapped(z[:, None] - means @ matrix.T, angles)
    white = away @ whiten.T
    volume = np.sum(np.log(np.sqrt(sizes[used]))) + np.sum(np.log(scale))
    return Gaussians(
        logs - 0.5 * np.sum(white * white, axis=-1) - volume,
        means + away @ gain.T,
        _root(keep @ cov @ keep.T + gain @ noise @ gain.T),
    )


def _root(cov: Array) -> Array:
    """Return a square root of a covariance, which may be singular."""
    scale = np.sqrt(np.maximum(np.diag(cov), 0.0))
    scale = np.where(scale > 0, scale, 1.0)
    sizes, axes = np.linalg.eigh(cov / scale[:, None] / scale)
    return np.asarray(scale[:, None] * axes * np.sqrt(np.maximum(sizes, 0.0)))


def drawn(source: str, parts: list[Gaussians], signs: Array, rng: np.random.Generator) -> Array:
    """Return a draw for each z, for the model of a source.

    Where weights are negative, proposals are accepted by the share of the density in them.
    """
    count, n = len(parts[0].means), parts[0].means.shape[2]
    logs = np.concatenate([part.logs for part in parts], axis=1)
    means = np.concatenate([part.means for part in parts], axis=1)
    which = np.repeat(np.arange(len(parts)), [part.means.shape[1] for part in parts])
    shares = np.exp(logs - logs.max(axis=1, keepdims=True))
    sums, roots, sign = np.cumsum(shares, axis=1), np.array([part.root for part in parts]), signs.reshape(-1)
    found, rest, tried = np.empty((count, n)), np.arange(count), 0
    while len(rest):
        chosen = np.sum(sums[rest] < rng.random((len(rest), 1)) * sums[rest, -1:], axis=1)
        found[rest] = means[rest, chosen] + (roots[which[chosen]] @ rng.standard_normal((len(rest), n, 1)))[..., 0]
        if (sign > 0).all():
            break
        accepted = rng.random(len(rest)) < _share(found[rest], shares[rest], means[rest], roots[which], sign)
        rest, tried = rest[~accepted], tried + 1
        if tried > 1.0 / FEWEST:
            raise InputError(
                f"{source}: sample_paths: the negative weights of the prior's nodes nearly cancel the positive "
                "ones; take another method, such as yau-yau"
            )
    return found


def _share(x: Array, shares: Array, means: Array, roots: Array, signs: Array) -> Array:
    """Return the density at x (P, n), relative to that with all weights positive."""
    terms = np.empty(shares.shape)
    for c in range(len(signs)):
        left, sizes, _ = np.linalg.svd(roots[c])
        used = sizes > 1e-7 * sizes[0]
        white = (x - means[:, c]) @ left[:, used] / sizes[used]
        terms[:, c] = np.exp(-0.5 * np.sum(white * white, axis=1)) / np.prod(sizes[used])
    terms *= shares
    return np.asarray(np.maximum(terms @ signs, 0.0) / np.maximum(terms.sum(axis=1), 1e-300))
