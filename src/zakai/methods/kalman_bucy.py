"""The Kalman-Bucy filter, with time-varying coefficients, singular noise, and any prior.

    dx = (L x + l) dt + g dv,   dy = (C x + c) dt + dw:   P' = L P + P L' + G - P C'S^-1 C P,
    dm = (L m + l) dt + P C'S^-1 (dy - (C m + c) dt)

(Kalman and Bucy 1961), with y linear between observations and the evidence of the DMZ equation.  No Riccati equation is stepped:
a step is the linear-fractional transition of an interval (`zakai.numerics.families`).  A mixture of Gaussians stays
one, and a density becomes a family of them (Makowski 1986).
"""

from __future__ import annotations

from zakai.algebra.exact_theorems import kalman_bucy as theorem
from zakai.methods import _gaussian_families as families
from zakai.methods._gaussian_backward import BACKWARD
from zakai.methods._protocol import Method

METHOD: Method[families.Prepared, families.State] = Method(
    name="kalman-bucy",
    source="Kalman and Bucy 1961; other priors: Makowski 1986",
    exactness="exact for y that is linear between observations, and for samples",
    theorem=theorem,
    options={},
    prepare=families.prepare,
    init=families.init,
    step=families.step,
    density=families.density,
    state=families.State,
    bounds=families.BOUNDS,
    valid=families.valid,
    backward=BACKWARD,
)
