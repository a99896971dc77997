"""Every method by its name, own or of another library: one list; a module is loaded when its method is used.

When one holds is said by `algebra.theorems.theorem_of` under the same name.
"""

from __future__ import annotations

import difflib
from importlib import import_module
from typing import Any, NamedTuple

from zakai.errors import InputError


class Entry(NamedTuple):
    """Where a method is: the module that defines its METHOD; and what it is, in a line."""

    module: str
    summary: str


METHODS = {
    "kalman-bucy": Entry(
        "zakai.methods.gaussian.kalman_bucy",
        "exact for linear systems in any number of states, whatever the prior; singular noise is allowed",
    ),
    "conditionally-gaussian": Entry(
        "zakai.methods.gaussian.conditionally_gaussian",
        "exact for f and h that are affine in x, with coefficients that depend on what is observed",
    ),
    "benes": Entry(
        "zakai.methods.gaussian.benes",
        "exact for affine h and a drift L x + l + G grad log cosh(q.x + delta), in any number of states",
    ),
    "hu-yau": Entry(
        "zakai.methods.gaussian.hu_yau",
        "exact for affine h and a drift L x + l + G grad F whose eta is quadratic, whatever the prior",
    ),
    "limited-direct": Entry(
        "zakai.methods.grid.limited_direct",
        "exact between observations for time-varying Yau systems whose q is quadratic, in one to three states",
    ),
    "general-direct": Entry(
        "zakai.methods.sums.general_direct",
        "a Gaussian sum for time-varying Yau systems of any dimension; exact where h is affine and v0 a Gaussian sum",
    ),
    "gaussian-sum": Entry(
        "zakai.methods.sums.gaussian_sum",
        "the same for systems that do not depend on time (the survey's Algorithm 2); only when it is named",
    ),
    "wei-norman": Entry(
        "zakai.methods.series.wei_norman",
        "for finite estimation algebras in one to three states, exp(t L0) on a grid; only when it is named",
    ),
    "yau-yau": Entry(
        "zakai.methods.grid.yau_yau",
        "convergent for any smooth system in one to four states: the Kolmogorov equation on a grid that follows the density",
    ),
    "kolmogorov-series": Entry(
        "zakai.methods.series.kolmogorov_series",
        "convergent for one state and any smooth f without time: the explicit series of the kernel; only when it is named",
    ),
    "tensor-train": Entry(
        "zakai.methods.frame.tensor_train",
        "convergent for smooth systems in two to eight states: a tensor train in a frame that follows the density",
    ),
    "guided-particles": Entry(
        "zakai.methods.particles.guided_particles",
        "convergent for any model in any number of states: particles, with standard errors of what they give",
    ),
    "extended-kalman-bucy": Entry(
        "zakai.methods.gaussian.extended.extended_kalman_bucy",
        "approximate for formulas with a derivative almost everywhere: linearised at the mean; only when it is named",
    ),
}
# Filters of other libraries, to compare with: never taken by "auto", and each needs the extra `peers`.
EXTRA = "peers"
PEERS = {
    "ekf": Entry("zakai.peers.ekf", "the extended Kalman filter of dynamax: approximate for any smooth system, one Gaussian"),
    "ukf": Entry("zakai.peers.ukf", "the unscented Kalman filter of dynamax: approximate for any smooth system, one Gaussian"),
    "enkf": Entry("zakai.peers.enkf", "the ensemble Kalman filter of cuthbert: approximate for any smooth system, by sampling"),
    "particle": Entry(
        "zakai.peers.particle", "the bootstrap particle filter of cuthbert: convergent for any smooth system, by sampling"
    ),
}
# What "auto" tries, most exact and cheapest first; the last holds for any model.
AUTO = (
    "kalman-bucy",
    "conditionally-gaussian",
    "benes",
    "hu-yau",
    "limited-direct",
    "general-direct",
    "yau-yau",
    "tensor-train",
    "guided-particles",
)


def load(name: str) -> Any:
    """The METHOD of that name; InputError for an unknown one, and where its library is not installed."""
    if name in METHODS:
        return import_module(METHODS[name].module).METHOD
    if name in PEERS:
        try:
            return import_module(PEERS[name].module).METHOD
        except ModuleNotFoundError as error:
            missing = (error.name or "a library").partition(".")[0]
            if missing == "zakai":
                raise
            raise InputError(f"{name}: {missing} is not installed; pip install 'zakai[{EXTRA}]'") from error
    close = difflib.get_close_matches(name, [*METHODS, *PEERS], n=1)
    hint = f'; did you mean "{close[0]}"? The' if close else "; the"
    names = f"auto, {', '.join(METHODS)}; of other libraries: {', '.join(PEERS)}"
    raise InputError(f'there is no method "{name}"{hint} methods are {names}')
