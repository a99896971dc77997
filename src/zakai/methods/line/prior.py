"""The prior of one state on a grid that fits it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from zakai.errors import InputError
from zakai.methods.line.domain import variable_of
from zakai.methods.line.system import Prepared, State
from zakai.models.numeric import numpy_function
from zakai.models.prior import DensityPrior
from zakai.numerics.line import window as lw
from zakai.numerics.line.window import Window
from zakai.numerics.prior_grid import mixture_log_density, prior_grid

Array = Any
# The smallest value that counts of a prior with natural ends, relative to the largest: farther out, rounding in the transition
# exceeds the mass, since the coefficients of the variable w grow exponentially.
CUT_OF_DOMAIN = 1e-8
SMOOTH = 1e-6  # spectrum at the end of that of a prior beyond which it is averaged around the grid points
_PLACES = 256  # in a spacing, to which the place of a jump is known


def averaged(evaluate: Callable[[Array], Array], window: Window) -> Array:
    """Return a density with a kink or a jump as averages around the grid points, which keep its mass and its mean.

    The weights are those of linear interpolation, so that a jump between two points has its place.
    """
    place = (np.arange(2 * _PLACES) + 0.5) / _PLACES - 1.0
    points = window.points[:, None] + window.spacing * place
    logs = evaluate(points.reshape(-1, 1)).reshape(points.shape)
    logs = np.where(np.isnan(logs.real), -np.inf, logs)
    values = np.exp(logs - np.max(logs.real)) @ (1.0 - np.abs(place))
    return np.asarray(values / np.sum(values))


def state_of(values: Array, window: lw.Window, error: float, log_floor: float) -> State:
    """Return the state of probabilities on a grid."""
    return State(values, window.origin, window.centre, window.spacing, window.unit, window.closed, error, log_floor)


def init(prepared: Prepared, prior: Any) -> State:
    """Return the prior on a grid that fits it."""
    model, closed, variable = prepared.model, bool(prepared.model.periodic), variable_of(prepared.model)
    if isinstance(prior, DensityPrior):
        function, log_density = numpy_function([prior.log_density], model, (1,)), None

        def evaluate(points: Array) -> Array:
            return function(points if variable is None else variable.x(points), model.start, prepared.theta)[..., 0]

    else:
        weights, means, covs = prior.components
        deviations = np.sqrt(covs[:, 0, 0])
        if np.any(deviations <= 1e-14 * np.abs(means[:, 0])):
            raise InputError("prior: a variance is zero; a grid needs a density, so give it a small variance")
        log_density = mixture_log_density(weights, means, covs, [closed])
        if variable is not None:
            mixture, log_density = log_density, None

            def evaluate(points: Array) -> Array:
                return mixture(np.array([variable.end]), variable.offset(points))

    if variable is not None:
        of_state = evaluate

        def evaluate(points: Array) -> Array:
            with np.errstate(all="ignore"):
                return of_state(points) + variable.log_slope(points)[..., 0]

    cut = lw.CUT if variable is None else CUT_OF_DOMAIN
    if log_density is None:
        tolerance = 1e-12 if variable is None else cut
        grid = prior_grid(lambda points: evaluate(points).real, 1, [closed], tolerance=tolerance)
        low, high = (float(grid.points[i, 0]) for i in (0, -1))
        # Rather too coarse than without a part of the mass.
        spacing = max(float(grid.basis[0, 0]), (high - low) / (lw.LARGE - 2 * lw.ALIGNMENT))
    else:
        depth = float(np.sqrt(-2.0 * np.log(cut))) + 0.1
        low, high = float(np.min(means[:, 0] - depth * deviations)), float(np.max(means[:, 0] + depth * deviations))
        spacing = float(deviations.min()) / 3.0
    if closed:
        size = lw.size_for(2 * np.pi / min(spacing * 0.95, 2 * np.pi / 64))
        window = Window(0.0, 0.0, 2 * np.pi / size, size, True, 1.0)
    else:
        origin = 0.5 * (low + high)
        window = Window(origin, 0.0, spacing, 0, False, spacing)
        window = lw.quantized(window, low - origin, high - origin, spacing, margin=0.0, most=lw.LARGE)
    for attempt in range(8):
        if log_density is None:
            points = window.points[:, None]
            logs = evaluate(np.pi - np.mod(np.pi - points, 2 * np.pi) if closed else points)
            logs = np.where(np.isnan(logs.real), -np.inf, logs)
        else:
            logs = log_density(np.array([window.origin]), window.offsets[:, None])
        values = np.exp(logs - np.max(logs.real))
        values = values / np.sum(values)
        look = lw.figures(values, closed, cut=cut)
        new = lw.fitted(look, window, lw.LARGE)
        if new == window or attempt == 7:  # the values belong to this window
            break
        window = new
    if log_density is None and not closed and look.aliasing > SMOOTH:
        values = averaged(evaluate, window)
    return state_of(values, window, max(0.0, look.aliasing - 1e-12), -700.0)
