"""What series are drawn with: few points that keep the extremes, and a logarithmic scale where it can be."""

from __future__ import annotations

import numpy as np

MOST_POINTS = 4000


def on_log_scale(values: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the values to draw, and whether the scale is logarithmic; zeros are then a decade below the rest."""
    finite = values[np.isfinite(values)]
    if not finite.size or finite.min() < 0 or finite.max() == 0:
        return values, False
    floor = max(finite[finite > 0].min() / 10, 1e-300)
    return np.where(values == 0, floor, values), True


def thinned(values: np.ndarray, most: int = MOST_POINTS) -> np.ndarray:
    """Return the positions of at most `most` values: the smallest and the largest of every part, so that no extreme is lost."""
    count = len(values)
    if count <= most:
        return np.arange(count)
    low = np.where(np.isfinite(values), values, np.inf)
    high = np.where(np.isfinite(values), values, -np.inf)
    size = -(-count // (most // 2))
    whole = count - count % size
    starts = np.arange(0, whole, size)
    kept = np.concatenate([starts + low[:whole].reshape(-1, size).argmin(1), starts + high[:whole].reshape(-1, size).argmax(1)])
    rest = [] if whole == count else [whole + int(np.argmin(low[whole:])), whole + int(np.argmax(high[whole:]))]
    return np.unique(np.concatenate([kept, np.array(rest, dtype=int)]))
