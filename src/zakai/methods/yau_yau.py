"""The on-and-offline filter of Yau and Yau for any smooth system, in one to four states.

Between observations the density obeys the Kolmogorov forward equation, which knows no data; what is observed multiplies it, or,
for increments with y linear between observations, acts inside of the equation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from zakai.algebra.theorems import any_smooth_system
from zakai.methods import _line, _reflecting
from zakai.methods._grid_backward import BACKWARD
from zakai.methods._line_model import in_pieces
from zakai.methods._line_system import State
from zakai.methods._protocol import Info, Infos, Method
from zakai.models import features
from zakai.models.model import Model
from zakai.records.schedule import Schedule

BOUNDS = {
    "tolerance_ratio": (
        1.0,
        "the error of a step exceeds the tolerance by this factor. Give more frequent observations, or a larger tolerance",
    ),
    "tail_depth": (1.0, "depth in the tails of the prediction to which an observation leads, divided by the accurate depth"),
    "outside_tables": (1e-4, "share of the mass where a table is constant beyond its range"),
    "without_law": (1e-6, "share of the mass where the law of the observation has no value, as for counts with a negative mean"),
}
HANDLES = features.OF_OBSERVATION | {
    features.CROSS_NOISE,
    features.DOMAIN,
    features.INPUTS,
    features.JUMPS,
    features.KINKS,
    features.SINC,
    features.STATE_DEPENDENT_DIFFUSION,
    features.TABLES,
}


def module_of(model: Model) -> Any:
    """Return the module with `init`, `step`, `density` and `valid` for the model's number of states and its domain."""
    if model.n == 1:
        return _reflecting if in_pieces(model) else _line
    from zakai.methods import _space

    return _space


def prepare(model: Model, schedule: Schedule, theta: np.ndarray, *, tolerance: float | None = None) -> Any:
    """Return what is prepared for a schedule.

    Args:
        model: one to four states.
        schedule: the intervals.
        theta: parameters (p,).
        tolerance: bound on the error of a step: of the mean in standard deviations and of the log-likelihood; by default 1e-5
            for one state, 1e-3 for more.

    Raises:
        InputError: the tolerance is out of range.
    """
    if model.n > 1:
        return module_of(model).prepare(model, schedule, theta, tolerance=tolerance)
    return _line.prepare(model, schedule, theta, 1e-5 if tolerance is None else tolerance, in_pieces(model))


def init(prepared: Any, prior: Any) -> Any:
    """Return the prior on a grid."""
    return module_of(prepared.model).init(prepared, prior)


def step(prepared: Any, k: int, state: Any, values: np.ndarray) -> tuple[Any, Info]:
    """Return the state after interval k and its observation, and the report."""
    result: tuple[Any, Info] = module_of(prepared.model).step(prepared, k, state, values)
    return result


def segment(prepared: Any, rows: slice, state: Any, values: np.ndarray) -> tuple[Sequence[Any], Infos] | None:
    """Return the states after the intervals of a slice, and their reports, for one state without reflecting ends."""
    return _line.segment(prepared, rows, state, values) if module_of(prepared.model) is _line else None


def density(prepared: Any, state: Any) -> Any:
    """Return the density of a state."""
    return module_of(prepared.model).density(prepared, state)


def valid(prepared: Any, state: Any) -> bool:
    """Return whether the arrays of a state fit together."""
    return bool(module_of(prepared.model).valid(prepared, state))


METHOD: Method[Any, Any] = Method(
    name="yau-yau",
    source="S.-T. Yau and S.S.-T. Yau 2008; likelihood online",
    exactness="convergent: spectral in x; with one state exact in time where no coefficient depends on t, and of fourth order in "
    "adaptive substeps elsewhere",
    theorem=any_smooth_system,
    options={"tolerance": None},
    prepare=prepare,
    init=init,
    step=step,
    density=density,
    state=State,
    bounds=BOUNDS,
    shorter="raise the option tolerance (command: --option tolerance=...)",
    valid=valid,
    handles=HANDLES,
    segment=segment,
    backward=BACKWARD,
)
