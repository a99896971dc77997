"""The filter of the volatility once more, on a grid in plain NumPy.  Nothing here uses zakai."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr


def grid_filter(returns: np.ndarray, p: dict, points: int = 401) -> tuple[np.ndarray, ...]:
    """Bayes' rule on `points` log variances, for one return a day from day 1; the law at day 0 is stationary.

    Gives the mean of x after each return (K,), the log density of each given those before it (K,), and the probability, given
    those, that a return is at most what it was (K,).
    """
    spread = p["s"] / np.sqrt(2 * p["k"])
    x = spread * np.linspace(-7, 7, points)
    decay = np.exp(-p["k"])
    day = np.exp(-0.5 * ((x[:, None] - decay * x) / spread) ** 2 / (1 - decay**2))
    day /= day.sum(axis=0)
    deviation = np.exp(0.5 * (p["mu"] + x))
    density = np.exp(-0.5 * (x / spread) ** 2)
    density /= density.sum()
    mean, increments, below = np.empty((3, len(returns)))
    for k, value in enumerate(returns):
        density = day @ density
        scaled = (value - p["m"]) / deviation
        below[k] = density @ ndtr(scaled)
        density = density * np.exp(-0.5 * scaled**2) / (np.sqrt(2 * np.pi) * deviation)
        increments[k] = np.log(density.sum())
        density = density / density.sum()
        mean[k] = density @ x
    return mean, increments, below
