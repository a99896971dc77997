"""The first Gaussian sum: a prior, cut into Gaussians that are narrow where it matters, and divided by the gauge.

A Gaussian is cut along the directions W'x in which h bends or phi varies: N(m, P) is N(0, s^2 P) convolved with a lattice of
points for N(m, (1 - s^2) P), exact to about 1e-5.  A density is a flat sum of narrow Gaussians, a partition of unity, times
the density.  The narrow ones are then put together until they fit into the slots; which with which is decided once,
for the model's own parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.densities.components import Components, components, moments, padded, regression, shares, wrapped
from zakai.densities.quadrature import refit
from zakai.densities.reduction import PRUNED, gathered, groups
from zakai.errors import InputError
from zakai.filters import _lattice_choice as choice
from zakai.models.compile import jax_field
from zakai.models.model import Model
from zakai.models.prior import DensityPrior, GaussianPrior

# The width of a narrow Gaussian in spacings of its lattice: a flat sum of them is flat to 2 exp(-2 pi^2 0.8^2) = 7e-6.
WIDTH = 0.8
_REACH = 5.3
# The same of a level below another, whose sum varies with sqrt(1/2) of its width.
_CLOSE = 1.13
# Where nothing is put together the tails cost little, and a reading may ask for them.
_FAR = 8.6
# What the gauge may change of a narrow Gaussian, and how many there may be.
_WELL = 1e-4
MOST = 2048
# Nodes a direction before anything is put together.
_FINE = {1: 64, 2: 20, 3: 8, 4: 5, 5: 4}


def prior_sum(model: Model, prior: Any, theta: Any) -> Components:
    """The prior as it is given; a density on a flat sum of narrow Gaussians."""
    if isinstance(prior, DensityPrior):
        return _cut_density(model, prior, theta)
    if isinstance(prior, GaussianPrior):
        logs, means, covs = np.zeros(1), prior.mean[None], prior.cov[None]
    else:
        logs, means, covs = np.log(prior.weights), prior.means, prior.covs
    return components(jnp.asarray(logs), jnp.asarray(means), jnp.asarray(covs))


def cut(sum_: Components, directions: np.ndarray, doubt: Callable[[Components], Any] | None) -> Components:
    """A prior as many narrow Gaussians; `doubt` tells of each (K,) how badly the gauge divides it."""
    k = directions.shape[1]
    if not k or k > max(_FINE):
        return sum_
    with jax.ensure_compile_time_eval():
        logs, means, covs, _ = (np.asarray(a) for a in sum_)
        share = max(4, int(_FINE[k] ** k / len(logs)) ** (1 / k))
        if k > 1 or doubt is None:
            logs, means, covs = _cut(logs, means, covs, directions, int(share))
        else:
            room = MOST // len(logs)
            parts = [_levels(*one, directions, int(share), room, doubt) for one in zip(logs, means, covs)]
            logs, means, covs = (np.concatenate(arrays) for arrays in zip(*parts))
        return _rounded(logs, means, covs)


def _rounded(logs: np.ndarray, means: np.ndarray, covs: np.ndarray) -> Components:
    """A sum in a multiple of 64 slots, or a power of two: few shapes, few compilations."""
    count = len(logs)
    slots = -(-count // 64) * 64 if count > 256 else max(8, 1 << (count - 1).bit_length())
    index = np.minimum(np.arange(slots), count - 1)
    logs = np.where(np.arange(slots) < count, logs[index], -np.inf)
    return Components(*(jnp.asarray(a) for a in (logs, means[index], covs[index], np.ones(slots))))


def _levels(log, mean, cov, directions, count, room, doubt):
    """One Gaussian as narrow ones along one direction, narrower where the gauge asks for it.

    The Gaussians of a level that the gauge does not divide well are written anew, all of them as one density, by some that are
    narrower by sqrt 2: N(z; a, s^2) = sum_i spacing N(z_i; a, s^2 - w^2) N(z; z_i, w^2).  Where phi is as good as linear that
    ends with wide ones, near its bend with narrow ones.
    """
    gain = _regression(cov[None], directions)[0, :, 0]
    spacing = 2 * _REACH / count
    width = min(WIDTH * spacing, 0.95)
    left = np.sqrt(1 - width**2)
    line = np.arange(-np.floor(_FAR * left / spacing), _FAR * left / spacing + 1e-9) * spacing
    weights = np.exp(-0.5 * (line / left) ** 2)
    logs = np.log(weights / weights.sum())

    def made(line, logs, width):
        covs = np.broadcast_to(cov - (1 - width**2) * np.outer(gain, gain), (len(line), *cov.shape))
        return log + logs, mean + np.outer(line, gain), covs

    done = []
    while True:
        here = made(line, logs, width)
        bad = np.asarray(doubt(_rounded(*here)))[: len(line)] > _WELL
        if not bad.any() or room < 2 * np.sum(bad):
            done.append(here)
            break
        done.append(tuple(a[~bad] for a in here))
        room -= np.sum(~bad)
        before, line, logs = line[bad], line[bad], logs[bad]
        variance, width = 0.5 * width**2, width * np.sqrt(0.5)
        spacing = width / _CLOSE
        ends = line[0] - _REACH * width, line[-1] + _REACH * width
        line = np.arange(np.floor(ends[0] / spacing), np.ceil(ends[1] / spacing) + 1) * spacing
        each = logs - 0.5 * (line[:, None] - before) ** 2 / variance - 0.5 * np.log(2 * np.pi * variance)
        top = each.max(axis=1)
        logs = np.log(spacing) + top + np.log(np.exp(each - top[:, None]).sum(axis=1))
        deep = logs > logs.max() - 0.5 * _FAR**2
        line, logs = line[deep], logs[deep]
    return tuple(np.concatenate(arrays) for arrays in zip(*done))


def _cut(logs, means, covs, directions, count):
    """Each Gaussian as `count` narrow ones in each of the directions (n, k)."""
    k = directions.shape[1]
    # count nodes cover +- reach deviations of what the narrow width leaves.
    spacing = 2 * _REACH / count
    width = min(WIDTH * spacing, 0.95)
    left = np.sqrt(1 - width**2)
    line = (np.arange(count) - (count - 1) / 2) * (width / WIDTH)
    line = line[np.abs(line) <= _REACH * left + 1e-9]
    weight = np.exp(-0.5 * (line / left) ** 2)
    # The few nodes of many directions have the variance that they should have by scaling them.
    line = line * left / np.sqrt((weight / weight.sum()) @ line**2) if len(line) > 1 else line
    grid = np.stack(np.meshgrid(*[line] * k, indexing="ij"), axis=-1).reshape(-1, k)
    weights = np.prod(np.stack(np.meshgrid(*[weight / weight.sum()] * k, indexing="ij"), axis=-1).reshape(-1, k), axis=1)
    gain = _regression(covs, directions)
    cut = covs - (1 - width**2) * np.einsum("kia,kja->kij", gain, gain)
    new_means = means[:, None] + np.einsum("kia,qa->kqi", gain, grid)
    return (
        (logs[:, None] + np.log(weights)).ravel(),
        new_means.reshape(-1, means.shape[1]),
        np.repeat(cut, len(weights), axis=0),
    )


def _regression(covs: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """`regression` on the host: a trace must not reach what decides how many Gaussians there are."""
    with jax.ensure_compile_time_eval():
        return np.asarray(regression(jnp.asarray(covs), jnp.asarray(directions)))


def _cut_density(model: Model, prior: DensityPrior, theta: Any) -> Components:
    """The density on a partition of unity of narrow Gaussians."""
    if model.n > 2:
        raise InputError(f"{model.source}: prior: a density in {model.n} coordinates is not cut into Gaussians; give a mixture")
    lattice, _ = choice.first_lattice(model, prior, None)
    logs, points = np.asarray(lattice.log_values), np.asarray(lattice.points())
    used = points[logs > logs.max() - 18.0]
    basis = np.asarray(lattice.basis)
    index = (used - np.asarray(lattice.centre)) @ np.linalg.inv(basis).T
    low, high = index.min(axis=0) - 0.5, index.max(axis=0) + 0.5
    count = _FINE[model.n]
    # On a circle the lattice is closed.
    turns = [np.isclose(high[a] - low[a], size) and bool(model.periodic) for a, size in enumerate(logs.shape)]
    spacing = (high - low) / count
    lines = [
        low[a] + spacing[a] * (np.arange(count) + 0.5) if turns[a] else low[a] + spacing[a] * np.arange(-1, count + 2)
        for a in range(model.n)
    ]
    grid = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, model.n)
    means = np.asarray(lattice.centre) + grid @ basis.T
    root = basis * (WIDTH * spacing)
    covs = np.broadcast_to(root @ root.T, (len(means), model.n, model.n))
    cell = np.log(abs(np.linalg.det(basis)) * np.prod(spacing))
    density = jax_field([prior.log_density], model)
    flat = components(jnp.full(len(means), cell), jnp.asarray(means), jnp.asarray(covs))

    def log_density(x):
        value = density(x, model.start, theta)[0]
        return jnp.where(jnp.isnan(value), -jnp.inf, jnp.maximum(value, -1e6))

    return refit(flat, log_density, np.eye(model.n), True).sum


def fitted(
    sum_: Components, own: Components, count: np.ndarray, loss: np.ndarray, most: int, slots: int, angles: tuple[int, ...]
) -> Components:
    """The narrow Gaussians put together to at most `most`, in that many slots; `own` are those of the model's own parameters,
    `count` (N,) their weights in u, and `loss` (N,) theirs."""
    if len(count) > most:
        used = count > 0.01 * PRUNED / len(count)
        sum_ = Components(*(jnp.asarray(a)[used] for a in sum_))
        with jax.ensure_compile_time_eval():
            label = groups(count[used], np.asarray(own.means)[used], np.asarray(own.covs)[used], loss[used], most, angles)
        sum_ = gathered(sum_, label, angles)
    return padded(sum_, slots)


@partial(jax.jit, static_argnums=2)
def difference(start: Components, prior: Components, angles: tuple[int, ...]) -> jax.Array:
    """How far the start stands from the prior: the largest error of its mass, its mean in deviations, and its variances."""
    (share, mass), (wanted, unit) = shares(start), shares(prior)
    mean, cov = moments(share, start.means, start.covs, angles)
    centre, spread = moments(wanted, prior.means, prior.covs, angles)
    own, variance = jnp.diagonal(cov), jnp.diagonal(spread)
    scale = jnp.where(variance > 0, variance, 1.0)
    away = jnp.abs(wrapped(mean - centre, angles)) / jnp.sqrt(scale)
    wrong = jnp.where(variance > 0, jnp.maximum(away, jnp.abs(own / scale - 1.0)), 0.0)
    worst = jnp.maximum(jnp.abs(jnp.expm1(mass - unit)), jnp.max(wrong))
    return jax.lax.stop_gradient(jnp.where(jnp.isnan(worst), jnp.inf, worst))
