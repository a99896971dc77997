"""The Kalman-Bucy filter, with time-varying coefficients, singular noise, and any prior.

    dx = (L x + l) dt + g dv,   dy = (C x + c) dt + dw,   E dv dw' = N dt,   K = (P C' + g N) S^-1:
    P' = L P + P L' + G - K S K',   dm = (L m + l) dt + K (dy - (C m + c) dt)

(Kalman and Bucy 1961), with y linear between observations and the evidence of the DMZ equation.  The coefficients may depend on
time and on known inputs.  No Riccati equation is stepped:
a step is the linear-fractional transition of an interval (`zakai.numerics.families`).  A mixture of Gaussians stays
one, and a density becomes a family of them (Makowski 1986).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from zakai.algebra.exact_theorems import kalman_bucy as theorem
from zakai.methods._protocol import Method
from zakai.methods.gaussian import angles, families
from zakai.methods.gaussian.backward import BACKWARD
from zakai.models.features import CROSS_NOISE, INPUTS, JUMPS, KINKS, OBSERVED_ANGLES, SINC
from zakai.models.model import Model


def _variant(model: Model, options: Mapping[str, Any]) -> Method[Any, Any]:
    return OF_ANGLES if OBSERVED_ANGLES in model.features else METHOD


METHOD: Method[Any, families.State] = Method(
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
    handles=frozenset({CROSS_NOISE, INPUTS, JUMPS, KINKS, OBSERVED_ANGLES, SINC}),
    segment=families.segment_of_families,
    backward=BACKWARD,
    variant=_variant,
)
OF_ANGLES: Method[Any, families.State] = replace(
    METHOD,
    exactness=f"{METHOD.exactness}; of an observed angle the nearest image is taken",
    prepare=angles.prepare,
    init=angles.init,
    step=angles.step,
    density=angles.density,
    bounds=angles.BOUNDS,
    valid=angles.valid,
    segment=None,
    backward=angles.BACKWARD,
    variant=None,
)
