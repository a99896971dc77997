"""A density as the numbers of a prior: a Gaussian mixture, or its values on a grid or between ends."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from zakai.densities._density import Density
from zakai.densities.conditional import ConditionalParticleDensity
from zakai.densities.gaussian import GaussianMixture
from zakai.densities.grid import GridDensity
from zakai.densities.interval import IntervalDensity
from zakai.densities.logarithmic import LogarithmicDensity
from zakai.densities.mapped import IntervalMap, MappedDensity
from zakai.densities.particles import ParticleDensity
from zakai.densities.points import PointMasses
from zakai.densities.product import ProductDensity
from zakai.densities.tensor_train import TensorTrainDensity
from zakai.errors import InputError

MOST_NUMBERS = 40_000  # of a grid, which keeps a model file with it below 1 MiB
_POINTS = {1: (128, 256, 512, 1024, 2048), 2: (64, 96, 136, 196)}  # along an axis of a density without a grid of its own
_REACH = 9.0  # standard deviations on each side
_RESOLVED = 1e-11  # error of the mass with every second point, at which the grid is fine enough
_ACCEPTED = 1e-6  # at which the finest grid is taken
MOST_KERNELS = 1000  # of a mixture that stands for particles
KERNELS_OF_A_TRAIN = 1024
_MOST_COMPONENTS = 64


def prior_table(density: Density) -> dict[str, Any]:
    """Return the keys of the prior that equals a density, as in a model file.

    Raises:
        InputError: a density that a grid of 40,000 points does not resolve.
    """
    found = plain(density)
    if isinstance(found, GaussianMixture):
        if len(found.weights) == 1:
            return {"kind": "gaussian", "mean": found.means[0], "cov": found.covs[0]}
        return {"kind": "mixture", "weights": found.weights, "means": found.means, "covs": found.covs}
    if isinstance(found, IntervalDensity):
        return {"kind": "interval", "values": found.values, "nodes": found.nodes, "rule": found.rule}
    grid, more = grid_of(found)
    return {"kind": "grid", "centre": grid.centre, "basis": grid.basis, "log_values": grid.log_values, **more}


def grid_of(density: GridDensity | LogarithmicDensity | MappedDensity) -> tuple[GridDensity, dict[str, Any]]:
    """Return the grid of a density, and what maps it to the states, by the names in a model file."""
    if isinstance(density, LogarithmicDensity):
        return density.grid, {"logarithms": [bool(one) for one in density.logarithms]}
    return (density.grid, dict(density.map.ends)) if isinstance(density, MappedDensity) else (density, {})


def mapped(grid: GridDensity, more: Mapping[str, Any]) -> GridDensity | LogarithmicDensity | MappedDensity:
    """Return the density of the states from what `grid_of` returns."""
    if "logarithms" in more:
        return LogarithmicDensity(grid, tuple(more["logarithms"]))
    return MappedDensity(grid, IntervalMap(more.get("lower", -np.inf), more.get("upper", np.inf))) if more else grid


def plain(density: Density) -> GaussianMixture | GridDensity | IntervalDensity | LogarithmicDensity | MappedDensity:
    """Return the same density as a mixture with positive weights, on a grid, or between the ends of a domain."""
    if isinstance(density, IntervalDensity | MappedDensity):
        return density
    if isinstance(density, LogarithmicDensity):
        grid = plain(density.grid)
        assert isinstance(grid, GridDensity)
        return replace(density, grid=grid)
    if isinstance(density, ParticleDensity | ConditionalParticleDensity):
        return density.thinned(MOST_KERNELS).smoothed
    if isinstance(density, TensorTrainDensity) and len(density.names) > 2:
        return density.kernels(KERNELS_OF_A_TRAIN)
    if isinstance(density, PointMasses):
        return density.smoothed
    if isinstance(density, GaussianMixture) and np.all(density.weights > 0):
        return density
    if isinstance(density, GridDensity) and density.log_values.size <= MOST_NUMBERS:
        return density
    if isinstance(density, ProductDensity):
        parts = [plain(part) for part in density.parts]
        if all(isinstance(part, GaussianMixture) for part in parts):
            mixture = _product(density, parts)  # type: ignore[arg-type]
            if mixture is not None:
                return mixture
    return _on_a_grid(density)


def _product(density: ProductDensity, parts: list[GaussianMixture]) -> GaussianMixture | None:
    """Return the product of mixtures as one mixture; None where it has many components."""
    if np.prod([len(part.weights) for part in parts]) > _MOST_COMPONENTS:
        return None
    n = len(density.names)
    weights, means, covs = [], [], []
    for chosen in itertools.product(*[range(len(part.weights)) for part in parts]):
        mean, cov, weight = np.zeros(n), np.zeros((n, n)), 1.0
        for part, place, k in zip(parts, density.places, chosen, strict=True):
            weight *= part.weights[k]
            mean[list(place)], cov[np.ix_(place, place)] = part.means[k], part.covs[k]
        weights.append(weight)
        means.append(mean)
        covs.append(cov)
    return GaussianMixture(np.array(weights), np.array(means), np.array(covs), density.names, density.periodic)


def _on_a_grid(density: Density) -> GridDensity:
    """Return the values on a grid along the principal axes, as coarse as resolves them; InputError where none does."""
    n = len(density.names)
    if n not in _POINTS:
        raise InputError(f"prior: a density of {n} states in this form has no grid; give a Gaussian with its mean and cov")
    if any(density.periodic):
        vectors, spread = np.eye(n), np.sqrt(np.diag(density.cov()))
    else:
        values, vectors = np.linalg.eigh(density.cov())
        spread = np.sqrt(values)
    half = np.where(density.periodic, np.pi, _REACH * spread)
    centre = np.where(density.periodic, 0.0, density.mean())
    for count in _POINTS[n]:
        basis = vectors * (2 * half / count)
        index = np.stack(np.meshgrid(*[np.arange(count) - count // 2] * n, indexing="ij"), axis=-1)
        logs = np.asarray(density.log_density(centre + index @ basis.T))
        mass = np.exp(logs) * abs(np.linalg.det(basis))
        error = max(abs(mass.sum() - 1.0), abs(2**n * mass[(slice(None, None, 2),) * n].sum() - 1.0))
        if error < _RESOLVED:
            break
    if not error < _ACCEPTED:
        raise InputError(
            f"prior: a grid of {count} points along each axis does not resolve this density (error {error:.1g}); "
            "give a Gaussian with its mean and cov, or a formula"
        )
    return GridDensity(logs, centre, basis, density.names, density.periodic)
