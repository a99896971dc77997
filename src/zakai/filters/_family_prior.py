"""A prior as families of Gaussians: v_0 = e^-phi sigma_0, with nodes only along the directions on which phi depends.

A Gaussian component is, given z = D x, still Gaussian, so that only v_0(z) = N(z; D m, D P D') e^-phi is put on nodes.  Where
phi is asymptotically linear, e^-phi N is again a Gaussian, and a component that is wide against the bend of phi is first
written as a sum of narrower ones, level by level: their weights, themselves Gaussian, are known exactly.
"""

from __future__ import annotations

from collections.abc import Callable
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
from zakai.models.compile import jax_field
from zakai.models.model import Model
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


def _values(functions: GaugeFunctions, model: Model, x: Any, theta: Any) -> Any:
    """phi at x (N, n), at the start."""
    value = functions.compiled(x, model.start, theta)[0]
    return value if _space(value) is jnp else np.asarray(value)


class Nodes(NamedTuple):
    """A part of v_0(z): nodes z (N, k), their covariance W (k, k), log |w|, signs, and what `Prior` holds."""

    points: Any
    cov: Any
    log_weights: Any
    signs: Any
    log_error: Any
    edge: Any


def _space(*arrays: Any) -> Any:
    """NumPy where nothing is traced: the shapes are many and not worth a compilation each."""
    return jnp if any(isinstance(a, jax.core.Tracer) for a in jax.tree.leaves(arrays)) else np


def _log_sum(logs: Any) -> Any:
    """log sum exp over the last axis."""
    xp = _space(logs)
    top = jax.lax.stop_gradient(xp.max(logs, axis=-1)) if xp is jnp else np.max(logs, axis=-1)
    return top + xp.log(xp.sum(xp.exp(logs - top[..., None]), axis=-1))


def _plain(tilts: Tilts) -> Tilts:
    return tilts if _space(tilts) is jnp else Tilts(*[None if a is None else np.asarray(a) for a in tilts])


def prior_families(functions: GaugeFunctions, model: Model, prior: Any, theta: Any) -> Prior:
    """The families of a prior for the parameters theta, traced or not; where the nodes are follows from the model's own."""
    if isinstance(prior, DensityPrior):
        return _from_density(functions, model, prior, theta)
    if isinstance(prior, GaussianPrior):
        components = [(0.0, prior.mean, prior.cov)]
    else:
        components = list(zip(np.log(prior.weights), prior.means, prior.covs, strict=True))
    if functions.trivial:
        made = [gaussian(mean, cov)._replace(log_mass=jnp.asarray(weight)) for weight, mean, cov in components]
        families = jax.tree.map(lambda *parts: jnp.stack(parts), *made)
        return Prior(families, np.full((len(made), 1), -np.inf), np.zeros((len(made), 1)), 0.0)
    own = _plain(functions.at(model.start, model.theta()))
    tilts = _plain(functions.at(model.start, theta))
    parts, worst = [], 0.0
    for weight, mean, cov in components:
        plan = _GaussianPlan(functions, model, np.asarray(own.directions), own, mean, cov)
        worst = max(worst, plan.error)
        for nodes in plan.nodes(tilts, theta):
            parts.append((_conditional(tilts.directions, mean, cov, nodes, plan.centre, weight), nodes))
    return _joined(parts, worst)


def _conditional(directions: Any, mean: Any, cov: Any, nodes: Nodes, centre: np.ndarray, log_mass: Any) -> Family:
    """The family of sum_i w_i N(z; z_i, W) N(x | z), x given z being that of N(mean, cov)."""
    across = cov @ directions.T
    inner = directions @ across
    singular = not isinstance(inner, jax.core.Tracer) and np.linalg.matrix_rank(inner) < len(inner)
    gain = across @ (np.linalg.pinv(inner) if singular else jnp.linalg.inv(inner))
    k = len(centre)
    narrowed = cov - gain @ (inner - nodes.cov) @ gain.T
    return Family(
        nodes.points - centre,
        nodes.log_weights,
        nodes.signs,
        mean + gain @ (centre - directions @ mean),
        0.5 * (narrowed + narrowed.T),
        gain,
        jnp.zeros(k),
        jnp.zeros((k, k)),
        jnp.asarray(log_mass, float),
    )


def _joined(parts: list[tuple[Family, Nodes]], error: float) -> Prior:
    """All parts with as many nodes each, those that were added having no weight."""
    most = max(len(family.log_weights) for family, _ in parts)

    def padded(array, value):
        return jnp.concatenate([jnp.asarray(array), jnp.full((most - len(array), *jnp.shape(array)[1:]), value)])

    families = [
        family._replace(
            nodes=padded(family.nodes, 0.0), log_weights=padded(family.log_weights, -jnp.inf), signs=padded(family.signs, 1.0)
        )
        for family, _ in parts
    ]
    stacked = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf, float) for leaf in leaves]), *families)
    log_error = jnp.stack([padded(nodes.log_error, -jnp.inf) for _, nodes in parts])
    edge = jnp.stack([padded(nodes.edge, 0.0) for _, nodes in parts])
    return Prior(stacked, log_error, edge, error)


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
    """Where the nodes of one Gaussian component are, decided for the model's own parameters."""

    def __init__(self, functions: GaugeFunctions, model: Model, directions: np.ndarray, tilts: Tilts, mean, cov):
        self.functions, self.model, self.mean, self.cov = functions, model, mean, cov
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
            lambda z: np.asarray(self._log_u(z, tilts) - scale(z)),
            lambda z: np.asarray(scale(z)),
            NodeLattice(origin, basis, sizes),
            TOLERANCE,
            _MOST_NODES[functions.count],
        )
        if not np.isfinite(self.error):
            raise InputError(f"{model.source}: prior: e^phi is not finite, or zero, where the prior is; give a narrower prior")

    def _bend(self, tilts: Tilts) -> tuple[float, float]:
        """Outside of these z one exponential is all of e^phi, to 1e-16."""
        along = np.asarray(tilts.slopes @ tilts.directions[0] / (tilts.directions[0] @ tilts.directions[0]))
        logs = np.asarray(tilts.logs)
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

    def _potential(self, tilts: Tilts, theta: Any) -> Callable[[Any], Any]:
        def phi(z):
            x = lifted(tilts.directions, z)
            if self.functions.exact:
                return _log_sum(x @ tilts.slopes.T + tilts.logs)
            return _values(self.functions, self.model, x, theta)

        return phi

    def _source(self, tilts: Tilts) -> tuple[Any, Any, Any]:
        """(points, log-weights, covariance) of the Gaussians of z that the last lattice is to represent."""
        directions = tilts.directions
        points, logs = (directions @ self.mean)[None], np.zeros(1)
        cov = self.vectors.T @ (directions @ self.cov @ directions.T) @ self.vectors
        for level in self.levels:
            logs = self._weights(level, points, logs, cov)[level.near]
            points, cov = level.points[level.near][:, None], np.array([[level.width**2]])
        return points, logs, cov

    def _weights(self, level: _Level, points: Any, logs: Any, cov: Any) -> Any:
        """The log-weights of a level's Gaussians."""
        variance = cov[0, 0] - level.width**2
        away = level.points[:, None] - points[:, 0]
        each = logs - 0.5 * away**2 / variance - 0.5 * _space(variance).log(2 * np.pi * variance)
        return _log_sum(each) + np.log(level.cell)

    def _log_u(self, z: Any, tilts: Tilts) -> Any:
        points, logs, cov = self._source(tilts)
        if not len(cov):
            return np.zeros(len(z))
        away = (z[:, None] - points) @ self.vectors
        each = logs - 0.5 * _space(away, cov).sum((away @ _space(cov).linalg.inv(cov)) * away, axis=-1)
        return _log_sum(each) - 0.5 * _space(cov).linalg.slogdet(2 * np.pi * cov)[1]

    def nodes(self, tilts: Tilts, theta: Any):
        """The parts of v_0(z) for the parameters theta."""
        points, logs = (tilts.directions @ self.mean)[None], np.zeros(1)
        cov = self.vectors.T @ (tilts.directions @ self.cov @ tilts.directions.T) @ self.vectors
        for number, level in enumerate(self.levels):
            weights = self._weights(level, points, logs, cov)
            edge = np.zeros(len(level.points))
            if number == 0:
                edge[[0, 1, -2, -1]] = 1.0
            far = ~level.near
            if far.any():
                yield self._tilted(tilts, level.points[far], weights[far], np.array([[level.width**2]]), edge[far])
            points, logs, cov = level.points[level.near][:, None], weights[level.near], np.array([[level.width**2]])
        if self.lattice is None:
            yield self._tilted(tilts, points[:, 0], logs, cov, np.zeros(len(points)))
            return
        z = self.lattice.points()
        phi = self._potential(tilts, theta)(z)
        log_u = self._log_u(z, tilts)
        logs = log_u - phi
        top = jax.lax.stop_gradient(jnp.max(logs))
        log_weights, signs = signed_logs(self.lattice.weights(jnp.exp(logs - top)))
        cell = np.log(np.abs(np.linalg.det(self.lattice.basis)))
        log_error = np.log(max(self.error, 1e-16)) + jnp.max(log_u) - phi + cell
        edge = _edge(self.lattice.sizes) * (not self.levels)
        yield Nodes(z, self.lattice.covariance, log_weights + top, signs, log_error, edge)

    def _tilted(self, tilts: Tilts, points: Any, log_weights: Any, cov: Any, edge: np.ndarray) -> Nodes:
        """Gaussians that lie where one exponential is all of e^phi: e^{-q z} N(z; s, W) / c."""
        assert self.bend is not None
        left = np.asarray(jax.lax.stop_gradient(self.lattice is None and self.tilted == 0 and not self.levels))
        if self.levels and len(edge) != 1:
            left = np.asarray(points) < 0.5 * (self.bend[0] + self.bend[1])
        which = np.where(np.broadcast_to(left, (len(edge),)), self.order[0], self.order[-1])
        along = (tilts.slopes @ tilts.directions[0] / (tilts.directions[0] @ tilts.directions[0]))[which]
        variance = cov[0, 0]
        logs = log_weights - along * points + 0.5 * along**2 * variance - tilts.logs[which]
        nothing = np.full(len(edge), -np.inf)
        return Nodes((points - along * variance)[:, None], cov, logs, np.ones(len(edge)), nothing, edge)


def _from_density(functions: GaugeFunctions, model: Model, prior: DensityPrior, theta: Any) -> Prior:
    """Nodes in all coordinates."""
    density = jax_field([prior.log_density], model)
    found, _ = first_lattice(model, prior, None)
    logs = np.asarray(found.log_values)
    basis, sizes = np.asarray(found.basis), np.array(logs.shape)
    origin = np.asarray(found.centre) - basis @ (sizes // 2)
    # As many cells as the narrowest feature asks for.
    finer = np.clip(np.minimum(features(logs[None])[0], 1e3) / 2.5, 0.1, 1e3)
    cells = np.maximum(np.ceil((sizes - 1) / finer), 8).astype(int)
    lattice = NodeLattice(origin, basis * ((sizes - 1) / cells), tuple(int(c) + 1 for c in cells))

    def log_u(z, values):
        return density(z, model.start, values)[0]

    def phi(z, values):
        return np.zeros(z.shape[:-1]) if functions.trivial else _values(functions, model, z, values)

    own = model.theta()
    lattice, error = resolve(
        lambda z: np.asarray(log_u(z, own) - phi(z, own)),
        lambda z: np.asarray(phi(z, own)),
        lattice,
        TOLERANCE,
        _MOST_NODES[model.n],
    )
    z = lattice.points()
    logs = log_u(z, theta) - phi(z, theta)
    top = jax.lax.stop_gradient(jnp.max(logs))
    log_weights, signs = signed_logs(lattice.weights(jnp.exp(logs - top)))
    cell = np.log(np.abs(np.linalg.det(lattice.basis)))
    log_error = np.log(max(error, 1e-16)) + jnp.max(log_u(z, theta)) - phi(z, theta) + cell
    n = model.n
    centre = z[len(z) // 2]
    family = Family(
        z - centre, log_weights, signs, centre, lattice.covariance, jnp.eye(n), jnp.zeros(n), jnp.zeros((n, n)), top
    )
    nodes = Nodes(z, lattice.covariance, log_weights, signs, log_error - top, _edge(lattice.sizes))
    return _joined([(family, nodes)], error)
