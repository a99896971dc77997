"""The transition of the Kolmogorov forward equation in one state as a matrix, where neither drift nor noise depends on time.

    u_t = -(f u)' + G u'' / 2        so that        u(tau) = exp(tau L) u(0)

On a lattice that resolves the density and holds it, the derivatives are those of the trigonometric interpolant, accurate to
rounding, and L is a matrix.  Its exponential is exact in time, however steep f is or long tau.  That the interpolant is periodic
does not matter: near the ends there is nothing of the density.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from zakai.kolmogorov.comoving import derivative, frequencies


def transition(drift: np.ndarray, covariance: float, tau: float) -> np.ndarray:
    """exp(tau L) (N, N), for f at the N points of a lattice and G, both in cells a unit of time; N is even.

    It keeps the sum of what it is applied to.
    """
    size = len(drift)
    # Of the real interpolant the highest frequency has a second derivative, and no first.
    bend = np.fft.ifft(-(frequencies(size) ** 2)[:, None] * np.fft.fft(np.eye(size), axis=0), axis=0).real
    return expm(tau * (0.5 * covariance * bend - derivative(size) * drift))
