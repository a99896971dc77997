"""The cyclist's filter once more, as a histogram of position and speed in plain NumPy.  Nothing here uses zakai."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.special import ndtr


def transition(tau: float, speeds: np.ndarray, bins: int, p: dict) -> np.ndarray:
    """Return the law of a step for each frequency of the position, (bins // 2 + 1, speeds after, speeds before).

    The speed is an Ornstein-Uhlenbeck process and the position its integral, so that both are jointly Gaussian given the speed
    before; given the speed after too, the position moves by a Gaussian amount of known mean and variance.
    """
    v0, relax, variance = p["v0"], p["relax"], p["spread"] ** 2
    decay = np.exp(-tau / relax)
    before, after = speeds - v0, speeds[:, None] - v0
    of_speed = variance * (1 - decay**2)
    common = variance * relax * (1 - decay) ** 2
    of_distance = 2 * variance * relax * (tau - 2 * relax * (1 - decay) + 0.5 * relax * (1 - decay**2))
    weights = np.exp(-0.5 * (after - decay * before) ** 2 / of_speed)
    weights /= weights.sum(axis=0)
    mean = v0 * tau + relax * (1 - decay) * before + common / of_speed * (after - decay * before)
    f = np.arange(bins // 2 + 1)[:, None, None]
    return weights * np.exp(-1j * f * mean - 0.5 * f**2 * (of_distance - common**2 / of_speed))


def histogram_filter(times: np.ndarray, observations: np.ndarray, table: np.ndarray, p: dict, bins: int = 768, rows: int = 40):
    """Filter with a histogram of `bins` positions and `rows` speeds, from any position and a stationary speed at the time 0.

    Gives the positions (bins,), the posterior of the position after each observation (K, bins), the mean speed (K,), the log
    density of each observation given those before it (K,), and the probability, given those, that it is at most what it was.
    """
    phi = -np.pi + 2 * np.pi * np.arange(bins) / bins
    speeds = p["v0"] + p["spread"] * np.linspace(-5.5, 5.5, rows)
    altitude = make_interp_spline(*table.T, k=3, bc_type="periodic")(phi)
    density = np.exp(-0.5 * ((speeds - p["v0"]) / p["spread"]) ** 2)[:, None] * np.ones(bins)
    density /= density.sum()
    kernels: dict[float, np.ndarray] = {}
    posterior, (speed, increments, below) = np.empty((len(times), bins)), np.empty((3, len(times)))
    for k, (tau, observation) in enumerate(zip(np.diff(times, prepend=0.0).tolist(), observations, strict=True)):
        if tau > 0:
            if tau not in kernels:
                kernels[tau] = transition(tau, speeds, bins, p)
            moved = kernels[tau] @ np.fft.rfft(density).T[:, :, None]
            density = np.maximum(np.fft.irfft(moved[:, :, 0].T, bins), 0)
        residual = (observation - altitude) / p["r"]
        below[k] = density.sum(axis=0) @ ndtr(residual)
        density = density * np.exp(-0.5 * residual**2) / np.sqrt(2 * np.pi * p["r"] ** 2)
        increments[k] = np.log(density.sum())
        density = density / density.sum()
        posterior[k], speed[k] = density.sum(axis=0), density.sum(axis=1) @ speeds
    return phi, posterior, speed, increments, below


def level_of_truth(phi: np.ndarray, posterior: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the mass (K,) of the region of larger density than at the truth: uniformly distributed if the filter is right."""
    places = np.round((truth - phi[0]) / (phi[1] - phi[0])).astype(int) % len(phi)
    there = posterior[np.arange(len(truth)), places]
    return np.where(posterior > there[:, None], posterior, 0).sum(axis=1)
