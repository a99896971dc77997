"""A box around the peaks of a density of which only the logarithm is known."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from zakai.errors import InputError

Array = np.ndarray
# Widenings of a step by one half: at a jump the search ends with steps as small as 1e-50.
_SEARCH_STEPS, _WIDENINGS = 150, 400
_FARTHEST = 1e13


def box_of_peaks(
    evaluate: Callable[[Array, Array], Array], n: int, angles: tuple[bool, ...], tolerance: float, source: str
) -> tuple[Array, Array]:
    """Return a box (low, high) around the peaks, by pattern search from starts at all scales."""
    origin = np.zeros(n)

    def value(x: Array) -> Array:
        logs = evaluate(origin, x).real
        return np.where(np.isnan(logs) | (logs == np.inf) | (np.abs(x).max(axis=-1) > _FARTHEST), -np.inf, logs)

    decades = 10.0 ** {1: np.arange(-6, 7, 0.5), 2: np.arange(-4, 7, 1.0), 3: np.arange(-3, 7, 1.5), 4: np.arange(-2, 5, 2.0)}[n]
    line = np.concatenate([-decades[::-1], [0.0], decades]) * 1.37
    circle = np.linspace(-np.pi, np.pi, 9)[:-1] + 0.2
    lines = [circle if angle else line for angle in angles]
    x = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, n)
    if n <= 2:  # peaks between the decades
        near = np.linspace(-10, 10, 201 if n == 1 else 41)
        close = np.stack(np.meshgrid(*[circle if angle else near for angle in angles], indexing="ij"), axis=-1).reshape(-1, n)
        x = np.concatenate([x, close])
    steps = np.where(angles, 0.3, np.maximum(0.3 * np.abs(x), 1e-3))
    best = value(x)
    alive = np.isfinite(best)
    if not alive.any():
        raise InputError(f"{source} is not finite anywhere; give a density")
    x, steps, best = x[alive], steps[alive], best[alive]
    order = np.argsort(-best, kind="stable")[: 400 if n < 3 else 200]
    x, steps, best = x[order], steps[order], best[order]
    moves = np.concatenate([np.eye(n), -np.eye(n)])
    if n > 1:
        moves = np.concatenate([moves, np.array(list(itertools.product([-1.0, 1.0], repeat=n)))])
    for _ in range(_SEARCH_STEPS):
        trials = x[:, None, :] + moves * steps[:, None, :]
        logs = value(trials.reshape(-1, n)).reshape(len(x), -1)
        choice = np.argmax(logs, axis=1)
        rows = np.arange(len(x))
        better = logs[rows, choice] > best
        x[better], best[better] = trials[rows, choice][better], logs[rows, choice][better]
        along = np.abs(moves[choice]) > 0
        # Axes along which the neighbours are far lower have too long a step.
        steep = np.stack([np.max(logs[:, [i, n + i]], axis=1) < best - 1.0 for i in range(n)], axis=1)
        flat = np.stack([np.min(logs[:, [i, n + i]], axis=1) > best - 0.01 for i in range(n)], axis=1)
        steps = np.where(better[:, None] & along, 2.0 * steps, np.where(steep, 0.5 * steps, np.where(flat, 2.0 * steps, steps)))
        steps = np.where(better[:, None] | steep | flat, steps, 0.7 * steps)
        steps = np.where(angles, np.minimum(steps, 1.0), np.maximum(steps, 4e-16 * np.abs(x)))
    depth = 3.0 - np.log(tolerance)
    peaks = best >= best.max() - depth
    x, steps, best = x[peaks], steps[peaks], best[peaks]
    low, high = x.min(axis=0), x.max(axis=0)
    for i in np.flatnonzero(~np.array(angles)):
        for sign in (-1.0, 1.0):
            reach = steps[:, i].copy()
            for _ in range(_WIDENINGS):
                end = x.copy()
                end[:, i] += sign * reach
                grows = value(end) >= best.max() - depth
                if not grows.any():
                    break
                reach = np.where(grows, 1.5 * reach, reach)
            else:
                raise InputError(f"{source} does not decay in coordinate {i + 1}, so it is not a density")
            if np.max(np.abs(x[:, i] + sign * reach)) >= _FARTHEST:
                raise InputError(f"{source} does not decay in coordinate {i + 1}, so it is not a density")
            if sign < 0:
                low[i] = np.min(x[:, i] - reach)
            else:
                high[i] = np.max(x[:, i] + reach)
    return np.where(angles, -np.pi, low), np.where(angles, np.pi, high)
