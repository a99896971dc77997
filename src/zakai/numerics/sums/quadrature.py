"""A Gaussian sum times a function, each component replaced by the Gaussian with its moments.

    N(x; m, P) e^{g(x)}  ->  e^{a} N(x; m', P')

The function depends on x through W'x alone.  Given W'x the rest of x stays Gaussian, so that quadrature is in k directions only.
The integrals are sums in logarithms: over Gauss-Hermite nodes, or, where the function may be much narrower than a component or
have several peaks, over equidistant nodes that are placed again where the product was found.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from itertools import product as tuples
from typing import Any, NamedTuple

import numpy as np

from zakai.numerics.complex_step import cholesky, log_determinant, log_sum_exp
from zakai.numerics.sums.mixture import Array, Components, dot, joined, product, regression, selected, solve, symmetric

# Gauss-Hermite nodes a direction, by the number of directions.
NODES = {0: 1, 1: 9, 2: 6, 3: 5, 4: 4, 5: 4}
# Equidistant nodes a direction and their spacing in standard deviations of a component, or of what was found of its product: few,
# and if they do not suffice many; the error of their sum for a Gaussian is exp(-2 pi^2 / spacing^2).
SEARCH = {1: (33, 0.375), 2: (13, 1.0), 3: (9, 1.1), 4: (5, 1.3), 5: (4, 1.5)}
_FEW = {1: (25, 0.63), 2: (9, 1.25), 3: (7, 1.375), 4: (5, 1.625), 5: (4, 1.875)}
_MANY = {1: (33, 0.47), 2: (13, 1.25), 3: (9, 1.375), 4: (5, 1.625), 5: (4, 1.875)}
# Nodes are placed again until two masses agree to this, so often at most.
AGREED, _PLACED = 1e-3, 12
# Of the corrected weights: what is added to a matrix of norm one, the largest relative change, and the share below which a
# component keeps its weight.
_RIDGE, _CHANGE, _LIGHT = 1e-3, 0.5, 1e-12
_EMPTY = 1e30
_SMALL = 40.0  # depth in nats below the largest from which a product is negligible

LogFactor = Callable[[Array, Array], Array]


class Rule(NamedTuple):
    """A tensor rule for N(0, 1) in k directions: `nodes` (Q, k), `weights` (Q,), `size` and `spacing` a direction."""

    nodes: Array
    weights: Array
    size: int
    spacing: float = 0.0


class Refitted(NamedTuple):
    """A product: the new sum and of each component (K,) three figures.

    `moved` is the distance to its new mean as a share of the reach of the nodes, `loss` the relative entropy of the product from
    the Gaussian that replaces it, `doubt` the logarithm of the ratio of its masses by two rules.
    """

    sum: Components
    moved: Array
    loss: Array
    doubt: Array


def without_loss(sum_: Components) -> Refitted:
    """Return an exact product."""
    zero = np.zeros(len(sum_.signs))
    return Refitted(sum_, zero, zero, zero)


def rows_of(product_: Refitted, index: Any) -> Refitted:
    """Return some components of a product."""
    return Refitted(selected(product_.sum, index), *(array[index] for array in product_[1:]))


def together(*products: Refitted) -> Refitted:
    """Return the components of several products as one."""
    sums = joined(*(one.sum for one in products))
    return Refitted(sums, *(np.concatenate(arrays) for arrays in zip(*(one[1:] for one in products), strict=True)))


@lru_cache(maxsize=16)
def gauss_hermite(directions: int) -> Rule:
    """Return the Gauss-Hermite rule, exact for polynomials of degree 2 size - 1 in each direction."""
    node, weight = np.polynomial.hermite_e.hermegauss(NODES[directions])
    return _tensor(node, weight / weight.sum(), directions)


@lru_cache(maxsize=16)
def equidistant(size: int, spacing: float, directions: int) -> Rule:
    """Return the rule of equal steps."""
    node = spacing * (np.arange(size) - (size - 1) / 2)
    return _tensor(node, spacing * np.exp(-0.5 * node**2) / np.sqrt(2 * np.pi), directions)._replace(spacing=spacing)


def _tensor(node: Array, weight: Array, directions: int) -> Rule:
    nodes = np.array(list(tuples(node, repeat=directions))).reshape(len(node) ** directions, directions)
    weights = np.array([np.prod(w) for w in tuples(weight, repeat=directions)])
    return Rule(nodes, weights, len(node))


def points(sum_: Components, gain: Array, nodes: Array) -> Array:
    """Return the nodes in x, (K, Q, n), of nodes (Q, k) or (K, Q, k); `gain` (K, n, k) is that of `regression`."""
    if gain.shape[1:] == (1, 1):
        return np.asarray(sum_.means[:, None] + gain * nodes)
    return np.asarray(sum_.means[:, None] + nodes @ np.swapaxes(gain, 1, 2))


def refit(
    sum_: Components, log_factor: LogFactor, directions: Array, sharp: bool, corrections: int = 0, agreed: float = AGREED
) -> Refitted:
    """Return the sum times exp(log_factor).

    Args:
        sum_: The sum.
        log_factor: Function of points (R, Q, n) and the numbers (R,) of their components, with values (R, Q).
        directions: W (n, k), orthonormal.
        sharp: Whether the factor may be much narrower than a component and have several peaks there, as that of a sample.
        corrections: The number of products whose lost shape the weights correct; one state, not sharp.
        agreed: The relative difference of masses up to which nodes are not placed again; sharp.
    """
    k = directions.shape[1]
    if k == 0 or len(sum_.signs) == 0:
        added = log_factor(sum_.means[:, None], np.arange(len(sum_.signs)))[:, 0] if len(sum_.signs) else 0.0
        return without_loss(sum_._replace(log_weights=sum_.log_weights + added))
    gain = regression(sum_.covs, directions)
    rule = equidistant(*SEARCH[k], k) if sharp else gauss_hermite(k)
    values = log_factor(points(sum_, gain, rule.nodes), np.arange(len(sum_.signs)))
    logs = values + np.log(rule.weights)
    log_mass, shift, cov = _weighted(logs, rule.nodes)
    loss, doubt = _divergence(logs.real, values.real, rule.nodes, log_mass.real, cov.real), np.zeros(len(sum_.signs))
    if sharp:
        log_mass, shift, cov, loss, doubt = _located(sum_, log_factor, gain, log_mass, shift, cov, loss, agreed)
    means = sum_.means + dot(gain, shift[:, None, :])
    across = np.swapaxes(gain, 1, 2)
    # Given W'x the rest of the covariance stays; where x is given there is no rest, and none is computed as a difference.
    rest = sum_.covs - gain @ across if k < sum_.means.shape[1] else 0.0
    new = Components(sum_.log_weights + log_mass, means, symmetric(rest + gain @ cov @ across), sum_.signs)
    if corrections and sum_.means.shape[1] == 1 and not sharp:
        new = _rebalanced(sum_, new, points(sum_, gain, rule.nodes)[..., 0], values, rule, corrections)
    moved = np.abs(shift.real).max(axis=1) / rule.nodes[-1, -1]
    return Refitted(new, moved, loss, doubt)


def steepest(sum_: Components, log_factor: Callable[[Array], Array], directions: Array) -> float:
    """Return by how many nats a factor falls from the largest of the first nodes to the larger of its neighbours.

    Along the direction in which that is most, of the components whose products are not negligible.
    """
    k = directions.shape[1]
    rule = equidistant(*SEARCH[k], k)
    real = Components(*(array.real for array in sum_))
    found = log_factor(points(real, regression(real.covs, directions), rule.nodes)).real
    logs = np.where(np.isfinite(found), found, -_EMPTY)
    top, place = logs.max(axis=1), logs.argmax(axis=1)
    total = top + real.log_weights
    used = (total > total.max(initial=-_EMPTY) - _SMALL) & (top > -_EMPTY)
    grids = np.pad(logs[used].reshape(-1, *[rule.size] * k), [(0, 0)] + [(1, 1)] * k, constant_values=-_EMPTY)
    at = np.array(np.unravel_index(place[used], [rule.size] * k)) + 1
    rows, falls = np.arange(len(grids)), [np.zeros(1)]
    for axis in np.eye(k, dtype=int)[:, :, None]:
        beside = [grids[(rows, *(at + sign * axis))] for sign in (-1, 1)]
        falls.append(top[used] - np.maximum(*beside))
    return float(np.concatenate(falls).max())


def _located(
    sum_: Components,
    log_factor: LogFactor,
    gain: Array,
    log_mass: Array,
    shift: Array,
    cov: Array,
    loss: Array,
    agreed: float,
) -> tuple[Array, Array, Array, Array, Array]:
    """Return log-masses (K,), means (K, k), covariances (K, k, k), losses and doubts of products, by nodes where they were found.

    The first of these are those of nodes over the components; nodes are placed again where the masses of two rules differ.
    """
    k = shift.shape[1]
    doubt, rows = np.zeros(len(sum_.signs)), np.arange(len(sum_.signs))
    log_mass, shift, cov = log_mass.copy(), shift.copy(), cov.copy()
    # What is narrower than the spacing lies between nodes; the next nodes cover the gap.
    width = np.broadcast_to(np.eye(k) * (0.3 * SEARCH[k][1]), cov.shape)
    for placed in range(_PLACED):
        rule = equidistant(*(_MANY if placed else _FEW)[k], k)
        nodes, log_weights = rule.nodes, np.log(rule.weights) + 0.5 * dot(rule.nodes, rule.nodes)
        part = selected(sum_, rows)
        width = _square_root(cov[rows] + width @ np.swapaxes(width, 1, 2))
        z = shift[rows][:, None] + nodes @ np.swapaxes(width, 1, 2)
        values = log_factor(points(part, gain[rows], z), rows)
        volume = np.log(np.diagonal(width, axis1=1, axis2=2)).sum(axis=1)
        logs = values + (log_weights - 0.5 * dot(z, z) + volume[:, None])
        now, centre, spread = _weighted(logs, z)
        change = np.abs((now - log_mass[rows]).real)
        loss[rows] = _divergence(logs.real, values.real, z.real, now.real, spread.real)
        log_mass[rows], shift[rows], cov[rows], doubt[rows] = now, centre, spread, change
        again = change > agreed
        rows, width = rows[again], width[again] * (0.3 * rule.spacing)
        if not len(rows):
            break
    return log_mass, shift, cov, loss, doubt


def _rebalanced(old: Components, new: Components, x: Array, values: Array, rule: Rule, corrections: int) -> Components:
    """Return `new`, which has the moments of each product, with weights that correct for the shape that each lost; one state.

    A product's skewness, lost at every observation, adds up to a wrong evidence of each mode; neighbours can carry it.  With
    p = sum_i w_i N_i e^g, known at nodes x (K, Q), and q = `new` this is Newton's step for the weights w_j (1 + e_j) of least
    E_p log(p / q),

        sum_l E_p[r_j r_l] e_l = E_p[r_j] - E_q[r_j],    r_j = w_j N_j / q,

    as many times as there were products that lost about the same.  Since sum_j r_j = 1, components that overlap no others
    keep their weight, and modes their mass.
    """
    log_mass = log_sum_exp(new.log_weights)
    before, after = (np.where(np.isfinite(v.log_weights.real), v.log_weights - log_mass, -_EMPTY) for v in (old, new))
    wide = old.covs[:, :1, 0] + 1e-280
    narrow = new.covs[:, :1, 0]
    narrow = np.where(narrow.real > 1e-12 * wide.real, narrow, 1e-12 * wide)
    height, half = after[:, None] - 0.5 * np.log(narrow), np.sqrt(0.5 / narrow)
    points_ = x.reshape(-1)
    # r_j at the nodes, (K, K Q).
    terms = np.exp(height - ((points_ - new.means) * half) ** 2)
    total = terms.sum(axis=0)
    log_weights = np.log(rule.weights)
    p = np.exp(before[:, None] + values + log_weights).reshape(-1)
    # Each component of `new` is integrated over its own nodes.
    own = np.exp(height - ((x - new.means) * half) ** 2)
    q = (own * np.exp(0.5 * (np.log(wide) + rule.nodes[:, 0] ** 2) + log_weights)).reshape(-1)
    share = np.exp(after)
    counted = share.real > _LIGHT
    scale = np.where(counted, np.where(counted, share, 1.0) ** -0.5, 0.0)
    parts = terms * scale[:, None] / np.where(total.real > 1e-290, total, 1e-290)
    gram = (parts * p) @ parts.T + _RIDGE * np.eye(len(share))
    slope = parts @ (p - q)
    change = corrections * scale * np.linalg.solve(gram, slope[:, None])[:, 0]
    if not np.all(np.isfinite(change)):
        return new
    # The step is shortened as a whole: of near-duplicates the changes cancel, and one of them cut short alone would not.
    largest = np.argmax(np.abs(change.real))
    size = change[largest] * np.sign(change[largest].real) / _CHANGE
    change = change / size if size.real > 1.0 else change
    return new._replace(log_weights=new.log_weights + np.log1p(change) - np.log1p(np.sum(share * change)))


def tilted(sum_: Components, slope: Array, constant: Any) -> Components:
    """Return the sum times exp(slope.x + constant), exactly."""
    across = product(sum_.covs, slope[:, None])[..., 0]
    logs = sum_.means @ slope + 0.5 * across @ slope + constant
    return sum_._replace(log_weights=sum_.log_weights + logs, means=sum_.means + across)


def refit_affine(sum_: Components, C: Array, c: Array, energy: Array) -> Components:
    """Return the sum times exp(-h'(energy) h / 2), exactly, for h = C x + c."""
    centre = sum_.means @ C.T + c
    spread = product(sum_.covs, C.T)
    # (E^-1 + C P C')^-1: no difference of large numbers where a component is far wider than what the observation leaves.
    inner = np.eye(len(c)) + (energy @ C) @ spread
    precision = solve(inner, np.broadcast_to(energy, (len(centre), *energy.shape)))
    pull = dot(precision, centre[:, None, :])
    logs = -0.5 * (dot(centre, pull) + log_determinant(inner))
    across = product(sum_.covs, C.T @ energy @ C)
    covs = symmetric(solve(np.eye(C.shape[1]) + across, sum_.covs))
    return Components(sum_.log_weights + logs, sum_.means - dot(spread, pull[:, None, :]), covs, sum_.signs)


def _divergence(logs: Array, values: Array, z: Array, log_mass: Array, cov: Array) -> Array:
    """Return the relative entropy (K,) of N(z; 0, 1) e^values, normalised, from the Gaussian with its moments."""
    top = logs.max(axis=1, keepdims=True)
    weight = np.exp(logs - top)
    weight /= weight.sum(axis=1, keepdims=True)
    level = np.where(weight > 0, values - 0.5 * dot(z, z), 0.0)
    k = z.shape[-1]
    entropy = np.log(np.maximum(cov[:, 0, 0], 1e-300)) if k == 1 else np.linalg.slogdet(cov)[1]
    return np.asarray(np.maximum((weight * level).sum(axis=1) - log_mass + 0.5 * (k + entropy), 0.0))


def _weighted(logs: Array, z: Array) -> tuple[Array, Array, Array]:
    """Return log-mass (K,), mean (K, k) and covariance (K, k, k) of nodes z (Q, k) or (K, Q, k) with log-weights (K, Q)."""
    top = logs.real.max(axis=1)
    top = np.where(np.isfinite(top), top, 0.0)
    weight = np.exp(logs - top[:, None])
    mass = weight.sum(axis=1)
    log_mass = np.log(mass) + top
    weight = weight / mass[:, None]
    if z.shape[-1] == 1:
        line = z[..., 0]
        mean = (weight * line).sum(axis=1)
        rest = line - mean[:, None]
        return log_mass, mean[:, None], (weight * rest * rest).sum(axis=1)[:, None, None]
    mean = weight @ z if z.ndim == 2 else (weight[:, None, :] @ z)[:, 0]
    rest = z - mean[:, None]
    return log_mass, mean, np.swapaxes(rest * weight[..., None], 1, 2) @ rest


def _square_root(cov: Array) -> Array:
    """Return the lower-triangular root, with a floor where all the mass sits on one node."""
    k = cov.shape[-1]
    cov = cov + (1e-6 * np.trace(cov, axis1=1, axis2=2)[:, None, None] / k + 1e-28) * np.eye(k)
    return np.sqrt(cov) if k == 1 else cholesky(cov)
