"""A prior as families of Gaussians: v_0 = e^-phi sigma_0, with nodes only along the directions on which phi depends.

A Gaussian component is, given z = D x, still Gaussian, so that only v_0(z) = N(z; D m, D P D') e^-phi is put on nodes.  Where
phi is asymptotically linear, e^-phi N is again a Gaussian, and a component that is wide against the bend of phi is first
written as a sum of narrower ones, level by level: their weights, themselves Gaussian, are known exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.errors import InputError
from zakai.filters._gauge import GaugeFunctions, Tilts, lifted
from zakai.filters._lattice_choice import features, first_lattice
from zakai.kolmogorov.families import Family, gaussian
from zakai.kolmogorov.nodes import NodeLattice, resolve, signed_logs
from zakai.kolmogorov.numpy_or_jax import numpy_or_jax
from zakai.models.compile import jax_field
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.prior import DensityPrior, GaussianPrior

TOLERANCE = 1e-12
_MOST_NODES = {1: 2**13, 2: 2**15, 3: 2**17}
_REACH = 8.6  # standard deviations to which a Gaussian is followed: there it is 1e-16 of its maximum
_NARROWER = 4.0  # by how much the Gaussians of one level are narrower than those before
_CELL = 0.186  # their spacing, in standard deviations of what they make up: flat to 1e-14


class Prior(NamedTuple):
    """The families of v_0 (leading axis J), with for each node the logarithm of the error that its place brings, and whether
    it is at the edge; `error` is the largest error relative to the maximum of the prior."""

    families: Family
    log_error: Any
    edge: Any
    error: float


class Nodes(NamedTuple):
    """A part of v_0(z): nodes z (N, k), their covariance W (k, k), log |w|, signs, and what `Prior` holds."""

    points: Any
    cov: Any
    log_weights: Any
    signs: Any
    log_error: Any
    edge: Any


def _log_sum(logs: Any) -> Any:
    """log sum exp over the last axis."""
    xp = numpy_or_jax(logs)
    top = jax.lax.stop_gradient(xp.max(logs, axis=-1)) if xp is jnp else np.max(logs, axis=-1)
    return top + xp.log(xp.sum(xp.exp(logs - top[..., None]), axis=-1))


def prior_families(functions: GaugeFunctions, model: Model, prior: Any, theta: Any) -> Prior:
    """The families of a prior for the parameters theta, traced or not; where the nodes are follows from the model's own."""
    if isinstance(prior, DensityPrior):
        return _from_density(functions, model, prior, theta)
    if isinstance(prior, GaussianPrior):
        components = [(0.0, prior.mean, prior.cov)]
    else:
        components = list(zip(np.log(prior.weights), prior.means, prior.covs, strict=True))
    if functions.trivial:
        made = [gaussian(mean, cov)._replace(log_mass=np.asarray(weight)) for weight, mean, cov in components]
        families = jax.tree.map(lambda *parts: np.stack(parts), *made)
        return Prior(families, np.full((len(made), 1), -np.inf), np.zeros((len(made), 1)), 0.0)
    own, tilts = functions.at(model.start, model.theta()), functions.at(model.start, theta)
    tilts = tilts._replace(directions=_like(own.directions, tilts.directions))
    parts, worst = [], 0.0
    for weight, mean, cov in components:
        plan = _GaussianPlan(functions, model, own, mean, cov)
        worst = max(worst, plan.error)
        for nodes in plan.nodes(tilts, theta):
            parts.append((_conditional(plan, tilts.directions, nodes, weight), nodes))
    return _joined(parts, worst)


def _like(own: np.ndarray, directions: Any) -> Any:
    """Directions that span the same as `directions`, along which a state moves like along `own`."""
    if numpy_or_jax(directions) is np:
        return directions
    return jnp.linalg.solve(directions @ np.linalg.pinv(own), directions)


def _conditional(plan: _GaussianPlan, directions: Any, nodes: Nodes, log_mass: Any) -> Family:
    """The family of sum_i w_i N(z; z_i, W) N(x | z), x given z being that of N(mean, cov)."""
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
    """All parts with as many nodes each, those that were added having no weight."""
    most = max(len(family.log_weights) for family, _ in parts)

    def padded(array, value):
        return numpy_or_jax(array).concatenate([array, np.full((most - len(array), *np.shape(array)[1:]), value)])

    def stack(*arrays):
        return numpy_or_jax(*arrays).stack(arrays)

    families = [
        family._replace(
            nodes=padded(family.nodes, 0.0), log_weights=padded(family.log_weights, -np.inf), signs=padded(family.signs, 1.0)
        )
        for family, _ in parts
    ]
    log_error = stack(*[padded(nodes.log_error, -np.inf) for _, nodes in parts])
    edge = stack(*[padded(nodes.edge, 0.0) for _, nodes in parts])
    return Prior(jax.tree.map(stack, *families), log_error, edge, error)


def _edge(sizes: tuple[int, ...]) -> np.ndarray:
    """One at the outermost two layers of a lattice."""
    index = np.stack(np.meshgrid(*[np.arange(s) for s in sizes], indexing="ij"), axis=-1)
    outside = (index < 2) | (index >= np.array(sizes) - 2)
    return np.any(outside & (np.array(sizes) > 1), axis=-1).ravel().astype(float)


@dataclass(frozen=True)
class _Level:
    """Gaussians of standard deviation `width` at `points` (N,) that make up those before; `near` (N,) are written anew."""

    points: np.ndarray
    cell: float
    width: float
    near: np.ndarray


class _GaussianPlan:
    """Where the nodes of one Gaussian component are, decided for the model's own parameters; they move with D mean."""

    def __init__(self, functions: GaugeFunctions, model: Model, tilts: Tilts, mean: np.ndarray, cov: np.ndarray):
        self.functions, self.model, self.mean, self.cov = functions, model, mean, cov
        directions = tilts.directions
        self.centre = directions @ mean
        spread = directions @ cov @ directions.T
        values, vectors = np.linalg.eigh(spread)
        wide = values > 1e-14 * max(values.max(), 1e-300)
        self.vectors = vectors[:, wide]
        self.levels: list[_Level] = []
        self.bend = self._bend(tilts) if functions.exact and functions.count == 1 else None
        self.tilted: int | None = None
        low, high = (self.centre[0] - _REACH * np.sqrt(spread[0, 0]), self.centre[0] + _REACH * np.sqrt(spread[0, 0]))
        if self.bend is not None and wide.any():
            ends = (low, high)
            low, high = self._split(float(self.centre[0]), float(np.sqrt(spread[0, 0])))
            if not self.levels and low < self.bend[1] and high > self.bend[0]:
                low, high = ends
            elif not self.bend[0] < high or not low < self.bend[1]:
                self.tilted, self.lattice, self.error = (0 if high <= self.bend[0] else 1), None, 0.0
                return
        if functions.count == 1:
            sizes: tuple[int, ...] = (49 if wide.any() else 1,)
            basis = np.array([[(high - low) / (sizes[0] - 1)]]) if wide.any() else np.ones((1, 1))
            origin = np.array([low]) if wide.any() else self.centre
        else:
            sizes = tuple(41 if w else 1 for w in wide)
            basis = vectors * np.where(wide, 2 * _REACH * np.sqrt(np.maximum(values, 0.0)) / 40, 1.0)
            origin = self.centre - basis @ np.where(wide, 20.0, 0.0)
        scale = self._potential(tilts, model.theta())
        self.lattice, self.error = resolve(
            lambda z: self._log_u(z, tilts) - scale(z),
            scale,
            NodeLattice(origin, basis, sizes),
            TOLERANCE,
            _MOST_NODES[functions.count],
        )
        if not np.isfinite(self.error):
            raise InputError(f"{model.source}: prior: e^phi is not finite, or zero, where the prior is; give a narrower prior")

    def _bend(self, tilts: Tilts) -> tuple[float, float]:
        """Outside of these z one exponential is all of e^phi, to 1e-16."""
        along, logs = _along(tilts), tilts.logs
        self.order = np.argsort(along)
        high = low = 0.0
        for side in (0, -1):
            first = self.order[side]
            for other in np.delete(np.arange(len(along)), first):
                if along[other] == along[first]:
                    continue
                where = (37.0 + logs[other] - logs[first] + np.log(len(along))) / (along[first] - along[other])
                low, high = (min(low, where), high) if side == 0 else (low, max(high, where))
        gaps = np.diff(np.sort(along))
        self.gap = float(np.max(along) - np.min(along)) if gaps.size else 0.0
        return low, high

    def _split(self, mean: float, width: float) -> tuple[float, float]:
        """The levels of a component that is wide against the bend, and the ends of what is left to the last lattice."""
        low, high = mean - self._margin(width), mean + self._margin(width)
        assert self.bend is not None
        while width * self.gap > 8.0 and low < self.bend[1] and high > self.bend[0]:
            before, width = width, width / _NARROWER
            cell = _CELL * before
            reach = (mean - _REACH * before, mean + _REACH * before) if not self.levels else (low, high)
            points = np.arange(np.floor(reach[0] / cell), np.ceil(reach[1] / cell) + 1) * cell
            near = (points + self._margin(width) > self.bend[0]) & (points - self._margin(width) < self.bend[1])
            self.levels.append(_Level(points, cell, width, near))
            low, high = points[near][0] - _REACH * width, points[near][-1] + _REACH * width
            low, high = min(low, self.bend[0]), max(high, self.bend[1])
        return low, high

    def _margin(self, width: float) -> float:
        """How far from the bend a Gaussian must be for one exponential to be all of e^phi in it, tilted by the others too."""
        return max(_REACH * width, 0.5 * self.gap * width**2)

    def gain(self, directions: Any) -> Any:
        """What x follows z by, (n, k): P D'V (V'D P D'V)^-1 V', where V spans what has width."""
        across = self.cov @ directions.T @ self.vectors
        return across @ numpy_or_jax(across).linalg.inv(self.vectors.T @ directions @ across) @ self.vectors.T

    def _shift(self, tilts: Tilts) -> Any:
        """By how much the nodes are elsewhere than for the model's own parameters."""
        return tilts.directions @ self.mean - self.centre

    def _potential(self, tilts: Tilts, theta: Any) -> Callable[[Any], Any]:
        def phi(z):
            if self.vectors.shape[1] < len(z[0]):
                # Where z has no width there may be no x; that of the mean is meant.
                centre = tilts.directions @ self.mean
                z = centre + (z - centre) @ self.gain(tilts.directions).T @ tilts.directions.T
            x = lifted(tilts.directions, z)
            if self.functions.exact:
                return _log_sum(x @ tilts.slopes.T + tilts.logs)
            return self.functions.potential(x, self.model.start, theta)

        return phi

    def _source(self, tilts: Tilts) -> tuple[Any, Any, Any]:
        """(points, log-weights, covariance) of the Gaussians of z that the last lattice is to represent."""
        directions = tilts.directions
        points, logs = (directions @ self.mean)[None], np.zeros(1)
        cov = self.vectors.T @ (directions @ self.cov @ directions.T) @ self.vectors
        for level in self.levels:
            logs = self._weights(level, self._shift(tilts), points, logs, cov)[level.near]
            points, cov = level.points[level.near][:, None] + self._shift(tilts), np.array([[level.width**2]])
        return points, logs, cov

    def _weights(self, level: _Level, shift: Any, points: Any, logs: Any, cov: Any) -> Any:
        """The log-weights of a level's Gaussians, of those at `points` that they make up."""
        variance = cov[0, 0] - level.width**2
        away = (level.points + shift)[:, None] - points[:, 0]
        each = logs - 0.5 * away**2 / variance - 0.5 * numpy_or_jax(variance).log(2 * np.pi * variance)
        return _log_sum(each) + np.log(level.cell)

    def _log_u(self, z: Any, tilts: Tilts) -> Any:
        points, logs, cov = self._source(tilts)
        if not len(cov):
            return np.zeros(len(z))
        linalg = numpy_or_jax(cov).linalg
        away = (z[:, None] - points) @ self.vectors
        each = logs - 0.5 * ((away @ linalg.inv(cov)) * away).sum(axis=-1)
        return _log_sum(each) - 0.5 * linalg.slogdet(2 * np.pi * cov)[1]

    def nodes(self, tilts: Tilts, theta: Any) -> Iterator[Nodes]:
        """The parts of v_0(z) for the parameters theta."""
        shift = self._shift(tilts)
        points, logs = (tilts.directions @ self.mean)[None], np.zeros(1)
        cov = self.vectors.T @ (tilts.directions @ self.cov @ tilts.directions.T) @ self.vectors
        # The outermost Gaussians are those of the first level, or what they are written as.
        ends = np.array([True, True])
        for level in self.levels:
            weights = self._weights(level, shift, points, logs, cov)
            points, logs, cov = (level.points + shift)[:, None], weights, np.array([[level.width**2]])
            edge = np.zeros(len(level.points))
            edge[:2], edge[-2:] = ends
            ends = ends & level.near[[0, -1]]
            far = ~level.near
            if far.any():
                assert self.bend is not None
                left = level.points[far] < 0.5 * sum(self.bend)
                which = np.where(left, self.order[0], self.order[-1])
                yield self._tilted(tilts, points[far], logs[far], cov, which, edge[far])
            points, logs = points[level.near], logs[level.near]
        if self.lattice is None:
            which = self.order[[0 if self.tilted == 0 else -1]]
            yield self._tilted(tilts, points, logs, cov, which, np.zeros(1))
            return
        z = self.lattice.points() + shift
        phi = self._potential(tilts, theta)(z)
        log_u = self._log_u(z, tilts)
        edge = _edge(self.lattice.sizes)
        if self.levels:
            edge[:2], edge[-2:] = ends
        yield _represented(self.lattice, z, log_u, phi, self.error, edge)

    def _tilted(self, tilts: Tilts, points: Any, log_weights: Any, cov: Any, which: np.ndarray, edge: np.ndarray) -> Nodes:
        """Gaussians that lie where one exponential, `which`, is all of e^phi: e^{-q z} N(z; s, W) / c."""
        along, variance = _along(tilts)[which], cov[0, 0]
        logs = log_weights - along * points[:, 0] + 0.5 * along**2 * variance - tilts.logs[which]
        nothing = np.full(len(edge), -np.inf)
        return Nodes(points - (along * variance)[:, None], cov, logs, np.ones(len(edge)), nothing, edge)


def _along(tilts: Tilts) -> Any:
    """The slopes (K,) in z, of one direction."""
    return tilts.slopes @ tilts.directions[0] / (tilts.directions[0] @ tilts.directions[0])


def _represented(lattice: NodeLattice, z: Any, log_u: Any, phi: Any, error: float, edge: np.ndarray) -> Nodes:
    """The nodes of u e^-phi from both at the points z of a lattice."""
    logs = log_u - phi
    xp = numpy_or_jax(logs)
    top = jax.lax.stop_gradient(xp.max(logs)) if xp is jnp else np.max(logs)
    log_weights, signs = signed_logs(lattice.weights(xp.exp(logs - top)))
    cell = np.log(np.abs(np.linalg.det(lattice.basis)))
    log_error = np.log(max(error, 1e-16)) + xp.max(log_u) - phi + cell
    return Nodes(z, lattice.covariance, log_weights + top, signs, log_error, edge)


def _from_density(functions: GaugeFunctions, model: Model, prior: DensityPrior, theta: Any) -> Prior:
    """Nodes in all coordinates."""
    with jax.ensure_compile_time_eval():
        found, _ = first_lattice(model, prior, None)
        logs, basis, centre = (np.asarray(array) for array in (found.log_values, found.basis, found.centre))
    sizes = np.array(logs.shape)
    # As many cells as the narrowest feature asks for.
    finer = np.clip(np.minimum(features(logs[None])[0], 1e3) / 2.5, 0.1, 1e3)
    cells = np.maximum(np.ceil((sizes - 1) / finer), 8).astype(int)
    lattice = NodeLattice(centre - basis @ (sizes // 2), basis * ((sizes - 1) / cells), tuple(int(c) + 1 for c in cells))
    field, function = jax_field([prior.log_density], model), numpy_function(prior.log_density, model)

    def log_u(z, values):
        return function(z, model.start, values) if numpy_or_jax(values) is np else field(z, model.start, values)[0]

    def phi(z, values):
        return np.zeros(z.shape[:-1]) if functions.trivial else functions.potential(z, model.start, values)

    own = model.theta()
    lattice, error = resolve(
        lambda z: log_u(z, own) - phi(z, own), lambda z: phi(z, own), lattice, TOLERANCE, _MOST_NODES[model.n]
    )
    z = lattice.points()
    nodes = _represented(lattice, z, log_u(z, theta), phi(z, theta), error, _edge(lattice.sizes))
    n, centre = model.n, z[len(z) // 2]
    still = np.zeros(n), np.zeros((n, n)), np.zeros(())
    family = Family(z - centre, nodes.log_weights, nodes.signs, centre, lattice.covariance, np.eye(n), *still)
    return _joined([(family, nodes)], error)
