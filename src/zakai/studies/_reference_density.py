"""Converged solutions of the filtering equation in plain NumPy and SciPy, which share no code with the filters.

    sigma_t = G:Hess sigma / 2 - div(f sigma) - |h|^2 sigma / 2 + h . y' sigma,     y linear between observations
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import lapack

Function = Callable[[np.ndarray], np.ndarray]
STABLE = 4.0  # decay of the fastest mode in a step; DOP853 is stable up to about 6


@dataclass(frozen=True, eq=False)
class Solution:
    """`points` (*grid, n), the normalised `densities` (K, *grid), and the `evidence` (K,), log of the mass that is left."""

    points: np.ndarray
    densities: np.ndarray
    evidence: np.ndarray
    cell: float

    @property
    def means(self) -> np.ndarray:
        """(K, n)."""
        return self.cell * np.tensordot(self.densities, self.points, axes=self.points.ndim - 1)

    @property
    def deviations(self) -> np.ndarray:
        """The standard deviations (K, n)."""
        second = self.cell * np.tensordot(self.densities, self.points**2, axes=self.points.ndim - 1)
        return np.sqrt(second - self.means**2)


def conditional_densities(
    drift: Function,
    observation: Function,
    covariance: np.ndarray,
    prior: Function,
    times: np.ndarray,
    increments: np.ndarray,
    half_width: float,
    count: int,
    tolerance: float = 1e-11,
    frozen: bool = False,
) -> Solution:
    """The density after each observation, by Fourier collocation on a periodic box and DOP853, in one or two states.

    drift, observation: of points (..., n), giving (..., n) and (..., m); observation noise is white. covariance: G (n, n).
    prior: the initial density up to a factor. increments: (K, m). The box reaches from -half_width to half_width, `count` points
    an axis, and must be wide enough for the density to vanish at its edge. frozen: y stays where it is until an observation.
    """
    n = len(covariance)
    axis = half_width * (2 * np.arange(count) / count - 1)
    points = np.stack(np.meshgrid(*[axis] * n, indexing="ij"), axis=-1)
    waves = np.stack(np.meshgrid(*[2 * np.pi * np.fft.fftfreq(count, 2 * half_width / count)] * n, indexing="ij"), axis=-1)
    diffusion = -0.5 * np.einsum("...i,ij,...j->...", waves, covariance, waves)
    over, f, h = tuple(range(n)), drift(points), observation(points)
    cell, energy = (2 * half_width / count) ** n, 0.5 * np.sum(h**2, axis=-1)
    sigma = prior(points)
    sigma = sigma / (sigma.sum() * cell)
    densities: list[np.ndarray] = []
    evidence: list[float] = []
    before = 0.0
    for time, increment in zip(times, increments, strict=True):
        rate = -energy if frozen else h @ increment / (time - before) - energy

        def slope(t: float, values: np.ndarray, rate: np.ndarray = rate) -> np.ndarray:
            now = values.reshape(diffusion.shape)
            spectrum = diffusion * np.fft.fftn(now)
            spectrum = spectrum - sum(1j * waves[..., i] * np.fft.fftn(f[..., i] * now, axes=over) for i in range(n))
            return (np.fft.ifftn(spectrum, axes=over).real + rate * now).ravel()

        # At its limit of stability the solver's own estimate misses errors of 1e-6.
        longest = STABLE / (np.abs(diffusion).max() + np.abs(rate).max())
        solved = solve_ivp(
            slope, (before, time), sigma.ravel(), "DOP853", rtol=tolerance, atol=tolerance * sigma.max(), t_eval=[time],
            max_step=longest,
        )  # fmt: skip
        sigma = solved.y[:, -1].reshape(diffusion.shape) * (np.exp(h @ increment) if frozen else 1.0)
        mass = sigma.sum() * cell
        sigma, before = sigma / mass, time
        densities.append(sigma)
        evidence.append((evidence[-1] if evidence else 0.0) + np.log(mass))
    return Solution(points, np.array(densities), np.array(evidence), cell)


def crank_nicolson(
    drift: Function,
    observation: Function,
    log_prior: Function,
    increments: np.ndarray,
    step: float,
    axis: np.ndarray,
    progress: Callable[[], None] = lambda: None,
) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances (paths, K) of one state with G = 1 and one observation, for many paths (paths, K) at once.

    Half of the likelihood exp(h dy - h^2 dt / 2), Crank and Nicolson's step of the Kolmogorov equation in finite volumes, which
    keeps the mass, and the other half. `axis` is an equidistant grid wide enough for every path; `progress` is called now and
    then.
    """
    cell = axis[1] - axis[0]
    middle, rate = drift(0.5 * (axis[1:] + axis[:-1])) / 2, 0.5 / cell**2
    down, up = rate + middle / cell, rate - middle / cell
    diagonal = -(np.append(down, 0.0) + np.append(0.0, up))
    factors = lapack.dgttrf(-0.5 * step * down, 1 - 0.5 * step * diagonal, -0.5 * step * up)[:-1]
    h = observation(axis)[:, None]
    density = np.repeat(np.exp(log_prior(axis))[:, None], len(increments), axis=1)
    means, variances = np.empty(increments.shape), np.empty(increments.shape)
    for k, increment in enumerate(increments.T):
        logs = 0.5 * (h * increment - 0.5 * step * h**2)
        # The tails' factors overflow where nothing of the density is.
        top = np.where(density > 1e-13 * density.max(axis=0), logs, -np.inf).max(axis=0)
        factor = np.exp(np.minimum(logs - top, 40.0))
        density = density * factor
        right = diagonal[:, None] * density
        right[1:] += down[:, None] * density[:-1]
        right[:-1] += up[:, None] * density[1:]
        density = np.maximum(lapack.dgttrs(*factors, density + 0.5 * step * right)[0], 0.0) * factor
        density /= density.sum(axis=0)
        if k % 100 == 0:
            progress()
        means[:, k] = axis @ density
        variances[:, k] = axis**2 @ density - means[:, k] ** 2
    return means, variances
