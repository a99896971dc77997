"""The probability that a grid loses at a natural end which the process nearly reaches.

Outside of a grid the density is zero, so that the grid absorbs the paths that leave it.  Near a natural end, at the distance d,
let the drift be f and G = g^2 ~ d^k, with kappa = 2 f d / G.  Paths come as near as d with a probability ~ d^(kappa - 1), and the
density of log d is ~ d^(kappa + 1 - k).  A grid that ends where that density is e loses about e^p,

    p = (kappa - 1) / (kappa + 1 - k).

At the limit of Feller, kappa = 1, that is no small number for any e.  Finite volumes without flux at their ends lose nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.methods.line.coarse import EDGE
from zakai.methods.line.domain import variable_of
from zakai.methods.line.system import Prepared
from zakai.methods.line.tables import covariance_at
from zakai.numerics.line import window as lw

Array = Any

ALLOWED = 0.1  # of the tolerance: the probability that a transition may lose
REACH = 8.0  # standard deviations of the noise within which an end counts
FAR = np.array([10.0, 20.0])  # logarithms of the distance, relative to the density, at which coefficients are powers of it
GROWS = 0.1  # exponent of the noise below which it does not grow towards an end


def lost(total: float) -> float:
    """Return the probability that a transition of a density with the mass one lost, from the mass after it."""
    return abs(total - 1.0)


def ends_of_leak(prepared: Prepared, window: lw.Window, ends: Array, start: float, length: float) -> Array | None:
    """Return offsets (2,) beyond which there is no density after an interval, None where a grid loses no more than is allowed.

    Args:
        prepared: the system.
        window: the grid.
        ends: the ends of the density as offsets from the origin (2,).
        start, length: the interval.
    """
    variable = variable_of(prepared.model)
    if variable is None:
        return None
    system, theta = prepared.system, prepared.theta.real
    found, leaking = np.array(ends, float), False
    for i, (own, end, side) in enumerate(zip((variable.lower, variable.upper), ends, (-1.0, 1.0), strict=True)):
        points = window.origin + float(end) + side * np.concatenate([[0.0], FAR])
        drift = system.drift(points[:, None], start, theta)[:, 0].real
        noise = covariance_at(system, points, start, theta).real * np.ones(3)
        # The noise at the end of the density counts, by which it may reach the end of the domain.
        if not np.isfinite(own) or not noise[0] * length * REACH**2 > 1.0 or not (np.isfinite(drift) & (noise > 0)).all():
            continue
        grows = float(np.log(noise[2] / noise[1]) / (FAR[1] - FAR[0]))  # 2 - k
        inward = max(float(-2.0 * side * drift[1] / noise[1]), 0.0)  # kappa - 1
        if grows > GROWS and EDGE ** (inward / (inward + grows)) > ALLOWED * prepared.tolerance:
            leaking = True
            found[i] += side * -np.log(EDGE) / (inward + grows)
    return found if leaking else None
