"""Filters on density grids for two to four states: `yau-yau` for any smooth system, `limited-direct` for Yau systems.

Both keep a density on a uniform affine grid that follows the mass; they differ in what moves it between observations, which is
what their `Prepared` does.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.densities import Density
from zakai.methods._protocol import Info


class State(NamedTuple):
    """The density `values` (*sizes), of integral one, at `centre` + `basis` (i - size // 2), and what is known of the errors.

    `rate`, `measured`, `age` and `fixed` control the substeps, `deviations` (n,) are those of the density for which `rate` was
    measured, `error` is the estimate of the relative error of the density, `kept` the share of it that an interval leaves.
    `logarithmic`: the grid is that of logarithms of some states (`space/logarithms.py`).
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
    logarithmic: bool = False


def init(prepared: Any, prior: Any) -> State:
    """Return the prior on a grid."""
    state: State = prepared.init(prior)
    return state


def step(prepared: Any, k: int, state: State, values: np.ndarray) -> tuple[State, Info]:
    """Return the state after interval k and its observation, and what the step reports."""
    result: tuple[State, Info] = prepared.of(state).step(k, state, values)
    return result


def density(prepared: Any, state: State) -> Density:
    """Return the posterior on its grid."""
    prepared = prepared.of(state)
    found: Density = prepared.posterior(prepared.density(state))
    return found


def valid(prepared: Any, state: State) -> bool:
    """Return whether the arrays of a state fit together and to the model."""
    n = prepared.model.n
    values = np.asarray(state.values)
    shapes = values.ndim == n and np.shape(state.centre) == np.shape(state.deviations) == (n,)
    shapes = shapes and np.shape(state.basis) == (n, n)
    if not shapes or min(values.shape) < 1 or not np.all(np.isfinite(values)):
        return False
    return bool(np.isfinite(state.centre).all() and np.isfinite(state.basis).all() and abs(np.linalg.det(state.basis)) > 0)
