"""The wind vane's filters once more, in plain NumPy and slowly, to check the fast one against.  Nothing here uses zakai.

    dtheta = sigma dv,    z_k = (cos theta, sin theta) + r e_k,    e_k ~ N(0, I),    theta uniform on the circle at first

`times` is (K,), `observations` (K, 2), with NaN where no direction was reported. A filter gives (direction, increments): the
complex mean E exp(i theta) after each observation, (K,), and the log density of each observation given the past, (K,), zero
where no direction was reported.
"""

from __future__ import annotations

import numpy as np
from scipy.special import i0e


def grid_filter(times: np.ndarray, observations: np.ndarray, sigma: float, r: float, bins: int = 720):
    """Bayes' rule on a circle of `bins` points.

    The prediction sums wrapped normal densities: all terms are positive, so that an improbable turn of the wind keeps its digits.
    """
    theta = 2 * np.pi * np.arange(bins) / bins
    points = np.column_stack([np.cos(theta), np.sin(theta)])
    density = np.full(bins, 1 / (2 * np.pi))
    cell, kernels = 2 * np.pi / bins, {}
    direction, increments = np.empty(len(times), complex), np.zeros(len(times))
    for k, (length, z) in enumerate(zip(np.diff(times, prepend=0.0), observations, strict=True)):
        if length > 0:
            if length not in kernels:
                row = sum(_normal(theta + 2 * np.pi * turn, sigma**2 * length) for turn in range(-4, 5)) * cell
                kernels[length] = row[(np.arange(bins)[:, None] - np.arange(bins)) % bins]
            density = kernels[length] @ density
        if not np.isnan(z).any():
            exponent = -np.sum((z - points) ** 2, axis=1) / (2 * r**2)
            density = density * np.exp(exponent - exponent.max())
            mass = density.sum() * cell
            increments[k] = np.log(mass) + exponent.max() - np.log(2 * np.pi * r**2)
            density = density / mass
        direction[k] = np.exp(1j * theta) @ density * cell
    return direction, increments


def particle_filter(
    times: np.ndarray, observations: np.ndarray, sigma: float, r: float, particles: int, generator: np.random.Generator
):
    """The bootstrap filter: move at random, weigh, resample systematically after every observation."""
    theta = generator.uniform(-np.pi, np.pi, particles)
    direction, increments = np.empty(len(times), complex), np.zeros(len(times))
    for k, (length, z) in enumerate(zip(np.diff(times, prepend=0.0), observations, strict=True)):
        theta = theta + sigma * np.sqrt(length) * generator.standard_normal(particles)
        cos, sin = np.cos(theta), np.sin(theta)
        if np.isnan(z).any():
            direction[k] = cos.mean() + 1j * sin.mean()
            continue
        exponent = -((z[0] - cos) ** 2 + (z[1] - sin) ** 2) / (2 * r**2)
        weights = np.exp(exponent - exponent.max())
        increments[k] = np.log(weights.mean()) + exponent.max() - np.log(2 * np.pi * r**2)
        ladder = np.cumsum(weights)
        direction[k] = (weights @ cos + 1j * (weights @ sin)) / ladder[-1]
        rungs = (generator.uniform() + np.arange(particles)) * (ladder[-1] / particles)
        theta = theta[np.minimum(np.searchsorted(ladder, rungs), particles - 1)] % (2 * np.pi)
    return direction, increments


def extended_kalman_filter(times: np.ndarray, observations: np.ndarray, sigma: float, r: float):
    """A Gaussian for the angle, h = (cos, sin) linearised at its mean; from the mean and variance of a uniform angle.

    Gives (mean (K,), increments (K,), predicted observation (K, 2), its covariance (K, 2, 2)).
    """
    mean, variance = 0.0, np.pi**2 / 3
    means, increments = np.empty(len(times)), np.zeros(len(times))
    predicted, spread = np.empty((len(times), 2)), np.empty((len(times), 2, 2))
    for k, (length, z) in enumerate(zip(np.diff(times, prepend=0.0), observations, strict=True)):
        variance = variance + sigma**2 * length
        predicted[k] = np.cos(mean), np.sin(mean)
        slope = np.array([-np.sin(mean), np.cos(mean)])
        spread[k] = variance * np.outer(slope, slope) + r**2 * np.eye(2)
        if not np.isnan(z).any():
            residual = z - predicted[k]
            increments[k] = -0.5 * residual @ np.linalg.solve(spread[k], residual) - np.log(2 * np.pi)
            increments[k] -= 0.5 * np.log(np.linalg.det(spread[k]))
            # The slope is a unit vector: the gain and the new variance are those of one observation of the angle.
            gain = variance / (variance + r**2)
            mean, variance = mean + gain * (slope @ residual), (1 - gain) * variance
        mean = np.angle(np.exp(1j * mean))
        means[k] = mean
    return means, increments, predicted, spread


def angle_kalman_filter(times: np.ndarray, angles: np.ndarray, sigma: float, r: float):
    """The engineer's way out: the observation is the angle itself with noise of deviation r, and its innovation is wrapped.

    Gives (mean (K,), the log density of each angle on the circle (K,)): the predicted Gaussian, wrapped.
    """
    mean, variance = 0.0, np.pi**2 / 3
    means, increments = np.empty(len(times)), np.zeros(len(times))
    for k, (length, angle) in enumerate(zip(np.diff(times, prepend=0.0), angles, strict=True)):
        variance = variance + sigma**2 * length
        if not np.isnan(angle):
            innovation = np.angle(np.exp(1j * (angle - mean)))
            total = variance + r**2
            increments[k] = np.log(sum(_normal(innovation + 2 * np.pi * turn, total) for turn in range(-3, 4)))
            mean = np.angle(np.exp(1j * (mean + variance / total * innovation)))
            variance = variance * r**2 / total
        means[k] = mean
    return means, increments


def log_length_density(r: float) -> float:
    """The log density of an observation's length at 1, |z| = 1, per unit of length; it is the same for every theta.

    In polar coordinates an observation is rho exp(i alpha) and, with kappa = 1 / r^2,

        p(rho, alpha | theta) = rho kappa / (2 pi) exp(-kappa (rho^2 + 1 - 2 rho cos(alpha - theta)) / 2),

    so that at rho = 1 the length contributes kappa exp(-kappa) I_0(kappa), and the direction is von Mises about theta.
    """
    kappa = 1 / r**2
    return float(np.log(kappa * i0e(kappa)))


def log_length_density_gaussian(variance: np.ndarray, r: np.ndarray, points: int = 720) -> np.ndarray:
    """The same for the extended Kalman filter, whose angle has `variance` before the observation; all of one shape.

    Its prediction of the observation is a Gaussian about a point of the unit circle, of variance r^2 across the circle and
    variance + r^2 along it; this is the integral of its density over the circle, wherever the point is.
    """
    angle = 2 * np.pi * np.arange(points) / points
    across, along = np.asarray(r) ** 2, np.asarray(variance) + np.asarray(r) ** 2
    exponent = -0.5 * ((np.cos(angle) - 1) ** 2 / across[..., None] + np.sin(angle) ** 2 / along[..., None])
    total = np.exp(exponent).sum(axis=-1) * 2 * np.pi / points  # the largest exponent is 0, at the point
    return np.log(total) - np.log(2 * np.pi) - 0.5 * np.log(across * along)


def extended_kalman_scores(times: np.ndarray, observations: np.ndarray, sigma: np.ndarray, r: np.ndarray) -> np.ndarray:
    """The log density of all the directions under the extended Kalman filter, (P,), for many sigma (P,) and r (P,) at once."""
    mean, variance, total = np.zeros(len(sigma)), np.full(len(sigma), np.pi**2 / 3), np.zeros(len(sigma))
    for length, z in zip(np.diff(times, prepend=0.0), observations, strict=True):
        variance = variance + sigma**2 * length
        if not np.isnan(z).any():
            cos, sin = np.cos(mean), np.sin(mean)
            across, along = z[0] * cos + z[1] * sin - 1, z[1] * cos - z[0] * sin
            spread = variance + r**2
            total += -0.5 * (across**2 / r**2 + along**2 / spread) - np.log(2 * np.pi) - 0.5 * np.log(r**2 * spread)
            total -= log_length_density_gaussian(variance, r, points=240)
            mean, variance = mean + variance / spread * along, variance * r**2 / spread
    return total


def grid_filter_with_rate(times: np.ndarray, values: np.ndarray, model: dict[str, float], angles: int = 96, rates: int = 112):
    """Bayes' rule on a grid for the vane with a rate: dtheta = rate dt + sigma dv, drate = -k rate dt + sigma_rate dv'.

    `model` holds k, sigma, sigma_rate, r and the prior's variances about zero, `angle_variance` and `rate_variance`. Given the
    rate before and after, the angle gains a Gaussian amount: one matrix product for each gain on the grid, all terms positive.
    Gives (direction (K,), mean rate (K,), increments (K,)).
    """
    k_, sigma, sigma_rate, r = (model[name] for name in ("k", "sigma", "sigma_rate", "r"))
    theta = 2 * np.pi * np.arange(angles) / angles
    reach = 8.5 * np.sqrt(max(model["rate_variance"], sigma_rate**2 / (2 * k_)))
    rate = np.linspace(-reach, reach, rates)
    cell = (theta[1] - theta[0]) * (rate[1] - rate[0])
    turns = 2 * np.pi * np.arange(-8, 9)[:, None]
    density = _normal(theta + turns, model["angle_variance"]).sum(axis=0)[:, None] * _normal(rate, model["rate_variance"])
    points = np.column_stack([np.cos(theta), np.sin(theta)])
    direction, mean_rate = np.empty(len(times), complex), np.empty(len(times))
    increments, kernels = np.zeros(len(times)), {}
    for k, (length, z) in enumerate(zip(np.diff(times, prepend=0.0), values, strict=True)):
        if length > 0:
            if length not in kernels:
                kernels[length] = _rate_kernel(theta, rate, length, k_, sigma, sigma_rate) * cell
            density = sum(np.roll(density, shift, axis=0) @ kernel for shift, kernel in enumerate(kernels[length]))
        if not np.isnan(z).any():
            exponent = -np.sum((z - points) ** 2, axis=1) / (2 * r**2)
            density = density * np.exp(exponent - exponent.max())[:, None]
            increments[k] = np.log(density.sum() * cell) + exponent.max() - np.log(2 * np.pi * r**2)
        density = density / (density.sum() * cell)
        direction[k] = np.exp(1j * theta) @ density.sum(axis=1) * cell
        mean_rate[k] = density.sum(axis=0) @ rate * cell
    return direction, mean_rate, increments


def _rate_kernel(theta, rate, length, k, sigma, sigma_rate):
    """p(gain of the angle, rate after | rate before), (angles, rates before, rates after), from the exact Gaussian law."""
    decay = np.exp(-k * length)
    map_angle = (1 - decay) / k
    cov_rate = sigma_rate**2 * (1 - decay**2) / (2 * k)
    cov_both = sigma_rate**2 * (1 - decay) ** 2 / (2 * k**2)
    cov_angle = sigma**2 * length + (sigma_rate / k) ** 2 * (length - 2 * map_angle + (1 - decay**2) / (2 * k))
    surprise = rate[None, :] - decay * rate[:, None]
    gain = map_angle * rate[:, None] + cov_both / cov_rate * surprise
    left = cov_angle - cov_both**2 / cov_rate
    turns = 2 * np.pi * np.arange(-6, 7)
    wrapped = sum(_normal(theta[:, None, None] + turn - gain, left) for turn in turns)
    return wrapped * _normal(surprise, cov_rate)


def _normal(x: np.ndarray, variance: float) -> np.ndarray:
    return np.exp(-0.5 * x**2 / variance) / np.sqrt(2 * np.pi * variance)
