"""The direct method for time-varying Yau systems, on a grid, in one to three states.

Chen, Luo and Yau (2017), Theorems 1 to 3, corrected and freed of Assumption 2: for f = L x + l + G grad phi and a quadratic q the
gauge u = e^phi v makes the Kolmogorov equation linear-quadratic, so that its kernel is Gaussian for any interval.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from zakai.algebra.theorems import limited_direct
from zakai.methods._options import one_of, tolerance_of
from zakai.methods._protocol import Method
from zakai.methods.grid.yau_yau import METHOD as YAU_YAU
from zakai.methods.grid.yau_yau import in_space, on_line
from zakai.methods.line import filter as line_filter
from zakai.methods.line.model import in_pieces
from zakai.methods.line.yau import yau_line_of
from zakai.methods.yau.system import power_series_of
from zakai.models import features
from zakai.models.model import Model
from zakai.models.prior import GaussianPrior, MixturePrior
from zakai.records.schedule import Schedule


def prepare(
    model: Model,
    schedule: Schedule,
    theta: np.ndarray,
    *,
    kernel: str = "flow",
    splitting: str = "strang",
    tolerance: float | None = None,
) -> Any:
    """Return what is prepared for a schedule.

    Args:
        model: one to three states.
        schedule: the intervals.
        theta: parameters (p,).
        kernel: how the Gaussian kernel of an interval is computed: "flow", the affine Hamiltonian flow, or "power-series",
            Theorem 3, with intervals divided where the series does not converge.  The series has no inputs: increments of an
            affine h act as those of a nonlinear h.
        splitting: of increments with nonlinear h.  "strang", the default: with one state the equation with y linear between
            observations is solved to the tolerance, with more the observation acts in two halves.  "lie" is the order of the
            papers, the transition with -h'S^-1 h / 2 inside and then exp(h'S^-1 dy).
        tolerance: bound on the error of a step: of the mean in standard deviations and of the log-likelihood; by default 1e-7
            for one state, with substeps for 1e-9.

    Raises:
        InputError: another word, or a tolerance that is out of range.
        ConditionError: with the series, a singular G, or a coefficient that is not analytic in time.
    """
    one_of("kernel", kernel, ("flow", "power-series"))
    one_of("splitting", splitting, ("strang", "lie"))
    if model.n > 1:
        from zakai.methods.space import direct as space_direct

        options: dict[str, Any] = {"splitting": splitting, "tolerance": tolerance, "kernel": kernel}
        return space_direct.prepare(model, schedule, theta, **options)
    prepared = line_filter.prepare(model, schedule, theta, tolerance_of(tolerance, 1e-9), in_pieces(model))
    prior = model.prior
    prepared = replace(
        prepared, promised=1e-7 if tolerance is None else prepared.tolerance,
        yau=yau_line_of(model), lie=splitting == "lie", series=power_series_of(model) if kernel == "power-series" else None,
        origin=float(prior.mean[0]) if isinstance(prior, GaussianPrior | MixturePrior) else 0.0,
    )  # fmt: skip
    prepared.kernels  # noqa: B018  # which fails where a series does not hold
    return prepared


def variant(model: Model, options: Mapping[str, Any]) -> Method[Any, Any]:
    """Return the method for the model's number of states and its kinks."""
    return on_line(METHOD, model) if model.n == 1 else in_space(METHOD, prepare)


METHOD: Method[Any, Any] = replace(
    YAU_YAU,
    name="limited-direct",
    source="Chen, Luo and Yau 2017, Theorems 1-3, corrected; x-coordinate form",
    exactness="exact between observations for every h in the class; increments with y linear between observations, with one "
    "state to the tolerance, with more by a symmetric splitting where h is nonlinear",
    theorem=limited_direct,
    options={"kernel": "flow", "splitting": "strang", "tolerance": None},
    prepare=prepare,
    variant=variant,
    handles=features.OF_OBSERVATION | {features.INPUTS, features.JUMPS, features.KINKS, features.SINC, features.TABLES},
)
