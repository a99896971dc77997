"""The nodes of e^-phi N(z; mean, cov): on a grid, or as tilted Gaussians away from the kink of phi."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from zakai.errors import InputError
from zakai.methods.gaussian.gauge import Gauge, Tilts, lifted
from zakai.models.model import Model
from zakai.numerics.complex_step import log_determinant, log_sum_exp
from zakai.numerics.nodes import NodeGrid, resolve, signed_logs
from zakai.numerics.transition import Array

TOLERANCE = 1e-12
MOST_NODES = {1: 2**13, 2: 2**15, 3: 2**17}
_REACH = 8.6  # standard deviations to which a Gaussian is followed: there it is 1e-16 of its maximum
_NARROWER = 4.0  # ratio of the standard deviations of two successive levels
_SPACING = 0.186  # spacing of a level's Gaussians, in standard deviations of the previous level: their sum is exact to 1e-14


class Nodes(NamedTuple):
    """A part of v_0(z): nodes z (N, k), their covariance W (k, k), log |w|, signs, and what `Prior` holds."""

    points: Any
    cov: Any
    log_weights: Any
    signs: Any
    log_error: Any
    edge: Any


def edge_of(sizes: tuple[int, ...]) -> np.ndarray:
    """Return one at the outermost two layers of a grid and zero elsewhere."""
    index = np.stack(np.meshgrid(*[np.arange(s) for s in sizes], indexing="ij"), axis=-1)
    outside = (index < 2) | (index >= np.array(sizes) - 2)
    return np.asarray(np.any(outside & (np.array(sizes) > 1), axis=-1), float).ravel()


@dataclass(frozen=True)
class _Level:
    """Gaussians of standard deviation `width` at `points` (N,), whose sum is the previous level; `near` (N,) are split again."""

    points: np.ndarray
    spacing: float
    width: float
    near: np.ndarray


class GaussianPlan:
    """The places of the nodes of one Gaussian component for the model's own parameters; other parameters shift them by D mean."""

    def __init__(self, gauge: Gauge, model: Model, tilts: Tilts, mean: np.ndarray, cov: np.ndarray):
        self.gauge, self.model, self.mean, self.cov = gauge, model, mean, cov
        directions = tilts.directions
        self.centre = directions @ mean
        spread = directions @ cov @ directions.T
        values, vectors = np.linalg.eigh(spread)
        wide = values > 1e-14 * max(values.max(), 1e-300)
        self.vectors = vectors[:, wide]
        self.levels: list[_Level] = []
        self.kink = self._kink(tilts) if gauge.exact and gauge.count == 1 else None
        self.tilted: int | None = None
        low, high = (self.centre[0] - _REACH * np.sqrt(spread[0, 0]), self.centre[0] + _REACH * np.sqrt(spread[0, 0]))
        if self.kink is not None and wide.any():
            ends = (low, high)
            low, high = self._split(float(self.centre[0]), float(np.sqrt(spread[0, 0])))
            if not self.levels and low < self.kink[1] and high > self.kink[0]:
                low, high = ends
            elif not self.kink[0] < high or not low < self.kink[1]:
                self.tilted, self.grid, self.error = (0 if high <= self.kink[0] else 1), None, 0.0
                return
        if gauge.count == 1:
            sizes: tuple[int, ...] = (49 if wide.any() else 1,)
            basis = np.array([[(high - low) / (sizes[0] - 1)]]) if wide.any() else np.ones((1, 1))
            origin = np.array([low]) if wide.any() else self.centre
        else:
            sizes = tuple(41 if w else 1 for w in wide)
            basis = vectors * np.where(wide, 2 * _REACH * np.sqrt(np.maximum(values, 0.0)) / 40, 1.0)
            origin = self.centre - basis @ np.where(wide, 20.0, 0.0)
        scale = self._potential(self.gauge.real(), tilts)
        self.grid, self.error = resolve(
            lambda z: self._log_u(z, tilts) - scale(z),
            scale,
            NodeGrid(origin, basis, sizes),
            TOLERANCE,
            MOST_NODES[gauge.count],
        )
        if not np.isfinite(self.error):
            raise InputError(f"{model.source}: prior: e^phi is not finite, or zero, where the prior is; give a narrower prior")

    def _kink(self, tilts: Tilts) -> tuple[float, float]:
        """Return the ends of the kink: outside of them one exponential equals e^phi to 1e-16."""
        along, logs = _along(tilts), tilts.logs
        assert logs is not None
        self.order = np.argsort(along)
        low, high = np.inf, -np.inf
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
        """Divide a component that is wide against the kink into levels, and return the ends of the last grid."""
        low, high = mean - self._margin(width), mean + self._margin(width)
        assert self.kink is not None
        while width * self.gap > 8.0 and low < self.kink[1] and high > self.kink[0]:
            before, width = width, width / _NARROWER
            spacing = _SPACING * before
            reach = (mean - _REACH * before, mean + _REACH * before) if not self.levels else (low, high)
            points = np.arange(np.floor(reach[0] / spacing), np.ceil(reach[1] / spacing) + 1) * spacing
            near = (points + self._margin(width) > self.kink[0]) & (points - self._margin(width) < self.kink[1])
            self.levels.append(_Level(points, spacing, width, near))
            low, high = points[near][0] - _REACH * width, points[near][-1] + _REACH * width
            low, high = min(low, self.kink[0]), max(high, self.kink[1])
        return low, high

    def _margin(self, width: float) -> float:
        """Return the distance from the kink beyond which one exponential equals e^phi for a Gaussian, tilted or not."""
        return max(_REACH * width, 0.5 * self.gap * width**2)

    def gain(self, directions: Any) -> Any:
        """Return the gain (n, k) of x given z: P D'V (V'D P D'V)^-1 V', V the directions of positive variance."""
        across = self.cov @ directions.T @ self.vectors
        return across @ np.linalg.inv(self.vectors.T @ directions @ across) @ self.vectors.T

    def _shift(self, tilts: Tilts) -> Any:
        """Return the shift of the nodes against those for the model's own parameters."""
        return tilts.directions @ self.mean - self.centre

    def _potential(self, gauge: Gauge, tilts: Tilts) -> Callable[[Any], Any]:
        def phi(z: Array) -> Array:
            if self.vectors.shape[1] < len(z[0]):
                # In a direction of zero variance z is replaced by the mean, for which there is an x.
                centre = tilts.directions @ self.mean
                z = centre + (z - centre) @ self.gain(tilts.directions).T @ tilts.directions.T
            x = lifted(tilts.directions, z)
            if tilts.slopes is not None:
                return log_sum_exp(x @ tilts.slopes.T + tilts.logs)
            return gauge.potential(x, self.model.start)

        return phi

    def _source(self, tilts: Tilts) -> tuple[Any, Any, Any]:
        """Return points, log-weights and covariance of the Gaussians of z that the last grid represents."""
        directions = tilts.directions
        points, logs = (directions @ self.mean)[None], np.zeros(1)
        cov = self.vectors.T @ (directions @ self.cov @ directions.T) @ self.vectors
        for level in self.levels:
            logs = self._weights(level, self._shift(tilts), points, logs, cov)[level.near]
            points, cov = level.points[level.near][:, None] + self._shift(tilts), np.array([[level.width**2]])
        return points, logs, cov

    def _weights(self, level: _Level, shift: Any, points: Any, logs: Any, cov: Any) -> Any:
        """Return the log-weights of a level's Gaussians, whose sum is the Gaussians at `points`."""
        variance = cov[0, 0] - level.width**2
        away = (level.points + shift)[:, None] - points[:, 0]
        each = logs - 0.5 * away**2 / variance - 0.5 * np.log(2 * np.pi * variance)
        return log_sum_exp(each) + np.log(level.spacing)

    def _log_u(self, z: Any, tilts: Tilts) -> Any:
        points, logs, cov = self._source(tilts)
        if not len(cov):
            return np.zeros(len(z))
        away = (z[:, None] - points) @ self.vectors
        each = logs - 0.5 * ((away @ np.linalg.inv(cov)) * away).sum(axis=-1)
        return log_sum_exp(each) - 0.5 * log_determinant(2 * np.pi * cov)

    def nodes(self, tilts: Tilts) -> Iterator[Nodes]:
        """Yield the parts of v_0(z) for the parameters theta."""
        shift = self._shift(tilts)
        points, logs = (tilts.directions @ self.mean)[None], np.zeros(1)
        cov = self.vectors.T @ (tilts.directions @ self.cov @ tilts.directions.T) @ self.vectors
        # The outermost Gaussians are those of the first level, or the levels that replace them.
        ends = np.array([True, True])
        for level in self.levels:
            weights = self._weights(level, shift, points, logs, cov)
            points, logs, cov = (level.points + shift)[:, None], weights, np.array([[level.width**2]])
            edge = np.zeros(len(level.points))
            edge[:2], edge[-2:] = ends
            ends = ends & level.near[[0, -1]]
            far = ~level.near
            if far.any():
                assert self.kink is not None
                left = level.points[far] < 0.5 * sum(self.kink)
                which = np.where(left, self.order[0], self.order[-1])
                yield self._tilted(tilts, points[far], logs[far], cov, which, edge[far])
            points, logs = points[level.near], logs[level.near]
        if self.grid is None:
            which = self.order[[0 if self.tilted == 0 else -1]]
            yield self._tilted(tilts, points, logs, cov, which, np.zeros(1))
            return
        z = self.grid.points() + shift
        phi = self._potential(self.gauge, tilts)(z)
        log_u = self._log_u(z, tilts)
        edge = edge_of(self.grid.sizes)
        if self.levels:
            edge[:2], edge[-2:] = ends
        yield represented(self.grid, z, log_u, phi, self.error, edge)

    def _tilted(self, tilts: Tilts, points: Any, log_weights: Any, cov: Any, which: np.ndarray, edge: np.ndarray) -> Nodes:
        """Return the nodes where one exponential, `which`, equals e^phi: e^{-q z} N(z; s, W) / c."""
        along, variance = _along(tilts)[which], cov[0, 0]
        assert tilts.logs is not None
        logs = log_weights - along * points[:, 0] + 0.5 * along**2 * variance - tilts.logs[which]
        nothing = np.full(len(edge), -np.inf)
        return Nodes(points - (along * variance)[:, None], cov, logs, np.ones(len(edge)), nothing, edge)


def _along(tilts: Tilts) -> Any:
    """Return the slopes (K,) in z of one direction."""
    assert tilts.slopes is not None
    return tilts.slopes @ tilts.directions[0] / (tilts.directions[0] @ tilts.directions[0])


def represented(grid: NodeGrid, z: Array, log_u: Array, phi: Array, error: float, edge: Array) -> Nodes:
    """Return the nodes of u e^-phi from both at the points z of a grid."""
    logs = log_u - phi
    top = np.max(logs.real)
    log_weights, signs = signed_logs(grid.weights(np.exp(logs - top)))
    spacing = np.log(np.abs(np.linalg.det(grid.basis)))
    log_error = np.log(max(error, 1e-16)) + np.max(log_u.real) - phi.real + spacing
    return Nodes(z, grid.covariance, log_weights + top, signs, log_error, edge)
