"""A prior of one state that no grid resolves: one with a kink or a jump."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from zakai.numerics.line_window import Window

Array = Any
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
