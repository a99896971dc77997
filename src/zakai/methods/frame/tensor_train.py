"""Densities of two to eight states as tensor trains in a moving frame."""

from __future__ import annotations

import numpy as np

from zakai.algebra.theorems import tensor_train as theorem
from zakai.errors import InputError
from zakai.methods._options import real_number, whole_number
from zakai.methods._protocol import Method
from zakai.methods.frame.backward import BACKWARD
from zakai.methods.frame.filter import density, init, step
from zakai.methods.frame.motion import system_of
from zakai.methods.frame.state import Choices, Prepared, State
from zakai.methods.frame.validity import valid
from zakai.models import features
from zakai.models.model import Model
from zakai.records.schedule import Schedule

FEW_STATES = 3
TOLERANCES = (1e-3, 5e-3)  # of the mean in standard deviations, for two and three states and for more
MOST_RANK, MOST_TOLERANCE = 24, 0.1


def prepare(
    model: Model, schedule: Schedule, theta: np.ndarray, *, tolerance: float | None = None, most_rank: int = MOST_RANK,
    choices: Choices | None = None,
) -> Prepared:
    """Return the programs of the formulas.

    Args:
        model: the system.
        schedule: its K intervals.
        theta: values of the parameters (p,).
        tolerance: the wanted error of a mean, in standard deviations; by default 1e-3 for two and three states, 5e-3 for more.
        most_rank: the largest rank of a train; a density that needs more is reported.
        choices: those of a run at neighbouring parameters, which are taken again; an empty `Choices()` keeps those of this run.

    Raises:
        InputError: another value of an option.
    """
    default = TOLERANCES[model.n > FEW_STATES] if tolerance is None else tolerance
    tolerance = real_number("tolerance", default, "a number from 1e-6 to 0.1", lambda value: 1e-6 <= value <= MOST_TOLERANCE)
    if not isinstance(choices, Choices | None):
        raise InputError("choices: expected what `fit` keeps of a run, or nothing")
    if choices is not None:
        tolerance = min(choices.coarser * tolerance, MOST_TOLERANCE)
    rank, system = whole_number("most_rank", most_rank, 2, 200), system_of(model)
    return Prepared(system, np.asarray(theta, float), schedule, tolerance, rank, None if system.kicked else choices)


BOUNDS = {
    "tolerance_ratio": (
        1.0, "the estimated error of the density exceeds what the tolerance allows by this factor. Raise most_rank, give more "
        "frequent observations or a larger tolerance, or compare with guided-particles",
    ),
    "tail_depth": (
        1.0, "depth in the tails of the prediction to which an observation leads, divided by the accurate depth. Lower the "
        "tolerance, or compare with guided-particles",
    ),
    "outside_tables": (1e-3, "share of the mass where a table is constant beyond its range"),
    "off_grid_error": (
        0.05, "share by which the density may be wrong: a part of little mass may be missing, and standard deviations too small. "
        "Raise most_rank, or compare with guided-particles",
    ),
    "unknown_draws": (
        0.01, "share of the smoother's draws to which the filter's density does not lead: a Gaussian stands for it. Compare with "
        "guided-particles",
    ),
}  # fmt: skip

METHOD: Method[Prepared, State] = Method(
    name="tensor-train",
    source="Oseledets and Tyrtyshnikov 2010 (cross interpolation)",
    exactness="convergent: tensor trains of quintic B-splines in a frame that follows the density; of second order in a substep, "
    "whose error is measured by points",
    theorem=theorem,
    options={"tolerance": None, "most_rank": MOST_RANK},
    prepare=prepare,
    init=init,
    step=step,
    density=density,
    state=State,
    bounds=BOUNDS,
    differentiable=False,
    by_values=Choices,
    cautious=False,
    backward=BACKWARD,
    valid=valid,
    shorter="raise the option tolerance (command: --option tolerance=...)",
    handles=frozenset(features.ASSUMPTIONS) - {features.OBSERVED_PATH},
)
