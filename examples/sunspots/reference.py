"""The sunspots' filter once more, in plain NumPy, to check the fast one against.  Nothing here uses zakai."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

START, MEAN, VARIANCE, OFFSET = 1699.5, 0.1, 0.25, 10.0


def grid_filter(times: np.ndarray, observations: np.ndarray, p: dict, bins: int = 512, steps: int = 32):
    """Bayes' rule on a circle of `bins` phases, for yearly observations; a year's transition is the power of a short one.

    A short one is normal about phi + h f + h^2 (f f' + sigma^2 f'' / 2) / 2, of variance sigma^2 h (1 + h f').  Gives the mean of
    the field A sin(phi) after each observation (K,), the log density of each given the past (K,), and the probability,
    given those, that it is not above what was read (K,).
    """
    phi, h = 2 * np.pi * np.arange(bins) / bins, 1 / steps
    f = p["omega"] * (1 + p["eps"] * np.sin(2 * phi))
    slope = 2 * p["omega"] * p["eps"] * np.cos(2 * phi)
    curvature = -4 * p["omega"] * p["eps"] * np.sin(2 * phi)
    distance = np.angle(np.exp(1j * (phi[:, None] - phi - h * f - 0.5 * h**2 * (f * slope + 0.5 * p["sigma"] ** 2 * curvature))))
    short = np.exp(-0.5 * distance**2 / (p["sigma"] ** 2 * h * (1 + h * slope)))
    year = np.linalg.matrix_power(short / short.sum(axis=0), steps)
    B = p["A"] * np.sin(phi)
    density = np.exp(-0.5 * np.angle(np.exp(1j * (phi - MEAN))) ** 2 / VARIANCE)
    density /= density.sum()
    field, increments, below = np.empty((3, len(times)))
    for k, (length, observation) in enumerate(zip(np.diff(times, prepend=START), observations, strict=True)):
        assert length == 1
        density = year @ density
        residual = (observation - np.sqrt(B**2 + OFFSET)) / p["r"]
        below[k] = density @ ndtr(residual)
        density = density * np.exp(-0.5 * residual**2) / np.sqrt(2 * np.pi * p["r"] ** 2)
        increments[k] = np.log(density.sum())
        density = density / density.sum()
        field[k] = B @ density
    return field, increments, below
