"""The first Gaussian sum: a prior as Gaussians that are narrow where it matters.

A Gaussian is cut along the directions W'x in which h is curved or phi varies: N(m, P) is N(0, s^2 P) convolved with a grid of
points for N(m, (1 - s^2) P), exact to about 1e-5.  A density is a flat sum of narrow Gaussians, a partition of unity, times
the density.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from zakai.errors import InputError
from zakai.methods.system.prior_moments import density_grid
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.prior import DensityPrior
from zakai.numerics.sums.mixture import Array, Components, components, joined, moments, regression, selected, shares
from zakai.numerics.sums.quadrature import refit
from zakai.numerics.sums.reduction import PRUNED, gathered, groups

# The width of a narrow Gaussian in spacings of its grid: a flat sum of them is flat to 2 exp(-2 pi^2 0.8^2) = 7e-6.
WIDTH = 0.8
_REACH = 5.3
# The same of a level of half the variance, where the sum is as smooth as the level before.
_CLOSE = 1.13
# Where nothing is merged the tails cost little, and an observation may reach them.
_FAR = 8.6
# So many nodes with equal spacing have an error of 1e-3, and narrower Gaussians than as many Gauss-Hermite nodes.
_EQUAL = 14
# By how much a narrow Gaussian may change when it is divided by e^phi and lifted again, and how many there may be.
_CHANGED, _MOST = 1e-4, 2048
# Nodes a direction before anything is merged.
_FINE = {1: 64, 2: 20, 3: 8, 4: 4, 5: 3}
# Negligible density of a prior that is given by its logarithm, in nats below its maximum.
_DEPTH = 18.0

Doubt = Callable[[Components], Array]


def cut_prior(
    model: Model, prior: Any, directions: Array, origin: Array, theta: Array, doubt: Doubt | None, far: bool
) -> tuple[Components, Array]:
    """Return the prior as narrow Gaussians in z = x - origin, and which (N,) are the outermost.

    Args:
        model: The model.
        prior: The prior.
        directions: W (n, k).
        origin: The origin (n,) of z.
        theta: The parameters.
        doubt: The error by which e^phi divides each of some Gaussians; None without a gauge.
        far: Whether the tails are kept too.
    """
    if isinstance(prior, DensityPrior):
        return _cut_density(model, prior, origin, theta)
    whole = given(model, prior, origin)
    k, N = directions.shape[1], len(whole.signs)
    if k == 1 and doubt is not None:
        count, reach = max(4, _FINE[1] // N), _FAR if far else _REACH
        parts = [_levels(selected(whole, slice(i, i + 1)), directions, count, _MOST // N, doubt, reach) for i in range(N)]
        sums, edges = zip(*parts, strict=True)
        return joined(*sums), np.concatenate(edges)
    if k and k <= max(_FINE):
        return _cut(whole, directions, int(max(4, int(_FINE[k] ** k / N)) ** (1 / k)))
    return whole, np.zeros(N)


def _levels(
    one: Components, directions: Array, count: int, budget: int, doubt: Doubt, reach: float
) -> tuple[Components, Array]:
    """Return one Gaussian as narrow ones along one direction, narrower where the gauge asks for it; 1 for the outermost two.

    The Gaussians of a level that e^phi does not divide within bounds are replaced, all of them as one density, by others of half
    the variance: N(z; a, s^2) = sum_i spacing N(z_i; a, s^2 - w^2) N(z; z_i, w^2).  The result has wide Gaussians where phi is
    nearly linear, and narrow ones where it is curved.
    """
    log, mean, cov = one.log_weights[0], one.means[0], one.covs[0]
    gain = regression(one.covs, directions)[0, :, 0]
    spacing = 2 * _REACH / count
    width = min(WIDTH * spacing, 0.95)
    spacing, rest = width / WIDTH, np.sqrt(1 - width**2)
    size = int(reach * rest / spacing)
    line = np.arange(-size, size + 1) * spacing
    logs = -0.5 * (line / rest) ** 2
    logs = logs - np.log(np.exp(logs).sum())
    edge, done = _outermost(line.shape), []
    while True:
        covs = np.broadcast_to(cov - (1 - width**2) * np.outer(gain, gain), (len(line), *cov.shape))
        level = components(log + logs, mean + np.outer(line, gain), covs)
        bad = doubt(level) > _CHANGED
        if not bad.any() or budget < 3 * np.sum(bad):
            done.append((level, edge))
            return joined(*(part for part, _ in done)), np.concatenate([part for _, part in done])
        done.append((selected(level, ~bad), edge[~bad]))
        budget -= int(np.sum(~bad))
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
        # Where the outermost are replaced, so are the edges.
        edge = _outermost(line.shape) * (bad[0] | bad[-1])


def _cut(whole: Components, directions: Array, count: int) -> tuple[Components, Array]:
    """Return each Gaussian as `count` narrow ones in each of the directions (n, k); 1 for the outermost."""
    k = directions.shape[1]
    line, weight, width = _nodes(count)
    grid = np.stack(np.meshgrid(*[line] * k, indexing="ij"), axis=-1).reshape(-1, k)
    weights = np.prod(np.stack(np.meshgrid(*[weight] * k, indexing="ij"), axis=-1).reshape(-1, k), axis=1)
    gain = regression(whole.covs, directions)
    cut = whole.covs - (1 - width**2) * gain @ np.swapaxes(gain, 1, 2)
    means = whole.means[:, None] + grid @ np.swapaxes(gain, 1, 2)
    return components(
        (whole.log_weights[:, None] + np.log(weights)).ravel(),
        means.reshape(-1, whole.means.shape[1]),
        np.repeat(cut, len(weights), axis=0),
    ), np.tile(_outermost((len(line),) * k), len(whole.signs))


@lru_cache(maxsize=64)
def _nodes(count: int) -> tuple[Array, Array, float]:
    """Return nodes, weights and w: N(0, 1) is N(0, w^2) convolved with them to 1e-3, up to 4.5 deviations."""
    if count >= _EQUAL:
        spacing = 2 * _REACH / count
        width = WIDTH * spacing
        line, rest = spacing * (np.arange(count) - (count - 1) / 2), np.sqrt(1 - width**2)
        line = line[np.abs(line) <= _REACH * rest + 1e-9]
        weight = np.exp(-0.5 * (line / rest) ** 2)
        weight = weight / weight.sum()
        return line * rest / np.sqrt(weight @ line**2), weight, width
    node, weight = np.polynomial.hermite_e.hermegauss(count)
    z, weight = np.linspace(0.0, 4.5, 200)[:, None], weight / weight.sum()
    low, width = 0.0, 1.0
    for _ in range(30):
        w = 0.5 * (low + width)
        density = np.exp(0.5 * z**2 - 0.5 * ((z - np.sqrt(1 - w**2) * node) / w) ** 2) @ weight / w
        low, width = (low, w) if np.abs(density - 1).max() < 1e-3 else (w, width)
    return np.sqrt(1 - width**2) * node, weight, width


def _outermost(sizes: tuple[int, ...], closed: Sequence[bool] = ()) -> Array:
    """Return 1 at the edge of a grid, 0 inside; along an axis that is `closed` there is no edge."""
    inside = np.ones(sizes, bool)
    for axis, size in enumerate(sizes):
        if size > 1 and not (closed and closed[axis]):
            index = np.arange(size)
            inside &= np.expand_dims((index > 0) & (index < size - 1), tuple(a for a in range(len(sizes)) if a != axis))
    return np.asarray((~inside).ravel().astype(float))


def _cut_density(model: Model, prior: DensityPrior, origin: Array, theta: Array) -> tuple[Components, Array]:
    """Return the density on a partition of unity of narrow Gaussians; 1 for the outermost."""
    n = model.n
    if n > 2:
        raise InputError(f"{model.source}: prior: a density in {n} coordinates is not cut into Gaussians; give a mixture")
    density = numpy_function(prior.log_density, model)
    grid = density_grid(model, prior, theta)
    logs = grid.log_values.real
    used = np.argwhere(logs > logs.max() - _DEPTH) - np.array(logs.shape) // 2
    low, high = used.min(axis=0) - 0.5, used.max(axis=0) + 0.5
    count = _FINE[n]
    # On a circle the grid is closed.
    closed = [grid.closed[a] and bool(np.isclose(high[a] - low[a], size)) for a, size in enumerate(logs.shape)]
    spacing = (high - low) / count
    lines = [
        low[a] + spacing[a] * (np.arange(count) + 0.5) if closed[a] else low[a] + spacing[a] * np.arange(-1, count + 2)
        for a in range(n)
    ]
    nodes = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, n)
    means = grid.centre + nodes @ grid.basis.T
    root = grid.basis * (WIDTH * spacing)
    volume = np.log(abs(np.linalg.det(grid.basis)) * np.prod(spacing))
    flat = components(np.full(len(means), volume), means, np.broadcast_to(root @ root.T, (len(means), n, n)))

    def log_density(x: Array, _: Array) -> Array:
        value = density(x, model.start, theta)
        value = np.where(value.real > -1e6, value, -1e6)
        return np.where(np.isnan(value.real), -np.inf, value)

    sum_ = refit(flat, log_density, np.eye(n), True).sum
    share = shares(sum_)[0].real
    kept = share > 1e-30 * share.max()
    edge = _outermost(tuple(len(line) for line in lines), closed)
    return selected(sum_._replace(means=sum_.means - origin), kept), edge[kept]


def merged(sum_: Components, share: Array, loss: Array, most: int, angles: tuple[int, ...]) -> Components:
    """Return the narrow Gaussians merged to at most `most`."""
    if len(share) <= most:
        return sum_
    used = share > 0.01 * PRUNED / len(share)
    few = selected(sum_, used)
    label, _ = groups(share[used], few.means.real, few.covs.real, loss[used], most, angles)
    return gathered(few, label, angles)


def given(model: Model, prior: Any, origin: Array) -> Components:
    """Return the prior as it is given, in z = x - origin; a density as the points of a grid."""
    if isinstance(prior, DensityPrior):
        grid = density_grid(model, prior, model.theta())
        logs = grid.log_values.ravel() + np.log(abs(np.linalg.det(grid.basis)))
        means = grid.points.reshape(-1, model.n)
        return components(logs, means - origin, np.zeros((len(means), model.n, model.n)))
    weights, means, covs = prior.components
    return components(np.log(weights), means - origin, covs)


def difference(start: Components, prior: Components, angles: tuple[int, ...]) -> float:
    """Return how far a start is from the prior: the largest error of its mass, of a mean in deviations, and of a variance.

    Of an angle a the mean of e^{ia} is compared, which is the same however it is cut: 1 - |E e^{ia}|^2 is its variance.
    """
    start = Components(*(array.real for array in start))
    (share, log_mass), (wanted, unit) = shares(start), shares(prior)
    mean, cov = moments(share, start.means, start.covs)
    centre, spread = moments(wanted, prior.means, prior.covs)
    variance = np.diag(spread).copy()
    shift, excess = mean - centre, np.diag(cov) - variance
    for i in angles:
        own, other = (
            np.sum(p * np.exp(1j * s.means[:, i] - 0.5 * s.covs[:, i, i])) for p, s in ((share, start), (wanted, prior))
        )
        length = abs(other)
        turned = own * (np.conj(other) / length if length > 1e-9 else 1.0)
        shift[i], excess[i] = turned.imag, 2.0 * (turned.real - length)
        # What is narrower than this is below the rounding of 1.
        variance[i] = max(1.0 - length**2, 1e-12)
    scale = np.where(variance > 0, variance, 1.0)
    wrong = np.where(variance > 0, np.maximum(np.abs(shift) / np.sqrt(scale), np.abs(excess) / scale), 0.0)
    worst = max(abs(np.expm1(log_mass - unit)), float(np.max(wrong)))
    return float("inf") if np.isnan(worst) else float(worst)
