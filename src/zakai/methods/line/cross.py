"""The equation of one state whose noise is correlated with that of the observations: E dv dw' = C dt.

With a = g C, K = S^-1 and y linear between observations,

    u_t = ((G - a K a') u)'' / 2 - ((f - a K h - a_x K a' / 2 + a K dy/dt) u)' + (h'K dy/dt - h'K h / 2 - h_x'K a' / 2) u,

which is u_t = L u - sum K_ij M_i M_j u / 2 + sum K_ij (dy_j/dt) M_i u with M_i u = h_i u - (a_i u)', the Zakai equation in the
sense of Stratonovich.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.methods.line.system import Prepared
from zakai.methods.line.tables import finite

Array = Any


def with_cross_noise(
    prepared: Prepared,
    points: Array,
    times: Array,
    rates: Array,
    h: Array,
    precision: Array,
    coefficients: tuple[Array, Array, Array, Array],
) -> tuple[Array, Array, Array, Array]:
    """Return the coefficients of the equation with correlated noise from those with independent noise.

    Args:
        prepared: the system.
        points: the points (N, 1) or (T, N, 1).
        times: (T,).
        rates: dy/dt (m,).
        h: (T, m, N).
        precision: K (T, m, m), zero for coordinates that do not act inside of the interval.
        coefficients: f (T, N), G (T,) or (T, N), the potential (T, N) and its constant (T,).
    """
    drift, covariance, potential, constant = coefficients
    parts = prepared.system.cross(points, times[:, None], prepared.theta)  # type: ignore[misc]
    cross, slope, h_slope = np.moveaxis(finite(parts), (2, 3), (0, 2))
    gain = precision @ cross
    covariance = np.broadcast_to(covariance[..., None] if covariance.ndim == 1 else covariance, drift.shape)
    rest = covariance - np.sum(gain * cross, axis=1)
    rest = np.where(rest.real > 1e-13 * covariance.real, rest, 0.0)
    drift = drift - np.sum(gain * (finite(h) - rates[:, None] + 0.5 * slope), axis=1)
    return drift, rest, potential - 0.5 * np.sum(gain * h_slope, axis=1), constant
