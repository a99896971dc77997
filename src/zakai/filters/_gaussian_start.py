"""The first Gaussian sum: a prior, cut into Gaussians that are narrow where it matters, and divided by the gauge.

A Gaussian is cut along the directions W'x in which h bends or phi varies: N(m, P) is N(0, s^2 P) convolved with a lattice of
points for N(m, (1 - s^2) P), exact to about 1e-5.  A density is a flat sum of narrow Gaussians, a partition of unity, times
the density.  The narrow ones are then put together until they fit into the slots; which with which is decided once,
for the model's own parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.densities.components import Components, components, moments, padded, regression, shares
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
# The same of a level of half the variance, where the sum is as smooth as the level before.
_CLOSE = 1.13
# Where nothing is put together the tails cost little, and a reading may ask for them.
_FAR = 8.6
# By how much a narrow Gaussian may change when it is divided by e^phi and lifted again, and how many there may be.
_WELL = 1e-4
_MOST = 2048
# As many are looked at together, so that the shapes are few.
_TOGETHER = 64
# Nodes a direction before anything is put together.
_FINE = {1: 64, 2: 20, 3: 8, 4: 5, 5: 4}


def cut_prior(
    model: Model, prior: Any, directions: np.ndarray, theta: Any, doubt: Callable[[Components], Any] | None, far: bool
) -> tuple[Components, np.ndarray]:
    """The prior as narrow Gaussians, and which (N,) are the outermost.

    doubt: how badly e^phi divides each of some Gaussians, for the model's own parameters. far: the tails are asked for.
    """
    if isinstance(prior, DensityPrior):
        return _cut_density(model, prior, theta)
    logs, means, covs, _ = given(model, prior)
    k, edge = directions.shape[1], np.zeros(len(logs))
    if k == 1 and doubt is not None:
        count = max(4, _FINE[1] // len(logs))
        with jax.ensure_compile_time_eval():
            parts = [
                _levels(*one, directions, count, _MOST // len(logs), doubt, _FAR if far else _REACH)
                for one in zip(logs, means, covs)
            ]
        logs, means, covs, edge = (np.concatenate(arrays) for arrays in zip(*parts))
        # Few sizes, few compilations.
        slots = max(_TOGETHER, 1 << (len(logs) - 1).bit_length())
        last = np.minimum(np.arange(slots), len(logs) - 1)
        empty = np.arange(slots) >= len(logs)
        logs, means, covs, edge = np.where(empty, -np.inf, logs[last]), means[last], covs[last], np.where(empty, 0.0, edge[last])
    elif k and k <= max(_FINE):
        share = max(4, int(_FINE[k] ** k / len(logs)) ** (1 / k))
        logs, means, covs, edge = _cut(logs, means, covs, directions, int(share))
    return components(jnp.asarray(logs), jnp.asarray(means), jnp.asarray(covs)), edge


def _levels(log, mean, cov, directions, count, room, doubt, reach):
    """One Gaussian as narrow ones along one direction, narrower where the gauge asks for it; 1 for the outermost two.

    The Gaussians of a level that e^phi does not divide well are written anew, all of them as one density, by others of half the
    variance: N(z; a, s^2) = sum_i spacing N(z_i; a, s^2 - w^2) N(z; z_i, w^2).  What is left at the end are wide ones where phi
    is as good as linear, and narrow ones near its bend.
    """
    gain = np.asarray(regression(jnp.asarray(cov)[None], jnp.asarray(directions)))[0, :, 0]
    spacing = 2 * _REACH / count
    width = min(WIDTH * spacing, 0.95)
    spacing, left = width / WIDTH, np.sqrt(1 - width**2)
    size = int(reach * left / spacing)
    line = np.arange(-size, size + 1) * spacing
    logs = -0.5 * (line / left) ** 2
    logs = logs - np.log(np.exp(logs).sum())
    edge, done = _outermost(line.shape), []
    while True:
        covs = np.broadcast_to(cov - (1 - width**2) * np.outer(gain, gain), (len(line), *cov.shape))
        here = log + logs, mean + np.outer(line, gain), covs, edge
        bad = _doubts(doubt, *here[:3]) > _WELL
        if not bad.any() or room < 3 * np.sum(bad):
            return tuple(np.concatenate(arrays) for arrays in zip(*done, here))
        done.append(tuple(array[~bad] for array in here))
        room -= int(np.sum(~bad))
        before, above = line[bad], logs[bad]
        variance, width = 0.5 * width**2, width * np.sqrt(0.5)
        spacing = width / _CLOSE
        ends = before[0] - _REACH * width, before[-1] + _REACH * width
        line = np.arange(np.floor(ends[0] / spacing), np.ceil(ends[1] / spacing) + 1) * spacing
        each = above - 0.5 * (line[:, None] - before) ** 2 / variance
        top = each.max(axis=1)
        logs = top + np.log(np.exp(each - top[:, None]).sum(axis=1) * spacing / np.sqrt(2 * np.pi * variance))
        deep = logs > logs.max() - 0.5 * _FAR**2
        line, logs = line[deep], logs[deep]
        # Where the outermost are written anew, so are the edges.
        edge = _outermost(line.shape) * (bad[0] | bad[-1])


def _doubts(doubt, logs, means, covs) -> np.ndarray:
    """`doubt` of any number of Gaussians (N,), some at a time."""
    told = []
    for first in range(0, len(logs), _TOGETHER):
        index = np.minimum(np.arange(first, first + _TOGETHER), len(logs) - 1)
        told.append(doubt(components(*(jnp.asarray(array[index]) for array in (logs, means, covs)))))
    return np.concatenate(told)[: len(logs)]


def _cut(logs, means, covs, directions, count):
    """Each Gaussian as `count` narrow ones in each of the directions (n, k); 1 for the outermost."""
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
        np.tile(_outermost((len(line),) * k), len(means)),
    )


def _outermost(sizes: tuple[int, ...], closed: Sequence[bool] = ()) -> np.ndarray:
    """1 at the edge of a lattice, 0 inside; along an axis that is `closed` there is no edge."""
    inside = np.ones(sizes, bool)
    for axis, size in enumerate(sizes):
        if size > 1 and not (closed and closed[axis]):
            index = np.arange(size)
            inside &= np.expand_dims((index > 0) & (index < size - 1), tuple(a for a in range(len(sizes)) if a != axis))
    return (~inside).ravel().astype(float)


def _regression(covs: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """`regression` on the host: a trace must not reach what decides how many Gaussians there are."""
    with jax.ensure_compile_time_eval():
        return np.asarray(regression(jnp.asarray(covs), jnp.asarray(directions)))


def _cut_density(model: Model, prior: DensityPrior, theta: Any) -> tuple[Components, np.ndarray]:
    """The density on a partition of unity of narrow Gaussians; 1 for the outermost."""
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

    edge = _outermost(tuple(len(line) for line in lines), turns)
    return refit(flat, log_density, np.eye(model.n), True).sum, edge


def fitted(
    sum_: Components, own: Components, count: np.ndarray, loss: np.ndarray, most: int, slots: int, angles: tuple[int, ...]
) -> Components:
    """The narrow Gaussians put together to at most `most`, in that many slots; `own` are those of the model's own parameters,
    `count` (N,) their weights in u, and `loss` (N,) theirs."""
    if len(count) <= most:
        return padded(sum_, slots)
    used = count > 0.01 * PRUNED / len(count)
    label = np.full(len(count), -1)
    with jax.ensure_compile_time_eval():
        label[used] = groups(
            count[used], np.asarray(own.means)[used], np.asarray(own.covs)[used], loss[used], most, angles
        )
    few = gathered(Components(*(jnp.asarray(a)[used] for a in sum_)), label[used], angles)
    return padded(few, slots)


def given(model: Model, prior: Any) -> Components:
    """The prior as it is given, for the model's own parameters and on the host; a density as the points of a lattice."""
    if isinstance(prior, DensityPrior):
        with jax.ensure_compile_time_eval():
            lattice, log_mass = choice.first_lattice(model, prior, None)
            logs, means = np.asarray(lattice.log_values).ravel(), np.asarray(lattice.points()).reshape(-1, model.n)
            cell = np.log(abs(np.linalg.det(np.asarray(lattice.basis))))
        logs, covs = logs + cell + log_mass, np.zeros((len(means), model.n, model.n))
    elif isinstance(prior, GaussianPrior):
        logs, means, covs = np.zeros(1), prior.mean[None], prior.cov[None]
    else:
        logs, means, covs = np.log(prior.weights), prior.means, prior.covs
    return Components(logs, means, covs, np.ones(len(logs)))


@partial(jax.jit, static_argnums=2)
def difference(start: Components, prior: Components, angles: tuple[int, ...]) -> jax.Array:
    """How far a start stands from the prior: the largest error of its mass, of a mean in deviations, and of a variance.

    Of an angle a the mean of e^{ia} is compared, which is the same however it is cut: 1 - |E e^{ia}|^2 is its variance.
    """
    start = jax.lax.stop_gradient(start)
    (share, log_mass), (wanted, unit) = shares(start), shares(prior)
    mean, cov = moments(share, start.means, start.covs)
    centre, spread = moments(wanted, jnp.asarray(prior.means), prior.covs)
    variance = jnp.diagonal(spread)
    shift, excess = mean - centre, jnp.diagonal(cov) - variance
    for i in angles:
        own, other = (
            jnp.sum(p * jnp.exp(1j * s.means[:, i] - 0.5 * s.covs[:, i, i])) for p, s in ((share, start), (wanted, prior))
        )
        length = jnp.abs(other)
        turned = own * jnp.where(length > 1e-9, jnp.conj(other) / length, 1.0)
        shift, excess = shift.at[i].set(turned.imag), excess.at[i].set(2.0 * (turned.real - length))
        # What is narrower than this is lost in the rounding of 1.
        variance = variance.at[i].set(jnp.maximum(1.0 - length**2, 1e-12))
    scale = jnp.where(variance > 0, variance, 1.0)
    wrong = jnp.where(variance > 0, jnp.maximum(jnp.abs(shift) / jnp.sqrt(scale), jnp.abs(excess) / scale), 0.0)
    worst = jnp.maximum(jnp.abs(jnp.expm1(log_mass - unit)), jnp.max(wrong))
    return jnp.where(jnp.isnan(worst), jnp.inf, worst)
