"""The on-and-offline filter of Yau and Yau for any smooth system, in one to four states.

Between observations the density obeys the Kolmogorov forward equation, which knows no data; what is observed multiplies it, or,
for increments with y linear between observations, acts inside of the equation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from zakai.algebra.theorems import any_smooth_system
from zakai.methods._options import tolerance_of
from zakai.methods._protocol import Method
from zakai.methods.line import filter as line_filter
from zakai.methods.line import tangents as line_tangents
from zakai.methods.line.backward import BACKWARD as LINE
from zakai.methods.line.model import in_pieces
from zakai.methods.line.prepared import Prepared, State
from zakai.methods.reflecting import filter as reflecting_filter
from zakai.methods.reflecting.backward import BACKWARD as REFLECTING
from zakai.models import features
from zakai.models.model import Model
from zakai.numerics.line.resolution import LOST_ALIASING
from zakai.records.schedule import Schedule

BOUNDS = {
    "tolerance_ratio": (
        1.0,
        "the error of a step exceeds the tolerance by this factor. Give more frequent observations, or a larger tolerance",
    ),
    "tail_depth": (1.0, "depth in the tails of the prediction to which an observation leads, divided by the accurate depth"),
    "aliasing": (1e-2, "share of the density that is finer than the grid: the mean may be off by as many deviations"),
    "outside_tables": (1e-4, "share of the mass where a table is constant beyond its range"),
    "without_law": (1e-6, "share of the mass where the law of the observation has no value, as for counts with a negative mean"),
}
# A tenth of a density that is finer than its grid, a step in which half of the density is unknown, and a sample where the density
# consists of rounding.
LOST = {"tail_depth": 1.0, "aliasing": LOST_ALIASING, "splitting_error": 0.5}
MANY = 4  # states that a grid is too coarse for
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


def prepare(model: Model, schedule: Schedule, theta: np.ndarray, *, tolerance: float | None = None) -> Prepared:
    """Return what is prepared for a schedule, for one state.

    Args:
        model: one state.
        schedule: the intervals.
        theta: parameters (p,).
        tolerance: bound on the error of a step: of the mean in standard deviations and of the log-likelihood; by default 1e-5
            for one state, 1e-3 for more.

    Raises:
        InputError: the tolerance is out of range.
    """
    return line_filter.prepare(model, schedule, theta, tolerance_of(tolerance, 1e-5), in_pieces(model))


def variant(model: Model, options: Mapping[str, Any]) -> Method[Any, Any]:
    """Return the method for the model's number of states and its domain."""
    if model.n == 1:
        return on_line(METHOD, model)
    from zakai.methods.space import kolmogorov as space_kolmogorov

    found = replace(in_space(METHOD, space_kolmogorov.prepare), bounded=space_kolmogorov.Prepared.bounded)
    # A grid of four states is limited by its memory: another tolerance changes neither its time nor its error for the better.
    return replace(found, shorter="take guided-particles") if model.n >= MANY else found


def on_line(method: Method[Any, Any], model: Model) -> Method[Any, Any]:
    """Return a method of one state with the functions for the domain and the kinks of a model."""
    if not in_pieces(model):
        return method
    return replace(
        method, init=reflecting_filter.init, step=reflecting_filter.step, density=reflecting_filter.density,
        state=reflecting_filter.State, valid=reflecting_filter.valid, segment=None, tangents=None, backward=REFLECTING,
    )  # fmt: skip


def in_space(method: Method[Any, Any], prepare: Callable[..., Any]) -> Method[Any, Any]:
    """Return a method with the functions for several states."""
    from zakai.methods.space import filter as space_filter
    from zakai.methods.space.backward import BACKWARD as SPACE

    return replace(
        method, prepare=prepare, init=space_filter.init, step=space_filter.step, density=space_filter.density,
        state=space_filter.State, valid=space_filter.valid, segment=None, tangents=None, for_interval=None, backward=SPACE,
    )  # fmt: skip


METHOD: Method[Any, Any] = Method(
    name="yau-yau",
    source="S.-T. Yau and S.S.-T. Yau 2008; likelihood online",
    exactness="convergent: spectral in x; with one state exact in time where no coefficient depends on t, and of fourth order in "
    "adaptive substeps elsewhere",
    theorem=any_smooth_system,
    options={"tolerance": None},
    prepare=prepare,
    init=line_filter.init,
    step=line_filter.step,
    density=line_filter.density,
    state=State,
    bounds=BOUNDS,
    losses=LOST,
    shorter="raise the option tolerance (command: --option tolerance=...)",
    variant=variant,
    valid=line_filter.valid,
    handles=HANDLES,
    segment=line_filter.segment,
    tangents=line_tangents.tangents,
    for_interval=line_filter.for_interval,
    backward=LINE,
)
