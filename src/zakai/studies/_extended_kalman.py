"""The extended Kalman-Bucy filter of a scalar system with two sensors of unit noise, for many paths at once.

    dm = f dt + P h'.(dy - h dt),    dP/dt = 2 F P + G - |h'|^2 P^2,    F = df/dx, h' = dh/dx at m,

either by explicit Euler, or by a splitting whose variance stays positive: half of the observation as a Kalman update, the exact
moments of the system linearised at the middle of the step, the other half.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Function = Callable[[np.ndarray, float], np.ndarray]
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)


def extended_kalman(
    drift: Function,
    drift_slope: Function,
    observation: Callable[[np.ndarray], np.ndarray],
    observation_slope: Callable[[np.ndarray], np.ndarray],
    increments: np.ndarray,
    step: float,
    first: np.ndarray,
    variances: np.ndarray,
    stable: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the estimates of every path from every first estimate, and which of them lost their variance.

    Args:
        drift: f(x, t).
        drift_slope: df/dx (x, t).
        observation: h(x) (..., 2) of x (...).
        observation_slope: dh/dx (..., 2).
        increments: of the observation (paths, steps, 2).
        step: length of an interval.
        first: first estimates (settings, paths).
        variances: their variances (settings,).
        stable: whether to split, instead of explicit Euler.

    Returns:
        The means (settings, paths, steps + 1), and whether a variance became negative or not finite (settings, paths).
    """
    steps = increments.shape[1]
    mean, cov = first.copy(), np.broadcast_to(variances[:, None], first.shape).copy()
    means, lost = np.empty((*first.shape, steps + 1)), np.zeros(first.shape, bool)
    means[..., 0] = first
    with np.errstate(all="ignore"):
        for k in range(steps):
            t, rate = k * step, increments[:, k] / step
            if stable:
                mean, cov = _update(observation, observation_slope, mean, cov, rate, 2.0 / step)
                mean, cov = _predict(drift, drift_slope, mean, cov, t, step)
                mean, cov = _update(observation, observation_slope, mean, cov, rate, 2.0 / step)
            else:
                h, slope = observation(mean), observation_slope(mean)
                gain = cov[..., None] * slope
                growth = 2.0 * drift_slope(mean, t) * cov + 1.0 - np.sum(gain**2, axis=-1)
                mean = mean + step * (drift(mean, t) + np.sum(gain * (rate - h), axis=-1))
                cov = cov + step * growth
            means[..., k + 1] = mean
            lost |= ~((cov >= 0) & np.isfinite(mean))
    return means, lost


def _update(
    observation: Callable[[np.ndarray], np.ndarray],
    observation_slope: Callable[[np.ndarray], np.ndarray],
    mean: np.ndarray,
    cov: np.ndarray,
    value: np.ndarray,
    noise: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the moments given value = h(x) + N(0, noise I)."""
    slope = observation_slope(mean)
    total = noise + cov * np.sum(slope**2, axis=-1)
    innovation = np.sum(slope * (value - observation(mean)), axis=-1)
    return mean + cov / total * innovation, cov * noise / total


def _predict(
    drift: Function, drift_slope: Function, mean: np.ndarray, cov: np.ndarray, t: float, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the moments after a step of the system linearised at its middle."""
    centre = mean + 0.5 * step * drift(mean, t) * (1.0 + 0.25 * step * drift_slope(mean, t))
    slope = drift_slope(centre, t + 0.5 * step)
    drifted, spread = np.zeros_like(mean), np.zeros_like(mean)
    for node, weight in zip(0.5 * step * (_NODES + 1.0), 0.5 * step * _WEIGHTS, strict=True):
        decay = np.exp(slope * (step - node))
        drifted += weight * decay * drift(centre, t + node)
        spread += weight * decay**2
    whole = np.exp(slope * step)
    return centre + whole * (mean - centre) + drifted, whole**2 * cov + spread
