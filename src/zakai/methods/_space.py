"""Filters on density grids for two to four states: `yau-yau` for any smooth system, `limited-direct` for Yau systems.

`prepare`, `init`, `step` and `density` dispatch on the method.  Both keep a density on a uniform affine grid that follows the
mass; they differ in what moves it between observations.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.densities.grid import GridDensity
from zakai.methods._protocol import Info
from zakai.models.model import Model
from zakai.records.schedule import Schedule

BOUNDS: dict[str, tuple[float, str]] = {
    "tolerance_ratio": (
        1.0,
        "the error of a step exceeds the tolerance by this factor. Give more frequent observations, or a larger tolerance",
    ),
    "tail_depth": (1.0, "depth in the tails of the prediction to which an observation leads, divided by the accurate depth"),
}


class State(NamedTuple):
    """The density `values` (*sizes), of integral one, at `centre` + `basis` (i - size // 2), and what is known of the errors.

    `rate`, `measured`, `age` and `fixed` control the substeps, `deviations` (n,) are those of the density for which `rate` was
    measured, `error` is the estimate of the relative error of the density, `kept` the share of it that an interval leaves.
    """

    values: np.ndarray
    centre: np.ndarray
    basis: np.ndarray
    rate: float
    measured: float
    age: int
    fixed: bool
    deviations: np.ndarray
    error: float
    kept: float


def prepare(
    model: Model,
    schedule: Schedule,
    theta: np.ndarray,
    tolerance: float | None = None,
    *,
    method: str = "yau-yau",
    **options: Any,
) -> Any:
    """Return what is known without data; `options` are those of the method."""
    if method == "limited-direct":
        return prepare_direct(model, schedule, theta, tolerance=tolerance, **options)
    from zakai.methods import _space_kolmogorov

    return _space_kolmogorov.prepare(model, schedule, theta, tolerance=tolerance, **options)


def prepare_direct(
    model: Model,
    schedule: Schedule,
    theta: np.ndarray,
    *,
    splitting: str = "strang",
    tolerance: float | None = None,
    **options: Any,
) -> Any:
    """Return what `limited-direct` knows without data."""
    from zakai.methods import _space_direct

    return _space_direct.prepare(model, schedule, theta, splitting=splitting, tolerance=tolerance, **options)


def init(prepared: Any, prior: Any) -> State:
    """Return the prior on a grid."""
    state: State = prepared.init(prior)
    return state


def step(prepared: Any, k: int, state: State, values: np.ndarray) -> tuple[State, Info]:
    """Return the state after interval k and its observation, and what the step reports."""
    result: tuple[State, Info] = prepared.step(k, state, values)
    return result


def density(prepared: Any, state: State) -> GridDensity:
    """Return the posterior on its grid."""
    model: Model = prepared.model
    field = prepared.density(state)
    with np.errstate(divide="ignore"):
        logs = np.log(np.maximum(field.values.real, 0.0))
    return GridDensity(logs, field.grid.centre, field.grid.basis, model.state, prepared.angles)


def valid(prepared: Any, state: State) -> bool:
    """Return whether the arrays of a state fit together and to the model."""
    n = prepared.model.n
    values = np.asarray(state.values)
    shapes = values.ndim == n and np.shape(state.centre) == np.shape(state.deviations) == (n,)
    shapes = shapes and np.shape(state.basis) == (n, n)
    if not shapes or min(values.shape) < 1 or not np.all(np.isfinite(values)):
        return False
    return bool(np.isfinite(state.centre).all() and np.isfinite(state.basis).all() and abs(np.linalg.det(state.basis)) > 0)
