"""The optimal filter of a scalar system in discrete time: Bayes' rule on a grid, in plain NumPy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

CELL = 0.05
REACH = 9.0  # standard deviations of the Gaussian transition that are summed
NEGLIGIBLE = 1e-30
_BLOCK = 64


def grid_optimal(
    drift: Callable[[np.ndarray, float], np.ndarray],
    observation: Callable[[np.ndarray], np.ndarray],
    increments: np.ndarray,
    step: float,
    prior_means: np.ndarray,
    prior_variances: np.ndarray,
    half_width: float,
    progress: Callable[[], None] = lambda: None,
) -> np.ndarray:
    """The posterior means of the Euler model, for many paths and priors at once.

        x_k = x_{k-1} + f(x_{k-1}, t_{k-1}) dt + N(0, dt),     dy_k = h(x_{k-1}) dt + N(0, dt 1)

    drift: f(x, t), increasing x + f dt in x. observation: h(x) (points, m). increments: dy (paths, steps, m). prior_means and
    prior_variances: (settings, paths) and (settings,). half_width: the grid reaches from -half_width to half_width; what leaves
    it is lost. Gives E[x_k | dy_1 .. dy_k] (settings, paths, steps + 1), the prior's mean first.
    """
    points = CELL * np.arange(-round(half_width / CELL), round(half_width / CELL) + 1)
    h = observation(points)
    energy = 0.5 * step * np.sum(h**2, axis=1)[:, None]
    steps = increments.shape[1]
    means = np.empty((*prior_means.shape, steps + 1))
    means[..., 0] = prior_means
    logs = -((points[:, None, None] - prior_means) ** 2) / (2 * prior_variances[:, None])
    density = np.exp(logs - logs.max(axis=0))
    for k in range(steps):
        weight = h @ increments[:, k].T - energy
        density *= np.exp(weight - weight.max(axis=0))[:, None, :]
        density = _transition(points, points + step * drift(points, k * step), step, density)
        density /= density.sum(axis=0)
        means[..., k + 1] = np.tensordot(points, density, axes=1)
        progress()
    return means


def _transition(points: np.ndarray, images: np.ndarray, step: float, density: np.ndarray) -> np.ndarray:
    """sum_j N(x_i; moved_j, step) density_j, a block of rows at a time, for the rows that anything can reach.

    Beyond `REACH` deviations the Gaussian is zero, and so is a probability below `NEGLIGIBLE`.
    """
    flat = density.reshape(len(points), -1)
    out = np.zeros_like(flat)
    reach = REACH * np.sqrt(step)
    used = images[np.flatnonzero(flat.max(axis=1) > NEGLIGIBLE)[[0, -1]]]
    begin, end = np.searchsorted(points, [used[0] - reach, used[1] + reach])
    for first in range(begin, end, _BLOCK):
        rows = points[first : min(first + _BLOCK, end)]
        low, high = np.searchsorted(images, [rows[0] - reach, rows[-1] + reach])
        kernel = np.exp(-((rows[:, None] - images[low:high]) ** 2) / (2 * step))
        out[first : first + len(rows)] = kernel @ flat[low:high]
    return out.reshape(density.shape)
