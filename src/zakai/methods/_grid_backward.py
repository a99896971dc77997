"""The backward pass of the methods that keep a density on a grid, by the number of states."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from zakai.errors import InputError
from zakai.methods._line_backward import BACKWARD as LINE
from zakai.methods._protocol import Backward, Info, Infos
from zakai.methods._reflecting_backward import BACKWARD as REFLECTING


def _of(prepared: Any) -> Backward[Any, Any, Any]:
    if prepared.model.n == 1:
        return REFLECTING if prepared.pieces else LINE
    from zakai.methods._space_backward import BACKWARD as SPACE

    return SPACE


def message(prepared: Any, state: Any) -> Any:
    """Return the message at the last time."""
    return _of(prepared).message(prepared, state)


def step(prepared: Any, k: int, later: Any, values: np.ndarray, state: Any) -> Any:
    """Return the message at the start of interval k."""
    return _of(prepared).step(prepared, k, later, values, state)


def smoothed(prepared: Any, state: Any, later: Any) -> tuple[Any, Info]:
    """Return the message, normalised, and the report of its product with the state."""
    return _of(prepared).smoothed(prepared, state, later)


def segment(prepared: Any, rows: slice, states: Sequence[Any], later: Any, values: np.ndarray) -> tuple[Any, Infos] | None:
    """Return the message at the start of the intervals of a slice and the reports after each, None for several states."""
    together = _of(prepared).segment
    return None if together is None else together(prepared, rows, states, later, values)


def density(prepared: Any, state: Any, later: Any) -> Any:
    """Return the smoothed density."""
    return _of(prepared).density(prepared, state, later)


def draw(
    prepared: Any, k: int, later: np.ndarray, values: np.ndarray, state: Any, rng: np.random.Generator
) -> tuple[np.ndarray, float]:
    """Return draws of the state at the start of interval k given those at its end.

    Raises:
        InputError: there are several states.
    """
    if prepared.model.n > 1:
        raise InputError(
            f"{prepared.model.source}: sample_paths: density grids draw paths of one state only; take kalman-bucy, benes, "
            "hu-yau or general-direct, where one holds"
        )
    one = _of(prepared).draw
    assert one is not None
    return one(prepared, k, later, values, state, rng)


def accuracy(prepared: Any) -> float:
    """Return the error of the evidence beyond which a result warns."""
    return _of(prepared).accuracy(prepared)


BACKWARD: Backward[Any, Any, Any] = Backward(message, step, smoothed, density, segment, draw, accuracy)
