"""A prior as families of Gaussians: v_0 = e^-phi sigma_0, with nodes only along the directions on which phi depends.

A Gaussian component is, given z = D x, still Gaussian, so that only v_0(z) = N(z; D m, D P D') e^-phi is put on nodes.  Where
phi is asymptotically linear, e^-phi N is again a Gaussian, and a component that is wide against the region where phi is nonlinear
(the kink) is first written as a sum of narrower ones, level by level: their weights, themselves Gaussian, are known exactly.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.errors import InputError
from zakai.methods.gaussian.gauge import Gauge
from zakai.methods.gaussian.nodes import MOST_NODES, TOLERANCE, GaussianPlan, Nodes, edge_of, represented
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.prior import DensityPrior
from zakai.numerics.complex_step import is_complex
from zakai.numerics.families import Family, gaussians
from zakai.numerics.nodes import NodeGrid, resolve
from zakai.numerics.prior_grid import prior_grid
from zakai.numerics.transition import Array

ROUGH = 0.05  # error of the nodes, relative to the maximum of the prior, that only a jump leaves


class Prior(NamedTuple):
    """The families of v_0 (leading axis J), and their errors.

    `log_error` is the logarithm of the error of each node, `edge` marks the nodes at the edge, and `error` is the largest error
    relative to the maximum of the prior.
    """

    families: Family
    log_error: Any
    edge: Any
    error: float


def prior_families(gauge: Gauge, model: Model, prior: Any) -> Prior:
    """Return the families of a prior; the real parts of the parameters alone decide the places of the nodes."""
    if isinstance(prior, DensityPrior):
        return _from_density(gauge, model, prior)
    weights, means, covs = prior.components
    means = means - gauge.origin
    if gauge.trivial:
        nothing = np.zeros((len(weights), 1))
        return Prior(gaussians(np.log(weights), means, covs), nothing - np.inf, nothing, 0.0)
    own, tilts = gauge.real().at_one(model.start), gauge.at_one(model.start)
    tilts = tilts._replace(directions=_like(own.directions, tilts.directions))
    parts, worst = [], 0.0
    for weight, mean, cov in zip(np.log(weights), means, covs, strict=True):
        plan = GaussianPlan(gauge, model, own, mean, cov)
        worst = max(worst, plan.error)
        for nodes in plan.nodes(tilts):
            parts.append((_conditional(plan, tilts.directions, nodes, weight), nodes))
    return _joined(parts, worst)


def _like(own: Array, directions: Array) -> Array:
    """Return directions with the span of `directions` and the scale of `own`."""
    if not is_complex(directions):
        return directions
    return np.linalg.solve(directions @ np.linalg.pinv(own), directions)


def _conditional(plan: GaussianPlan, directions: Any, nodes: Nodes, log_mass: Any) -> Family:
    """Return the family of sum_i w_i N(z; z_i, W) N(x | z), with the law of x given z under N(mean, cov)."""
    gain = plan.gain(directions)
    centre = directions @ plan.mean
    narrowed = plan.cov - gain @ (directions @ plan.cov @ directions.T - nodes.cov) @ gain.T
    k = len(centre)
    return Family(
        nodes.points - centre,
        nodes.log_weights,
        nodes.signs,
        plan.mean,
        0.5 * (narrowed + narrowed.T),
        gain,
        np.zeros(k),
        np.zeros((k, k)),
        np.asarray(log_mass, float),
    )


def _joined(parts: list[tuple[Family, Nodes]], error: float) -> Prior:
    """Return all parts, padded to the same number of nodes by nodes of weight zero."""
    most = max(len(family.log_weights) for family, _ in parts)

    def padded(array: Array, value: float) -> Array:
        return np.concatenate([array, np.full((most - len(array), *array.shape[1:]), value)])

    families = [
        family._replace(
            nodes=padded(family.nodes, 0.0), log_weights=padded(family.log_weights, -np.inf), signs=padded(family.signs, 1.0)
        )
        for family, _ in parts
    ]
    log_error = np.stack([padded(nodes.log_error, -np.inf) for _, nodes in parts])
    edge = np.stack([padded(nodes.edge, 0.0) for _, nodes in parts])
    return Prior(Family(*(np.stack(arrays) for arrays in zip(*families, strict=True))), log_error, edge, error)


def _from_density(gauge: Gauge, model: Model, prior: DensityPrior) -> Prior:
    """Return nodes in all coordinates."""
    function = numpy_function(prior.log_density, model)
    theta, origin, start = gauge.theta, gauge.origin, model.start

    def log_u(z: Array, values: Array) -> Array:
        return function(z + origin, start, values)

    def phi(z: Array, own: Gauge) -> Array:
        return np.zeros(z.shape[:-1]) if gauge.trivial else own.potential(z, start)

    name = f"{model.source}: prior: log_density"
    found = prior_grid(lambda z: log_u(z, theta.real), model.n, tolerance=TOLERANCE, aligned=False, source=name)
    sizes = np.array(found.log_values.shape)
    basis, centre = found.basis, found.centre
    # The smallest standard deviation along an axis decides the number of points.
    finer = np.clip(_narrowest(found.log_values.real) / 2.5, 0.1, 1e3)
    spacings = np.maximum(np.ceil((sizes - 1) / finer), 8).astype(int)
    if np.prod(spacings + 1.0) > MOST_NODES[model.n]:
        raise _too_rough(name)
    grid = NodeGrid(centre - basis @ (sizes // 2), basis * ((sizes - 1) / spacings), tuple(int(c) + 1 for c in spacings))
    real = gauge.real()
    grid, error = resolve(
        lambda z: log_u(z, theta.real) - phi(z, real), lambda z: phi(z, real), grid, TOLERANCE, MOST_NODES[model.n]
    )
    if error > ROUGH:
        raise _too_rough(name)
    z = grid.points()
    nodes = represented(grid, z, log_u(z, theta), phi(z, gauge), error, edge_of(grid.sizes))
    n, middle = model.n, z[len(z) // 2]
    none = np.zeros(n), np.zeros((n, n)), np.zeros(())
    family = Family(z - middle, nodes.log_weights, nodes.signs, middle, grid.covariance, np.eye(n), *none)
    return _joined([(family, nodes)], max(error, found.error))


def _too_rough(name: str) -> InputError:
    what = "changes too fast somewhere for a sum of Gaussians, as at a jump"
    return InputError(f'{name}: {what}; give method="yau-yau", which takes it')


def _narrowest(log_values: Array) -> Array:
    """Return the standard deviation (n,), in grid spacings, the smallest along each axis, from the curvature."""
    found = []
    matters = log_values > log_values.max() - 14.0
    for axis in range(log_values.ndim):
        along, used = np.moveaxis(log_values, axis, 0), np.moveaxis(matters, axis, 0)[1:-1]
        with np.errstate(invalid="ignore"):
            curvature = 2 * along[1:-1] - along[:-2] - along[2:]
        largest = np.max(np.where(used & np.isfinite(curvature), curvature, 0.0), initial=1e-12)
        found.append(1.0 / np.sqrt(largest))
    return np.array(found)
