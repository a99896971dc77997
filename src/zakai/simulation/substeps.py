"""How many steps an interval of a simulation needs: |l| d of a step d is small for all eigenvalues l of the drift's slope."""

from __future__ import annotations

import numpy as np

from zakai.models import checks
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.numerics.arrays import Array
from zakai.records import Inputs

SUBSTEPS, SUBSTEPS_OF_STATE_DEPENDENT_NOISE, MOST = 10, 50, 1000  # of an interval of median length, and of one at most
STEEP = 0.25  # |l| d above which steps are too long
FINE, MOST_FINE = 0.2, 20_000  # |l| d of shorter ones, and the most of them in an interval
LOOKED_AT = 500  # states of a path at which the drift is differentiated
_STEP = 1e-6  # of the differences, relative to a state


def usual_counts(intervals: Array, model: Model) -> Array:
    """Return the steps of intervals (K,) of which no drift is known to be steep."""
    least = SUBSTEPS_OF_STATE_DEPENDENT_NOISE if checks.depends_on_state(model.diffusion, model) else SUBSTEPS
    relative = intervals / np.median(intervals[intervals > 0]) if (intervals > 0).any() else intervals
    return np.clip(np.ceil(least * relative * (1 - 1e-9)), least, MOST).astype(int)


def finer_counts(model: Model, grid: Array, states: Array, counts: Array, inputs: Inputs | None) -> Array | None:
    """Return the steps that the intervals of a path need, None where those that it has are short enough.

    Args:
        model: the system.
        grid: the ends of the intervals (K + 1,).
        states: those at some of the ends, from the first one on (J, n).
        counts: the steps that the path has (K,).
        inputs: the known inputs.
    """
    places = np.unique(np.linspace(0, len(states) - 1, min(len(states), LOOKED_AT)).astype(int))
    x, t = states[places], grid[places]
    u = None if inputs is None else inputs.at(t, model.input_hold)
    f = numpy_function(list(model.drift), model, (model.n,))
    apart = _STEP * (1.0 + np.abs(x))
    columns = []
    with np.errstate(all="ignore"):
        for j in range(model.n):
            move = np.zeros_like(x)
            move[:, j] = apart[:, j]
            columns.append((f(x + move, t, model.theta(), u) - f(x - move, t, model.theta(), u)) / (2.0 * apart[:, j : j + 1]))
        J = np.stack(columns, axis=-1)
        J = J[np.isfinite(J).all(axis=(1, 2))]
        if not len(J):
            return None
        rates = np.linalg.eigvals(J)
        length = np.diff(grid)
        step = float(np.max(length / counts))
    fastest = float(np.abs(rates).max())
    if fastest * step <= STEEP:
        return None
    return np.clip(np.ceil(length * fastest / FINE), counts, MOST_FINE).astype(int)
