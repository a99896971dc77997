"""The filtering density of a system with increments, y running linearly between observations: the DMZ equation on a box.

    sigma_t = 1/2 G:Hess sigma - f.grad sigma - (div f + 1/2 h'S^-1 h - h'S^-1 dy/dt) sigma

Fourier collocation and DOP853, as in `references.kolmogorov`; the rate of y is part of the potential.
"""

from __future__ import annotations

import numpy as np

from references.kolmogorov import Box, propagate


def dmz(box: Box, sigma, times, increments, drift, divergence, covariance, h, S, start=0.0, tolerance=1e-13):
    """sigma after each observation; `drift`, `divergence` and `h` are functions of x (..., n) and t."""
    out, precision = [], np.linalg.inv(S)
    for stop, dy in zip(times, increments, strict=True):
        rate = dy / (stop - start)

        def potential(x, t, rate=rate):
            values = h(x, t)
            return np.einsum("...i,ij,...j->...", values, precision, values - 2.0 * rate)

        sigma = propagate(box, sigma, start, stop, drift, divergence, covariance, potential, tolerance)
        out.append(sigma)
        start = stop
    return out
