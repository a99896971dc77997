"""The extended Kalman-Bucy filter and smoother: a Gaussian that follows the linearised system, to compare with."""

from __future__ import annotations

from zakai.algebra.theorems import smooth_system as theorem
from zakai.methods._protocol import Backward, Method
from zakai.methods.gaussian.extended.backward import density as smoothed_density
from zakai.methods.gaussian.extended.backward import message, smoothed
from zakai.methods.gaussian.extended.backward import step as step_back
from zakai.methods.gaussian.extended.filter import Prepared, State, density, init, prepare, segment, step, valid
from zakai.models.angles import ONE_IMAGE
from zakai.models.features import CROSS_NOISE, INPUTS, LINEARISED

METHOD: Method[Prepared, State] = Method(
    name="extended-kalman-bucy",
    source="Jazwinski 1970, theorem 8.1 and its continuous-discrete form; explicit Euler as in Chen, Luo and Yau 2017, section V",
    exactness="approximate: the system is linearised at the mean; for a linear system second order in the interval "
    "(increments), exact for samples and constant coefficients",
    theorem=theorem,
    options={"riccati": "stable", "substeps": 1},
    prepare=prepare,
    init=init,
    step=step,
    density=density,
    state=State,
    bounds={
        "indefinite_cov": (1e-9, "the covariance has a negative eigenvalue (its share of the largest), or is not finite"),
        "other_image": ONE_IMAGE,
        "linearisation": (0.05, "deviations, or a share of a variance, by which a prediction of the linearised system is off"),
    },
    valid=valid,
    backward=Backward(message, step_back, smoothed, smoothed_density),
    handles=LINEARISED | {CROSS_NOISE, INPUTS},
    segment=segment,
)
